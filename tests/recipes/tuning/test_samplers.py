"""Samplers whose values depend on the trials before and on the number of the trial alone."""

from __future__ import annotations

import math

import pytest

from torchrl_her_recipes.config.search import SAMPLERS
from torchrl_her_recipes.config.spaces import make_space
from torchrl_her_recipes.tuning.samplers import make_sampler

from .searches import SPACE

optuna = pytest.importorskip("optuna", reason="needs the extra tune")

TRIALS = 16  # the first ten of TPE are drawn at random


def values(sampler: str, *, seed: int = 0, cut: bool = False) -> list[dict[str, object]]:
    """What is drawn in turn; perhaps each fourth trial is cut short, and another process goes on with it."""
    storage, space = optuna.storages.InMemoryStorage(), make_space("small", SPACE)
    optuna.create_study(storage=storage, study_name="search", direction="maximize")

    def study_of_a_process() -> optuna.Study:
        own = make_sampler(sampler, seed)
        return optuna.load_study(storage=storage, study_name="search", sampler=own)

    study, drawn = study_of_a_process(), []
    for number in range(TRIALS):
        trial = study.ask()
        if cut and number % 4 == 3:
            next(iter(space)).suggest(trial)
            study = study_of_a_process()
            trial = optuna.Trial(study, trial._trial_id)
        drawn.append(space.suggest(trial))
        score = -abs(math.log10(trial.params["learning_rate"]) + 3) - trial.params["k"] / 10
        study.tell(number, score)
    return drawn


@pytest.mark.parametrize("sampler", SAMPLERS)
def test_what_is_drawn_is_the_same_however_often_a_search_is_cut_short(sampler: str) -> None:
    drawn = values(sampler)
    assert values(sampler, cut=True) == drawn
    assert len({tuple(each.values()) for each in drawn}) == TRIALS


def test_seeds_differ_and_tpe_learns_where_good_trials_are() -> None:
    drawn = values("tpe")
    assert drawn != values("tpe", seed=1)
    last = [each["k"] for each in drawn[-4:]]
    assert all(isinstance(k, int) and k <= 4 for k in last)


def test_a_sampler_whose_package_is_missing_names_the_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torchrl_her_recipes.tuning.samplers.find_spec", lambda _name: None)
    with pytest.raises(ImportError, match=r"--sampler cmaes needs cmaes: pip install '.\[tune\]'"):
        make_sampler("cmaes", 0)
