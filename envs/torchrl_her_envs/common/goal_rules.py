"""What is found out about the rewards and ends of an environment that is not of this package."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Literal, cast, get_args

import numpy as np

Termination = Literal["auto", "success", "reward", "never"]
Ends = Literal["own", "success", "reward", "never"]

_LOGGER = logging.getLogger("torchrl_her_envs")
_MOST_VALUES = 2  # different rewards of goals that are not achieved, in a sparse reward
_SHOWN = 3  # rewards in a message
_DIGITS = 5  # in which rewards must differ to be different
_said: set[str] = set()


def say_once(line: str) -> None:
    """Logs a line, the first time that it is said in this process."""
    if line not in _said:
        _said.add(line)
        _LOGGER.info(line)


def warn_once(line: str) -> None:
    """Logs a warning, the first time in this process; nothing if the line is empty.

    Without any handler, Python prints such a record as one line; a ``UserWarning`` would be two, with code.
    """
    if line and line not in _said:
        _said.add(line)
        _LOGGER.warning(line)


def check_termination(word: str) -> Termination:
    """Returns the word, if it is one of the values of ``termination``.

    Raises:
        ValueError: it is none of them.

    Example:
        >>> check_termination("sucess")
        Traceback (most recent call last):
        ValueError: termination must be one of auto, success, reward, never, got 'sucess'
    """
    allowed = get_args(Termination)
    if word not in allowed:
        raise ValueError(f"termination must be one of {', '.join(allowed)}, got {word!r}")
    return cast(Termination, word)


def choose_ends(
    name: str,
    termination: Termination,
    *,
    has_own: bool,
    achieved: np.ndarray,
    terminated: np.ndarray,
    tells_success: bool,
) -> Ends:
    """What ends an episode at its goal, by what the user said or by what some steps showed.

    The environment's own function decides if it has one. If it has none, ``auto`` looks at steps in which
    the goal was achieved: an environment that went on in one of them never ends there. If it ended, or if
    no step achieved the goal, episodes end at their goals, as ``info["is_success"]`` tells, or else the
    reward. That is a rule which can be held for real and virtual goals alike, whatever the environment does.

    Args:
        name: of the environment, for the line that is logged.
        termination: what the user said.

    Keyword Args:
        has_own: whether the environment has a function that tells whether a goal ends an episode.
        achieved: [n] of bool, steps that achieved their goals.
        terminated: [n] of bool, whether these steps ended the episode.
        tells_success: whether the environment's ``info`` has ``is_success``.

    Raises:
        ValueError: ``"success"`` was asked for, and ``info`` has no such entry.
    """
    if termination == "success" and not tells_success:
        raise ValueError(
            f"task.options.termination=success needs info['is_success'], which {name} does not give: "
            "choose task.options.termination=reward or never"
        )
    if termination != "auto":
        return termination
    if has_own:
        return "own"
    by: Ends = "success" if tells_success else "reward"
    where = "info['is_success'] is true" if tells_success else "the reward is that of an achieved goal"
    ends: Ends = by
    if bool((achieved & ~terminated).any()):
        ends = "never"
        why = "in a trial it went on after a goal was achieved, so goals never end an episode"
    elif bool(achieved.any()):
        why = f"in a trial it ended where a goal was achieved, so goals end an episode, where {where}"
    else:
        why = (
            f"goals are taken to end an episode, where {where}; if it goes on, choose "
            "task.options.termination=never"
        )
    say_once(f"{name} has no compute_terminated: {why} (task.options.termination={ends})")
    return ends


def check_stateless(name: str, before: np.ndarray, after: np.ndarray) -> None:
    """Raises a ValueError if ``compute_reward`` gives the same goals other rewards in another state.

    Args:
        name: of the environment, for the message.
        before, after: rewards [n] of the same pairs of goals, with some steps between them.
    """
    differ = ~np.isclose(before, after, rtol=1e-4, atol=1e-5, equal_nan=True)
    if differ.any():
        at = int(differ.argmax())
        raise ValueError(
            f"{name}: compute_reward gave {before[at] + 0.0:g}, and {after[at] + 0.0:g} some steps later, "
            "for the same two goals; it must depend on them alone, not on the state of the environment"
        )


def check_rewards(
    name: str, equal: float, others: Sequence[float] | np.ndarray, given: float | None
) -> tuple[float, float, bool]:
    """Tells a sparse reward, and one that is dense.

    Args:
        name: of the environment, for messages.
        equal: the least reward of two equal goals.
        others: rewards of further pairs of goals.
        given: the reward from which on a goal counts as achieved, if the user said so.

    Returns:
        The reward of a missed goal (the least one that was seen), the reward of an achieved one (the least
        one that counts as such), and whether the reward is dense.

    Raises:
        ValueError: equal goals give no more than all others, the reward is dense and ``given`` is None, or
            ``given`` does not separate equal goals from the least reward.

    Example:
        >>> check_rewards("walk", 0.0, [-1.0, 0.0, -1.0], None)
        (-1.0, 0.0, False)
        >>> check_rewards("walk", 0.0, [-3.0, -1.0, -2.5, -0.5], -0.1)
        (-3.0, -0.1, True)
    """
    missed = _missed(equal, others)
    equal = equal + 0.0  # never -0.0
    if not len(missed):
        least, most = min(others) + 0.0, max(others) + 0.0
        raise ValueError(
            f"{name}: equal goals give {equal:g}, and other pairs from {least:g} to {most:g}; equal goals "
            "must give the most, and compute_reward must depend on its two goals alone"
            if most > equal or equal < 0
            else f"{name}: other goals give {equal:g}, as equal goals do; they must give less (are all goals "
            "achieved from the start?)"
        )
    dense = is_dense(equal, others)
    if given is None:
        if dense:
            some = missed[np.linspace(0, len(missed) - 1, _SHOWN).astype(int)]
            example = f"{equal - 0.05 * (equal - missed[0]):.2g}"
            raise ValueError(
                f"{name} has a dense reward: goals that are not achieved give "
                f"{', '.join(f'{value:g}' for value in some)} and more, equal ones {equal:g}. Say from "
                f"which reward on a goal counts as achieved, as in task.options.achieved_reward={example}, "
                "or choose a sparse reward"
            )
        return float(missed[0]), equal, False
    if isinstance(given, bool) or not isinstance(given, int | float) or not missed[0] < given <= equal:
        raise ValueError(
            f"achieved_reward of {name} must be above {missed[0]:g}, the least reward of a pair of goals, "
            f"and at most {equal:g}, that of equal ones, got {given!r}"
        )
    return float(missed[0]), float(given), dense


def is_dense(equal: float, others: Sequence[float] | np.ndarray) -> bool:
    """Whether goals that are not achieved have different rewards; arguments as for :func:`check_rewards`.

    Example:
        >>> is_dense(0.0, [-1.0, 0.0]), is_dense(0.0, [-3.0, -1.0, -2.5, -0.5])
        (False, True)
    """
    return len(_missed(equal, others)) > _MOST_VALUES


def _missed(equal: float, others: Sequence[float] | np.ndarray) -> np.ndarray:
    """The different rewards of other pairs that are less than those of equal ones, in their order."""
    seen = np.unique(np.round(others, _DIGITS) + 0.0)
    return seen[seen < equal]


def check_same_rewards(name: str, stepped: np.ndarray, computed: np.ndarray) -> str:
    """A warning for rewards of steps [n] that differ from those computed for their goals; empty if none does.

    Steps in which an episode failed are left out: what that cost is kept in virtual transitions.

    Example:
        >>> check_same_rewards("walk", np.array([-1.0, -1.2]), np.array([-1.0, -1.0]))
        'walk: a step gave the reward -1.2, and compute_reward -1 for the same goals, ...'
    """
    differ = ~np.isclose(stepped, computed, rtol=1e-4, atol=1e-5)
    if not differ.any():
        return ""
    at = int(differ.argmax())
    return (
        f"{name}: a step gave the reward {stepped[at]:g}, and compute_reward {computed[at] + 0.0:g} for the "
        "same goals, so virtual transitions have other rewards than real ones"
    )
