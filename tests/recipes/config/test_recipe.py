"""Recipes: defaults that work, and one clear line for what cannot."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.modules import ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import DQNLoss, SACLoss, SoftUpdate, TD3Loss

from torchrl_her import FusedLearner, LossLearner, make_actor, make_critic
from torchrl_her.modules import CriticNet
from torchrl_her.native import load_steps
from torchrl_her.replay_buffers import RunsPrioritizedSampler, RunsSampler
from torchrl_her_recipes import ALGORITHMS, Recipe, build, make_recipe, run
from torchrl_her_recipes.components.assembly import make_collector
from torchrl_her_recipes.config.presets import load_preset

from ..small import small


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"task": "hand_v9"},
            "unknown task 'hand_v9'; did you mean hand_v0. The tasks are hand_reach, hand_v0",
        ),
        ({"algo": "sarsa"}, "unknown algorithm 'sarsa'; the algorithms are no_hindsight, her, filtered_her"),
        ({"strategy": "past"}, "unknown goal strategy 'past'; the strategies are future, final, episode"),
        ({"strategy": "actual"}, r"'actual', .*: write goal_sources='\{actual: 4\}'"),
        ({"goal_sources": {"actul": 2}}, "unknown goal source 'actul'; did you mean actual. The sources are"),
        ({"goal_sources": {"future": 0}}, "goal_sources.future must be a whole number of at least 1, got 0"),
        ({"goal_sources": {"future": True}}, "goal_sources.future must be a whole number .*, got True"),
        ({"goal_sources": "actual"}, r"must be numbers of goals by source, as in .*, got 'actual'"),
        ({"goal_sources": {}}, r"must be numbers of goals by source, .*, got \{\}"),
        ({"goal_sources": {"actual:2": None}}, "goal_sources needs a space behind each colon, as in "),
        ({"curriculum": "nowhere.yaml"}, "there is no curriculum 'nowhere.yaml'; the curricula are task, "),
        ({"sampler": "best"}, "sampler must be one of prioritized, uniform, got 'best'"),
        ({"threshold": -0.1}, "threshold must be above 0, got -0.1"),
        ({"batch_size": 256, "buffer_size": 100}, "batch_size=256 must be at most buffer_size=100"),
        (
            {"processes": 3, "num_envs": 64, "epoch_frames": 6_400},
            "num_envs=64 cannot be shared out among processes=3: it must be a multiple of it",
        ),
        (
            {"epoch_frames": 100, "num_envs": 64},
            "epoch_frames=100 must be at least num_envs times steps_per_batch, 640",
        ),
        (
            {"demonstrations.episodes": 3},
            "demonstrations.episodes=3 needs a file: demonstrations.file=FILE, as `torchrl-her record`",
        ),
        (
            {"demonstrations.episodes": 3, "demonstrations.file": "demos.pt", "demonstrations.share": 0},
            "demonstrations.episodes=3 has no effect with demonstrations.share=0 and ",
        ),
        ({"demonstrations.share": 1.0}, "demonstrations.share must be at least 0 and below 1, got 1.0"),
        ({"seed": 2**40}, "seed must be below 2147483648, got 1099511627776"),
        ({"k": -1}, "k must be at least 0, got -1"),
        ({"seed": -1}, "seed must be at least 0, got -1"),
        ({"num_runs": 0}, "num_runs must be at least 1, got 0"),
        ({"gamma": 1.0}, "gamma must be above 0 and below 1, got 1.0"),
        ({"tau": 1.5}, "tau must be at least 0 and at most 1, got 1.5"),
        ({"learning_rate": float("nan")}, "learning_rate must be above 0, got nan"),
        ({"epsilon_start": 0.1, "epsilon_end": 0.5}, "epsilon_end=0.5 must not be above epsilon_start=0.1"),
    ],
)
def test_what_cannot_work_is_named(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_recipe(**options)


def test_values_that_no_recipe_has_are_named() -> None:
    with pytest.raises(ValueError, match="no option 'speed'"):
        Recipe.from_dict({"speed": 3})
    with pytest.raises(ValueError, match="no option 'run.sed'; did you mean seed. The options of run"):
        Recipe.from_dict({"run": {"sed": 3}})


@pytest.mark.parametrize("task", ["bit_flip", "treasure_hunt", "chain"])
def test_a_preset_of_ddpg_serves_tasks_whose_actions_are_discrete(task: str) -> None:
    preset = load_preset("thesis")
    assert preset["learner"]["action_penalty"] == 0.0  # which DQN does not have
    recipe = make_recipe(preset, task=task, epochs=1)
    components = build(recipe)
    assert isinstance(components.loss, DQNLoss)
    assert recipe.learner.tau == preset["learner"]["tau"]
    with pytest.raises(ValueError, match="action_penalty=0.1 has no effect with learner=dqn"):
        build(make_recipe(preset, task=task, action_penalty=0.1))
    with pytest.raises(ValueError, match=f"learner=ddpg must not be used on {task}, .*: choose dqn"):
        build(make_recipe({**preset, "learner": {"name": "ddpg", **preset["learner"]}}, task=task))


@pytest.mark.parametrize(
    ("algo", "sampler"),
    [*((algo, "prioritized") for algo in ALGORITHMS), ("her", "uniform"), ("cher_ibs", "uniform")],
)
def test_every_algorithm_runs_and_with_either_sampler(algo: str, sampler: str) -> None:
    short = {"epochs": 1, "num_envs": 4, "epoch_frames": 240, "warmup_frames": 160}
    components = build(small(algo=algo, sampler=sampler, **short))
    (row,) = run(components, progress=False).rows
    kind = RunsPrioritizedSampler if sampler == "prioritized" else RunsSampler
    assert type(components.buffer.sampler) is kind
    assert row["updates"] > 0
    assert (row["rows_virtual"] > 0) == (algo != "no_hindsight")
    filtered = algo.startswith(("filtered_her", "cher"))
    assert components.buffer.writer.filter_achieved == filtered


@pytest.mark.parametrize("algo", ["filtered_her_ibs", "cher"])
def test_goals_of_other_episodes_are_written(algo: str) -> None:
    sources = {"actual": 1, "achieved": 2}
    components = build(small(algo=algo, goal_sources=sources, num_runs=2, task="hand_v1", epochs=1))
    writer = components.buffer.writer
    assert writer.options.sources == sources
    assert run(components, progress=False).rows[-1]["rows_virtual"] > 0
    assert all(goals is not None for own in writer.state_dict()["recent"][0].values() for goals in own)


@pytest.mark.parametrize("strategy", ["future", "final", "episode"])
def test_every_goal_strategy_runs(strategy: str) -> None:
    assert run(build(small(strategy=strategy, epochs=1)), progress=False).rows


@pytest.mark.parametrize(
    "options",
    [
        {"norm": "batch"},
        {"norm": "batch", "num_runs": 2},
        {"hard_update_interval": 50},
        {"dtype": "float64"},
        {"k": 0},
    ],
)
def test_other_options_run(options: dict[str, Any]) -> None:
    rows = run(build(small(epochs=1, **options)), progress=False).rows
    # without virtual goals there is no distribution of them
    values = [value for row in rows for name, value in row.items() if name != "kl" or options.get("k", 4)]
    assert torch.tensor(values).isfinite().all()


def test_stored_rows_hold_the_environment_s_reward_and_nothing_of_the_real_goal() -> None:
    components = build(small(epochs=1, task="hand_v2", normalize=False))
    run(components, progress=False)
    rows = components.buffer[:]
    after = rows["next"]
    assert "state" not in rows.keys()
    assert torch.equal(rows["desired_goal"], after["desired_goal"])
    ball = after["observation"][:, 5:7]
    reward = components.env.compute_reward(ball, after["desired_goal"])
    assert torch.equal(after["reward"], reward)
    assert torch.equal(after["terminated"], reward == 0)


# Swapping components


def test_td3_may_take_the_place_of_ddpg() -> None:
    components = build(small(epochs=1))
    actor = components.actor
    loss = TD3Loss(actor, make_critic((9, 2), 3), bounds=(-1.0, 1.0), num_qvalue_nets=2)
    loss.make_value_estimator(gamma=0.98)
    components.loss, components.critic = loss, None
    components.optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)
    components.target = SoftUpdate(loss, tau=0.01)
    before = torch.cat([p.detach().flatten().clone() for p in actor.parameters()])
    rows = run(components, progress=False).rows
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
    components = build(small())
    keys = ["observation", "desired_goal"]
    actor = ProbabilisticActor(
        TensorDictModule(TwoHeads(), in_keys=keys, out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        return_log_prob=False,
    )
    critic = ValueOperator(CriticNet(11, 3), in_keys=[*keys, "action"])
    loss = SACLoss(actor, critic, action_spec=components.env.action_spec_unbatched)
    loss.make_value_estimator(gamma=0.98)
    components.actor = components.policy = actor
    components.critic, components.loss, components.target = None, loss, SoftUpdate(loss, tau=0.01)
    components.optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)
    components.collector = make_collector(components.env, actor, components.recipe.collection.steps_per_batch)
    rows = run(components, progress=False).rows
    assert rows[-1]["loss_qvalue"] > 0
    assert rows[-1]["loss_alpha"] != rows[0]["loss_alpha"]


def test_actor_of_ones_own_keys() -> None:
    assert make_actor((3,), 2, in_keys=["seen"], action_key=("deep", "action")).out_keys == [
        ("deep", "action")
    ]


@pytest.mark.parametrize(
    ("learner", "norm"),
    [("ddpg", "none"), ("ddpg", "batch"), ("td3", "none"), ("sac", "none"), ("tqc", "none")],
)
@pytest.mark.parametrize(("runs", "dtype"), [(1, "float32"), (2, "float64")])
def test_gradient_steps_are_fused_unless_told_otherwise(
    learner: str, norm: str, runs: int, dtype: str
) -> None:
    for compile, kind in (("auto", FusedLearner), ("always", FusedLearner), ("never", LossLearner)):
        components = build(small(learner=learner, norm=norm, num_runs=runs, dtype=dtype, compile=compile))
        assert type(components.learner()) is kind


def test_where_they_cannot_be_fused_the_loss_is_used_unless_compiled_steps_are_asked_for() -> None:
    auto, always = (build(small(compile=choice)) for choice in ("auto", "always"))
    for components in (auto, always):
        components.loss.loss_function = "smooth_l1"
    assert isinstance(auto.learner(), LossLearner)
    message = "compile=always is not supported here: loss_function='smooth_l1'; choose compile=auto"
    with pytest.raises(ValueError, match=message):
        always.learner()


def test_without_a_compiler_it_warns_and_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    load_steps.cache_clear()
    monkeypatch.setenv("CXX", "no-such-compiler")
    with pytest.warns(UserWarning, match="several times slower .* no C\\+\\+ compiler no-such-compiler"):
        assert isinstance(build(small()).learner(), LossLearner)
    with pytest.raises(ValueError, match="compile=always is not supported here"):
        build(small(compile="always")).learner()


@pytest.mark.parametrize("learner", ["ddpg", "td3", "sac"])
def test_networks_have_the_shape_that_is_asked_for(learner: str) -> None:
    options = {"hidden": 8, "depth": 2, "activation": "elu", "norm": "layer"}
    components = build(small(learner=learner, **options))
    for network in (components.actor, components.critic):
        kinds = [type(module).__name__ for module in network.modules()]
        assert kinds.count("ELU") == kinds.count("StackedLayerNorm") == 2


def test_critics_of_a_run_depend_on_its_seed_alone() -> None:
    alone, beside = (
        build(
            small(learner="td3", critics=3, norm="none", seed=seed, num_runs=runs)
        ).loss.qvalue_network_params
        for seed, runs in ((4, 1), (3, 2))
    )
    for one, two in zip(alone.values(True, True), beside.values(True, True), strict=True):
        assert one.shape[0] == 3
        assert torch.equal(one[:, 0], two[:, 1])
        assert one.ndim < 4 or not torch.equal(one[0], one[1])
