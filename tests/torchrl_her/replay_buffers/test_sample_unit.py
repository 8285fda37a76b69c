"""HERSampleUnit and its index of episodes: hindsight at sampling time, and what TorchRL's own class does.

Goals are tagged with the environment, episode and state that they come from (see ``her_data``).
"""

from __future__ import annotations

import pickle
from functools import partial
from inspect import signature
from itertools import chain
from typing import Any

import pytest
import torch
import torchrl.data
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torch import Tensor
from torchrl.data import (
    HERReplayBuffer,
    LazyTensorStorage,
    TensorDictReplayBuffer,
    TensorStorage,
)
from torchrl.data.replay_buffers import ReplayBufferEnsemble
from torchrl.data.replay_buffers.samplers import (
    PrioritizedSampler,
    PrioritizedSliceSampler,
    RandomSampler,
    Sampler,
    SliceSampler,
    SliceSamplerWithoutReplacement,
)
from torchrl.data.replay_buffers.writers import ImmutableDatasetWriter, TensorDictMaxValueWriter
from torchrl.envs.transforms import RewardScaling

from torchrl_her import GoalReward, HERSampleUnit, HERWriter
from torchrl_her.trainers import buffer_state_dict, load_buffer_state_dict

from ..her_data import WANTED, PreferFar, along, make_batch, pairs, tag, tags

pytestmark = pytest.mark.filterwarnings("ignore:the reward function gives")  # made up as each test needs it
REWARD = GoalReward(0.5)  # tags differ by at least 1


IDS = ("collector", "traj_ids")
NEVER_REAL = 10**6  # as k: practically all rows are virtual


def make_buffer(
    capacity: int = 10_000,
    *,
    per: bool = False,
    sampler: Sampler | None = None,
    ndim: int = 1,
    seed: int = 0,
    **options: Any,
) -> TensorDictReplayBuffer:
    unit = HERSampleUnit(options.pop("reward", REWARD), **options)
    by_default = PrioritizedSampler(capacity, alpha=1.0, beta=0.4) if per else RandomSampler()
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(capacity, ndim=ndim),
        sampler=by_default if sampler is None else sampler,
        sample_unit=unit,
        collate_fn=unit.relabel,
    )
    buffer.set_rng(torch.Generator().manual_seed(seed))
    return buffer


def make_beside(unit: HERSampleUnit | None = None, **parts: Any) -> TensorDictReplayBuffer:
    """A unit in a buffer of other parts."""
    unit = unit or HERSampleUnit(REWARD)
    usual = {"storage": LazyTensorStorage(100), "collate_fn": unit.relabel, "batch_size": 4}
    return TensorDictReplayBuffer(sample_unit=unit, **{**usual, **parts})


def make_torchrl(capacity: int = 1_000, **options: Any) -> HERReplayBuffer:
    """TorchRL's own class, made to relabel every row, with a reward of the right goal."""

    def reward(rows: TensorDict) -> Tensor:
        return REWARD(rows["next", "achieved_goal"], rows["desired_goal"])[0]

    return HERReplayBuffer(
        reward, storage=LazyTensorStorage(capacity), her_ratio=1.0, batch_size=256, **options
    )


def flat(lengths: list[list[int]], **options: Any) -> TensorDict:
    return make_batch(lengths, **options).reshape(-1)


# Where goals come from


def test_rows_of_an_open_episode_may_take_goals_up_to_the_newest() -> None:
    for strategy in ("future", "final"):
        buffer = make_buffer(strategy=strategy)
        buffer.extend(flat([[9]], steps=2))
        assert pairs(buffer.sample(200)) == {(0, 2), (1, 2)} | ({(0, 1)} if strategy == "future" else set())
        buffer.extend(flat([[9]], steps=1, first=[(0, 2)]))
        assert (0.0, 3.0) in pairs(buffer.sample(200))


def test_stretches_of_environments_in_turn_make_whole_episodes() -> None:
    buffer = make_buffer(strategy="final")
    whole = make_batch([[6], [6]])
    for start in (0, 2, 4):  # what a collector of two steps an environment gives, flattened
        buffer.extend(whole[:, start : start + 2].reshape(-1).clone())
    expected = {(tag(env, 0, t), tag(env, 0, 6)) for env in (0, 1) for t in range(6)}
    assert pairs(buffer.sample(1_000)) == expected


def test_torchrl_leaks_where_the_ring_begins_again() -> None:
    theirs, ours = make_torchrl(8, strategy="final"), make_buffer(8, strategy="final")
    rows = flat([[3, 3, 4]])
    for buffer in (theirs, ours):
        buffer.extend(rows[:6].clone())
        buffer.extend(rows[6:].clone())  # slots 6, 7, 0 and 1
    assert (200.0, 102.0) in pairs(theirs.sample())
    assert pairs(ours.sample(500)) == {
        *((200.0 + t, 204.0) for t in range(4)),
        *((100.0 + t, 103.0) for t in range(3)),
        (2.0, 3.0),  # what is left of the first episode
    }


def test_torchrl_cannot_sample_a_full_buffer_that_was_written_again() -> None:
    theirs, ours = make_torchrl(12), make_buffer(12)
    for buffer in (theirs, ours):
        buffer.extend(flat([[4, 4, 4]]))
        buffer.sample(256)
        buffer.extend(flat([[4] * 9], steps=4, first=[(3, 0)]))
    with pytest.raises(RuntimeError, match="must match the size"):  # it compares the cursors of two batches
        theirs.sample()
    assert {observation // 100 for observation, _ in pairs(ours.sample(300))} == {1, 2, 3}


@pytest.mark.parametrize("per", [False, True])
def test_a_storage_of_two_dimensions(per: bool) -> None:
    buffer = make_buffer(20, ndim=2, per=per, strategy="final")
    whole = make_batch([[3, 4, 7], [6, 2, 6]])
    for start in (0, 7):
        buffer.extend(whole[:, start : start + 7].clone())  # the ring holds ten steps: 4 to 13
    rows = buffer.sample(3_000)
    assert pairs(rows) == {
        *((100.0 + t, 104.0) for t in range(1, 4)),
        *((200.0 + t, 207.0) for t in range(7)),
        *((1000.0 + t, 1006.0) for t in range(4, 6)),
        *((1100.0 + t, 1102.0) for t in range(2)),
        *((1200.0 + t, 1206.0) for t in range(6)),
    }
    index = rows["index"]
    assert torch.equal(buffer.storage[:]["observation"][index[:, 0], index[:, 1]], rows["observation"])


def test_the_last_slot_of_a_capacity_that_is_no_multiple_of_the_environments() -> None:
    buffer = make_buffer(11, ndim=2, k=NEVER_REAL, strategy="final")  # two environments, six slots
    whole = make_batch([[8], [8]])
    for steps in (slice(0, 4), slice(4, 6), slice(6, 8)):
        buffer.extend(whole[:, steps].clone())
    assert pairs(buffer.sample(500)) == {
        (tag(env, 0, t), tag(env, 0, 8)) for env in (0, 1) for t in range(2, 8)
    }


@pytest.mark.filterwarnings("ignore:all [0-9]+ episodes have one step")  # of an example, it may be so
@settings(max_examples=40, deadline=None)
@given(
    st.lists(st.lists(st.integers(1, 6), min_size=1, max_size=4), min_size=1, max_size=3),
    st.integers(1, 7),
    st.sampled_from(["future", "final", "episode"]),
    st.sampled_from([13, 24, 10_000]),
    st.booleans(),
    st.sampled_from([1, 2]),
    st.booleans(),
)
def test_no_goal_ever_leaks(
    lengths: list[list[int]], size: int, strategy: str, capacity: int, per: bool, ndim: int, filtered: bool
) -> None:
    """Batches of any size, buffers that wrap: the goals are exactly the ones that are stored and allowed."""
    buffer = make_buffer(
        capacity, strategy=strategy, per=per, ndim=ndim, filter_achieved=filtered, k=NEVER_REAL
    )
    whole = make_batch(lengths)
    size = max(ndim, min(size, capacity // len(lengths)))
    for start in range(0, max(whole.shape[1], ndim), size):
        batch = whole[:, start : start + size].clone()
        if batch.shape[1] >= ndim:  # TorchRL cannot write single steps to a storage of two dimensions
            buffer.extend(batch if ndim == 2 else batch.reshape(-1))
    if not len(buffer):
        return
    stored = buffer.storage[:]["observation"][..., 0].flatten()
    rows = buffer.sample(200)
    assert rows["virtual"].all()
    observation, goal = rows["observation"][:, 0], rows["desired_goal"][:, 0]
    assert torch.isin(goal - 1, stored).all()
    assert torch.equal((observation / 100).floor(), ((goal - 1) / 100).floor())
    if strategy == "future":
        assert (goal > observation).all()
    if strategy == "final":
        newest = [float(stored[(stored / 100).floor() == (o / 100).floor()].max()) + 1 for o in observation]
        assert goal.tolist() == newest


# What follows from a goal


def test_transforms_see_the_lent_goal() -> None:
    def with_input(rows: TensorDict) -> TensorDict:
        return rows.set("input", torch.cat((rows["observation"], rows["desired_goal"]), -1))

    buffer = make_buffer()
    buffer.append_transform(with_input)
    buffer.extend(flat([[4]]))
    rows = buffer.sample(64)
    assert rows["virtual"].any()
    assert torch.equal(rows["input"][:, 2:], rows["desired_goal"])


def test_shapes_and_kinds_of_numbers_are_those_of_the_storage() -> None:
    batch = flat([[4]])
    batch["next", "reward"] = batch["next", "reward"].double().squeeze(-1)
    batch["next", "done"] = batch["next", "done"].squeeze(-1)
    buffer = make_buffer()
    buffer.extend(batch.clone())
    rows = buffer.sample(50)
    for key in batch.exclude("state", ("next", "state")).keys(True, True):
        assert (rows[key].dtype, rows[key].shape[1:]) == (batch[key].dtype, batch[key].shape[1:]), key
    assert (rows["virtual"].dtype, rows["virtual"].shape) == (torch.bool, (50, 1))


# Filter and weights


def test_many_rows_are_drawn_piece_by_piece(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torchrl_her.replay_buffers.sample_unit.LIKELIHOODS", 64)
    buffer = make_buffer(weights=PreferFar(), strategy="episode", k=NEVER_REAL)
    buffer.extend(along([5, 0, 1, 3]).reshape(-1))
    rows = buffer.sample(3_000)
    assert (rows["desired_goal"][:, 0] == 3).float().mean().item() == pytest.approx(0.75, abs=0.04)


def test_weights_that_promise_to_be_alike_are_not_asked() -> None:
    class Alike(PreferFar):
        is_uniform = True

        def __call__(self, goals: Tensor) -> Tensor:
            raise AssertionError("asked")

    buffer = make_buffer(weights=Alike())
    buffer.extend(flat([[4]]))
    assert buffer.sample(50)["virtual"].any()


# Buffers


@pytest.mark.parametrize("ndim", [1, 2])
def test_priorities_are_those_of_the_real_rows(ndim: int) -> None:
    buffer = make_buffer(40, per=True, ndim=ndim)
    batch = make_batch([[10], [10]])
    buffer.extend(batch if ndim == 2 else batch.reshape(-1))
    rows = buffer.sample(2_000)
    assert rows["virtual"].any()
    assert (rows["priority_weight"] == 1).all()
    rows["td_error"] = (rows["observation"][:, 0] == 1004).float() * 100 + 1e-6
    buffer.update_tensordict_priority(rows)
    rows = buffer.sample(200)
    assert (rows["observation"][:, 0] == 1004).all()
    assert rows["virtual"].float().mean().item() == pytest.approx(0.8, abs=0.12)
    assert set(tags(rows["desired_goal"])) == {WANTED, *(1005.0 + t for t in range(6))}


def test_batches_that_are_prefetched_by_threads() -> None:
    buffer = make_beside(storage=LazyTensorStorage(1_000), batch_size=64, prefetch=4)
    buffer.extend(flat([[7] * 20] * 4))
    for _ in range(40):
        rows = buffer.sample()
        observation, goal = rows["observation"][:, 0], rows["desired_goal"][:, 0]
        lent = goal != WANTED
        assert torch.equal(lent, rows["virtual"].squeeze(-1))
        assert torch.equal((observation / 100).floor()[lent], ((goal - 1) / 100).floor()[lent])
    buffer.shutdown()


def test_a_data_set_that_nobody_writes() -> None:
    unit, stored = HERSampleUnit(REWARD, strategy="final"), TensorStorage(flat([[4, 6]]))
    buffer = make_beside(unit, storage=stored, writer=ImmutableDatasetWriter(), batch_size=300)
    assert pairs(buffer.sample()) == {*((t, 4) for t in range(4)), *((100 + t, 106) for t in range(6))}


def test_a_buffer_that_only_reads_asks_the_one_that_writes() -> None:
    storage = LazyTensorStorage(5)
    reads = make_beside(HERSampleUnit(REWARD, strategy="final"), storage=storage, batch_size=200)
    writes = TensorDictReplayBuffer(storage=storage)
    rows = flat([[3, 4]]).exclude("collector")  # only the cursor keeps the two apart
    writes.extend(rows[:3].clone())
    writes.extend(rows[3:].clone())  # slots 3, 4, 0 and 1
    assert pairs(reads.sample()) == {(2.0, 3.0), *((100.0 + t, 104.0) for t in range(4))}


def test_a_full_buffer_that_was_loaded_goes_on_as_the_one_that_was_saved() -> None:
    first, second = (make_buffer(7, strategy="final") for _ in range(2))
    rows = flat([[3, 9]], steps=9).exclude("collector")
    first.extend(rows[:4].clone())
    first.extend(rows[4:].clone())
    load_buffer_state_dict(second, buffer_state_dict(first))
    expected, loaded = first.sample(100), second.sample(100)
    assert torch.equal(expected["desired_goal"], loaded["desired_goal"])
    assert pairs(loaded) == {(2.0, 3.0), *((100.0 + t, 106.0) for t in range(6))}


def test_an_emptied_buffer_forgets_its_episodes() -> None:
    buffer = make_buffer(12)
    buffer.extend(flat([[9]]))
    buffer.sample(5)
    buffer.empty()
    buffer.extend(flat([[9] * 3], steps=3, first=[(2, 0)]))
    assert pairs(buffer.sample(200)) == {(200 + t, 200 + g) for t in range(3) for g in range(t + 1, 4)}


@pytest.mark.parametrize("per", [False, True])
@pytest.mark.parametrize("weighted", [False, True])
def test_seeds_make_sampling_repeat(per: bool, weighted: bool) -> None:
    batches = []
    for seed in (1, 1, 2):
        weights = PreferFar() if weighted else None
        buffer = make_buffer(seed=seed, per=per, filter_achieved=True, weights=weights)
        # the filter refuses some of the first proposals
        buffer.extend(along([0, 0, 0, 1, 2, 3, 4]).reshape(-1))
        batches.append(buffer.sample(200))
    same, again, differs = batches
    for key in same.keys(True, True):
        assert torch.equal(same[key], again[key]), key
    assert not torch.equal(same["desired_goal"], differs["desired_goal"])


def test_torchrl_ignores_the_buffers_generator() -> None:
    batches = []
    for _ in range(2):
        buffer = make_torchrl()
        buffer.set_rng(torch.Generator().manual_seed(0))
        buffer.extend(flat([[30]]))
        batches.append(buffer.sample())
    assert torch.equal(batches[0]["index"], batches[1]["index"])
    assert not torch.equal(batches[0]["desired_goal"], batches[1]["desired_goal"])


def test_a_generator_of_its_own() -> None:
    batches = []
    for seed in (1, 1, 2):
        buffer = make_buffer(generator=torch.Generator().manual_seed(seed))
        buffer.extend(flat([[9, 9]]))
        batches.append(buffer.sample(50))
    assert all(torch.equal(batch["index"], batches[0]["index"]) for batch in batches)
    assert torch.equal(batches[0]["desired_goal"], batches[1]["desired_goal"])
    assert not torch.equal(batches[0]["desired_goal"], batches[2]["desired_goal"])


# Options


def test_a_unit_without_its_other_half_is_noticed() -> None:
    buffer = make_beside(collate_fn=None)
    buffer.extend(flat([[4]]))
    with pytest.raises(RuntimeError, match="nothing puts into batches; make the buffer with collate_fn=unit"):
        buffer.sample()
    buffer.append_transform(RewardScaling(0.0, 1.0))  # TorchRL's own, which does not relabel either
    with pytest.raises(RuntimeError, match="nothing puts into batches"):
        buffer.sample()
    buffer = make_beside(collate_fn=lambda rows: rows)
    buffer.extend(flat([[4]]))
    buffer.sample()  # the function may have relabeled
    with pytest.raises(RuntimeError, match="nothing puts into batches"):
        buffer.sample()


def test_a_batch_of_another_size_is_refused() -> None:
    unit = HERSampleUnit(REWARD)
    buffer = make_buffer()
    buffer.extend(flat([[4]]))
    unit.expand(torch.arange(3), {}, buffer.storage)
    with pytest.raises(RuntimeError, match=r"a batch \[3\] was drawn, but a batch \[4\] was read"):
        unit.relabel(buffer.storage[:])


# Slices

SLICES = {
    "slices": lambda: SliceSampler(slice_len=4, traj_key=IDS),
    "without replacement": lambda: SliceSamplerWithoutReplacement(slice_len=4, traj_key=IDS),
    "prioritized": lambda: PrioritizedSliceSampler(10_000, 0.7, 0.5, slice_len=4, traj_key=IDS),
    "short ones too": lambda: SliceSampler(slice_len=4, traj_key=IDS, strict_length=False),
    "padded": lambda: SliceSampler(slice_len=4, traj_key=IDS, strict_length=False, pad_output=True),
    "no ends": lambda: SliceSampler(slice_len=4, traj_key=IDS, truncated_key=None),
    "by ends": lambda: SliceSampler(slice_len=4, end_key=("next", "done")),
}
if "output_layout" in signature(SliceSampler).parameters:  # since TorchRL 0.15
    SLICES["a row each"] = lambda: SliceSampler(
        slice_len=6, traj_key=IDS, strict_length=False, output_layout="batch_time"
    )


def sequences(rows: TensorDict) -> list[TensorDict]:
    """The parts of a batch in which observations follow each other, up to an end, without padding."""
    if rows.ndim == 2:
        return [row[row["collector", "mask"]] for row in rows]
    if ("collector", "mask") in rows.keys(True):
        rows = rows[rows["collector", "mask"].flatten()]
    step = rows["observation"][:, 0]
    new = (step[1:] != step[:-1] + 1) | rows["next", "truncated"][:-1, 0]
    first = torch.cat((torch.tensor([0]), new.nonzero().squeeze(-1) + 1, torch.tensor([len(rows)])))
    return list(rows.split(first.diff().tolist()))


@pytest.mark.parametrize("filtered", [False, True])
@pytest.mark.parametrize("kind", list(SLICES))
def test_a_slice_gets_one_goal_and_keeps_its_ends(kind: str, filtered: bool) -> None:
    buffer = make_buffer(sampler=SLICES[kind](), k=4, filter_achieved=filtered)
    buffer.extend(flat([[6, 9, 5], [8, 4, 8]], terminated=True))
    seen = 0
    for part in chain.from_iterable(sequences(buffer.sample(24)) for _ in range(10)):
        step, goal = part["observation"][:, 0], part["desired_goal"][:, 0]
        virtual = part["virtual"].flatten()
        if kind != "no ends":  # where slices can follow each other unnoticed
            assert len(goal.unique()) == 1
            assert virtual.all() or not virtual.any()
        own = part[virtual]
        if len(own) == 0:
            continue
        seen += 1
        step, goal = own["observation"][:, 0], own["desired_goal"][:, 0]
        assert torch.equal((goal / 100).floor(), (step / 100).floor())
        assert goal[-1] > step[-1]  # of the last one, which may be the first to achieve it
        after = own["next"]
        assert torch.equal(after["terminated"].flatten(), step + 1 == goal)
        assert torch.equal(after["reward"].flatten(), (step + 1 == goal).float() - 1.0)
        assert torch.equal(after["done"], after["terminated"] | after["truncated"])
        if kind not in ("no ends", "a row each"):
            assert after["truncated"][..., 0].nonzero().flatten().tolist()[0] == step.argmax()
    assert seen > 30


def test_the_filter_looks_at_all_of_a_slice() -> None:
    batch = along([0.0, 1.0, 2.0, 1.0, 3.0])
    goals = {}
    for filtered in (False, True):
        sampler = SliceSampler(slice_len=3, traj_key=IDS)
        buffer = make_buffer(sampler=sampler, k=NEVER_REAL, filter_achieved=filtered)
        buffer.extend(batch.squeeze(0))
        rows = buffer.sample(600)
        goals[filtered] = pairs(rows)
    # Slices 0-2 and 1-3: 1 is achieved in the last state of the first one, but before, too.
    early, late = {(float(t), g) for t in range(3) for g in (1.0, 3.0)}, {(float(t), 3.0) for t in (1, 2, 3)}
    assert goals[False] == early | late
    assert goals[True] == {(float(t), 3.0) for t in range(4)}


def test_whole_episodes_need_slices() -> None:
    buffer = make_beside(HERSampleUnit(REWARD, per="episode"))
    buffer.extend(flat([[5]]))
    with pytest.raises(ValueError, match="needs a sampler of slices"):
        buffer.sample(4)


# Several steps


def test_steps_never_cross_episodes_in_a_ring() -> None:
    buffer = make_buffer(14, k=1, n_steps=3, gamma=0.9)
    for episode in range(4):
        buffer.extend(flat([[5] * 4], steps=5, first=[(episode, 0)]))
    rows = buffer.sample(500)
    ahead = rows["next", "observation"][:, 0] - rows["observation"][:, 0]
    assert torch.equal(ahead, rows["steps_to_next_obs"][:, 0].float())
    assert ((rows["next", "observation"][:, 0] % 100) <= 5).all()


# Metadata: where goals are from

METADATA = {"step_offset", "anchor_index", "validity_mask"}


def metadata(rows: TensorDict) -> list[Tensor]:
    """Step offset and validity of transitions, and by how many states their goals are ahead, [n] each."""
    ahead = rows["desired_goal"][..., 0] - rows["observation"][..., 0]
    return [rows["step_offset"].flatten(), rows["validity_mask"].flatten(), ahead.flatten().long()]


@pytest.mark.parametrize("n_steps", [1, 3])
@pytest.mark.parametrize("ndim", [1, 2])
def test_metadata_by_hand(ndim: int, n_steps: int) -> None:
    buffer = make_buffer(strategy="final", k=NEVER_REAL, ndim=ndim, metadata=True, n_steps=n_steps, gamma=0.9)
    batch = make_batch([[4, 2], [1, 5]])
    buffer.extend(batch.reshape(-1) if ndim == 1 else batch)
    rows = buffer.sample(300)
    to_the_end = {tag(0, 0, 0): 4, tag(0, 0, 1): 3, tag(0, 0, 2): 2, tag(0, 0, 3): 1}
    to_the_end |= {tag(0, 1, 0): 2, tag(0, 1, 1): 1, tag(1, 0, 0): 1}
    to_the_end |= {tag(1, 1, step): 5 - step for step in range(5)}
    assert rows["step_offset"].tolist() == [to_the_end[own] for own in tags(rows["observation"])]
    assert rows["validity_mask"].all()
    assert torch.equal(rows["anchor_index"], rows["index"])


def test_offsets_to_goals_of_the_past_are_below_one() -> None:
    buffer = make_buffer(14, strategy="episode", k=1, metadata=True)
    for episode in range(4):  # the ring begins again
        buffer.extend(flat([[5] * 4], steps=5, first=[(episode, 0)]))
    rows = buffer.sample(500)
    offset, valid, ahead = metadata(rows)
    assert torch.equal(valid, rows["virtual"].flatten())
    assert torch.equal(offset, torch.where(valid, ahead, 0))
    assert set(offset[valid].tolist()) == set(range(-3, 6))


@pytest.mark.parametrize("source", ["actual", "achieved"])
def test_goals_of_other_episodes_have_no_offset(source: str) -> None:
    buffer = make_buffer(goal_sources={"final": NEVER_REAL, source: NEVER_REAL}, metadata=True)
    buffer.extend(flat([[3, 3]]))
    offset, valid, ahead = metadata(buffer.sample(400))
    assert 0.4 < valid.float().mean() < 0.6
    assert torch.equal(offset[valid], ahead[valid])
    assert (offset[~valid] == 0).all()


@pytest.mark.parametrize("kind", list(SLICES))
def test_each_transition_of_a_slice_has_its_own_offset(kind: str) -> None:
    buffer = make_buffer(sampler=SLICES[kind](), k=4, metadata=True)
    buffer.extend(flat([[6, 9, 5], [8, 4, 8]]))
    rows = buffer.sample(24)
    offset, valid, ahead = metadata(rows)
    filled = ~rows.get(("collector", "mask"), torch.ones(24, dtype=torch.bool)).flatten()
    assert torch.equal(valid, rows["virtual"].flatten() & ~filled)
    assert torch.equal(rows["anchor_index"], rows["index"])
    assert torch.equal(offset[valid], ahead[valid])


@pytest.mark.parametrize("ndim", [1, 2])
def test_metadata_changes_nothing_else(ndim: int) -> None:
    plain, told = (make_buffer(100, per=True, ndim=ndim, metadata=own) for own in (False, True))
    batch = make_batch([[6, 9, 5], [8, 4, 8]])
    for buffer in (plain, told):
        buffer.extend(batch if ndim == 2 else batch.reshape(-1))
    for _ in range(3):
        rows, more = (buffer.sample(32) for buffer in (plain, told))
        assert set(more.keys()) - set(rows.keys()) == METADATA
        assert (more.exclude(*METADATA) == rows).all()
        for buffer, own in ((plain, rows), (told, more)):
            own["td_error"] = own["observation"][:, 0]
            buffer.update_tensordict_priority(own)


@pytest.mark.skipif(not hasattr(torchrl.data, "SubgoalTriplet"), reason="TorchRL has it since 0.15")
def test_metadata_has_the_names_and_types_of_torchrls_unit() -> None:
    buffer, index = make_buffer(), torch.tensor([0, 2])
    buffer.extend(flat([[4]]))
    _, own = HERSampleUnit(REWARD, metadata=True).expand(index, {}, buffer.storage)
    _, theirs = torchrl.data.SubgoalTriplet().expand(index, {}, buffer.storage)
    assert {key: value.dtype for key, value in own.items()} == {
        key: value.dtype for key, value in theirs.items()
    }
    assert {key: value.shape for key, value in own.items()} == {
        key: value.view(2, 4)[:, 0].shape for key, value in theirs.items()
    }


# Ids that are used again


@pytest.mark.parametrize("ids", [True, False])
def test_episodes_whose_goal_rests_are_told_apart_by_what_was_wanted(ids: bool) -> None:
    """As a ball that lies at the same place at the start of each episode, until somebody touches it."""
    one, other = make_batch([[9]], steps=3).squeeze(0), make_batch([[9, 4]], first=[(1, 0)]).squeeze(0)[:4]
    for key in ("achieved_goal", ("next", "achieved_goal")):
        one[key] = torch.zeros(3, 2)
        other[key][:, 0] = torch.tensor([0.0, 0.0, 1.0, 2.0]) if key == "achieved_goal" else torch.arange(4.0)
    for key in ("desired_goal", ("next", "desired_goal")):
        other[key] = torch.full((4, 2), 99.0)
    other["collector", "traj_ids"] = torch.zeros(4, dtype=torch.int64)
    buffer = make_buffer(strategy="final", k=NEVER_REAL)
    for batch in (one, other):
        buffer.extend(batch if ids else batch.exclude("collector"))
    rows = buffer.sample(200)
    assert {g for o, g in pairs(rows) if o < 100} == {0.0}
    assert {g for o, g in pairs(rows) if o >= 100} == {3.0}


@pytest.mark.parametrize("ndim", [1, 2])
def test_ids_that_are_used_again_join_no_episodes(ndim: int) -> None:
    first = make_batch([[9], [9]], steps=3)
    again = make_batch([[9, 4], [9, 4]], first=[(1, 0), (1, 0)], steps=4)
    again["collector", "traj_ids"] = first["collector", "traj_ids"][:, :1].expand(2, 4).clone()
    buffer = make_buffer(ndim=ndim, strategy="final", k=NEVER_REAL)
    for batch in (first, again):
        buffer.extend(batch.reshape(-1) if ndim == 1 else batch)
    last = {0: 3.0, 1: 104.0, 10: 1003.0, 11: 1104.0}
    for observation, goal in pairs(buffer.sample(500)):
        assert goal == last[int(observation // 100)]


# Parts that cannot work together


def test_a_unit_of_an_ensemble_is_refused_at_its_first_sample() -> None:
    unit = HERSampleUnit(REWARD)
    plain = [TensorDictReplayBuffer(storage=LazyTensorStorage(20)) for _ in range(2)]
    for member in plain:
        member.extend(flat([[5]]))
    with pytest.raises(ValueError, match="cannot work in a ReplayBufferEnsemble"):
        ReplayBufferEnsemble(*plain, batch_size=10, sample_unit=unit).sample()


def test_unit_and_relabel_may_be_copied_one_by_one() -> None:
    used = make_beside(unit := HERSampleUnit(REWARD, k=2, generator=torch.Generator()))
    used.extend(flat([[5]]))
    used.sample()
    copies = [pickle.loads(pickle.dumps(part)) for part in (unit, unit.relabel)]
    assert (copies[0].k, copies[0].generator) == (2, None)
    buffer = make_beside(copies[0], collate_fn=copies[1], batch_size=50)
    buffer.extend(flat([[5]]))
    assert buffer.sample()["virtual"].any()


def test_two_units_do_not_mix_up_their_batches() -> None:
    one, other = make_buffer(), make_buffer(strategy="final")
    for buffer in (one, other):
        buffer.extend(flat([[5]]))
    index, info = one.sampler.sample(one.storage, 10)
    one._sample_unit.expand(index, info, one.storage)
    assert other.sample(20)["virtual"].any()
    assert one._sample_unit.relabel(one.storage[index])["virtual"].any()


@pytest.mark.parametrize(
    ("parts", "batch", "error", "message"),
    [
        (
            {"writer": partial(TensorDictMaxValueWriter, rank_key=("next", "reward"))},
            flat([[5]]),
            ValueError,
            "order of time, which TensorDictMaxValueWriter does not keep",
        ),
        (
            {"writer": partial(HERWriter, REWARD)},
            flat([[5]]),
            ValueError,
            "but a HERWriter with k=4 relabels them: use one of the two",
        ),
        (
            {"sampler": partial(SliceSampler, slice_len=4, traj_key=IDS, truncated_key=("next", "cut"))},
            flat([[5]]),
            ValueError,
            r"under \('next', 'cut'\), and relabeling reads",
        ),
        (
            {"shared": True},
            flat([[5]]),
            RuntimeError,
            "shared between processes: workers send episodes",
        ),
        (
            {
                "storage": partial(LazyTensorStorage, 100, ndim=2),
                "sampler": partial(PrioritizedSliceSampler, 100, 0.7, 0.5, slice_len=2, traj_key=IDS),
            },
            make_batch([[5], [5]]),
            ValueError,
            "PrioritizedSliceSampler over a storage of 2 dimensions",
        ),
    ],
)
def test_parts_that_cannot_work_beside_it_are_named(
    parts: dict[str, Any], batch: TensorDict, error: type[Exception], message: str
) -> None:
    made = {name: part() if callable(part) else part for name, part in parts.items()}
    buffer = make_beside(**made)
    buffer.extend(batch.clone())
    with pytest.raises(error, match=message):
        buffer.sample()


def test_excluding_a_nested_entry_excludes_no_other_one() -> None:
    buffer = make_buffer(n_steps=2, gamma=0.5, exclude=[("agent", "observation")])
    batch = flat([[5]])
    batch["agent", "observation"] = batch["observation"]
    batch["next", "agent", "observation"] = batch["observation"]
    buffer.extend(batch)
    keys = set(buffer.sample(4).keys(True, True))
    assert ("next", "observation") in keys
    assert not {("agent", "observation"), ("next", "agent", "observation")} & keys
