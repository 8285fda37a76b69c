"""Replay of several runs in one buffer: each run is the run that it would be alone."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from typing import Any

import pytest
import torch
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, ListStorage, TensorDictReplayBuffer
from torchrl.data.replay_buffers.samplers import RandomSampler

from torchrl_her import GoalGrid, GoalReward, GoalWeights, HERWriter, Instructiveness
from torchrl_her.goals import GoalHistogram, KernelInstructiveness, NetworkNovelty, RareGoals
from torchrl_her.replay_buffers import (
    PackedStorage,
    RunsPrioritizedSampler,
    RunsSampler,
    empty_run,
    rows_of_run,
    sizes_of,
)
from torchrl_her.trainers import buffer_state_dict, load_buffer_state_dict

from ...her_data import make_batch, same

RUNS, ENVS, STEPS = 3, 2, 4
GRID = GoalGrid((0.0, -1.0), (7_000.0, 1.0), (10, 1), warn=False)
NEAR = GoalReward(1.5)  # neighboring states: the filter has something to do


class PreferLate(GoalWeights):
    """A user's own weights; they have a state."""

    def __init__(self, power: float) -> None:
        self.power, self.seen = power, 0

    def __call__(self, goals: torch.Tensor) -> torch.Tensor:
        return (goals[..., 0] % 100) ** self.power

    def update(self, goals: torch.Tensor) -> None:
        self.seen += len(goals)

    def clear(self) -> None:
        self.seen = 0


def q_star(sigma: float) -> torch.Tensor:
    return torch.linspace(1.0, 2.0, 10).softmax(0)


def make_weights(kind: str, run: int) -> GoalWeights | None:
    if kind == "ibs":
        return Instructiveness(GRID, q_star, sigma=0.1 + run)
    if kind == "kernel ibs":
        real = torch.stack([torch.linspace(0.0, 6_000.0, 7), torch.zeros(7)], 1)
        return KernelInstructiveness(real, sigma=300.0 + 100.0 * run, samples=50)
    if kind == "novel":
        return NetworkNovelty(seed=run, hidden=8, features=4)
    rare = RareGoals(estimator="neighbors", k=3, sharpness=1.0 + run, memory=60, samples=20)
    return {"counted": GoalHistogram(GRID), "own": PreferLate(run + 1.0), "rare": rare}.get(kind)


def make_buffer(
    runs: range,
    *,
    capacity: int = 1_000,
    weights: str = "none",
    sampler: str = "prioritized",
    packed: bool = True,
    **options: Any,
) -> TensorDictReplayBuffer:
    """The buffer of some of the runs, each of which has its own seed and its own weights."""
    n, generators = len(runs), [torch.Generator().manual_seed(run) for run in runs]
    own: Any = [weight for run in runs if (weight := make_weights(weights, run)) is not None] or None
    shared: dict[str, Any] = {"runs": n, "generators": generators}
    return TensorDictReplayBuffer(
        storage=(PackedStorage if packed else LazyTensorStorage)(n * capacity),
        writer=HERWriter(NEAR, weights=own[0] if own and n == 1 else own, **shared, **options),
        sampler=RunsSampler(capacity, **shared)
        if sampler == "uniform"
        else RunsPrioritizedSampler(capacity, 0.6, 0.4, **shared),
    )


def batches(lengths: list[list[int]], number: int) -> Iterator[TensorDict]:
    """Batches [R * E, T] of environments, each of which plays episodes of these lengths."""
    whole = make_batch(lengths, steps=number * STEPS)
    return iter([whole[:, i * STEPS : (i + 1) * STEPS] for i in range(number)])


def block(batch: TensorDict, run: int) -> TensorDict:
    return batch[run * ENVS : (run + 1) * ENVS].clone()


def assert_same_state(one: Any, other: Any) -> None:
    """Nested plain data and tensors, up to rounding."""
    if isinstance(one, dict):
        assert one.keys() == other.keys()
        for key in one:
            assert_same_state(one[key], other[key])
    elif isinstance(one, torch.Tensor):
        torch.testing.assert_close(one, other)
    else:
        assert one == other


def make_both(**options: Any) -> tuple[TensorDictReplayBuffer, list[TensorDictReplayBuffer]]:
    """A buffer of all runs, and one of each."""
    alone = [make_buffer(range(run, run + 1), **options) for run in range(RUNS)]
    return make_buffer(range(RUNS), **options), alone


def extend(
    together: TensorDictReplayBuffer, alone: list[TensorDictReplayBuffer], batch: TensorDict
) -> tuple[torch.Tensor, list[torch.Tensor]]:
    """Writes a batch of all runs; returns where its rows are, in the buffer of all and in each."""
    index = together.extend(batch.clone())
    return index, [own.extend(block(batch, run)) for run, own in enumerate(alone)]


def check_alone(together: TensorDictReplayBuffer, alone: list[TensorDictReplayBuffer]) -> None:
    """Everything that is known of each run is what its own buffer knows."""
    writer = together.writer
    for run, own in enumerate(alone):
        assert sizes_of(together)[run] == len(own)
        assert writer.counts_of(run) == own.writer.counts
        assert writer.totals_of(run) == own.writer.totals
        if len(own):
            assert same(rows_of_run(together, run), rows_of_run(own))
        for weights in writer.goal_weights[run : run + 1]:
            single = own.writer.goal_weights[0]
            if isinstance(weights, GoalHistogram):
                assert torch.equal(weights.counts, single.counts)
            elif isinstance(weights, PreferLate):
                assert weights.seen == single.seen
            else:
                assert_same_state(weights.state_dict(), single.state_dict())
    assert writer.held_back == sum(own.writer.held_back for own in alone)


def learn(together: TensorDictReplayBuffer, alone: list[TensorDictReplayBuffer], n: int = 16) -> None:
    """Draws, and sets priorities; idle runs draw nothing."""
    filled = [run for run, size in enumerate(sizes_of(together)) if size]
    if not filled:
        return
    drawn = together.sample(len(alone) * n)
    rows = drawn.view(len(alone), n)
    for run in filled:
        own = alone[run].sample(n)
        assert same(rows[run].exclude("index", "priority_weight"), own.exclude("index", "priority_weight"))
        if "priority_weight" in own.keys():  # a power, whose last bit depends on the others
            torch.testing.assert_close(rows["priority_weight"][run], own["priority_weight"])
        assert torch.equal(rows["index"][run] - run * together.writer.capacity, own["index"])
        own["td_error"] = own["observation"][:, :1] % 13
        alone[run].update_tensordict_priority(own)
    changed = rows[filled].flatten()
    changed["td_error"] = changed["observation"][:, :1] % 13
    together.update_tensordict_priority(changed)


CASES: list[dict[str, Any]] = [
    {},
    {"filter_achieved": True},
    {"filter_achieved": True, "weights": "ibs"},
    {"weights": "own", "filter_achieved": True},
    {"weights": "counted", "strategy": "episode"},
    {"sampler": "uniform", "strategy": "final"},
    {"capacity": 37, "filter_achieved": True},
    {"capacity": 5},
    {"goal_sources": {"final": 2, "actual": 1}, "filter_achieved": True, "refill": 4},
    {"n_steps": 3, "gamma": 0.9},
    {"k": 0},
    {"packed": False, "capacity": 60},
    {"goal_sources": {"future": 2, "actual": 2}, "filter_achieved": True},
    {
        "goal_sources": {"achieved": 2, "final": 1},
        "filter_achieved": True,
        "weights": "ibs",
        "recent_achieved": 20,
    },
    {"goal_sources": {"achieved": 3}, "weights": "own", "n_steps": 3, "gamma": 0.9},
    {"filter_achieved": True, "weights": "rare"},
    {"filter_achieved": True, "weights": "novel"},
    {"filter_achieved": True, "weights": "kernel ibs"},
]


def _shown(value: object) -> str:
    return "_".join(value) if isinstance(value, dict) else str(value)


@pytest.mark.parametrize(
    "options", CASES, ids=lambda options: "-".join(map(_shown, options.values())) or "plain"
)
@pytest.mark.filterwarnings("ignore:all [0-9]+ episodes have one step")
@settings(max_examples=4, deadline=None, derandomize=True, phases=[Phase.generate])
@given(data=st.data())
def test_each_run_is_the_run_that_it_is_alone(options: dict[str, Any], data: st.DataObject) -> None:
    """Rows, indices, draws, priorities and counts, whatever episodes the others play."""
    lengths = data.draw(
        st.lists(
            st.lists(st.integers(1, 15), min_size=30, max_size=30), min_size=RUNS * ENVS, max_size=RUNS * ENVS
        )
    )
    together, alone = make_both(**options)
    for batch in batches(lengths, 6):
        with warnings.catch_warnings():  # the smallest buffer holds less than is held back
            warnings.filterwarnings("ignore", ".* wait for their end")
            index, singles = extend(together, alone, batch)
        for run, single in enumerate(singles):
            block_index = index[run * ENVS : (run + 1) * ENVS]
            shifted = block_index - run * together.writer.capacity
            assert torch.equal(torch.where(block_index < 0, -1, shifted), single)
        check_alone(together, alone)
        learn(together, alone)


def test_one_run_is_the_case_of_one() -> None:
    """With a buffer's own generator and TorchRL's storage, the same rows are written and drawn."""
    generator = torch.Generator().manual_seed(0)
    plain = TensorDictReplayBuffer(
        storage=LazyTensorStorage(100),
        writer=HERWriter(NEAR, filter_achieved=True),
        sampler=RunsPrioritizedSampler(100, 0.6, 0.4),
    )
    plain.set_rng(generator)
    buffer = make_buffer(range(1), capacity=100, filter_achieved=True)
    for batch in batches([[3, 9, 5, 30], [7, 7, 30]], 6):
        assert torch.equal(plain.extend(batch.clone()), buffer.extend(batch.clone()))
        assert same(plain[:], buffer[:]) if len(plain) else len(buffer) == 0
        if len(plain):
            assert same(plain.sample(8), buffer.sample(8))


def test_environments_are_known_by_ids_that_come_in_any_order() -> None:
    together, alone = make_both(filter_achieved=True)
    ids = torch.randperm(1_000, generator=torch.Generator().manual_seed(0))[: RUNS * ENVS]
    lengths = [[3, 8, 30], [9, 30], [30, 2], [5, 5, 30], [4, 30], [11, 30]]
    for batch in batches(lengths, 6):
        batch = batch.clone().set("env_ids", ids.unsqueeze(-1).expand(-1, STEPS))
        extend(together, alone, batch)
        check_alone(together, alone)


def test_episodes_are_ended_for_all_runs() -> None:
    together, alone = make_both()
    first, second = batches([[30]] * (RUNS * ENVS), 2)
    for batch in (first, second):
        for own in (together, *alone):
            own.writer.end_episodes()
        extend(together, alone, batch)
    check_alone(together, alone)
    assert together.writer.totals.real == RUNS * ENVS * STEPS


@pytest.mark.parametrize("weights", ["ibs", "own", "rare", "novel", "kernel ibs"])
def test_emptying_a_run_empties_it_alone(weights: str) -> None:
    """Rows, priorities, q, counts and open episodes; the others go on as if nothing were the matter."""
    options: dict[str, Any] = {"filter_achieved": True, "weights": weights, "capacity": 50}
    options["goal_sources"] = {"future": 2, "achieved": 2}
    together, alone = make_both(**options)
    for step, batch in enumerate(batches([[3, 6, 5, 7, 30], [11, 4, 30]] * RUNS, 8)):
        if step == 4:
            empty_run(together, 1)
            empty_run(alone[1])
            assert sizes_of(together)[1] == 0
            assert together.writer.totals_of(1).real > together.writer.counts_of(1).real == 0
            learn(together, alone)
        extend(together, alone, batch)
        check_alone(together, alone)
        learn(together, alone)
    with pytest.raises(ValueError, match=r"run must be in \[0, 2\], got 3"):
        empty_run(together, 3)


def test_runs_relabel_with_rewards_and_weights_of_their_own() -> None:
    """As in a curriculum, where runs are in several stages."""
    options: dict[str, Any] = {"filter_achieved": True, "weights": "ibs"}
    together, alone = make_both(**options)
    wide = GoalReward(2.5)
    for run, (reward, alike) in enumerate(((NEAR, True), (wide, False), (NEAR, True))):
        for buffer, place in ((together, run), (alone[run], 0)):
            buffer.writer.set_reward(reward, run=place)
            buffer.writer.goal_weights[place].is_uniform = alike
    for batch in batches([[9, 12, 30], [8, 30]] * RUNS, 6):
        extend(together, alone, batch)
        check_alone(together, alone)
    assert together.writer.reward_of(1) is wide
    assert together.writer.reward_of(2) is NEAR


@pytest.mark.parametrize("pieces", [1 << 7, 1 << 9])
@pytest.mark.parametrize("sources", [{"future": 4}, {"future": 2, "achieved": 2}])
def test_pieces_do_not_change_what_a_run_writes(
    pieces: int, sources: dict[str, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("torchrl_her.replay_buffers.writer._ROWS", pieces)
    options: dict[str, Any] = {"filter_achieved": True, "weights": "ibs", "goal_sources": sources}
    together, alone = make_both(**options)
    lengths = [[2] * 20, [3] * 12, [20, 30], [7, 9, 2, 30], [1] * 30, [24]]
    batch = make_batch(lengths, steps=24)
    extend(together, alone, batch)
    check_alone(together, alone)


@pytest.mark.parametrize("sampler", ["uniform", "prioritized"])
@pytest.mark.parametrize("packed", [True, False])
def test_a_state_goes_on_as_the_unbroken_buffer(sampler: str, packed: bool) -> None:
    options: dict[str, Any] = {"weights": "ibs", "capacity": 40, "sampler": sampler, "packed": packed}
    options |= {"goal_sources": {"future": 2, "achieved": 2}, "recent_achieved": 30}
    buffer, other = (make_buffer(range(RUNS), **options) for _ in range(2))
    stream = batches([[3, 6, 5, 7, 30], [11, 4, 30]] * RUNS, 8)
    for step in range(8):
        if step == 4:
            empty_run(buffer, 1)
            state = buffer_state_dict(buffer)
            assert sum(len(next(iter(own.values()))) > 0 for own in state["rows"] if own) == RUNS - 1
            load_buffer_state_dict(other, state)
            for mine, theirs in zip(buffer.writer.generators, other.writer.generators, strict=True):
                theirs.set_state(mine.get_state())
        batch = next(stream)
        index = buffer.extend(batch.clone())
        if step >= 4:
            assert torch.equal(other.extend(batch.clone()), index)
            assert same(other.sample(RUNS * 8), buffer.sample(RUNS * 8))
            for run in range(RUNS):
                assert same(rows_of_run(other, run), rows_of_run(buffer, run))
    assert other.writer.totals == buffer.writer.totals
    with pytest.raises(ValueError, match="the buffer must be empty"):
        load_buffer_state_dict(other, state)
    with pytest.raises(ValueError, match="the state must have . runs, got"):
        load_buffer_state_dict(make_buffer(range(2), capacity=60, sampler=sampler, packed=packed), state)


def test_what_cannot_be_is_refused() -> None:
    generators = [torch.Generator() for _ in range(RUNS)]
    with pytest.raises(ValueError, match="3 runs need 3 generators, one for each run, got None"):
        HERWriter(NEAR, runs=RUNS)
    with pytest.raises(ValueError, match="3 runs need a list of 3 weights, one for each run, got 1"):
        HERWriter(NEAR, runs=RUNS, generators=generators, weights=GoalHistogram(GRID))
    together, batch = make_buffer(range(RUNS)), make_batch([[2]] * (RUNS * ENVS))
    with pytest.raises(ValueError, match=r"takes batches \[R \* N, T\], 3 equal blocks .*, got \[5, 2\]"):
        together.extend(batch[:5])
    with pytest.raises(ValueError, match=r"3 equal blocks of environments, got \[12\]"):
        together.extend(batch.reshape(-1))

    def beside(storage: Any, sampler: Any) -> None:
        writer = HERWriter(NEAR, runs=RUNS, generators=generators)
        TensorDictReplayBuffer(storage=storage, sampler=sampler, writer=writer).extend(batch.clone())

    sampler = RunsSampler(10, runs=RUNS, generators=generators)
    with pytest.raises(ValueError, match="of 3 equal blocks, got a LazyTensorStorage of 31 rows"):
        beside(LazyTensorStorage(31), sampler)
    with pytest.raises(ValueError, match="of 3 equal blocks, got a ListStorage of 30 rows"):
        beside(ListStorage(30), sampler)
    with pytest.raises(ValueError, match="of 3 runs, got a RandomSampler of 1"):
        beside(LazyTensorStorage(30), RandomSampler())


# Episodes of one run that nobody collected


@pytest.mark.parametrize("weights", ["none", "ibs"])
def test_whole_episodes_of_one_run_are_written_as_if_it_were_alone(weights: str) -> None:
    together, alone = make_both(weights=weights, filter_achieved=True)
    collected = next(batches([[4], [4]] * RUNS, 1))
    shown = make_batch([[3, 2, 5]], steps=10)[0].exclude("collector")
    together.extend(collected)
    index = together.writer.extend_run(shown, run=1)
    for run, own in enumerate(alone):
        own.extend(block(collected, run))
    own_index = alone[1].writer.extend_run(shown)
    check_alone(together, alone)
    assert (index - own_index).unique().tolist() == [1_000]  # the block of run 1
    assert torch.equal(together.storage[index]["observation"], shown["observation"])
    together.sample(RUNS * 4)  # the sampler knows of them


def test_open_episodes_wait_while_others_are_written() -> None:
    first, second = batches([[6], [6]] * RUNS, 2)
    whole, plain = make_buffer(range(RUNS)), make_buffer(range(RUNS))
    for buffer in (whole, plain):
        buffer.extend(first)
    whole.writer.extend_run(make_batch([[3]])[0].exclude("collector"), run=2)
    assert whole.writer.held_back == plain.writer.held_back == RUNS * ENVS * STEPS
    for buffer in (whole, plain):
        buffer.extend(second)
    assert whole.writer.counts_of(2).real == plain.writer.counts_of(2).real + 3
    assert same(rows_of_run(whole, 0), rows_of_run(plain, 0))


@pytest.mark.parametrize(
    ("steps", "run", "message"),
    [
        (3, 3, r"run must be in \[0, 2\], got 3"),
        (2, 0, r"extend_run needs transitions \[n\], the last of which is done, got \[2\]"),
        (0, 0, r"extend_run needs transitions \[n\], the last of which is done, got \[0\]"),
    ],
)
def test_what_is_no_whole_episode_of_a_run_is_refused(steps: int, run: int, message: str) -> None:
    buffer = make_buffer(range(RUNS))
    with pytest.raises(ValueError, match=message):
        buffer.writer.extend_run(make_batch([[3]])[0, :steps], run=run)
    assert len(buffer) == 0
