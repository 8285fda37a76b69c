"""The buffer of a run is made as its recipe says."""

from __future__ import annotations

import math

import pytest
import torch

from torchrl_her_recipes import build, look_at, make_recipe
from torchrl_her_recipes.components import buffers

from ..small import small

SMALL = {"task": "hand_v0", "num_envs": 2, "steps_per_batch": 2, "pictures": False}


@pytest.mark.parametrize("learner", ["ddpg", "td3", "sac", "redq", "tqc"])
def test_priorities_are_schaul_s_power_of_the_absolute_td_error(learner: str) -> None:
    """The loss gives the error or its square: alpha makes up for that."""
    components = build(small(learner=learner, priority_alpha=0.8))
    buffer, loss = components.buffer, components.loss
    for _ in range(6):  # until episodes end
        buffer.extend(components.collector.next())
    rows = buffer.sample(32)
    rows["next", "terminated"].fill_(True)
    rows["next", "reward"].fill_(-40.0)  # then the error is about 40
    loss(rows)
    power = (rows["td_error"].mean().log() / math.log(40.0)).round().item()
    assert buffer.sampler.alpha * power == pytest.approx(0.8)


def test_the_exponent_of_importance_weights_rises_until_the_last_epoch() -> None:
    components = build(small(epochs=3, priority_beta=0.4, priority_beta_end=1.0))
    betas = []
    for schedule in 4 * components.trainer().schedules[-1:]:
        betas.append(components.buffer.sampler.beta)
        schedule.step()
    assert betas == pytest.approx([0.4, 0.7, 1.0, 1.0])


@pytest.mark.parametrize("relative", [True, False])
def test_the_floor_of_ibs_is_relative_or_absolute_as_the_recipe_says(relative: bool) -> None:
    (weights,) = build(small(algo="her_ibs", floor_is_relative=relative)).buffer.writer.goal_weights
    assert weights.floor_is_relative is relative


@pytest.mark.parametrize("n_steps", [1, 3])
def test_steps_and_their_discount_are_the_recipe_s(n_steps: int) -> None:
    components = build(small(n_steps=n_steps, gamma=0.9))
    options = components.buffer.writer.options
    assert (options.n_steps, options.gamma) == (n_steps, 0.9)


def test_goals_are_drawn_from_where_the_recipe_says() -> None:
    for values, expected in (
        ({"goal_sources": "auto"}, {"future": 3, "actual": 2}),
        ({"k": 4}, {"future": 4}),
        ({"k": 2, "strategy": "final"}, {"final": 2}),
        ({"goal_sources": {"future": 2, "actual": 3}}, {"future": 2, "actual": 3}),
        ({"algo": "no_hindsight"}, {}),
    ):
        assert build(small(**values)).buffer.writer.options.sources == expected


@pytest.mark.parametrize("order", [None, "threshold", "all_at_once"])
def test_sampled_transitions_are_shifted_in_the_stage_of_each(order: str | None) -> None:
    """The first column of the state, and the goal behind the observation, are moved far away together."""
    stages = {"algo": "her"} if order is None else {"algo": "cher", "order": order, "num_runs": 2}
    goal = build(small(task="hand_v1")).env.observation_spec["observation"].shape[-1]
    symmetry = {"shifts": [{"columns": [0, goal], "most": 1e6}]}
    components = build(small(task="hand_v1", **stages, symmetry=symmetry, normalize=False))
    components.trainer().epoch()
    curriculum = components.curriculum and components.curriculum.curriculum
    rows = components.buffer.sample(64)
    stored = components.buffer.storage[rows["index"].flatten()]
    assert float(stored["observation"].abs().max()) < 1e3
    for part in (rows, rows["next"]):
        inputs = part["input"] if curriculum else torch.cat((part["observation"], part["desired_goal"]), -1)
        assert float(inputs[:, 0].abs().max()) > 1e5
        if order == "all_at_once":
            moved = curriculum.input_columns[rows["stage"].squeeze(-1)]
            goals = inputs[moved == goal]
            assert len(goals) > 0
            assert ((inputs - inputs[:, :1])[moved == goal].abs() < 1e3).all()
            assert (inputs[(moved != goal) & (moved != 0)].abs() < 1e3).all()


@pytest.mark.parametrize(
    ("symmetry", "message"),
    [
        ("nowhere.yaml", "there is no symmetry 'nowhere.yaml'; the symmetries are fetch"),
        ([1], r"symmetry must be a mapping, got \[1\]"),
        ({"mirrors": {0: 0.0}}, "is no symmetry: .*unexpected keyword argument 'mirrors'"),
        ({"shifts": [{"columns": [0]}]}, "is no symmetry: .*missing .* 'most'"),
        ("fetch", "the state has the columns 0 to .*, but the symmetry has"),
        ({"mirror": {99: 0.0}}, "the state has the columns 0 to .*, but the symmetry has 99"),
    ],
)
def test_symmetries_that_cannot_be(symmetry: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        build(small(symmetry=symmetry))


def test_refused_goals_are_left_out_if_the_recipe_says_so() -> None:
    assert build(small()).buffer.writer.options.redraw
    assert not build(small(redraw=False)).buffer.writer.options.redraw


def test_virtual_transitions_of_a_recipe_get_the_info_of_their_own_step() -> None:
    task = {"task": "gym:tests.envs.gym.costly:tests/InfoCost-v0", "task.options.info_keys": ["cost"]}
    recipe = small(**task, **{"task.options.achieved_reward": -0.5, "normalize": False})
    assert look_at(recipe, steps=100).disagree == 0
    components = build(recipe)
    for _ in range(6):  # until episodes end
        components.buffer.extend(components.collector.next())
    rows = components.buffer[:]
    after, virtual = rows["next"], rows["virtual"].flatten()
    far = (after["observation"] - after["desired_goal"]).abs() > 0.5
    assert int(virtual.sum()) > 50
    assert (~far[virtual]).any()
    torch.testing.assert_close(after["reward"], -far.float() - rows["action"].abs() / 4)
    assert "info" not in rows.keys()
    components.close()


def test_sizes_beyond_memory_are_refused_by_name() -> None:
    # 9 + 2 numbers and 3 flags before and after the action, 3 of the action, and a reward
    message = "buffer_size=1000000000000 needs 220000 GB for num_runs=2, 110 bytes for each transition, but"
    with pytest.raises(ValueError, match=message):
        build(make_recipe(**SMALL, buffer_size=10**12, num_runs=2))


def test_a_buffer_that_just_fits_is_made(monkeypatch: pytest.MonkeyPatch) -> None:
    recipe = make_recipe(**SMALL, buffer_size=1_000, batch_size=16)
    monkeypatch.setattr(buffers, "memory_of", lambda device: 110_000.0)
    assert build(recipe).buffer.storage.max_size == 1_000
    monkeypatch.setattr(buffers, "memory_of", lambda device: 109_999.0)
    with pytest.raises(ValueError, match="buffer_size=1000 needs 0 GB"):
        build(recipe)


def test_limits_that_limit_nothing_may_be_infinite() -> None:
    recipe = make_recipe(**SMALL, max_grad_norm=math.inf, normalize=True, normalize_clip=math.inf)
    assert build(recipe).recipe.learner.max_grad_norm == torch.inf
