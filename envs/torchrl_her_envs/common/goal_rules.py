"""Finds out by trial how environments of other packages reward goals and end episodes."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any, Literal, cast, get_args

import numpy as np

Termination = Literal["auto", "own", "success", "reward", "never", "watch"]
Ends = Literal["own", "success", "reward", "never", "watch"]

_LOGGER = logging.getLogger("torchrl_her_envs")
_MOST_VALUES = 2  # largest number of different rewards that missed goals have in a sparse reward
_SHOWN = 3  # number of rewards in a message
_DIGITS = 5  # decimal places to which rewards are compared
_said: set[str] = set()


def say_once(line: str) -> None:
    """Logs a line once per process; does nothing for an empty line."""
    if line and line not in _said:
        _said.add(line)
        _LOGGER.info(line)


def warn_once(line: str) -> None:
    """Logs a warning once per process; does nothing for an empty line.

    Without a log handler, Python prints the record as one line; a ``UserWarning`` takes two, one with code.
    """
    if line and line not in _said:
        _said.add(line)
        _LOGGER.warning(line)


def check_termination(word: str) -> Termination:
    """Returns the value of the option ``termination``, checked.

    Raises:
        ValueError: the value is not an allowed word.

    Example:
        >>> check_termination("sucess")
        Traceback (most recent call last):
        ValueError: termination must be one of auto, own, success, reward, never, watch, got 'sucess'
    """
    allowed = get_args(Termination)
    if word not in allowed:
        raise ValueError(f"termination must be one of {', '.join(allowed)}, got {word!r}")
    return cast(Termination, word)


class GoalEnds:
    """Rule for the ends of episodes at goals, and counts of what the environment itself did there.

    Args:
        name: name of the environment, for messages.
        env_ends: whether the environment's ``compute_terminated`` is true at goals, which ends episodes; None
            if the environment has no such function.
        tells_success: whether the infos of steps have ``is_success``.

    Attributes:
        rule: rule that ends episodes: the environment's own function (``"own"``), its ``is_success``
            (``"success"``) or the reward of a goal (``"reward"``); ``"never"`` if goals end none; ``"watch"``
            while the environment's own ends count and no rule is chosen.
        steps: number of steps so far.
        ended, went_on: numbers of steps at achieved goals in which the environment ended or continued the
            episode.

    Example:
        >>> ends = GoalEnds("walk", env_ends=None, tells_success=True)
        >>> ends.found() is None  # no goal was met so far
        True
        >>> met, stops = np.array([True, False]), np.array([False, True])
        >>> _ = ends.apply(met, stops, np.array([False, False]))
        >>> ends.decide("auto")
        >>> ends.rule, ends.went_on
        ('never', 1)
        >>> ends.apply(np.array([True, False]), np.array([True, True]), np.array([False, False]))
        (array([False,  True]), array([ True, False]))
    """

    def __init__(self, name: str, *, env_ends: bool | None, tells_success: bool) -> None:
        self.name, self.env_ends, self.tells_success = name, env_ends, tells_success
        self.rule: Ends = "watch"
        self.steps = self.ended = self.went_on = 0

    @property
    def asks_success(self) -> bool:
        """Whether ``is_success``, and not the reward, decides which steps achieve their goals."""
        return self.tells_success and self.rule != "reward"

    def decide(self, termination: Termination) -> None:
        """Sets the rule to the user's choice, or to the one that was found.

        Raises:
            ValueError: the environment lacks what the user's choice needs.
        """
        lacks = {"success": not self.tells_success and "info['is_success']"}
        lacks["own"] = self.env_ends is None and "compute_terminated"
        if lack := lacks.get(termination):
            others = ", ".join(choice for choice in ("success", "reward", "never") if not lacks.get(choice))
            raise ValueError(
                f"task.options.termination={termination} needs {lack}, which {self.name} does not give; "
                f"choose {others}"
            )
        found = self.found()
        if termination == "watch":
            self.rule = "watch" if self.env_ends is None else found or "own"
        elif termination == "auto":
            self.rule = found or "never"
            say_once(self.line())
        else:
            self.rule = termination

    def found(self) -> Ends | None:
        """Returns the rule that fits the environment's behavior so far; None before a goal was achieved.

        The environment's own function decides if there is one. If not, and an episode continued at its goal,
        goals never end an episode.
        """
        if self.env_ends is not None:
            return "own" if self.env_ends else "never"
        if self.went_on:
            return "never"
        return ("success" if self.tells_success else "reward") if self.ended else None

    def line(self) -> str:
        """Returns a line that explains the rule; empty if the environment's own function decides."""
        if self.env_ends is not None:
            return ""
        by, where = "reward", "the reward is that of an achieved goal"
        if self.tells_success:
            by, where = "success", "info['is_success'] is true"
        during = f"in {self.steps:,} random steps it"
        if self.went_on:
            why = f"{during} went on after a goal was achieved, so goals never end an episode"
        elif self.ended:
            why = f"{during} ended where a goal was achieved, so goals end an episode, where {where}"
        else:
            why = (
                f"no goal was achieved in {self.steps:,} random steps, and goals are assumed to end no "
                f"episode; if they do, choose task.options.termination={by}"
            )
        rule = self.found() or "never"
        return f"{self.name} has no compute_terminated: {why} (task.options.termination={rule})"

    def apply(self, met: Any, terminated: Any, truncated: Any) -> tuple[Any, Any]:
        """Returns the ends of steps by the rule, and counts what the environment did at achieved goals.

        Args:
            met: bool for each step, whether it achieved its goal.
            terminated, truncated: flags of these steps by the environment.

        Returns:
            ``(terminated, truncated)``. If goals never end an episode, one that the environment ended at its
            goal is truncated. Ends without the goal stay as the environment gave them.
        """
        at_goal = terminated & met
        ended, went_on = int(at_goal.sum()), int((met & ~terminated & ~truncated).sum())
        self.steps, self.ended = self.steps + len(met), self.ended + ended
        self.went_on += went_on
        if self.rule == "never":
            if ended:
                by = "success" if self.tells_success else "reward"
                self._say_contrary("ended an episode where its goal was achieved", by)
            return terminated & ~met, truncated | at_goal
        if self.rule in ("success", "reward"):
            if went_on:
                self._say_contrary("went on where a goal was achieved", "never")
            return terminated | met, truncated
        return terminated, truncated

    def _say_contrary(self, what: str, instead: str) -> None:
        instead = instead if self.env_ends is None else "own"
        say_once(
            f"{self.name} {what}, against task.options.termination={self.rule}: "
            f"task.options.termination={instead} does as the environment"
        )


def check_stateless(name: str, before: np.ndarray, after: np.ndarray) -> None:
    """Raises a ValueError if ``compute_reward`` gives the same goals different rewards in different states.

    Args:
        name: name of the environment, for the message.
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
    """Finds the reward of an achieved goal; raises if rewards are dense and ``given`` is None.

    Args:
        name: name of the environment, for messages.
        equal: the least reward of two equal goals.
        others: rewards of further pairs of goals.
        given: the user's choice of the least reward of an achieved goal; None if not set.

    Returns:
        The reward of a missed goal (the least reward seen), the reward of an achieved goal (the least that
        counts as achieved), and whether the reward is dense.

    Raises:
        ValueError: equal goals give no higher reward than others, the reward is dense and ``given`` is None,
            or ``given`` does not separate equal goals from the least reward.

    Example:
        >>> check_rewards("walk", 0.0, [-1.0, 0.0, -1.0], None)
        (-1.0, 0.0, False)
        >>> check_rewards("walk", 0.0, [-3.0, -1.0, -2.5, -0.5], -0.1)
        (-3.0, -0.1, True)
    """
    missed = _missed(equal, others)
    equal = equal + 0.0  # turns -0.0 into 0.0
    if not len(missed):
        least, most = min(others) + 0.0, max(others) + 0.0
        raise ValueError(
            f"{name}: equal goals have the reward {equal:g}, other pairs {least:g} to {most:g}; equal goals "
            "must have the highest reward, and compute_reward must depend on its two goals alone"
            if most > equal or equal < 0
            else f"{name}: different goals have the reward {equal:g}, like equal goals; it must be lower "
            "(are all goals achieved from the start?)"
        )
    dense = is_dense(equal, others)
    if given is None:
        if dense:
            some = missed[np.linspace(0, len(missed) - 1, _SHOWN).astype(int)]
            example = f"{equal - 0.05 * (equal - missed[0]):.2g}"
            raise ValueError(
                f"{name} has a dense reward: "
                f"{', '.join(f'{value:g}' for value in some)} and other values for missed goals, {equal:g} "
                "for equal goals. Give the least reward at which a goal counts as achieved, as in "
                f"task.options.achieved_reward={example}, or choose a sparse reward"
            )
        return float(missed[0]), equal, False
    if isinstance(given, bool) or not isinstance(given, int | float) or not missed[0] < given <= equal:
        raise ValueError(
            f"achieved_reward of {name} must be above {missed[0]:g}, the least reward that was seen, and at "
            f"most {equal:g}, the reward where achieved and desired goal are equal, got {given!r}"
        )
    return float(missed[0]), float(given), dense


def equal_with_info(name: str, equal: np.ndarray, others: np.ndarray, given: float | None) -> float:
    """Finds the reward of equal goals for :func:`check_rewards`, if rewards depend on infos as well.

    With infos, equal goals may be achieved only for some infos, which random steps may not have met.

    Args:
        name: name of the environment, for the message.
        equal: rewards [n] of equal goals, with different infos.
        others: rewards of other pairs of goals.
        given: the user's choice of the least reward of an achieved goal; None if not set.

    Raises:
        ValueError: equal goals give no higher reward than others, and ``given`` is None.

    Example:
        >>> equal_with_info("walk", np.array([-1.0, 0.0]), np.array([-1.0]), None)
        0.0
        >>> equal_with_info("walk", np.array([-1.0, -1.0]), np.array([-1.0]), 0.0)
        0.0
    """
    most = float(equal.max())
    if given is None and most <= others.min():
        raise ValueError(
            f"{name}: with the infos of {len(equal)} random steps, equal goals have the reward {most:g}, "
            "like other goals; give the least reward for achieving one: task.options.achieved_reward=..."
        )
    return most if given is None else max(most, given)


def is_dense(equal: float, others: Sequence[float] | np.ndarray) -> bool:
    """Returns whether goals that are not achieved differ in reward; arguments as for :func:`check_rewards`.

    Example:
        >>> is_dense(0.0, [-1.0, 0.0]), is_dense(0.0, [-3.0, -1.0, -2.5, -0.5])
        (False, True)
    """
    return len(_missed(equal, others)) > _MOST_VALUES


def _missed(equal: float, others: Sequence[float] | np.ndarray) -> np.ndarray:
    """Returns the distinct rewards of other pairs of goals below the reward of equal goals, ascending."""
    rewards = np.unique(np.round(others, _DIGITS) + 0.0)
    return rewards[rewards < equal]


def check_same_rewards(name: str, stepped: np.ndarray, computed: np.ndarray) -> str:
    """Returns a warning if rewards of steps [n] differ from those computed for their goals, else "".

    Steps in which an episode failed are left out, since virtual transitions keep the cost of a failure.

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
        "same goals, so virtual transitions have other rewards than real ones; if compute_reward reads "
        "info, name its keys: task.options.info_keys=[KEY]"
    )
