"""Calls the functions of gymnasium's GoalEnv with batches of goals, even those written for one pair."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal, get_args

import numpy as np

Answers = Literal["batch", "one", "loop"]
Form = Literal["pair", "rows", "rows and infos"]
Function = Callable[[np.ndarray, np.ndarray, dict[str, Any]], Any]


class GoalFunction:
    """``compute_reward`` or ``compute_terminated`` of an environment, for batches of goals.

    Such functions are written for one pair of goals. Many also take batches, and some nothing else, with an
    info for each row or without. Some answer a batch with one value, which is right only if the answer is
    always the same. Others fail, or mix up the goals of a batch. The constructor finds out which kind a
    function is: it compares the answer to a batch of a few pairs with the answers to each of these pairs. The
    functions get empty infos, since there is none for virtual goals.

    Args:
        function: (achieved goal, desired goal, info) to a number or truth value.
        achieved: [M, g] goals to try it with. Some rows should be equal to those of ``desired`` and others
            not, and M should not be g, so that the two dimensions cannot be mistaken for each other.
        desired: [M, g].
        name: of the function, for messages.

    Attributes:
        form: what it takes for one pair of goals: the two goals (``"pair"``), a batch of one (``"rows"``), or
            a batch of one with a list of infos.
        answers: ``"batch"`` if it takes batches, ``"one"`` if one value answers for all, ``"loop"`` if it
            has to be called pair by pair.
        tried: [M], its answers to the goals that it was tried with.

    Raises:
        ValueError: it cannot be called with an empty info, or does not answer with one number.

    Example:
        >>> here, there = np.array([[0.0, 0.0], [3.0, 4.0], [1.0, 1.0]]), np.array([[0.0, 0.0]] * 3)
        >>> near = lambda a, d, info: bool(np.linalg.norm(a - d) < 1)  # the norm of all of a batch
        >>> function = GoalFunction(near, here, there, name="compute_terminated")
        >>> function.answers, function(here, there).tolist()
        ('loop', [1.0, 0.0, 0.0])
    """

    def __init__(self, function: Function, achieved: np.ndarray, desired: np.ndarray, *, name: str) -> None:
        self._function = function
        self._name = name
        self.tried = self._try_forms(achieved, desired)
        self.answers: Answers = self._find_out(achieved, desired)

    def __call__(self, achieved: np.ndarray, desired: np.ndarray) -> np.ndarray:
        """The answers [B] of float64 to goals [B, g]."""
        if self.answers == "loop" or not len(achieved):
            return self._loop(achieved, desired)
        answer = self._batch(achieved, desired)
        shape = (len(achieved),)
        return np.full(shape, answer.item()) if self.answers == "one" else answer.reshape(shape)

    def _batch(self, achieved: np.ndarray, desired: np.ndarray) -> np.ndarray:
        info: Any = [{} for _ in achieved] if self.form == "rows and infos" else {}
        return np.asarray(self._function(achieved, desired, info), np.float64)

    def _try_forms(self, achieved: np.ndarray, desired: np.ndarray) -> np.ndarray:
        """The answers [M] in the first form that the function takes; the error of a pair if it takes none."""
        errors: list[ValueError] = []
        for form in get_args(Form):
            self.form: Form = form
            try:
                return self._loop(achieved, desired)
            except ValueError as error:
                errors.append(error)
        raise errors[0]

    def _loop(self, achieved: np.ndarray, desired: np.ndarray) -> np.ndarray:
        pairs = zip(achieved, desired, strict=True)
        return np.array([self._ask(one, other) for one, other in pairs], np.float64)

    def _ask(self, achieved: np.ndarray, desired: np.ndarray) -> float:
        """The answer to one pair of goals."""
        try:
            if self.form == "pair":
                answer = np.asarray(self._function(achieved, desired, {}), np.float64)
            else:
                answer = self._batch(achieved[None], desired[None])
        except Exception as error:
            reason = f"{type(error).__name__}: {error}".splitlines()[0]
            raise ValueError(
                f"{self._name} cannot be called with two goals and an empty info: {reason}"
            ) from error
        if answer.size != 1:
            raise ValueError(
                f"{self._name} must give one number for two goals, got an array of shape {answer.shape}"
            )
        return answer.item()

    def _find_out(self, achieved: np.ndarray, desired: np.ndarray) -> Answers:
        try:
            answer = self._batch(achieved, desired)
        except Exception:  # whatever it is that a function for single goals stumbles over
            return "loop"
        if answer.size not in (1, len(achieved)) or not np.allclose(answer.reshape(-1), self.tried):
            return "loop"
        return "one" if answer.size == 1 else "batch"
