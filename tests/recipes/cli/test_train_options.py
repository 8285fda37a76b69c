"""The arguments of ``train``: help, completion, and what ``--show`` prints."""

from __future__ import annotations

import re
from pathlib import Path

import click
import pytest
import yaml

from torchrl_her_recipes import Recipe, cli, make_recipe
from torchrl_her_recipes.cli.train import train
from torchrl_her_recipes.cli.train_options import complete, requests, with_folder
from torchrl_her_recipes.config.shortcuts import LONG_ONLY, option_names


def completed(text: str) -> list[str]:
    return complete(click.Context(train), train.params[-1], text)


def test_completion_of_names_and_values() -> None:
    assert completed("se") == ["seed="]
    assert completed("run.s") == ["run.seed="]
    assert completed("learner=d") == ["learner=ddpg", "learner=dqn"]
    assert completed("sampler=") == ["sampler=prioritized", "sampler=uniform"]
    assert completed("strategy=f") == ["strategy=future", "strategy=final"]
    assert completed("estimator=k") == ["estimator=kernel"]
    assert completed("seed=") == []
    assert completed("demonstrations.f") == ["demonstrations.file="]
    assert completed("starts") == []


def test_help_explains_every_option_of_the_default_learner(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["train", "-h"]) == 0
    words = {word.partition("=")[0] for word in capsys.readouterr().out.split()}
    for group, names in option_names().items():
        shown = [f"{group}.{name}" for name in names] if group in LONG_ONLY else names
        assert set(shown) - {"name"} <= words


def test_show_prints_documents_that_are_recipes(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["train", "-m", "--show", "preset=demo", "seed=0,1"]) == 0
    shown = [Recipe.from_dict(each) for each in yaml.safe_load_all(capsys.readouterr().out)]
    assert [recipe.run.seed for recipe in shown] == [0, 1]
    assert {recipe.task.name for recipe in shown} == {"hand_v1"}


def test_requests_and_their_folders() -> None:
    ((folder, recipe),) = requests(("task=gym:FetchReach-v4", "algo=her"), multirun=False).items()
    assert recipe == make_recipe(task="gym:FetchReach-v4", algo="her")
    assert folder.name.endswith("_gym_FetchReach-v4_her_s0")
    several = requests(("seed=3,4", "folder=a,b"), multirun=True)
    assert list(map(str, several)) == ["a,b/hand_v0_s3_0", "a,b/hand_v0_s4_1"]


def test_options_of_a_task_are_given_as_the_guide_says() -> None:
    guide = (Path(__file__).parents[3] / "docs" / "gymnasium.md").read_text()
    (written,) = set(re.findall(r"`(task.options.continuing_task=\w+)`", guide))
    (recipe,) = requests(("task=gym:PointMaze_UMaze-v3", written), multirun=False).values()
    assert recipe.task.options == {"continuing_task": False}
    assert "task_options" not in guide


def test_goal_sources_are_given_as_a_mapping_or_one_by_one() -> None:
    mixed = make_recipe(goal_sources={"future": 2, "actual": 2})
    single = "hindsight.goal_sources."
    for written in (["goal_sources={future: 2, actual: 2}"], [f"{single}future=2", f"{single}actual=2"]):
        (recipe,) = requests(tuple(written), multirun=False).values()
        assert recipe == mixed
    several = requests(("goal_sources={future: 4},{actual: 1}",), multirun=True)
    assert [recipe.hindsight.sources for recipe in several.values()] == [{"future": 4}, {"actual": 1}]
    with pytest.raises(ValueError, match="goal_sources needs a space behind each colon"):
        requests(("goal_sources={future:2,actual:2}",), multirun=False)


def test_folders_have_names_that_every_file_system_takes() -> None:
    tasks = ("task=gym:my.module:Mine/Walk-v0",)
    several = requests((*tasks, "seed=0,1"), multirun=True)
    for folder in (*requests(tasks, multirun=False), *several):
        assert re.fullmatch(r"[\w./-]+", str(folder))


def test_the_folder_is_given_in_either_way() -> None:
    for options in (with_folder(("seed=3",), "there"), with_folder(("seed=3", "folder=there"), None)):
        assert list(requests(options, multirun=False)) == [Path("there")]
    with pytest.raises(ValueError, match="folder"):
        requests(with_folder(("folder=here",), "there"), multirun=False)
