"""``torchrl-her tune``: what it says, and how it fails."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

import pytest

import torchrl_her_recipes
from torchrl_her_recipes.cli import main

from ..small import Refused, overrides
from ..studies.here import Here


@pytest.fixture(autouse=True)
def _in_a_folder_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def _small(**options: Any) -> list[str]:
    shrunk = {"epochs": 1, "num_runs": 2, "compile": "never", **options}
    return ["task=bit_flip", *overrides(**shrunk)]


def test_a_search_says_what_it_varies_and_how_to_train_the_best(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], refused: Refused
) -> None:
    pytest.importorskip("optuna", reason="needs the extra tune")
    monkeypatch.setattr(torchrl_her_recipes, "make_workers", lambda **_options: Here())
    command = ["tune", *_small(gamma=0.95), "--trials", "2", "--sampler", "random"]
    assert main(command) == 0
    said = capsys.readouterr().out.splitlines()
    # What is given is not varied: gamma, and batch_size and hidden among the options that make it small.
    assert said[:2] == [
        "search: runs/tune_bit_flip_s0",
        "varied: learning_rate, tau, norm, epsilon_decay, epsilon_end",
    ]
    assert re.fullmatch(r"trial 0: score \d+% \(best \d+%, trial 0\)", said[2])
    assert said[4].startswith("trial ")
    assert said[-1] == "the best: torchrl-her train preset=runs/tune_bit_flip_s0/best.yaml"

    assert main(["train", "preset=runs/tune_bit_flip_s0/best.yaml", "--show"]) == 0
    assert "gamma: 0.95" in capsys.readouterr().out
    Path("runs/tune_bit_flip_s0").rename("runs/mine, moved")
    assert main([*command, "folder=runs/mine, moved"]) == 0
    said = capsys.readouterr().out.splitlines()
    assert said[-1] == "the best: torchrl-her train 'preset=runs/mine, moved/best.yaml'"
    said = refused(*command[:-1], "tpe", "folder=runs/mine, moved")
    assert "mine, moved holds a search with --sampler=random, not --sampler=tpe" in said


def test_list_names_the_spaces(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["list"]) == 0
    assert re.search(r"^spaces:\n(  \w+ +learning_rate, gamma, .*\n)+", capsys.readouterr().out, re.MULTILINE)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--trials", "0"], "Invalid value for '--trials': 0 is not in the range x>=1"),
        (["--minutes", "0"], "Invalid value for '--minutes': 0.0 is not in the range x>0.0"),
        (["--jobs", "0"], "Invalid value for '--jobs': 0 is not in the range x>=1"),
        (["--sampler", "grid"], "'grid' is not one of 'tpe', 'random', 'cmaes'"),
        (["--space", "ddgp"], "there is no space 'ddgp'; did you mean ddpg? The spaces are ddpg, dqn, redq"),
        (["--space", "no.yaml"], "there is no space 'no.yaml'; the spaces are"),
        (["--space", "tqc"], "the space tqc does not fit: learner=auto has no option temperature"),
        (["seed=1,2"], "seed must be one value, got 1,2"),
        (["lerning_rate=3"], "no option 'lerning_rate'; did you mean learning_rate?"),
        (["task=hand_v9"], "unknown task 'hand_v9'"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(arguments: list[str], message: str, refused: Refused) -> None:
    assert message in refused("tune", *arguments)
    assert not Path("runs").exists()


def test_without_optuna_the_remedy_is_given(monkeypatch: pytest.MonkeyPatch, refused: Refused) -> None:
    for name in [name for name in sys.modules if name.startswith("torchrl_her_recipes.tuning")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.delitem(vars(torchrl_her_recipes), "tune", raising=False)  # kept once it was loaded
    monkeypatch.setitem(sys.modules, "optuna", None)
    assert refused("tune", *_small()) == "torchrl-her: a search needs Optuna: pip install '.[tune]'\n"
