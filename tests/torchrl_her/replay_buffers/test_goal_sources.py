"""Goals from several sources, other episodes among them, in the writer and in the sample unit.

Each episode wants a goal that tells which one it is: -1 - (1000 n + 100 e) for episode e of environment n.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torch import Tensor
from torchrl.data import LazyTensorStorage, SliceSampler, TensorDictReplayBuffer

from torchrl_her import GoalReward, GoalWeights, HERSampleUnit, HERWriter

from ..her_data import make_batch, tag

pytestmark = pytest.mark.filterwarnings("ignore:the reward function gives")  # made up as each test needs it
REWARD = GoalReward(0.5)
MIXED = {"future": 2, "actual": 2}
IDS = ("collector", "traj_ids")


def wanted_by(env: int, episode: int) -> float:
    return -1.0 - tag(env, episode, 0)


def tagged(lengths: list[list[int]], **options: Any) -> TensorDict:
    batch = make_batch(lengths, **options)
    wanted = -1.0 - (batch["achieved_goal"] / 100).floor() * 100
    wanted[..., 1] = 0.0
    batch["desired_goal"], batch["next", "desired_goal"] = wanted, wanted.clone()
    return batch


def walks(paths: list[list[float]], wanted: list[float]) -> TensorDict:
    """A flat batch of one environment that walks along paths; observations are 100 e + t."""
    batch = make_batch([[len(path) - 1 for path in paths]]).squeeze(0)
    before = [x for path in paths for x in path[:-1]]
    after = [x for path in paths for x in path[1:]]
    goals = [goal for path, goal in zip(paths, wanted, strict=True) for _ in path[1:]]
    for key, values in (("achieved_goal", before), (("next", "achieved_goal"), after)):
        batch[key] = torch.tensor(values).unsqueeze(-1)
    for key in ("desired_goal", ("next", "desired_goal")):
        batch[key] = torch.tensor(goals).unsqueeze(-1)
    return batch


def make_buffer(
    kind: type, capacity: int = 10_000, *, seed: int = 0, **options: Any
) -> TensorDictReplayBuffer:
    part = kind(options.pop("reward", REWARD), **options)
    parts = {"writer": part} if kind is HERWriter else {"sample_unit": part, "collate_fn": part.relabel}
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(capacity), **parts)
    buffer.set_rng(torch.Generator().manual_seed(seed))
    return buffer


def virtual(buffer: TensorDictReplayBuffer, size: int = 3_000) -> TensorDict:
    """All virtual rows that a writer stored, or those of a sample."""
    rows = buffer[:] if isinstance(buffer.writer, HERWriter) else buffer.sample(size)
    return rows[rows["virtual"].squeeze(-1)]


def goals_of(rows: TensorDict) -> set[float]:
    return set(rows["desired_goal"][:, 0].tolist())


both = pytest.mark.parametrize("kind", [HERWriter, HERSampleUnit])


def extend(buffer: TensorDictReplayBuffer, batch: TensorDict) -> None:
    buffer.extend(batch.clone() if isinstance(buffer.writer, HERWriter) else batch.reshape(-1))


# Where goals come from


def test_each_transition_gets_so_many_goals_of_each_source() -> None:
    buffer = make_buffer(HERWriter, goal_sources={"future": 2, "actual": 3, "achieved": 1})
    buffer.extend(tagged([[3], [2]]))
    rows = virtual(buffer)
    assert (buffer.writer.counts.real, buffer.writer.counts.virtual, len(rows)) == (5, 30, 30)
    for env, length in ((0, 3), (1, 2)):
        for t in range(length):
            own = rows[rows["observation"][:, 0] == tag(env, 0, t)]["desired_goal"][:, 0].tolist()
            # Goals of one source follow each other.
            assert all(tag(env, 0, t) < goal <= tag(env, 0, length) for goal in own[:2])
            assert set(own[2:5]) <= {wanted_by(0, 0), wanted_by(1, 0)}
            assert own[5] in {1.0, 2.0, 3.0, 1001.0, 1002.0}


@both
def test_goals_of_recent_episodes_are_those_of_all_environments_and_batches(kind: type) -> None:
    for source, first, second in (
        ("actual", {wanted_by(0, 0), wanted_by(1, 0)}, {wanted_by(0, 1), wanted_by(1, 1)}),
        ("achieved", {1.0, 2.0, 1001.0}, {101.0, 1101.0, 1102.0}),
    ):
        buffer = make_buffer(kind, goal_sources={source: 300})
        extend(buffer, tagged([[2], [1, 9]], steps=2)[:, :1])
        extend(buffer, tagged([[2], [1, 9]], steps=2)[:, 1:])
        if kind is HERWriter:
            assert goals_of(virtual(buffer)) == first
        before = len(buffer)
        extend(buffer, tagged([[2, 1], [1, 2]], steps=1, first=[(1, 0), (1, 1)]))
        new = virtual(buffer)
        new = new[new["observation"][:, 0] % 1000 >= 100]
        assert len(buffer) > before
        assert goals_of(new) == first | second


@both
def test_only_the_newest_goals_are_remembered(kind: type) -> None:
    options: dict[str, Any] = {"recent_actual": 2, "recent_achieved": 3}
    for source, expected in (
        ("actual", {wanted_by(0, 1), wanted_by(0, 2)}),
        ("achieved", {103.0, 201.0, 202.0}),
    ):
        buffer = make_buffer(kind, goal_sources={source: 200}, **options)
        whole = tagged([[2, 3, 2]])
        for begin, end in ((0, 2), (2, 5), (5, 7)):
            extend(buffer, whole[:, begin:end])
        rows = virtual(buffer)
        last = rows[rows["observation"][:, 0] >= 200]
        assert goals_of(last) == expected


def test_the_newest_stored_rows_are_meant_where_a_ring_is_full() -> None:
    buffer = make_buffer(HERSampleUnit, 6, goal_sources={"achieved": 500}, recent_achieved=4)
    for episode in range(5):
        extend(buffer, tagged([[2] * 9], steps=2, first=[(episode, 0)]))
    assert goals_of(virtual(buffer)) == {301.0, 302.0, 401.0, 402.0}
    buffer._sample_unit.goal_sources = {"actual": 500}
    assert goals_of(virtual(buffer)) == {wanted_by(0, 2), wanted_by(0, 3), wanted_by(0, 4)}


def test_rows_of_a_storage_of_two_dimensions_and_of_open_episodes_count() -> None:
    unit = HERSampleUnit(REWARD, goal_sources={"actual": 500}, recent_actual=3)
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(100, ndim=2), sample_unit=unit, collate_fn=unit.relabel
    )
    buffer.extend(tagged([[2, 2, 9], [3, 9], [9]], steps=5))
    assert goals_of(virtual(buffer)) == {wanted_by(0, 2), wanted_by(1, 1), wanted_by(2, 0)}
    unit.options = unit.options.changed({"goal_sources": {"achieved": 500}, "recent_achieved": 6})
    assert goals_of(virtual(buffer)) == {102.0, 201.0, 1101.0, 1102.0, 2004.0, 2005.0}


def test_what_is_held_back_is_not_remembered_yet() -> None:
    buffer = make_buffer(HERWriter, goal_sources={"actual": 100})
    batch = tagged([[3], [9]], steps=6)
    buffer.extend(batch[:, :3])
    assert goals_of(virtual(buffer)) == {wanted_by(0, 0)}


# What follows from such a goal


def check(row: TensorDict, paths: list[list[float]], n_steps: int, gamma: float) -> None:
    """That a virtual row is what it should be for its goal, whatever the goal is."""
    episode, t = divmod(int(row["observation"][0]), 100)
    path, goal = paths[episode], float(row["desired_goal"][0])
    reached = [abs(path[i + 1] - goal) < 0.5 for i in range(t, len(path) - 1)][:n_steps]
    steps = reached.index(True) + 1 if True in reached else len(reached)
    rewards = [0.0 if own else -1.0 for own in reached[:steps]]
    after = row["next"]
    assert float(after["desired_goal"][0]) == goal
    assert float(after["reward"]) == pytest.approx(sum(gamma**i * own for i, own in enumerate(rewards)))
    assert bool(after["terminated"]) == reached[steps - 1]
    assert bool(after["truncated"]) == (t + steps == len(path) - 1)
    assert bool(after["done"]) == (reached[steps - 1] or t + steps == len(path) - 1)
    assert float(after["observation"][0]) == 100 * episode + t + steps
    assert float(after["achieved_goal"][0]) == path[t + steps]
    if n_steps > 1:
        assert int(row["steps_to_next_obs"]) == steps


PATHS = st.lists(st.lists(st.integers(0, 4).map(float), min_size=2, max_size=6), min_size=1, max_size=4)
SOURCES = st.dictionaries(
    st.sampled_from(["future", "final", "episode", "actual", "achieved"]),
    st.integers(1, 3),
    min_size=1,
    max_size=4,
)


@both
@settings(max_examples=40, deadline=None)
@given(paths=PATHS, sources=SOURCES, n_steps=st.sampled_from([1, 3]), filtered=st.booleans())
def test_virtual_rows_are_right_in_every_respect(
    kind: type, paths: list[list[float]], sources: dict[str, int], n_steps: int, filtered: bool
) -> None:
    wanted = [float(10 * (e % 2)) for e in range(len(paths))]  # 10 is never achieved, 0 sometimes
    buffer = make_buffer(
        kind, goal_sources=sources, n_steps=n_steps, gamma=0.5, filter_achieved=filtered, seed=len(paths)
    )
    buffer.extend(walks(paths, wanted))
    allowed = set(wanted) if "actual" in sources else set()
    if set(sources) - {"actual"}:
        allowed |= {goal for path in paths for goal in path[1:]}
    for row in virtual(buffer, 60):
        check(row, paths, n_steps, 0.5)
        episode, t = divmod(int(row["observation"][0]), 100)
        goal = float(row["desired_goal"][0])
        assert goal in allowed
        if not set(sources) & {"actual", "achieved"}:
            assert goal in paths[episode][1:]
        assert not filtered or abs(paths[episode][t] - goal) >= 0.5


def test_copies_of_whole_episodes_have_one_goal_of_another_episode() -> None:
    """The first episode wants 11, where the second one ends; the second wants 2, where both pass."""
    paths = [[0.0, 1.0, 2.0, 3.0], [10.0, 2.0, 11.0]]
    buffer = make_buffer(HERWriter, per="episode", goal_sources={"actual": 20})
    buffer.extend(walks(paths, [11.0, 2.0]))
    rows = virtual(buffer)
    copies = [rows[rows[IDS] == copy] for copy in rows[IDS].unique()]
    assert len(copies) == 40
    seen = Counter()
    for copy in copies:
        (goal,) = goals_of(copy)
        assert goals_of(copy["next"]) == {goal}
        after = copy["next"]
        ends = zip(after["terminated"].flatten().tolist(), after["truncated"].flatten().tolist(), strict=True)
        seen[tuple(copy["observation"][:, 0].tolist()), goal, tuple(ends)] += 1
    go, reached, cut = (False, False), (True, False), (False, True)
    assert set(seen) == {
        ((0.0, 1.0, 2.0), 11.0, (go, go, cut)),
        ((0.0, 1.0), 2.0, (go, reached)),
        ((100.0,), 2.0, (reached,)),
        ((100.0, 101.0), 11.0, (go, (True, True))),
    }


def test_a_slice_gets_one_goal_of_another_episode() -> None:
    unit = HERSampleUnit(REWARD, goal_sources={"actual": 5, "achieved": 5}, per="episode")
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(100),
        sampler=SliceSampler(slice_len=3, traj_key=IDS),
        sample_unit=unit,
        collate_fn=unit.relabel,
    )
    buffer.extend(tagged([[4, 3], [5]], steps=7).reshape(-1))
    slices = buffer.sample(900).reshape(-1, 3)
    foreign = 0
    for own in slices:
        goals = own["desired_goal"][:, 0]
        assert len(goals.unique()) == 1
        assert len(own["virtual"].unique()) == 1
        start = float(own["observation"][0, 0]) // 100 * 100
        foreign += bool(own["virtual"][0]) and goals[0].item() not in {-1.0 - start, start + 1, start + 2}
    assert foreign > 100


# Weights and filter


def test_the_filter_looks_at_all_of_a_slice() -> None:
    """The goal 4 is achieved before the last step of the third slice only."""
    unit = HERSampleUnit(REWARD, goal_sources={"actual": 10**6}, filter_achieved=True)
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(100),
        sampler=SliceSampler(slice_len=3, traj_key=IDS),
        sample_unit=unit,
        collate_fn=unit.relabel,
    )
    buffer.extend(walks([[0.0, 1.0, 2.0, 3.0, 4.0, 5.0]], [4.0]))
    slices = buffer.sample(600).reshape(-1, 3)
    virtual_from = {
        first: slices["virtual"][slices["observation"][:, 0, 0] == first].unique().tolist()
        for first in range(3)
    }
    assert virtual_from == {0: [True], 1: [True], 2: [False]}


class Table(GoalWeights):
    """The weight of a goal is what a table says of the whole number nearest to it."""

    def __init__(self, *table: float) -> None:
        self.table, self.written = torch.tensor(table), 0

    def __call__(self, goals: Tensor) -> Tensor:
        return self.table[goals.squeeze(-1).round().long()]

    def update(self, goals: Tensor) -> None:
        self.written += len(goals)


LONG = [[0.0, 1.0, 2.0], [3.0, 2.0], [1.0, 1.0, 4.0, 0.0]]
ASKED = [4.0, 4.0, 2.0]


def expected(sources: dict[str, int], weight: list[float], filtered: bool) -> dict[tuple[int, float], float]:
    """The share that each pair of a transition and a goal has of all virtual rows."""
    pools = {"actual": ASKED, "achieved": [goal for path in LONG for goal in path[1:]]}
    shares: dict[tuple[int, float], float] = Counter()
    for episode, path in enumerate(LONG):
        for t in range(len(path) - 1):
            for source, number in sources.items():
                likelihood = Counter()
                for goal in pools.get(source, path[t + 1 :]):
                    likelihood[goal] += weight[int(goal)] * (not filtered or goal != path[t])
                for goal, own in likelihood.items():
                    if own > 0:
                        shares[100 * episode + t, goal] += number * own / likelihood.total()
    return {pair: share / sum(shares.values()) for pair, share in shares.items()}


@both
@pytest.mark.parametrize("filtered", [False, True])
@pytest.mark.parametrize("weight", [[1.0] * 5, [1.0, 0.0, 2.0, 1.0, 5.0], [0.0, 1.0, 0.0, 1.0, 0.0]])
@pytest.mark.parametrize("tries", [0, 8])
def test_writer_and_unit_follow_the_one_formula(
    kind: type, filtered: bool, weight: list[float], tries: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in ("draw", "sample_unit"):
        monkeypatch.setattr(f"torchrl_her.replay_buffers.{module}.TRIES", tries)
    sources = {"future": 300, "actual": 600, "achieved": 300}
    alike = len(set(weight)) == 1
    own = None if alike else Table(*weight)
    buffer = make_buffer(kind, 20_000, goal_sources=sources, filter_achieved=filtered, weights=own)
    buffer.extend(walks(LONG, ASKED))
    rows = virtual(buffer, 12_000)
    pairs = zip(rows["observation"][:, 0].long().tolist(), rows["desired_goal"][:, 0].tolist(), strict=True)
    shares = {pair: count / len(rows) for pair, count in Counter(pairs).items()}
    assert shares == pytest.approx(expected(sources, weight, filtered), abs=0.02)  # five deviations
    assert own is None or own.written == len(rows)


def test_a_source_that_may_give_nothing_leaves_the_others_as_they_are() -> None:
    """The only actual goal is achieved before each action, so the filter refuses it."""
    buffer = make_buffer(HERWriter, goal_sources={"actual": 3, "future": 2}, filter_achieved=True)
    buffer.extend(walks([[0.0, 0.2, 0.1]], [0.0]))
    assert len(virtual(buffer)) == 0
    buffer.extend(walks([[0.0, 1.0, 5.0]], [0.0]))  # now the second step may take it
    rows = virtual(buffer)
    counts = Counter(
        zip(rows["observation"][:, 0].tolist(), rows["desired_goal"][:, 0].tolist(), strict=True)
    )
    assert counts[1.0, 0.0] == 3
    assert sum(counts.values()) == 2 + 2 + 3
    assert counts[0.0, 0.0] == 0


# State


def test_a_writer_goes_on_with_the_goals_that_it_remembers(tmp_path: Path) -> None:
    options: dict[str, Any] = {"goal_sources": {"future": 1, "actual": 2, "achieved": 2}, "recent_actual": 3}
    first, second = make_buffer(HERWriter, **options), make_buffer(HERWriter, seed=9, **options)
    whole = tagged([[3, 2, 4, 3], [5, 2, 5]])
    first.extend(whole[:, :7])
    first.writer.dumps(tmp_path)
    second.writer.loads(tmp_path)
    second.storage.set(torch.arange(len(first)), first[:])
    second.set_rng(torch.Generator())
    second.writer._rng.set_state(first.writer._rng.get_state())
    for buffer in (first, second):
        buffer.extend(whole[:, 7:].clone())
    assert torch.equal(first[:]["desired_goal"], second[:]["desired_goal"])
    assert (virtual(first)["desired_goal"][:, 0] == wanted_by(1, 0)).any()


def test_a_state_without_a_memory_makes_a_writer_forget_its_own() -> None:
    state = make_buffer(HERWriter).writer.state_dict()
    buffer = make_buffer(HERWriter, goal_sources={"actual": 50})
    buffer.extend(tagged([[3], [2]]))
    buffer.writer.load_state_dict(state)
    buffer.extend(tagged([[2] * 9], steps=2, first=[(7, 0)]))
    tags = virtual(buffer)["observation"][:, 0]
    assert goals_of(virtual(buffer)[(tags >= 700) & (tags < 1000)]) == {wanted_by(0, 7)}


def test_an_emptied_buffer_forgets_goals() -> None:
    buffer = make_buffer(HERWriter, goal_sources={"actual": 50, "achieved": 50})
    whole = tagged([[3, 2]])
    buffer.extend(whole[:, :3])
    buffer.empty()
    buffer.extend(whole[:, 3:])
    assert goals_of(virtual(buffer)) == {wanted_by(0, 1), 101.0, 102.0}


@both
def test_seeds_make_it_repeat(kind: type) -> None:
    def drawn(seed: int) -> Tensor:
        buffer = make_buffer(kind, seed=seed, goal_sources={**MIXED, "achieved": 2}, filter_achieved=True)
        extend(buffer, tagged([[3, 4], [7]]))
        return virtual(buffer, 200)["desired_goal"]

    assert torch.equal(drawn(3), drawn(3))
    assert drawn(3).shape != drawn(4).shape or not torch.equal(drawn(3), drawn(4))
