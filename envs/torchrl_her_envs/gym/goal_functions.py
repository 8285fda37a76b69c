"""Calls the functions of gymnasium's GoalEnv with batches of goals, and shapes sparse rewards."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, Literal, get_args

import numpy as np

Answers = Literal["batch", "one", "loop"]
Form = Literal["pair", "rows", "rows and infos"]
Function = Callable[[np.ndarray, np.ndarray, Any], Any]
Info = Mapping[str, np.ndarray]  # entries [B, ...] of B infos
_NOTHING: Info = {}
_MOST = 0.99  # largest share of the reward of an achieved goal that a missed one can get


class _OneInfo(dict[str, Any]):
    """An info that records which missing entries were read."""

    def __init__(self, entries: Mapping[str, Any], lacking: set[str]) -> None:
        super().__init__(entries)
        self._lacking = lacking

    def __contains__(self, key: object) -> bool:
        present = super().__contains__(key)
        if not present and isinstance(key, str):  # a string is an entry, no row's index
            self._lacking.add(key)
        return present

    def __missing__(self, key: str) -> Any:
        _ = key in self
        raise KeyError(key)

    def get(self, key: str, default: Any = None) -> Any:
        return super().get(key, default) if key in self else default


class GoalFunction:
    """``compute_reward`` or ``compute_terminated`` of an environment, for batches of goals.

    Such functions are written for one pair of goals. Many also take batches, and some take batches only, with
    an info for each row or without. Some answer a batch with one value, which is right only if the answer is
    always the same. Others fail, or mix up the goals of a batch. The constructor finds out which kind a
    function is: it compares the answer to a batch of a few pairs with the answers to each of these pairs.
    Infos have the entries that are given. Those of a batch are one dictionary of arrays, or an array of
    dictionaries.

    Args:
        function: maps (achieved goal, desired goal, info) to a number or bool.
        achieved: [M, g] goals to try it with. Some rows should be equal to those of ``desired`` and others
            not, and M should not be g, so that the two dimensions cannot be mistaken for each other.
        desired: [M, g], the desired goals to try it with.
        name: name of the function, for messages.
        info: entries [M, ...] of the infos to try it with.

    Attributes:
        form: form in which the function takes one pair of goals: the two goals (``"pair"``), a batch of one
            (``"rows"``), or a batch of one with an array of infos.
        answers: ``"batch"`` if it takes batches, ``"one"`` if one value holds for all pairs, ``"loop"`` if it
            has to be called pair by pair.
        tried: [M], the function's results for the goals that it was tried with.
        lacking: keys of infos that the function read but that were missing.

    Raises:
        ValueError: the function cannot be called with such infos, or does not return one number.

    Example:
        >>> here, there = np.array([[0.0, 0.0], [3.0, 4.0], [1.0, 1.0]]), np.array([[0.0, 0.0]] * 3)
        >>> near = lambda a, d, info: bool(np.linalg.norm(a - d) < 1)  # the norm of a whole batch
        >>> function = GoalFunction(near, here, there, name="compute_terminated")
        >>> function.answers, function(here, there).tolist()
        ('loop', [1.0, 0.0, 0.0])
    """

    def __init__(
        self,
        function: Function,
        achieved: np.ndarray,
        desired: np.ndarray,
        *,
        name: str,
        info: Info = _NOTHING,
    ) -> None:
        self._function = function
        self._name = name
        self.lacking: set[str] = set()
        self.tried = self._try_forms(achieved, desired, info)
        self.answers: Answers = self._find_out(achieved, desired, info)

    def __call__(self, achieved: np.ndarray, desired: np.ndarray, info: Info = _NOTHING) -> np.ndarray:
        """Returns the results [B] of float64 for goals [B, g], with the entries [B, ...] of their infos."""
        if self.answers == "loop" or not len(achieved):
            return self._loop(achieved, desired, info)
        answer = self._batch(achieved, desired, info, self._batched)
        shape = (len(achieved),)
        return np.full(shape, answer.item()) if self.answers == "one" else answer.reshape(shape)

    def _batch(self, achieved: np.ndarray, desired: np.ndarray, info: Info, form: Form) -> np.ndarray:
        infos: Any = _OneInfo(info, self.lacking)
        if form == "rows and infos":
            infos = np.array([self._one(info, row) for row in range(len(achieved))], object)
        return np.asarray(self._function(achieved, desired, infos), np.float64)

    def _one(self, info: Info, row: int) -> _OneInfo:
        return _OneInfo({key: entries[row] for key, entries in info.items()}, self.lacking)

    def _try_forms(self, achieved: np.ndarray, desired: np.ndarray, info: Info) -> np.ndarray:
        """Calls the function in the first form that it takes; returns [M] results, or raises an error."""
        errors: list[ValueError] = []
        for form in get_args(Form):
            self.form: Form = form
            try:
                return self._loop(achieved, desired, info)
            except ValueError as error:
                errors.append(error)
        raise errors[0]

    def _loop(self, achieved: np.ndarray, desired: np.ndarray, info: Info) -> np.ndarray:
        rows = range(len(achieved))
        return np.array([self._ask(achieved, desired, info, row) for row in rows], np.float64)

    def _ask(self, achieved: np.ndarray, desired: np.ndarray, info: Info, row: int) -> float:
        """Calls the wrapped function for one pair of goals, and checks that the result is one number."""
        try:
            if self.form == "pair":
                result = self._function(achieved[row], desired[row], self._one(info, row))
                answer = np.asarray(result, np.float64)
            else:
                at = slice(row, row + 1)
                own_info = {key: entries[at] for key, entries in info.items()}
                answer = self._batch(achieved[at], desired[at], own_info, self.form)
        except Exception as error:
            if self.lacking:
                raise ValueError(self.hint(info)) from error
            reason = f"{type(error).__name__}: {error}".splitlines()[0]
            with_info = f"the info {', '.join(info)}" if info else "an empty info"
            raise ValueError(
                f"{self._name} cannot be called with two goals and {with_info}: {reason}"
            ) from error
        if answer.size != 1:
            raise ValueError(
                f"{self._name} must give one number for two goals, got an array of shape {answer.shape}"
            )
        return answer.item()

    def hint(self, info: Collection[str]) -> str:
        """Returns a hint about missing entries of infos that the function reads; empty if there are none."""
        if not self.lacking:
            return ""
        keys = sorted(self.lacking)
        return (
            f"{self._name} reads {' and '.join(f'info[{key!r}]' for key in keys)}, which virtual transitions "
            f"have only if it is named: task.options.info_keys=[{','.join([*info, *keys])}]"
        )

    def _find_out(self, achieved: np.ndarray, desired: np.ndarray, info: Info) -> Answers:
        forms: tuple[Form, ...] = ("rows", "rows and infos") if self.form == "pair" else (self.form,)
        for self._batched in forms:
            try:
                answer = self._batch(achieved, desired, info, self._batched)
            except Exception:  # a function for single goals may fail with any error
                continue
            if answer.size in (1, len(achieved)) and np.allclose(answer.reshape(-1), self.tried):
                return "one" if answer.size == 1 else "batch"
        return "loop"


class ShapedReward:
    """A sparse reward in which nearly achieved goals get a share of the reward of achieved ones.

    The share grows from 0 at the distance ``far`` to 1 at ``near``, with the logarithm of the distance: each
    halving gains the same. So it pays to be more precise, even far from precise enough.

    Args:
        function: maps (achieved, desired) goals [B, g] and their info to rewards [B].
        missed, achieved: rewards of a missed and of an achieved goal.
        shaping: the distances ``near`` and ``far`` between goals, in their unit.

    Raises:
        ValueError: ``shaping`` is not two distances, 0 < near < far.

    Example:
        >>> sparse = lambda achieved, desired, info: -1.0 + (abs(achieved - desired) < 1)[:, 0]
        >>> shaped = ShapedReward(sparse, -1.0, 0.0, (1.0, 100.0))
        >>> shaped(np.array([[0.5], [10.0], [300.0]]), np.zeros((3, 1))).tolist()
        [0.0, -0.5, -1.0]
    """

    def __init__(self, function: Function, missed: float, achieved: float, shaping: Sequence[float]) -> None:
        if np.shape(shaping) != (2,) or not 0 < shaping[0] < shaping[1] < np.inf:
            raise ValueError(f"shaping must be two distances, 0 < near < far, got {shaping}")
        self.function, self._achieved, self._gain = function, achieved, achieved - missed
        self._near, self._far = shaping

    def __call__(self, achieved: np.ndarray, desired: np.ndarray, info: Info = _NOTHING) -> np.ndarray:
        """Returns the rewards [B] of goals [B, g], with the entries [B, ...] of their infos."""
        reward = self.function(achieved, desired, info)
        return reward + self.bonus(achieved, desired, reward)

    def bonus(self, achieved: np.ndarray, desired: np.ndarray, reward: np.ndarray) -> np.ndarray:
        """Returns what is added to the sparse rewards [B] of goals [B, g]: 0 where they are achieved."""
        # Goals of unsigned whole numbers would wrap around below 0.
        gap = np.subtract(achieved, desired, dtype=np.result_type(achieved, desired, np.float32))
        distance = np.linalg.norm(gap, axis=-1).clip(self._near, self._far)
        share = np.log(self._far / distance) / np.log(self._far / self._near)
        return self._gain * np.where(reward < self._achieved, share.clip(0, _MOST), 0)
