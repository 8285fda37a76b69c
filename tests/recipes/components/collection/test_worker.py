"""What a process that collects has, and how its episodes begin."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.envs import EnvBase
from torchrl.envs.utils import check_env_specs

from torchrl_her_envs.common.goal_env import goal_env
from torchrl_her_recipes import build
from torchrl_her_recipes.components.collection.worker import Beginning, WorkerCollector, make_worker_env
from torchrl_her_recipes.components.envs import TaskEnvs

from ...small import small


def worker_env(**options: Any) -> EnvBase:
    recipe = small(**options)
    return make_worker_env(TaskEnvs.of(recipe), recipe.order, recipe.collection, recipe.seeds)


def collect(env_seeds: list[int], seeds: list[int], **options: Any) -> TensorDictBase:
    options = {"processes": 2, "num_runs": 2, **options}
    components = build(small(**options))
    collector = WorkerCollector(
        worker_env(**options),
        components.policy,
        frames_per_batch=320,
        total_frames=-1,
        auto_register_policy_transforms=False,
    )
    collector.next()
    state = components.curriculum
    collector.begin(Beginning(env_seeds, seeds, None if state is None else state.progress.state_dict()))
    return collector.next().clone()


def test_it_has_its_share_of_the_environments_of_each_run() -> None:
    env = worker_env(processes=4, num_runs=3)  # 8 of each run
    assert env.batch_size == torch.Size([6])
    assert "env_ids" not in env.observation_spec
    check_env_specs(worker_env(processes=4, sync=False, algo="cher", task="hand_v1"))


def test_rows_carry_ids_where_batches_come_from_any_process() -> None:
    env = worker_env(processes=4, num_runs=3, sync=False)
    assert len(env.reset()["env_ids"].unique()) == 6
    assert goal_env(env).batch_size == torch.Size([6])


def test_seeds_repeat_what_follows_and_runs_have_their_own() -> None:
    first = collect([5, 6], [7, 8])
    same, other_env, other_draws = collect([5, 6], [7, 8]), collect([5, 9], [7, 8]), collect([5, 6], [7, 9])
    keys = ("observation", "action", "desired_goal")
    assert all(torch.equal(first[key], same[key]) for key in keys)
    for changed, key in ((other_env, "desired_goal"), (other_draws, "action")):
        assert torch.equal(first[key][:4], changed[key][:4])
        assert not torch.equal(first[key][4:], changed[key][4:])


def test_each_process_draws_the_stages_of_its_episodes() -> None:
    at_once = {"task": "hand_v1", "algo": "cher", "order": "all_at_once", "num_envs": 64, "epoch_frames": 640}
    one, same, other = (collect([5, 6], seeds, **at_once)["stage"] for seeds in ([7, 8], [7, 8], [7, 9]))
    assert torch.equal(one, same)
    assert torch.equal(one[:32], other[:32])
    assert not torch.equal(one[32:], other[32:])
    whole = collect([5, 6], [7, 8], **at_once, every_stage=True, task_share=1.0)
    assert (whole["stage"] == 1).all()
    assert "state" in whole  # of which every stage is shown where transitions are stored
