"""Recipes: defaults that work, and one clear line for what cannot."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data.replay_buffers.samplers import PrioritizedSampler, RandomSampler
from torchrl.modules import ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import SACLoss, SoftUpdate, TD3Loss

from torchrl_her import CriticNet, make_actor, make_critic
from torchrl_her_recipes import ALGORITHMS, Recipe
from torchrl_her_recipes.parts import make_collector

from .small import small


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"task": "hand_v9"}, "unknown task 'hand_v9'; the tasks are hand_reach, hand_v0"),
        ({"algo": "sarsa"}, "unknown algorithm 'sarsa'; the algorithms are no_hindsight, her, filtered_her"),
        ({"strategy": "past"}, "unknown goal strategy 'past'; the strategies are future, final, episode"),
        ({"sampler": "best"}, "sampler must be one of prioritised, uniform, got 'best'"),
        ({"threshold": -0.1}, "threshold must be above 0, got -0.1"),
        ({"batch_size": 256, "buffer_size": 100}, "batch_size=256 must fit buffer_size=100"),
        ({"epoch_frames": 100}, "epoch_frames=100 must be at least num_envs times steps_per_batch, 640"),
        ({"seed": 2**40}, "seed must be below 2147483648, got 1099511627776"),
        ({"k": -1}, "k must be at least 0, got -1"),
        ({"seed": -1}, "seed must be at least 0, got -1"),
        ({"num_runs": 0}, "num_runs must be at least 1, got 0"),
        ({"gamma": 1.0}, "gamma must be below 1, got 1.0"),
        ({"tau": 1.5}, "tau must be between 0 and 1, got 1.5"),
        ({"learning_rate": float("nan")}, "learning_rate must be above 0, got nan"),
        ({"epsilon_start": 0.1, "epsilon_end": 0.5}, "epsilon_end=0.5 must not be above epsilon_start=0.1"),
    ],
)
def test_what_cannot_work_is_named(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Recipe(**options)


def test_values_that_no_recipe_has_are_named() -> None:
    with pytest.raises(ValueError, match="a recipe has no speed; it has .*epochs"):
        Recipe.from_dict({"speed": 3})


@pytest.mark.parametrize("algo", ALGORITHMS)
@pytest.mark.parametrize("sampler", ["prioritised", "uniform"])
def test_every_algorithm_runs_with_every_sampler(algo: str, sampler: str) -> None:
    parts = small(algo=algo, sampler=sampler).build()
    result = parts.run(progress=False)
    assert isinstance(parts.buffer.sampler, PrioritizedSampler if sampler == "prioritised" else RandomSampler)
    assert len(result.rows) == 2
    assert (result.rows[-1]["rows_virtual"] > 0) == (algo != "no_hindsight")
    filtered = {"filtered_her", "filtered_her_ibs", "cher", "cher_ibs"}
    assert parts.buffer.writer.filter_achieved == (algo in filtered)


@pytest.mark.parametrize("strategy", ["future", "final", "episode"])
def test_every_goal_strategy_runs(strategy: str) -> None:
    assert small(strategy=strategy, epochs=1).build().run(progress=False).rows


@pytest.mark.parametrize(
    "options",
    [
        {"batch_norm": True},
        {"batch_norm": True, "num_runs": 2},
        {"hard_update_interval": 50},
        {"dtype": "float64"},
        {"k": 0},
    ],
)
def test_other_options_run(options: dict[str, Any]) -> None:
    rows = small(epochs=1, **options).build().run(progress=False).rows
    # without virtual goals there is no distribution of them
    values = [value for row in rows for name, value in row.items() if name != "kl" or options.get("k", 4)]
    assert torch.tensor(values).isfinite().all()


def test_schaul_s_alpha_is_halved_because_errors_come_squared() -> None:
    assert small(priority_alpha=0.6).build().buffer.sampler.alpha == pytest.approx(0.3)


def test_stored_rows_hold_nothing_of_the_real_goal() -> None:
    parts = small(epochs=1).build()
    parts.run(progress=False)
    rows = parts.buffer[:]
    assert "state" not in rows.keys()
    assert torch.equal(rows["desired_goal"], rows["next", "desired_goal"])


def test_the_stored_reward_is_the_environment_s() -> None:
    parts = small(epochs=1, task="hand_v2").build()
    parts.run(progress=False)
    after = parts.buffer[:]["next"]
    ball = after["observation"][:, 5:7]
    reward = parts.env.compute_reward(ball, after["desired_goal"])
    assert torch.equal(after["reward"], reward)
    assert torch.equal(after["terminated"], reward == 0)


# Swapping parts


def test_td3_may_take_the_place_of_ddpg() -> None:
    parts = small().build()
    actor = parts.actor
    loss = TD3Loss(
        actor,
        make_critic((9, 2), 3),
        bounds=(-1.0, 1.0),
        num_qvalue_nets=2,
    )
    loss.make_value_estimator(gamma=0.98)
    parts.loss, parts.critic = loss, None
    parts.optimiser = torch.optim.Adam(loss.parameters(), lr=1e-3)
    parts.target = SoftUpdate(loss, tau=0.01)
    before = torch.cat([p.detach().flatten().clone() for p in actor.parameters()])
    rows = parts.run(progress=False).rows
    after = torch.cat([p.detach().flatten() for p in actor.parameters()])
    assert not torch.equal(before, after)
    assert rows[-1]["loss_qvalue"] > 0


class TwoHeads(nn.Module):
    """Location and scale of an action."""

    def __init__(self) -> None:
        super().__init__()
        self.body = nn.Sequential(nn.Linear(11, 32), nn.ReLU(), nn.Linear(32, 6))

    def forward(self, observation: torch.Tensor, goal: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        location, scale = self.body(torch.cat((observation, goal), -1)).chunk(2, -1)
        return location, nn.functional.softplus(scale) + 0.01


def test_sac_may_take_the_place_of_ddpg() -> None:
    parts = small().build()
    keys = ["observation", "desired_goal"]
    actor = ProbabilisticActor(
        TensorDictModule(TwoHeads(), in_keys=keys, out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        return_log_prob=False,
    )
    critic = ValueOperator(CriticNet(11, 3), in_keys=[*keys, "action"])
    loss = SACLoss(actor, critic, action_spec=parts.env.action_spec_unbatched)
    loss.make_value_estimator(gamma=0.98)
    parts.actor = parts.policy = actor
    parts.critic, parts.loss, parts.target = None, loss, SoftUpdate(loss, tau=0.01)
    parts.optimiser = torch.optim.Adam(loss.parameters(), lr=1e-3)
    parts.collector = make_collector(parts.recipe, parts.env, actor)
    rows = parts.run(progress=False).rows
    assert rows[-1]["loss_qvalue"] > 0
    assert rows[-1]["loss_alpha"] != rows[0]["loss_alpha"]


def test_actor_of_ones_own_keys() -> None:
    assert make_actor((3,), 2, in_keys=["seen"], action=("deep", "action")).out_keys == [("deep", "action")]


@pytest.mark.parametrize(
    ("options", "compiles"),
    [
        ({"epochs": 30}, True),  # 30,720 gradient steps
        ({"epochs": 10}, False),
        ({"epochs": 10, "compile": "always"}, True),
        ({"epochs": 30, "compile": "never"}, False),
        ({"epochs": 30, "num_runs": 15}, False),  # 3,840 rows: nothing to win
        ({"epochs": 30, "num_runs": 15, "batch_size": 64}, True),
    ],
)
def test_long_runs_of_few_rows_are_compiled(options: dict[str, Any], compiles: bool) -> None:
    assert Recipe(**options).compiles is compiles


def test_compiling_what_cannot_be_is_said() -> None:
    parts = small(compile="always", batch_norm=True).build()
    with pytest.warns(UserWarning, match="compile=always has no effect"):
        parts.learner()
