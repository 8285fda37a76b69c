"""Model cards: their code runs, and their command trains the same recipe."""

from __future__ import annotations

import re
import shlex
from pathlib import Path
from typing import Any

import pytest

from torchrl_her_envs import make_env
from torchrl_her_recipes import make_recipe
from torchrl_her_recipes.cli.overrides import single
from torchrl_her_recipes.policies.model_card import card_path, check_free, training_command, write_model_card

from .tiny import needs_onnx, tiny_policy


@pytest.mark.parametrize(
    "options",
    [
        {"task": "hand_v1", "algo": "cher_ibs", "seed": 3, "sigma": 0.1, "norm": "layer"},
        {"task": "bit_flip", "algo": "her", "learner": "dqn", "task.options.bits": 8},
        {"task": "hand_v0", "algo": "her", "learner": "sac", "critics": 3, "clamp_targets": True},
        {"task": "hand_v2", "algo": "cher", "curriculum": make_env("hand_v1").stages()},
        {"task": "chain", "algo": "her", "behavior": "mega", "goal_sources": {"future": 3, "final": 1}},
    ],
    ids=lambda options: options["task"],
)
def test_the_command_trains_the_same_recipe(options: dict[str, Any]) -> None:
    recipe = make_recipe(**options)
    torchrl_her, train, *words = shlex.split(training_command(recipe))
    assert (torchrl_her, train) == ("torchrl-her", "train")
    assert make_recipe(**single(words)) == recipe


def test_the_command_has_the_stages_in_place_of_their_file() -> None:
    recipe = make_recipe(task="hand_v1", curriculum="panda_stack")
    values = single(shlex.split(training_command(recipe))[2:])
    assert make_recipe(**values).curriculum.stages == recipe.curriculum.stages
    assert "curriculum" not in values


@pytest.mark.parametrize("suffix", [pytest.param(".onnx", marks=needs_onnx), ".safetensors"])
@pytest.mark.parametrize("options", [{}, {"task": "bit_flip", "learner": "dqn"}], ids=["hand", "bits"])
def test_the_code_of_a_card_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, options: dict[str, Any], suffix: str
) -> None:
    monkeypatch.chdir(tmp_path)
    policy = tiny_policy(**options)
    policy.save(f"my policy{suffix}")
    text = Path("my policy.md").read_text()
    blocks = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    assert len(blocks) == 1
    for block in blocks:
        exec(compile(block, "card", "exec"), {})
    assert ("torchrl-her play 'my policy.safetensors'" in text) == (suffix == ".safetensors")
    assert "| success | 50.0 % of 1,000 episodes have their goal achieved at the last step |" in text
    assert "| reached | 75.0 % at some step |" in text
    assert f"`{policy.info.task}`" in text
    for part in ("How it was trained", "What it expects", "Limits", "License"):
        assert f"\n## {part}\n" in text


def test_a_page_that_somebody_wrote_is_not_replaced(tmp_path: Path) -> None:
    policy, page = tiny_policy(normalize=True), tmp_path / "mine.md"
    assert card_path(tmp_path / "mine.safetensors") == page
    check_free(page)
    write_model_card(page, "mine.safetensors", policy.info, policy.recipe)
    check_free(page)  # a newer one may replace it
    text = page.read_text()
    assert "clips\nthem to plus and minus 5." in text
    assert "It was trained on" not in text
    assert "torchrl-her export mine.safetensors --format onnx" in text
    page.write_text(text.split("\n", 1)[1])
    with pytest.raises(ValueError, match="mine.md exists, and export did not write it"):
        check_free(page)
