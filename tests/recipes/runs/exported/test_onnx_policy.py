"""A policy that onnxruntime plays, beside other modules."""

from __future__ import annotations

import copy
import pickle
from pathlib import Path

import pytest
import torch

from torchrl_her import evaluate
from torchrl_her_envs import make_env
from torchrl_her_recipes import load_policy
from torchrl_her_recipes.runs.exported.onnx_export import write_onnx

from .tiny import needs_onnx, states, tiny_policy

pytestmark = needs_onnx


def test_it_is_a_module_like_others(tmp_path: Path) -> None:
    policy = tiny_policy()
    path = tmp_path / "mine.onnx"
    write_onnx(policy.actor, policy.card, policy.recipe, path, states=states(policy.card, 5))
    loaded = load_policy(path)
    seen = states(policy.card, 6)
    wanted = loaded(seen.clone())["action"]
    path.unlink()  # it is in memory
    for same in (copy.deepcopy(loaded), pickle.loads(pickle.dumps(loaded))):
        torch.testing.assert_close(same(seen.clone())["action"], wanted, atol=0, rtol=0)
    assert list(loaded.parameters()) == []
    env = make_env("hand_v1", num_envs=3, seed=0)
    played = evaluate(env, loaded, max_steps=5)
    env.set_seed(0)
    torch.testing.assert_close(
        played["action"], evaluate(env, policy.actor, max_steps=5)["action"], atol=1e-4, rtol=0
    )
    other = make_env("robot_v0", num_envs=3).reset()
    with pytest.raises(ValueError, match="a policy of hand_v1 reads observation of width 9, got 15"):
        loaded(other)
