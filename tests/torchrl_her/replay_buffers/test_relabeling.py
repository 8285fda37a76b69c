"""Virtual transitions, whether they are made when episodes are written or when rows are sampled."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

from torchrl_her import EnvKeys, EnvReward, GoalReward, GoalWeights, HERSampleUnit, HERWriter

from ..her_data import WANTED, PreferFar, along, costly, make_batch, pairs, tags

pytestmark = pytest.mark.filterwarnings("ignore:the reward function gives")  # made up as each test needs it
REWARD = GoalReward(0.5)  # tags differ by at least 1
# The reward of a goal, which ends no episode, and one that no goal achieves.
ENDLESS = EnvReward(lambda a, d: REWARD(a, d)[0], lambda a, d: torch.zeros_like(a[..., :1]).bool())
NEVER = EnvReward(
    lambda a, d: REWARD(a, d)[0] - 1.0,
    lambda a, d: torch.zeros_like(a[..., :1]).bool(),
    achieved_reward=0.0,
)
N_STEPS: dict[str, Any] = {"n_steps": 3, "gamma": 0.5}

Relabel = Callable[..., TensorDict]


def written(batch: TensorDict, *, reward: Any = REWARD, **options: Any) -> TensorDict:
    """All rows, real and virtual, that a writer stores of a batch [N, T]."""
    writer = HERWriter(reward, **options)
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(50_000), writer=writer)
    buffer.set_rng(torch.Generator().manual_seed(0))
    buffer.extend(batch.clone())
    return buffer[:]


def sampled(batch: TensorDict, *, ndim: int = 1, reward: Any = REWARD, **options: Any) -> TensorDict:
    """Rows, real and virtual ones at random, that a buffer with a sample unit gives; at least 2,000."""
    unit = HERSampleUnit(reward, **options)
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(10_000, ndim=ndim), sample_unit=unit, collate_fn=unit.relabel
    )
    buffer.set_rng(torch.Generator().manual_seed(0))
    buffer.extend(batch.clone() if ndim == 2 else batch.reshape(-1))
    return buffer.sample(max(2_000, 4 * len(buffer)))


@pytest.fixture(params=[written, sampled, partial(sampled, ndim=2)], ids=["written", "sampled", "sampled 2d"])
def relabel(request: pytest.FixtureRequest) -> Relabel:
    return request.param


def virtual_of(rows: TensorDict) -> TensorDict:
    return rows[rows["virtual"].squeeze(-1)]


# Where goals come from


@pytest.mark.parametrize("strategy", ["future", "final", "episode"])
def test_goals_are_achieved_by_next_states_of_the_same_episode(strategy: str, relabel: Relabel) -> None:
    rows = relabel(make_batch([[5, 3], [2, 6]]), strategy=strategy, k=200)
    goals: dict[str, Callable[[int, int], Any]] = {
        "future": lambda step, length: range(step + 1, length + 1),
        "final": lambda step, length: [length],
        "episode": lambda step, length: range(1, length + 1),
    }
    assert pairs(rows) == {
        (origin + step, origin + goal)
        for origin, length in ((0, 5), (100, 3), (1000, 2), (1100, 6))
        for step in range(length)
        for goal in goals[strategy](step, length)
    }
    assert torch.equal(rows["virtual"].squeeze(-1), rows["desired_goal"][:, 0] != WANTED)
    assert torch.equal(rows["desired_goal"], rows["next", "desired_goal"])


def test_episodes_of_length_one_and_success_at_the_first_step(relabel: Relabel) -> None:
    rows = virtual_of(relabel(make_batch([[1, 1, 1], [1, 1, 1]], terminated=True), k=2))
    assert pairs(rows) == {(start, start + 1) for start in (0, 100, 200, 1000, 1100, 1200)}
    assert (rows["next", "reward"] == 0).all()


@pytest.mark.parametrize(("k", "share"), [(0, 0.0), (1, 0.5), (4, 0.8)])
def test_share_of_virtual_rows_in_a_batch(k: int, share: float, relabel: Relabel) -> None:
    virtual = relabel(make_batch([[20] * 65] * 4), k=k)["virtual"]
    assert virtual.float().mean().item() == pytest.approx(share, abs=0.015)


# What follows from a goal


def test_reward_terminated_and_done_are_recomputed_and_truncated_stays(relabel: Relabel) -> None:
    rows = virtual_of(relabel(make_batch([[3]]), strategy="final", k=1))
    last = rows["observation"][:, :1] == 2
    assert torch.equal(rows["next", "reward"], last.float() - 1)
    for key in ("terminated", "truncated", "done"):
        assert torch.equal(rows["next", key], last)


def test_a_real_termination_is_undone_where_the_goal_is_not_reached(relabel: Relabel) -> None:
    reward = EnvReward(
        lambda a, d: -torch.ones_like(a[..., :1]),
        lambda a, d: torch.zeros_like(a[..., :1]).bool(),
        achieved_reward=0.0,
    )
    rows = relabel(make_batch([[3]], terminated=True), reward=reward, k=1)
    for key in ("terminated", "done"):
        assert not rows["next", key][rows["virtual"]].any()
        assert torch.equal(rows["next", key], ~rows["virtual"] & (rows["observation"][:, :1] == 2))


def test_real_rows_and_all_other_entries_stay_as_they_were(relabel: Relabel) -> None:
    batch = make_batch([[4, 2]])
    rows = relabel(batch)
    tag = rows["observation"][:, 0].long()
    origin = batch.reshape(-1).exclude("state", ("next", "state"))[tag % 100 + 4 * (tag // 100)]
    real = ~rows["virtual"].squeeze(-1)
    for key in origin.keys(True, True):
        assert torch.equal(rows[key][real], origin[key][real]), key
    for key in ("observation", "action", "achieved_goal", ("next", "observation"), ("next", "truncated")):
        assert torch.equal(rows[key], origin[key]), key
    assert torch.equal(rows["next", "achieved_goal"], origin["next", "achieved_goal"])
    assert "state" not in rows.keys()  # which holds the real goal
    assert ("next", "state") not in rows.keys(True)


def test_the_reward_is_asked_in_the_order_achieved_desired(relabel: Relabel) -> None:
    def compute_reward(achieved: Tensor, desired: Tensor) -> Tensor:
        return (achieved[..., :1] >= desired[..., :1]).float() - 1.0

    reward = EnvReward(compute_reward, lambda a, d: compute_reward(a, d) == 0)
    rows = virtual_of(relabel(make_batch([[6]]), reward=reward, strategy="episode"))
    expected = compute_reward(rows["next", "achieved_goal"], rows["desired_goal"])
    assert torch.equal(rows["next", "reward"], expected)
    assert 0 < (expected == 0).float().mean() < 1


# Filter and weights


def test_the_filter_leaves_out_goals_already_achieved_before_the_action(relabel: Relabel) -> None:
    rows = relabel(along([0, 0, 0, 1, 2, 3]), filter_achieved=True, k=50)  # the ball moves from step 2 on
    # Not (0, 0) and (1, 0): the goal 0 is where the ball already is. Step 2 achieves 1 by itself: kept.
    assert pairs(rows) == {
        (t, g)
        for t, goals in ((0, (1, 2, 3)), (1, (1, 2, 3)), (2, (1, 2, 3)), (3, (2, 3)), (4, (3,)))
        for g in goals
    }
    real = rows["observation"][~rows["virtual"].squeeze(-1), 0]
    assert set(real.tolist()) == set(range(5))


def test_the_filter_asks_the_reward_even_where_nothing_ever_terminates(relabel: Relabel) -> None:
    assert not relabel(along([0, 0, 0, 0]), reward=ENDLESS, filter_achieved=True)["virtual"].any()


@pytest.mark.parametrize("reward", [REWARD, ENDLESS], ids=["ends", "goes on"])
def test_where_episodes_go_on_at_goals_the_filter_keeps_what_teaches_to_stay(
    reward: Any, relabel: Relabel
) -> None:
    """From 0 to 1, and staying there: the last transition had its goal before, but not at the start."""
    rows = relabel(along([0, 0, 1, 1, 0]), reward=reward, filter_achieved=True, strategy="episode", k=8)
    late = {0.0} if reward is REWARD else {0.0, 1.0}
    assert pairs(rows) == {(0, 1), (1, 1), *((t, goal) for t in (2, 3) for goal in late)}


@pytest.mark.parametrize("weighted", [False, True])
def test_goals_that_pass_the_filter_are_drawn_in_proportion(weighted: bool, relabel: Relabel) -> None:
    weights, batch = PreferFar() if weighted else None, along([0, 0, 1, 3, 0], episodes=1_000)
    rows = virtual_of(relabel(batch, k=6, filter_achieved=True, weights=weights))
    time, goal = rows["observation"][:, 0], rows["desired_goal"][:, 0]
    for t, kept in enumerate([[1.0, 3.0], [1.0, 3.0], [3.0, 0.0], [0.0]]):  # the goal 0 is achieved at first
        drawn, total = goal[time == t], sum(kept) if weighted else len(kept)
        assert (len(drawn) > 3_000) == bool(total)
        assert relabel is not written or len(drawn) in (0, 6_000)  # k of each episode
        for value in (0.0, 1.0, 3.0) if total else ():
            expected = (value if weighted else 1) / total if value in kept else 0.0
            assert (drawn == value).float().mean().item() == pytest.approx(expected, abs=0.05)  # 5 deviations
    if weights is not None:
        assert weights.chosen == len(rows)


class Constant(GoalWeights):
    """All goals are as useful."""

    def __init__(self, value: float | bool) -> None:
        self.value = value

    def __call__(self, goals: Tensor) -> Tensor:
        return torch.full(goals.shape[:-1], self.value)


@pytest.mark.parametrize("bad", [-1.0, float("nan"), float("inf")])
def test_weights_that_cannot_be_are_refused(bad: float, relabel: Relabel) -> None:
    with pytest.raises(ValueError, match="weights of goals must be finite and at least 0"):
        relabel(make_batch([[4]]), weights=Constant(bad))


@pytest.mark.parametrize("nothing", [0.0, False])
def test_weights_of_zero_give_no_virtual_row(nothing: float | bool, relabel: Relabel) -> None:
    assert not relabel(make_batch([[4]]), weights=Constant(nothing))["virtual"].any()


# Several steps


@pytest.mark.parametrize(
    ("n_steps", "real", "virtual", "steps"),
    [
        (2, [-2.0, -4.0, -8.0, -8.0], [-1.5, -1.5, -1.0, 0.0], [2, 2, 2, 1]),
        (3, [-3.0, -6.0, -8.0, -8.0], [-1.75, -1.5, -1.0, 0.0], [3, 3, 2, 1]),
        (10, [-4.0, -6.0, -8.0, -8.0], [-1.75, -1.5, -1.0, 0.0], [4, 3, 2, 1]),
    ],
)
def test_returns_over_several_steps_by_hand(
    n_steps: int, real: list[float], virtual: list[float], steps: list[int], relabel: Relabel
) -> None:
    batch = make_batch([[4]])
    batch["next", "reward"][0, :, 0] = torch.tensor([-1.0, -2.0, -4.0, -8.0])
    rows = relabel(batch, strategy="final", k=1, n_steps=n_steps, gamma=0.5)
    for is_virtual in (False, True):
        own = rows[rows["virtual"].flatten() == is_virtual]
        step, after = own["observation"][:, 0].long(), own["next"]
        behind = step + torch.tensor(steps)[step]
        assert set(step.tolist()) == {0, 1, 2, 3}
        assert torch.equal(after["reward"][:, 0], torch.tensor(virtual if is_virtual else real)[step])
        assert torch.equal(own["steps_to_next_obs"][:, 0], torch.tensor(steps)[step])
        assert torch.equal(after["observation"][:, 0], behind.float())
        for key in ("truncated", "done"):
            assert torch.equal(after[key][:, 0], behind == 4)
        assert torch.equal(after["terminated"][:, 0], (behind == 4) & is_virtual)
        assert torch.equal(own["desired_goal"], after["desired_goal"])
        assert "state" not in after.keys()


def test_goals_that_are_passed_on_the_way_cut_the_steps(relabel: Relabel) -> None:
    batch = along([0, 1, 2, 3, 1])
    batch["next", "observation"][..., 0] = torch.arange(1.0, 5.0)
    rows = virtual_of(relabel(batch, strategy="final", k=1, **N_STEPS))
    first, second = (rows[rows["observation"][:, 0] == step][0] for step in (0, 1))
    assert first["next", "reward"].item() == 0.0  # the goal 1 is achieved by the first step, not by the last
    assert (first["next", "terminated"].item(), first["next", "done"].item()) == (True, True)
    assert (first["steps_to_next_obs"].item(), first["next", "observation"][0].item()) == (1, 1.0)
    assert not first["next", "truncated"].item()
    assert second["next", "reward"].item() == -1.5
    assert (second["steps_to_next_obs"].item(), second["next", "terminated"].item()) == (3, True)


@pytest.mark.parametrize("filtered", [False, True])
@pytest.mark.parametrize(
    ("n_steps", "rewards"), [(1, [-1.25, -1.5, -0.75]), (2, [-1.25 - 0.5 * 1.5, -1.5 - 0.5 * 0.75, -0.75])]
)
def test_virtual_transitions_are_rewarded_with_their_own_info(
    n_steps: int, rewards: list[float], filtered: bool, relabel: Relabel
) -> None:
    rule, batch = costly([[3], [3]])
    options: dict[str, Any] = {"strategy": "final", "k": 1}
    options |= {"n_steps": n_steps, "gamma": 0.5, "filter_achieved": filtered}
    rows = virtual_of(relabel(batch, reward=rule, **options))
    step = rows["observation"][:, :1] % 1000
    assert set(zip(tags(step), tags(rows["next", "reward"]), strict=True)) == set(enumerate(rewards))
    assert torch.equal(rows["next", "terminated"], step + n_steps >= 3)


# Ends that have nothing to do with the goal

FALLS = pytest.mark.parametrize(
    ("relabel", "options"),
    [(written, {}), (written, N_STEPS), (written, {"per": "episode"}), (sampled, {}), (sampled, N_STEPS)],
)


@FALLS
def test_a_fall_terminates_virtual_transitions_too(relabel: Relabel, options: dict[str, Any]) -> None:
    """An episode that terminated without success would have done so for any goal."""
    batch = make_batch([[4]], terminated=True)
    batch["next", "reward"].fill_(-1.0)
    rows = virtual_of(relabel(batch, reward=NEVER, k=2, **options))
    at_end = rows["next", "observation"][:, 0] == 4
    assert at_end.any()
    for key in ("terminated", "done"):
        assert torch.equal(rows["next", key][:, 0], at_end)


@FALLS
def test_what_a_fall_cost_is_kept_for_other_goals(relabel: Relabel, options: dict[str, Any]) -> None:
    drawn = []
    for cost in (0.0, 5.0):
        batch = make_batch([[4]], terminated=True)
        rewards = NEVER(batch["next", "achieved_goal"], batch["next", "desired_goal"])[0]
        batch["next", "reward"] = rewards - torch.where(batch["next", "terminated"], cost, 0.0)
        torch.manual_seed(0)
        drawn.append(virtual_of(relabel(batch, reward=NEVER, k=2, **options)))
    free, dear = drawn
    assert torch.equal(free["desired_goal"], dear["desired_goal"])
    at_end = free["next", "observation"][:, :1] == 4
    assert at_end.any()
    steps = free.get("steps_to_next_obs", torch.ones_like(at_end, dtype=torch.int64))
    expected = free["next", "reward"] - torch.where(at_end, 5.0 * 0.5 ** (steps - 1), 0.0)
    torch.testing.assert_close(dear["next", "reward"], expected)


# Options


def test_keys_of_ones_own(relabel: Relabel) -> None:
    batch = make_batch([[4]])
    for rows in (batch, batch["next"]):
        rows.rename_key_("desired_goal", ("goals", "wanted")).rename_key_("achieved_goal", ("goals", "got"))
    batch["next"].rename_key_("reward", "cost")
    keys = EnvKeys(achieved_goal=("goals", "got"), desired_goal=("goals", "wanted"), reward="cost")
    rows = relabel(batch, virtual_key=None, keys=keys)
    assert "virtual" not in rows.keys()
    is_virtual = rows["goals", "wanted"][:, 0] != WANTED
    assert is_virtual.float().mean().item() == pytest.approx(0.8, abs=1e-6 if relabel is written else 0.02)
    assert torch.equal(rows["goals", "wanted"], rows["next", "goals", "wanted"])
    assert (rows["next", "cost"][is_virtual] == 0).any()
