"""How the values of a trial are chosen: by Optuna, so that a trial's number and those before it decide."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from importlib.util import find_spec
from typing import Any

import numpy as np
from optuna.distributions import BaseDistribution
from optuna.samplers import BaseSampler, CmaEsSampler, RandomSampler, TPESampler
from optuna.study import Study
from optuna.trial import FrozenTrial, TrialState


class NumberedSampler(BaseSampler):
    """Makes a sampler anew for each trial, with random numbers of the trial's own.

    Those of Optuna go on with their random numbers from trial to trial, so a search that was killed would
    choose other values when it goes on than one that was not.

    Args:
        make: makes the sampler with a seed.
        seed: of the search.

    Example:
        >>> import optuna
        >>> def first(seed):
        ...     sampler = NumberedSampler(lambda own: RandomSampler(seed=own), seed)
        ...     return optuna.create_study(sampler=sampler).ask().suggest_float("x", 0, 1)
        >>> first(3) == first(3), first(3) == first(4)
        (True, False)
    """

    def __init__(self, make: Callable[[int], BaseSampler], seed: int) -> None:
        self._make, self._seed = make, seed

    def _of(self, trial: FrozenTrial, name: str = "") -> BaseSampler:
        """The sampler of one trial, and of an option that is drawn by itself."""
        words = np.random.SeedSequence([self._seed, trial.number, zlib.crc32(name.encode())])
        return self._make(int(words.generate_state(1)[0]))

    def infer_relative_search_space(self, study: Study, trial: FrozenTrial) -> dict[str, BaseDistribution]:
        """The options that are drawn together."""
        return self._of(trial).infer_relative_search_space(study, trial)

    def sample_relative(
        self, study: Study, trial: FrozenTrial, search_space: dict[str, BaseDistribution]
    ) -> dict[str, Any]:
        """Draws the options that are drawn together."""
        return self._of(trial).sample_relative(study, trial, search_space)

    def sample_independent(
        self, study: Study, trial: FrozenTrial, param_name: str, param_distribution: BaseDistribution
    ) -> Any:
        """Draws an option by itself; when a killed search goes on, some others may be drawn already."""
        return self._of(trial, param_name).sample_independent(study, trial, param_name, param_distribution)

    def before_trial(self, study: Study, trial: FrozenTrial) -> None:
        """Called by Optuna."""
        self._of(trial).before_trial(study, trial)

    def after_trial(
        self, study: Study, trial: FrozenTrial, state: TrialState, values: Sequence[float] | None
    ) -> None:
        """Called by Optuna."""
        self._of(trial).after_trial(study, trial, state, values)


def make_sampler(name: str, seed: int) -> BaseSampler:
    """A sampler by its name.

    Raises:
        ImportError: it needs a package that is not installed.
    """
    if name == "cmaes" and find_spec("cmaes") is None:
        raise ImportError("--sampler cmaes needs cmaes: pip install '.[tune]'")
    made: dict[str, Callable[[int], BaseSampler]] = {
        "tpe": lambda own: TPESampler(seed=own),
        "random": lambda own: RandomSampler(seed=own),
        # Choices are drawn at random there; Optuna would say so at each trial.
        "cmaes": lambda own: CmaEsSampler(seed=own, warn_independent_sampling=False),
    }
    return NumberedSampler(made[name], seed)
