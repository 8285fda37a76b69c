"""Options that are `auto`: what they become, and when."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from torchrl_her_recipes import build, load_preset, make_recipe, run
from torchrl_her_recipes.config.choices.order import AllAtOnce, Threshold
from torchrl_her_recipes.config.resolve import EnvFacts, auto_options, resolve
from torchrl_her_recipes.config.shipped import shipped_names


@pytest.mark.parametrize(
    ("max_steps", "batched", "values"),
    [
        (50, False, (0.96, 8, 1.0, 5_000, 1_000)),
        (50, True, (0.96, 64, 5.0, 12_800, 3_200)),
        (300, False, (0.99, 8, 1.0, 30_000, 2_400)),
        (4, False, (0.9, 8, 1.0, 400, 1_000)),
        (1, True, (0.9, 64, 5.0, 640, 1_000)),
    ],
)
def test_values_follow_from_the_environment(max_steps: int, batched: bool, values: tuple[float, ...]) -> None:
    recipe = resolve(make_recipe(), EnvFacts(max_steps=max_steps, batched=batched))
    own = recipe.collection
    sizes = (own.num_envs, own.frames_per_update, own.epoch_frames, own.warmup_frames)
    assert (recipe.learner.gamma, *sizes) == values
    assert recipe.hindsight.goal_sources == {"future": 3, "actual": 2}
    assert auto_options(recipe) == []


@pytest.mark.parametrize(("max_steps", "gamma"), [(20, 0.8), (50, 0.8), (100, 0.9), (2_000, 0.99)])
def test_shaped_rewards_need_a_short_horizon_only(max_steps: int, gamma: float) -> None:
    facts = EnvFacts(max_steps=max_steps, shaping=[0.01, 0.1])
    given = make_recipe(task="gym:HandReach-v3", **{"task.options": {"shaping": [0.01, 0.1]}})
    assert resolve(make_recipe(task="gym:HandReach-v3"), facts).learner.gamma == gamma
    assert resolve(given, EnvFacts(max_steps=max_steps)).learner.gamma == gamma
    assert resolve(given.replace(gamma=0.95), facts).learner.gamma == 0.95


def test_a_curriculum_comes_with_its_options() -> None:
    stages = [{"name": "near"}, {"name": "all"}]
    recipe = resolve(make_recipe(), EnvFacts(max_steps=50, stages=stages))
    assert (recipe.hindsight.algo, recipe.curriculum.stages) == ("cher", stages)
    assert (recipe.curriculum.guided_share, recipe.curriculum.guided_per) == (0.5, "step")
    assert recipe.order == AllAtOnce(every_stage=True, task_share=1.0)
    weighted = resolve(make_recipe(weights="rare"), EnvFacts(max_steps=50, stages=stages))
    assert weighted.order == Threshold(stage_epochs=10)
    assert resolve(make_recipe(), EnvFacts(max_steps=50)).hindsight.algo == "filtered_her"
    assert make_recipe(curriculum=stages).hindsight.algo == "cher"


def test_values_that_are_given_stay() -> None:
    facts = EnvFacts(max_steps=50)
    recipe = resolve(make_recipe(gamma=0.5, num_envs=30, strategy="final", processes=2), facts)
    assert (recipe.learner.gamma, recipe.collection.num_envs) == (0.5, 30)
    assert recipe.collection.warmup_frames == 1_500
    assert recipe.hindsight.sources == {"final": 4}
    assert resolve(make_recipe(processes=3), facts).collection.num_envs == 9
    assert auto_options(resolve(make_recipe(algo="no_hindsight"), facts)) == []


def test_frames_become_epochs() -> None:
    facts = EnvFacts(max_steps=50)
    assert resolve(make_recipe(frames=12_000), facts).run.epochs == 3
    assert make_recipe(frames=12_000, epoch_frames=4_000).run.epochs == 3
    assert make_recipe({"frames": 12_000, "epoch_frames": 4_000}, epochs=7).run.epochs == 7


def test_a_run_of_few_frames_is_one_short_epoch() -> None:
    recipe = resolve(make_recipe(frames=3_000), EnvFacts(max_steps=2_000))
    assert (recipe.run.epochs, recipe.collection.epoch_frames) == (1, 3_000)
    recipe = resolve(make_recipe(frames=10), EnvFacts(max_steps=2_000))
    assert recipe.total_frames == recipe.collection.num_envs * recipe.collection.steps_per_batch


@pytest.mark.parametrize("preset", shipped_names("preset"))
def test_presets_leave_nothing_to_the_environment(preset: str) -> None:
    assert auto_options(make_recipe(load_preset(preset))) == []


def test_the_folder_of_a_run_has_the_values(tmp_path: Path) -> None:
    sizes = {"num_envs": 4, "epoch_frames": 80, "epochs": 1, "episodes": 2, "hidden": 8}
    run(build(make_recipe(task="hand_v0", pictures=False, **sizes)), tmp_path / "run", progress=False)
    written = yaml.safe_load((tmp_path / "run" / "config.yaml").read_text())
    assert written["learner"]["gamma"] == 0.96
    assert written["collection"]["frames_per_update"] == 5.0
    assert "auto" not in {
        value for name in ("collection", "hindsight") for value in map(str, written[name].values())
    }
