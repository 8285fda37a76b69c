"""Policies of tiny networks that nobody trained, made without a run."""

from __future__ import annotations

import importlib.util
from dataclasses import asdict, replace
from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from torchrl_her.modules import RunningNorm
from torchrl_her_envs.common.goal_env import goal_env
from torchrl_her_recipes import Policy, PolicyInfo, Recipe, make_recipe
from torchrl_her_recipes.components.agents import find_builder, shape_of
from torchrl_her_recipes.components.curricula import read_curriculum
from torchrl_her_recipes.components.envs import TaskEnvs
from torchrl_her_recipes.components.learner import acting
from torchrl_her_recipes.policies.info import describe_env

needs_onnx = pytest.mark.skipif(
    any(importlib.util.find_spec(name) is None for name in ("onnx", "onnxruntime", "onnxscript")),
    reason="needs the extra onnx",
)

LEARNERS: list[dict[str, Any]] = [
    {"learner": "ddpg"},
    {"learner": "td3", "norm": "layer"},
    {"learner": "sac", "activation": "tanh"},
    {"learner": "redq", "critics": 3},
    {"learner": "tqc", "activation": "elu"},
    {"learner": "dqn", "task": "bit_flip", "norm": "layer"},
]


def make_player(recipe: Recipe, env: EnvBase) -> TensorDictModuleBase:
    """The greedy policy that a run of the recipe trains, with its normalization."""
    builder = find_builder(recipe.learner, shape_of(recipe.task.name, recipe.run, env))
    with torch.random.fork_rng(devices=[]):
        return acting(builder.player(recipe.run.num_runs), builder.norm())


def tiny_policy(*, task: str = "hand_v1", scale: float = 1.0, relay: bool = False, **options: Any) -> Policy:
    """A policy whose actions differ from state to state, with statistics of inputs if it normalizes."""
    recipe = make_recipe(task=task, algo="her", hidden=8, **options)
    env = TaskEnvs.of(recipe).make(1, [0])
    player = make_player(recipe, env)
    with torch.no_grad():
        for weight in player.parameters():
            weight.copy_(0.5 * torch.randn_like(weight))
    own = describe_env(env)
    info = PolicyInfo(
        task=task,
        **own,
        normalize_clip=recipe.learner.normalize_clip if recipe.learner.normalize else None,
        algorithm="her",
        learner=recipe.learner.name,
        seed=0,
        frames=100,
        dtype=recipe.run.dtype,
        success=0.5,
        reached=0.75,
        versions={"torchrl-her": "0.1.0"},
    )
    if scale != 1.0:
        info = replace(info, low=tuple(-scale for _ in info.low), high=tuple(2 * scale for _ in info.high))
    if relay:  # with a threshold that divides random states
        stages = read_curriculum(goal_env(env).stages(), goal_env(env)).resolved
        info = replace(info, stages=tuple(asdict(stage) | {"threshold": 3.0} for stage in stages))
    for module in player.modules():
        if isinstance(module, RunningNorm):
            module.update(states(info, 200, mean=3.0))
    return Policy(info, recipe, player.state_dict(), source="tiny")


def states(info: PolicyInfo, rows: int, *, mean: float = 0.0) -> TensorDictBase:
    """Random inputs of a policy."""
    return TensorDict(
        {key: mean + 2 * torch.randn(rows, width) for key, width in info.widths.items()}, batch_size=[rows]
    )
