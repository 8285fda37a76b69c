"""HERWriter: every way in which relabeling is known to go wrong.

Goals are tagged with the environment, episode and state that they come from (see ``her_data``).
"""

from __future__ import annotations

import multiprocessing
import os
import pickle
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.data.replay_buffers.sample_units import Sequence
from torchrl.data.replay_buffers.samplers import PrioritizedSampler, RandomSampler, SliceSampler

from torchrl_her import EnvReward, GoalReward, GoalWeights, HERWriter
from torchrl_her.replay_buffers import RunsSampler

from ..her_data import WANTED, PreferFar, along, costly, make_batch, pairs, tag, tags

pytestmark = pytest.mark.filterwarnings("ignore:the reward function gives")  # made up as each test needs it
REWARD = GoalReward(0.5)  # tags differ by at least 1


def make_buffer(
    capacity: int = 10_000, *, prioritized: bool = False, seed: int = 0, **options: Any
) -> TensorDictReplayBuffer:
    sampler = PrioritizedSampler(capacity, alpha=0.6, beta=0.4) if prioritized else RandomSampler()
    writer = HERWriter(options.pop("reward", REWARD), **options)
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(capacity), writer=writer, sampler=sampler)
    buffer.set_rng(torch.Generator().manual_seed(seed))
    return buffer


def split(buffer: TensorDictReplayBuffer) -> tuple[TensorDict, TensorDict]:
    """The real and the virtual rows."""
    rows = buffer[:]
    virtual = rows["virtual"].squeeze(-1)
    return rows[~virtual], rows[virtual]


# The filter


@pytest.mark.parametrize("per", ["transition", "episode"])
def test_an_episode_in_which_nothing_moved_writes_real_rows_only(per: str) -> None:
    batch = make_batch([[4]])
    batch["achieved_goal"].zero_()
    batch["next", "achieved_goal"].zero_()
    buffer = make_buffer(per=per, filter_achieved=True)
    index = buffer.extend(batch)
    real, virtual = split(buffer)
    assert (len(real), len(virtual)) == (4, 0)
    assert index.tolist() == [[0, 1, 2, 3]]
    assert buffer.writer.counts.virtual == 0


def moved_in(step: int, length: int) -> TensorDict:
    """An episode in which what is achieved moves once, in one of its steps."""
    batch = make_batch([[length]])
    for part, late in ((batch, 0), (batch["next"], 1)):
        part["achieved_goal"][..., 0] = (torch.arange(length) + late > step).float() * 9
        part["achieved_goal"][..., 1:] = 0
    return batch


@pytest.mark.parametrize(("refill", "times"), [(1, [1, 1, 1]), (3, [1, 3, 2]), (9, [1, 5, 2])])
def test_what_the_filter_keeps_makes_up_for_what_it_leaves_out(refill: int, times: list[int]) -> None:
    """Relabeled were none, then 2 of 10 transitions, then 2 + 8 of 20."""
    buffer = make_buffer(filter_achieved=True, refill=refill, goal_sources={"future": 2, "actual": 1})
    written = []
    for step in (1, 7, 0):  # relabeled are the transitions up to this one
        before = buffer.writer.counts.virtual
        buffer.extend(moved_in(step, 10))
        written.append(buffer.writer.counts.virtual - before - 10)  # a goal that was wanted, for each
    assert written == [2 * relabeled * more for relabeled, more in zip((2, 8, 1), times, strict=True)]
    assert buffer.writer.counts.relabeled == 11
    buffer.empty()
    buffer.extend(moved_in(1, 10))
    assert buffer.writer.counts.virtual == 4 + 10  # it counts from 0 again


def test_goals_are_made_up_for_where_nothing_was_kept_so_far() -> None:
    buffer = make_buffer(filter_achieved=True, refill=4, k=2)
    buffer.extend(moved_in(10, 10))
    assert buffer.writer.counts.relabeled == 0
    buffer.extend(moved_in(0, 10))
    assert buffer.writer.counts.virtual == 2 * 4


def test_refill_is_for_single_transitions() -> None:
    with pytest.raises(ValueError, match="refill=2 needs per='transition', got per='episode'"):
        HERWriter(REWARD, per="episode", refill=2)
    with pytest.raises(ValueError, match="refill must be"):
        HERWriter(REWARD, refill=0)


# Rewards that read more than goals


def test_virtual_transitions_of_whole_episodes_are_rewarded_with_their_own_info() -> None:
    rule, batch = costly([[3, 2]])
    buffer = make_buffer(reward=rule, strategy="final", k=1, per="episode")
    buffer.extend(batch)
    real, virtual = split(buffer)
    assert real["next", "reward"].flatten().tolist() == [-1.25, -1.5, -1.75, -1.25, -1.5]
    assert virtual["next", "reward"].flatten().tolist() == [-1.25, -1.5, -0.75, -1.25, -0.5]
    assert virtual["next", "terminated"].flatten().tolist() == [False, False, True, False, True]
    assert buffer.writer.counts.virtual_positive == 2


def test_the_filter_reads_the_info_of_the_state_before_the_action() -> None:
    """A goal counts while the lamp is on: nothing moves, and the lamp goes on in the second step."""
    batch, near = make_batch([[3]]), GoalReward(0.5)
    for part in (batch, batch["next"]):
        part["achieved_goal"].zero_()
    batch["lamp"] = torch.tensor([[[0.0], [0.0], [1.0]]])
    batch["next", "lamp"] = torch.tensor([[[0.0], [1.0], [1.0]]])

    def lit(a: Tensor, d: Tensor, info: TensorDictBase) -> Tensor:
        return torch.where(info["lamp"] > 0, near(a, d)[0], -1.0)

    rule = EnvReward(lit, lambda a, d, info: lit(a, d, info) == 0, info_keys=["lamp"])
    buffer = make_buffer(reward=rule, strategy="final", k=1, filter_achieved=True)
    buffer.extend(batch)
    virtual = split(buffer)[1]
    assert virtual["lamp"].flatten().tolist() == [0.0, 0.0]  # in the third step the goal is achieved already
    assert virtual["next", "reward"].flatten().tolist() == [-1.0, 0.0]


def test_entries_of_the_root_are_read_where_next_lacks_them() -> None:
    batch, near = make_batch([[2]]), GoalReward(0.5)
    batch["action"] = torch.tensor([[[0.5], [0.25]]])
    rule = EnvReward(
        lambda a, d, info: near(a, d)[0] - info["action"].abs(), info_keys=["action"], achieved_reward=-0.9
    )
    buffer = make_buffer(reward=rule, strategy="final", k=1)
    buffer.extend(batch)
    assert split(buffer)[1]["next", "reward"].flatten().tolist() == [-1.5, -0.25]


def test_an_entry_that_a_reward_reads_must_be_there() -> None:
    rule = EnvReward(lambda a, d, info: info["cost"], info_keys=["cost"])
    with pytest.raises(KeyError, match="the reward function reads the entry 'cost', got"):
        make_buffer(reward=rule).extend(make_batch([[2]]))
    with pytest.raises(TypeError, match=r"info_keys must be a list, got 'cost': write \['cost'\]"):
        EnvReward(lambda a, d, info: info["cost"], info_keys="cost")


# Episodes, environments, batches


def test_an_open_episode_is_held_back_until_it_closes() -> None:
    buffer = make_buffer(strategy="final", k=1)
    first = buffer.extend(make_batch([[5], [2, 9]], steps=3))
    assert first.tolist() == [[-1, -1, -1], [2, 3, -1]]
    assert buffer.writer.held_back == 4
    second = buffer.extend(make_batch([[5], [2, 9]], steps=2, first=[(0, 3), (1, 1)]))
    assert (second[0] >= 0).all()
    assert (second[1] == -1).all()
    _, virtual = split(buffer)
    own = virtual["observation"][:, 0] < 100
    assert tags(virtual["observation"][own]) == [0.0, 1.0, 2.0, 3.0, 4.0]
    assert set(tags(virtual["desired_goal"][own])) == {tag(0, 0, 5)}


def test_flat_rows_are_told_apart_by_their_trajectories() -> None:
    batch = make_batch([[4, 2], [3, 3]])
    flat = batch.reshape(-1)
    shuffled = flat[torch.tensor([0, 6, 1, 7, 2, 8, 3, 9, 4, 10, 5, 11])]  # interleaved
    buffer = make_buffer(strategy="final", k=1)
    index = buffer.extend(shuffled)
    assert index.shape == (12,)
    assert torch.equal(buffer[:][index]["observation"], shuffled["observation"])
    _, virtual = split(buffer)
    last = {0: 4.0, 1: 102.0, 10: 1003.0, 11: 1103.0}
    for observation, goal in pairs(virtual):
        assert goal == last[int(observation // 100)]


def test_flat_rows_without_trajectories_are_one_stream() -> None:
    buffer = make_buffer(strategy="final", k=1)
    index = buffer.extend(make_batch([[2, 3]], steps=4).squeeze(0).exclude("collector"))
    assert index.tolist() == [2, 3, -1, -1]


def test_single_steps_may_be_added() -> None:
    buffer = make_buffer(strategy="final", k=1)
    for step in make_batch([[3]]).squeeze(0):
        buffer.add(step)
    real, virtual = split(buffer)
    assert tags(real["observation"]) == [0.0, 1.0, 2.0]
    assert tags(virtual["desired_goal"]) == [3.0, 3.0, 3.0]


def with_env_ids(batch: TensorDict) -> TensorDict:
    """As with the transform ``EnvIds``: of thousands, so that their order is not that of the streams."""
    ids = 7_000 - batch["observation"][..., :1].div(1_000, rounding_mode="floor").long()
    return batch.set("env_ids", ids).set(("next", "env_ids"), ids)


@pytest.mark.parametrize("how", ["told", "known by ids"])
def test_an_environment_reset_from_outside_leaks_nothing(how: str) -> None:
    buffer = make_buffer(strategy="final", k=1)
    first, later = make_batch([[9]], steps=3), make_batch([[9, 2]], steps=2, first=[(1, 0)])
    if how == "told":
        buffer.extend(first)
        buffer.writer.end_episodes()
        buffer.extend(later)
    else:
        buffer.extend(with_env_ids(first))
        buffer.extend(with_env_ids(later))
        assert "env_ids" not in buffer[:].keys()
        assert ("next", "env_ids") not in buffer[:].keys(True)
    assert pairs(buffer[:]) == {(0.0, 3.0), (1.0, 3.0), (2.0, 3.0), (100.0, 102.0), (101.0, 102.0)}


def test_an_episode_longer_than_the_buffer_is_said_once() -> None:
    buffer = make_buffer(13)
    rows = make_batch([[40]])
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        for step in range(40):
            buffer.extend(rows[:, step : step + 1].clone())
    said = [str(own.message) for own in seen if "wait for their end" in str(own.message)]
    assert [line.split(":")[0] for line in said] == [
        "14 transitions of open episodes wait for their end, more than the buffer's 13"
    ]
    assert len(buffer) == 13


@pytest.mark.filterwarnings("ignore:all [0-9]+ episodes have one step")  # of an example, it may be so
@pytest.mark.filterwarnings("ignore:.*wait for their end")  # in buffers of 13 rows
@settings(max_examples=40, deadline=None)
@given(
    st.lists(st.lists(st.integers(1, 6), min_size=1, max_size=4), min_size=1, max_size=3),
    st.integers(1, 7),
    st.sampled_from(["future", "final", "episode"]),
    st.sampled_from([13, 40, 10_000]),
    st.booleans(),
)
def test_no_goal_ever_leaks(
    lengths: list[list[int]], size: int, strategy: str, capacity: int, prioritized: bool
) -> None:
    """Batches of any size, buffers that wrap: every virtual goal is of its own episode."""
    buffer = make_buffer(capacity, strategy=strategy, k=3, prioritized=prioritized)
    whole = make_batch(lengths)
    for start in range(0, whole.shape[1], size):
        buffer.extend(whole[:, start : start + size].clone())
    if not len(buffer):
        return
    rows = buffer[:]
    virtual = rows[rows["virtual"].squeeze(-1)]
    observation, goal = virtual["observation"][:, 0], virtual["desired_goal"][:, 0]
    assert torch.equal((observation / 100).floor(), ((goal - 1) / 100).floor())
    if strategy == "future":
        assert (goal > observation).all()
    real = rows[~rows["virtual"].squeeze(-1)]
    assert (real["desired_goal"][:, 0] == WANTED).all()


# Buffers


@pytest.mark.parametrize("prioritized", [False, True])
def test_a_full_buffer_keeps_the_newest_rows_and_can_be_sampled(prioritized: bool) -> None:
    buffer = make_buffer(60, prioritized=prioritized, k=4)
    for episode in range(7):
        buffer.extend(make_batch([[10] * 7], steps=10, first=[(episode, 0)]))
    assert len(buffer) == 60
    assert set((buffer[:]["observation"][:, 0] // 100).tolist()) == {5.0, 6.0}
    rows = buffer.sample(500)
    assert (rows["observation"][:, 0] >= 500).all()


@pytest.mark.parametrize("prioritized", [False, True])
def test_a_batch_larger_than_the_buffer(prioritized: bool) -> None:
    buffer = make_buffer(50, prioritized=prioritized, k=4)
    index = buffer.extend(make_batch([[10] * 5]))
    assert len(buffer) == 50
    assert index[0, :40].tolist() == [-1] * 40  # pushed out by later rows of the same batch
    stored = buffer[:][index[0, 40:]]
    assert tags(stored["observation"]) == [400.0 + t for t in range(10)]
    assert (buffer.sample(200)["observation"][:, 0] >= 400).all()


def test_an_episode_larger_than_the_buffer_keeps_its_real_rows() -> None:
    buffer = make_buffer(12, k=4)
    buffer.extend(make_batch([[10]]))
    assert len(buffer) == 12
    assert len(split(buffer)[0]) == 10


def test_all_rows_are_new_to_a_prioritized_sampler() -> None:
    buffer = make_buffer(prioritized=True, k=4)
    buffer.extend(make_batch([[10]]))
    buffer.update_priority(torch.arange(50), torch.full((50,), 1e-6))
    buffer.extend(make_batch([[10, 10]], steps=10, first=[(1, 0)]))
    rows = buffer.sample(2000)
    assert (rows["observation"][:, 0] >= 100).float().mean() > 0.95
    assert rows["virtual"].float().mean().item() == pytest.approx(0.8, abs=0.05)


def test_held_back_rows_are_skipped_by_priority_updates() -> None:
    buffer = make_buffer(prioritized=True)
    index = buffer.extend(make_batch([[3, 9]], steps=5)).flatten()
    buffer.update_priority(index, torch.full((5,), 2.0))
    assert (index == -1).sum() == 2
    assert len(buffer.sample(10)) == 10


# Memory of its own


class CountingWeights(GoalWeights):
    """Prefers the largest goal, and counts what was written."""

    def __init__(self) -> None:
        self.written = 0

    def __call__(self, goals: Tensor) -> Tensor:
        return (goals[..., 0] == goals[..., 0].max()).float()

    def update(self, goals: Tensor) -> None:
        self.written += len(goals)

    def clear(self) -> None:
        self.written = 0

    def state_dict(self) -> dict[str, Any]:
        return {"written": self.written}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.written = state["written"]


def test_a_file_carries_held_back_episodes_counts_and_weights(tmp_path: Path) -> None:
    first, second = make_buffer(weights=CountingWeights()), make_buffer(weights=CountingWeights())
    first.extend(make_batch([[3, 9]], steps=5))
    second.storage.set(torch.arange(15), first[:])
    first.writer.dumps(tmp_path)
    second.writer.loads(tmp_path)
    assert second.writer.held_back == 2
    assert second.writer.counts == first.writer.counts
    assert second.writer.totals == first.writer.totals
    assert second.writer.weights.written == 12
    index = second.extend(make_batch([[3, 9]], steps=7, first=[(1, 2)]))
    assert second.writer.held_back == 0
    assert (index >= 15).all()  # behind the fifteen rows that the first one wrote
    held = second[:][15 + 36 :]["observation"]
    assert tags(held) == [tag(0, 1, t) for t in range(9)]


def test_a_state_with_other_weights_is_refused_before_anything_is_read() -> None:
    first, second = make_buffer(weights=CountingWeights()), make_buffer()
    first.extend(make_batch([[3, 9]], steps=5))
    with pytest.raises(ValueError, match="the state must have 0 weights, got 1"):
        second.writer.load_state_dict(first.writer.state_dict())
    assert (second.writer.held_back, second.writer.counts.real) == (0, 0)
    with pytest.raises(ValueError, match="the state must have 1 weights, got 0"):
        first.writer.load_state_dict(second.writer.state_dict())


def test_held_back_episodes_end_where_a_new_collector_begins_anew() -> None:
    """Its trajectories are counted from 0 again, so ids do not tell."""
    first, second = make_buffer(strategy="final"), make_buffer(strategy="final")
    first.extend(make_batch([[9], [9]], steps=4))
    second.writer.load_state_dict(first.writer.state_dict())
    other = make_batch([[9], [9]], first=[(0, 0), (0, 4)])  # the second environment goes on
    other["collector", "traj_ids"] = make_batch([[9], [9]])["collector", "traj_ids"]
    second.extend(other[:, :5])
    real, virtual = split(second)
    assert (len(real), second.writer.held_back) == (4 + 9, 5)
    assert set(tags(virtual["desired_goal"])) == {tag(0, 0, 4), tag(1, 0, 9)}


def test_a_batch_that_cannot_be_written_costs_no_open_episode() -> None:
    class Once(GoalWeights):
        bad = True

        def __call__(self, goals: Tensor) -> Tensor:
            return torch.full(goals.shape[:-1], -1.0 if self.bad else 1.0)

    buffer = make_buffer(weights=Once(), goal_sources={"actual": 4})
    buffer.extend(make_batch([[9]], steps=4))
    with pytest.raises(ValueError, match="at least 0"):
        buffer.extend(make_batch([[9]], steps=5, first=[(0, 4)]))
    assert buffer.writer.held_back == 4
    buffer.writer.weights.bad = False
    buffer.extend(make_batch([[9]], steps=5, first=[(0, 4)]))
    assert tags(split(buffer)[0]["observation"]) == [float(t) for t in range(9)]
    (goals,) = buffer.writer.state_dict()["recent"][0]["actual"]
    assert tags(goals) == [WANTED]  # remembered once


def test_counts_by_hand() -> None:
    batch = make_batch([[3]], terminated=True)
    batch["next", "reward"][0, 2] = 0.0
    buffer = make_buffer(strategy="final", k=2)
    buffer.extend(batch)
    counts = buffer.writer.counts
    assert (counts.real, counts.virtual, counts.real_positive) == (3, 6, 1)
    assert (counts.virtual_positive, counts.useful_virtual_positive) == (2, 2)
    assert buffer.write_count == 9


def test_a_goal_that_was_achieved_before_is_no_useful_positive() -> None:
    batch = along([5.0, 0.0, 0.0])
    buffer = make_buffer(strategy="final", k=1)
    buffer.extend(batch)
    counts = buffer.writer.counts
    assert (counts.virtual_positive, counts.useful_virtual_positive) == (2, 1)


def test_an_emptied_writer_is_as_new_but_for_its_totals() -> None:
    buffer = make_buffer(weights=CountingWeights())
    writer, batch = buffer.writer, make_batch([[3, 9]], steps=5)
    buffer.extend(batch.clone())
    before = replace(writer.totals)
    assert before == writer.counts
    writer.load_state_dict(writer.state_dict())
    buffer.empty()
    assert (len(buffer), writer.held_back, writer.counts.real, writer.weights.written) == (0, 0, 0, 0)
    assert writer.totals == before
    buffer.extend(batch)
    assert (writer.totals.real, writer.counts.real) == (6, 3)
    with pytest.raises(ValueError, match="1 episodes are not over"):  # as of a writer that loaded no state
        buffer.extend(make_batch([[9], [9]], steps=3)[1:])


# Options


def test_without_virtual_rows_no_goals_are_needed() -> None:
    buffer = make_buffer(k=0)
    goals = ("achieved_goal", "desired_goal")
    buffer.extend(make_batch([[3]]).exclude(*goals, *(("next", key) for key in goals)))
    assert len(buffer) == 3


# Beside other collectors


@pytest.mark.parametrize("ids", [True, False])
def test_batches_in_which_places_are_taken_by_others_are_refused(ids: bool) -> None:
    buffer = make_buffer()
    first, other = make_batch([[9]], steps=3), make_batch([[9], [9]], steps=3)[1:]
    if not ids:
        first, other = first.exclude("collector"), other.exclude("collector")
    buffer.extend(first)
    with pytest.raises(ValueError, match=r"1 episodes are not over, but .*EnvIds\(\)"):
        buffer.extend(other)
    assert buffer.writer.held_back == 3


def test_another_trajectory_within_a_batch_is_refused_without_environment_ids() -> None:
    workers = make_batch([[9], [9]], steps=3)
    with pytest.raises(ValueError, match="1 episodes are not over"):
        make_buffer().extend(workers.reshape(1, 6))  # cat_results=-1


@pytest.mark.parametrize("joined", [True, False])
def test_environments_of_several_workers_are_told_apart_by_their_ids(joined: bool) -> None:
    """Batches arrive in turns, as from an asynchronous collector, or joined in time by cat_results=-1."""
    whole = with_env_ids(make_batch([[5, 3], [4, 4], [2, 6], [8]]))
    buffer = make_buffer(strategy="final", k=1)
    for start in range(0, 8, 2):
        one, two = whole[:2, start : start + 2].clone(), whole[2:, start : start + 2].clone()
        for part in [torch.cat((one, two), 1)] if joined else [two, one]:
            buffer.extend(part)
    real, virtual = split(buffer)
    assert (len(real), len(virtual), buffer.writer.held_back) == (32, 32, 0)
    last = {0: 5.0, 1: 103.0, 10: 1004.0, 11: 1104.0, 20: 2002.0, 21: 2106.0, 30: 3008.0}
    for observation, goal in pairs(virtual):
        assert goal == last[int(observation // 100)]


def test_a_writer_without_a_buffer_can_be_printed() -> None:
    assert repr(HERWriter(REWARD, k=2)).startswith(f"HERWriter({REWARD!r}, HindsightOptions(k=2")


def test_the_values_of_environment_ids_do_not_matter() -> None:
    batch = make_batch([[5], [3], [4]])
    stored = []
    for ids in ([3, 1, 2], [10**15, 7, 4]):
        own = batch.clone().set("env_ids", torch.tensor(ids).view(3, 1, 1).expand(3, 5, 1))
        buffer = make_buffer()
        buffer.extend(own)
        stored.append(buffer[:])
    assert all(torch.equal(stored[0][key], stored[1][key]) for key in stored[0].keys(True, True))


@pytest.mark.parametrize(
    ("ids", "got"),
    [
        (torch.zeros(1, 5, 3, dtype=torch.int64), r"torch.int64 of shape \[1, 5, 3\]"),
        (torch.zeros(1, 5, 1), r"torch.float32 of shape \[1, 5, 1\]"),
    ],
)
def test_an_entry_that_holds_no_environment_ids_is_named(ids: Tensor, got: str) -> None:
    message = (
        rf"\('env_ids'\) must be one whole number for each transition, got {got}: use another env_ids_key"
    )
    with pytest.raises(ValueError, match=message):
        make_buffer().extend(make_batch([[5]]).set("env_ids", ids))
    make_buffer(env_ids_key="who").extend(make_batch([[5]]).set("env_ids", ids))


def test_ids_that_are_used_again_join_no_episodes() -> None:
    first = make_batch([[9]], steps=3).squeeze(0)
    again = make_batch([[9, 4]], first=[(1, 0)], steps=4).squeeze(0)
    again["collector", "traj_ids"] = torch.zeros(4, dtype=torch.int64)  # a second collector counts from 0
    buffer = make_buffer(strategy="final", k=1)
    buffer.extend(first)
    buffer.extend(again)
    assert pairs(buffer[:]) == {(0.0, 3.0), (1.0, 3.0), (2.0, 3.0)} | {(100.0 + t, 104.0) for t in range(4)}


def test_batches_in_another_form_are_refused_while_episodes_are_open() -> None:
    buffer = make_buffer()
    buffer.extend(make_batch([[9]], steps=3))
    with pytest.raises(ValueError, match="by places in the batch, but this batch has trajectory ids"):
        buffer.extend(make_batch([[9]], first=[(0, 3)], steps=3).squeeze(0))


# Whole episodes


def make_sliced(**options: Any) -> TensorDictReplayBuffer:
    sampler = SliceSampler(num_slices=20, traj_key=("collector", "traj_ids"), strict_length=False)
    writer = HERWriter(REWARD, per="episode", **options)
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(10_000), writer=writer, sampler=sampler, batch_size=20 * 4
    )
    buffer.set_rng(torch.Generator().manual_seed(0))
    return buffer


def test_whole_episodes_by_hand() -> None:
    batch = along([0.0, 1.0, 2.0, 1.0, 5.0])
    buffer = make_sliced(k=200)
    buffer.extend(batch)
    rows = buffer[:]
    ids = rows["collector", "traj_ids"]
    seen = {}
    for number in ids.unique().tolist():
        own = rows[ids == number]
        if not own["virtual"].any():
            continue
        goal = own["desired_goal"][:, 0].unique()
        assert len(goal) == 1
        assert torch.equal(own["desired_goal"], own["next", "desired_goal"])
        after = own["next"]
        assert torch.equal(after["done"], after["terminated"] | after["truncated"])
        seen[goal.item()] = (
            tags(own["observation"]),
            after["reward"].flatten().tolist(),
            after["terminated"].flatten().tolist(),
            after["truncated"].flatten().tolist(),
        )
    no = [False, False, False]
    assert seen == {
        1.0: ([0.0], [0.0], [True], [False]),  # achieved by the first step, so the episode ends there
        2.0: ([0.0, 1.0], [-1.0, 0.0], [False, True], [False, False]),
        5.0: ([0.0, 1.0, 2.0, 3.0], [-1.0, -1.0, -1.0, 0.0], [*no, True], [*no, True]),
    }
    assert len(ids.unique()) == 201
    assert tags(rows[~rows["virtual"].squeeze(-1)]["observation"]) == [0.0, 1.0, 2.0, 3.0]


def test_an_episode_that_does_not_terminate_for_its_goal_is_truncated() -> None:
    endless = EnvReward(lambda a, d: REWARD(a, d)[0], lambda a, d: torch.zeros_like(a[..., :1]).bool())
    batch = make_batch([[3]], terminated=True)
    buffer = make_buffer(reward=endless, per="episode", k=1)
    buffer.extend(batch)
    _, virtual = split(buffer)
    assert len(virtual) == 3
    assert virtual["next", "truncated"].flatten().tolist() == [False, False, True]
    assert virtual["next", "done"].flatten().tolist() == [False, False, True]
    assert not virtual["next", "terminated"].any()


def test_goals_of_whole_episodes_follow_weights_and_filter() -> None:
    batch = along([1.0, 1.0, 2.0, 1.0, 6.0])
    buffer = make_buffer(
        per="episode", k=4_000, filter_achieved=True, weights=PreferFar(), seed=3, capacity=20_000
    )
    buffer.extend(batch)
    _, virtual = split(buffer)
    first = virtual[virtual["observation"][:, 0] == 0]
    goals, counts = first["desired_goal"][:, 0].unique(return_counts=True)
    assert goals.tolist() == [2.0, 6.0]  # 1 is achieved in the first state
    assert (counts / 4_000).tolist() == pytest.approx([0.25, 0.75], abs=0.04)


@pytest.mark.filterwarnings("ignore:all [0-9]+ episodes have one step")  # of an example, it may be so
@pytest.mark.filterwarnings("ignore:SliceSampler returned a short flat batch:UserWarning")
@settings(max_examples=30, deadline=None)
@given(
    st.lists(st.lists(st.integers(1, 6), min_size=1, max_size=4), min_size=1, max_size=3),
    st.integers(1, 7),
    st.sampled_from(["future", "final"]),
)
def test_slices_are_sequences_with_one_goal(lengths: list[list[int]], size: int, strategy: str) -> None:
    buffer = make_sliced(strategy=strategy, k=3)
    whole = make_batch(lengths)
    for start in range(0, whole.shape[1], size):
        buffer.extend(whole[:, start : start + size].clone())
    if not len(buffer):
        return
    rows = buffer.sample()
    slices = rows.split((torch.diff(_ends(rows), prepend=torch.tensor([-1]))).tolist())
    assert len(slices) == 20
    for part in slices:
        step = part["observation"][:, 0]
        assert torch.equal(step, step[0] + torch.arange(len(part)))
        assert (part["desired_goal"] == part["desired_goal"][0]).all()
        assert len(part["collector", "traj_ids"].unique()) == 1
        if part["virtual"][0]:
            goal = part["desired_goal"][:, 0]
            assert ((goal / 100).floor() == (step / 100).floor()).all()
            assert torch.equal(part["next", "terminated"].flatten(), step + 1 == goal)


def _ends(rows: TensorDict) -> Tensor:
    """Where slices end, which the sampler marks as truncated."""
    return rows["next", "truncated"].flatten().nonzero().squeeze(-1)


# Several steps


def test_one_step_is_as_without_the_option() -> None:
    one, plain = make_buffer(n_steps=1, gamma=0.9), make_buffer()
    for buffer in (one, plain):
        buffer.extend(make_batch([[5, 3], [2, 6]]))
    assert all(torch.equal(one[:][key], plain[:][key]) for key in plain[:].keys(True, True))
    assert "steps_to_next_obs" not in one[:].keys()


# Parts that cannot work together


def test_slices_of_single_copies_are_refused() -> None:
    storage, unit = LazyTensorStorage(100), Sequence(length=2)
    buffer = TensorDictReplayBuffer(storage=storage, writer=HERWriter(REWARD), sample_unit=unit)
    with pytest.raises(ValueError, match="under a sampler of slices, HERWriter needs per='episode'"):
        buffer.extend(make_batch([[5]]))
    buffer = make_sliced()
    buffer.writer.options = replace(buffer.writer.options, per="transition", k=0, n_steps=2, gamma=0.9)
    with pytest.raises(ValueError, match="needs n_steps=1, got 2"):
        buffer.extend(make_batch([[3]]))


def test_a_copy_in_another_process_is_refused() -> None:
    buffer = make_buffer()
    with pytest.raises(RuntimeError, match="workers send episodes and the learner extends"):
        multiprocessing.get_context("spawn").Process(target=len, args=(buffer.writer,)).start()
    buffer.writer._process += 1  # as in a fork, which copies without asking
    with pytest.raises(RuntimeError, match="only in the process that made its buffer"):
        buffer.extend(make_batch([[5]]))
    other = pickle.loads(pickle.dumps(buffer.writer))  # moved as a whole, as Ray does
    assert other._process == os.getpid()


def test_priorities_in_a_batch_are_those_of_real_rows_if_it_is_flat() -> None:
    batch = make_batch([[3, 9]], steps=5)
    batch["td_error"] = torch.full((1, 5), 1e6)
    buffer = make_buffer(prioritized=True)
    with pytest.raises(ValueError, match=r"holds priorities \('td_error'\)"):
        buffer.extend(batch)
    index = buffer.extend(batch.squeeze(0))
    assert index.tolist() == [12, 13, 14, -1, -1]
    assert not buffer.sample(100)["virtual"].any()


def test_flat_rows_of_two_environments_without_ids_are_refused_at_once() -> None:
    with pytest.raises(ValueError, match="1 episodes are not over"):
        make_buffer().extend(make_batch([[9], [9]], steps=3).reshape(-1).exclude("collector"))


# Ends that have nothing to do with the goal


def test_a_success_with_another_reward_is_no_fall() -> None:
    """As with dense rewards: the reward function's end is that of the goal."""
    dense = EnvReward(lambda a, d: REWARD(a, d)[0] - 0.1, lambda a, d: REWARD(a, d)[1], achieved_reward=0.0)
    batch = make_batch([[4]], terminated=True)
    batch["next", "reward"] -= 0.1
    batch["next", "desired_goal"][0, 3] = batch["next", "achieved_goal"][0, 3]
    buffer = make_buffer(reward=dense, k=50)
    buffer.extend(batch)
    _, virtual = split(buffer)
    reached = virtual["next", "achieved_goal"][:, 0] == virtual["desired_goal"][:, 0]
    assert torch.equal(virtual["next", "terminated"][:, 0], reached)


# Found by a reviewer


def test_real_episodes_that_are_ended_from_outside_are_truncated_for_slices() -> None:
    buffer = make_buffer(per="episode", k=1)
    buffer.extend(make_batch([[9]], steps=3))
    buffer.writer.end_episodes()
    buffer.extend(make_batch([[4]], first=[(0, 0)]))
    real, _ = split(buffer)
    ends = [False, False, True, False, False, False, True]
    assert real["next", "truncated"].flatten().tolist() == ends
    assert real["next", "done"].flatten().tolist() == ends


def test_an_id_that_is_used_twice_in_a_flat_batch_joins_no_episodes() -> None:
    one, other = make_batch([[9]], steps=3).squeeze(0), make_batch([[9, 4]], first=[(1, 0)]).squeeze(0)[:4]
    other["collector", "traj_ids"] = torch.zeros(4, dtype=torch.int64)
    buffer = make_buffer(strategy="final", k=1)
    buffer.extend(torch.cat((one, other)))
    _, virtual = split(buffer)
    goals = zip(tags(virtual["observation"]), tags(virtual["desired_goal"]), strict=True)
    assert {(o >= 100, g) for o, g in goals} == {(False, 3.0), (True, 104.0)}


def test_sums_of_whole_numbers_keep_their_fractions() -> None:
    batch = make_batch([[4]])
    batch["next", "reward"] = batch["next", "reward"].long()
    buffer = make_buffer(strategy="final", k=1, n_steps=2, gamma=0.5)
    buffer.extend(batch)
    assert buffer[:]["next", "reward"].unique().tolist() == [-1.5, -1.0, 0.0]


def test_a_reward_function_may_leave_out_the_last_dimension() -> None:
    flat = EnvReward(lambda a, d: REWARD(a, d)[0].squeeze(-1), lambda a, d: REWARD(a, d)[1].squeeze(-1))
    for options in ({"n_steps": 2, "gamma": 0.5}, {"per": "episode"}):
        one, other = make_buffer(reward=flat, **options), make_buffer(**options)
        for buffer in (one, other):
            buffer.extend(make_batch([[5, 3]]))
        assert all(torch.equal(one[:][key], other[:][key]) for key in one[:].keys(True, True))


def test_nothing_to_write_is_nothing() -> None:
    buffer = make_buffer()
    buffer.extend(make_batch([[9]], steps=3))
    writer = buffer.writer
    assert writer.extend(make_batch([[9]], steps=3)[:, :0]).shape == (1, 0)
    assert writer.held_back == 3


# What it tells others


@pytest.mark.parametrize("runs", [1, 2])
def test_all_that_is_written_is_told_once(runs: int) -> None:
    told: list[tuple[TensorDict, list[int], list[int]]] = []
    generators = None if runs == 1 else [torch.Generator().manual_seed(run) for run in range(runs)]
    writer = HERWriter(
        REWARD,
        k=2,
        runs=runs,
        generators=generators,
        on_write=lambda *own: told.append((own[0].clone(), *own[1:])),
    )
    storage = LazyTensorStorage(1_000)
    buffer = TensorDictReplayBuffer(
        storage=storage,
        writer=writer,
        sampler=None if runs == 1 else RunsSampler(500, runs=2, generators=generators),
    )
    buffer.extend(make_batch([[4, 3], [2, 9]], steps=7))  # the last episode is held back
    for run in range(runs):
        rows = torch.cat(
            [
                part
                for out, own, counts in told
                for part, at in zip(out.split(counts), own, strict=True)
                if at == run
            ]
        )
        stored = storage[run * 500 : run * 500 + writer.sizes[run]]
        assert len(rows) == len(stored)
        assert (rows == stored).all()
    assert sum(len(out) for out, _, _ in told) == writer.counts.real + writer.counts.virtual
    assert writer.held_back == 5
