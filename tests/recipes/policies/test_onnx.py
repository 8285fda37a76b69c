"""ONNX files act as the policies that they were made of."""

from __future__ import annotations

import json
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDictBase

from torchrl_her_recipes.policies import onnx as onnx_files
from torchrl_her_recipes.policies.onnx import write_onnx

from .test_network import LEARNERS
from .tiny import needs_onnx, states, tiny_policy

pytestmark = needs_onnx


def played(path: Path, seen: TensorDictBase) -> np.ndarray:
    """Returns the actions that onnxruntime gives for rows of observations and goals."""
    import onnxruntime  # noqa: PLC0415

    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    return session.run(["action"], {key: value.float().numpy() for key, value in seen.items()})[0]


@pytest.mark.parametrize(
    "options",
    [
        *LEARNERS,
        {"learner": "ddpg", "normalize": True},
        {"learner": "sac", "dtype": "float64", "scale": 3.0},
        {"learner": "td3", "normalize": True, "relay": True},
    ],
    ids=lambda options: "_".join(str(value) for value in options.values()),
)
def test_onnxruntime_gives_the_policy_s_actions(options: dict[str, Any], tmp_path: Path) -> None:
    policy = tiny_policy(**options)
    path = tmp_path / "mine.onnx"
    write_onnx(policy.module, policy.info, policy.recipe.to_dict(), path, states=states(policy.info, 20))
    assert [file.name for file in tmp_path.iterdir()] == ["mine.onnx"]
    for rows in (1, 2, 333):
        seen = states(policy.info, rows, mean=2.0)
        wanted = policy(seen.to(getattr(torch, options.get("dtype", "float32"))))["action"]
        written = torch.from_numpy(played(path, seen.select("observation", "desired_goal")))
        assert written.dtype == (torch.int64 if policy.info.discrete else torch.float32)
        torch.testing.assert_close(written, wanted.to(written.dtype), atol=1e-5, rtol=0)


def test_onnxruntime_alone_plays_it(tmp_path: Path) -> None:
    """Raw inputs go in, which the graph normalizes: hand-written numbers of a network of one weight."""
    import onnxruntime  # noqa: PLC0415

    policy = tiny_policy(normalize=True)
    write_onnx(
        policy.module,
        policy.info,
        policy.recipe.to_dict(),
        tmp_path / "a.onnx",
        states=states(policy.info, 20),
    )
    session = onnxruntime.InferenceSession(str(tmp_path / "a.onnx"), providers=["CPUExecutionProvider"])
    shapes = {each.name: each.shape for each in (*session.get_inputs(), *session.get_outputs())}
    assert shapes == {"observation": ["batch", 9], "desired_goal": ["batch", 2], "action": ["batch", 3]}
    mean = policy.module.norm.mean[0].numpy().astype(np.float32)
    (at_mean,) = session.run(["action"], {"observation": mean[None, :9], "desired_goal": mean[None, 9:]})
    zeros = torch.zeros(1, 9), torch.zeros(1, 2)
    np.testing.assert_allclose(at_mean, policy.module.actor.module(*zeros).numpy(), atol=1e-5)
    (raw,) = session.run(
        ["action"], {name: np.zeros((1, n), np.float32) for name, n in policy.info.widths.items()}
    )
    assert np.abs(raw - at_mean).max() > 1e-3


def test_a_file_says_what_it_expects_and_what_made_it(tmp_path: Path) -> None:
    import onnx  # noqa: PLC0415

    policy = tiny_policy(learner="sac", normalize=True)
    path = tmp_path / "mine.onnx"
    write_onnx(policy.module, policy.info, policy.recipe.to_dict(), path, states=states(policy.info, 20))
    metadata = {each.key: each.value for each in onnx.load(path).metadata_props}
    assert set(metadata) == {"torchrl_her.card", "torchrl_her.recipe"}
    plain = json.loads(metadata["torchrl_her.card"])
    assert plain["task"] == "hand_v1"
    assert plain["widths"] == {"observation": 9, "desired_goal": 2}
    assert plain["low"] == [-1.0, -1.0, -1.0]
    assert plain["versions"] == {"torchrl-her": version("torchrl-her")}
    text = path.read_bytes()
    for trace in (b".py", str(Path.cwd()).encode(), b"site-packages"):
        assert trace not in text


def test_a_file_that_acts_otherwise_is_not_left_behind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy, other = tiny_policy(), tiny_policy()
    graph_of = onnx_files._graph_of
    monkeypatch.setattr(
        onnx_files, "_graph_of", lambda _own, card: graph_of(onnx_files.TensorPolicy(other.module), card)
    )
    path = tmp_path / "mine.onnx"
    with pytest.raises(ValueError, match="on 20 states of the task, onnxruntime's actions differ by up to"):
        write_onnx(policy.module, policy.info, policy.recipe.to_dict(), path, states=states(policy.info, 20))
    assert list(tmp_path.iterdir()) == []


def test_actions_that_are_no_numbers_are_no_match(tmp_path: Path) -> None:
    policy = tiny_policy()
    seen = states(policy.info, 20)
    seen["observation"][3] = torch.nan
    with pytest.raises(ValueError, match="differ by up to inf"):
        write_onnx(policy.module, policy.info, policy.recipe.to_dict(), tmp_path / "mine.onnx", states=seen)
