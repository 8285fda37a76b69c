"""What HERWriter and HERSampleUnit refuse by name, before anything of it is written or counted."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import Any

import pytest
import torch
from tensordict import NestedKey, NonTensorData, NonTensorStack, TensorDict, lazy_stack
from torch import Tensor
from torchrl.data import LazyStackStorage, LazyTensorStorage, TensorDictReplayBuffer

from torchrl_her import EnvReward, GoalReward, GoalWeights, HERSampleUnit, HERWriter
from torchrl_her.modules import RunningNorm

from ..her_data import make_batch

pytestmark = pytest.mark.filterwarnings("ignore:the reward function gives")  # made up as each test needs it
REWARD = GoalReward(0.5)
GOALS = ["achieved_goal", "desired_goal", ("next", "achieved_goal"), ("next", "desired_goal")]


def writing(reward: Any = REWARD, **options: Any) -> TensorDictReplayBuffer:
    return TensorDictReplayBuffer(storage=LazyTensorStorage(1_000), writer=HERWriter(reward, **options))


def sampling(reward: Any = REWARD, **options: Any) -> TensorDictReplayBuffer:
    many = {} if "goal_sources" in options else {"k": 10**6}  # practically all rows are virtual
    unit = HERSampleUnit(reward, **many, **options)
    return TensorDictReplayBuffer(
        storage=LazyTensorStorage(1_000, ndim=2), sample_unit=unit, collate_fn=unit.relabel, batch_size=64
    )


def fill(buffer: TensorDictReplayBuffer, batch: TensorDict) -> TensorDict:
    buffer.extend(batch)
    return buffer.sample(64)


def nothing_is_written(buffer: TensorDictReplayBuffer) -> bool:
    writer = buffer.writer
    counted = writer.counts.real + writer.counts.virtual + writer.totals.real + writer.totals.virtual
    return len(buffer) + buffer.write_count + counted + writer.held_back + writer._episodes == 0


# What is not finite


@pytest.mark.parametrize("key", [*GOALS, ("next", "reward")])
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("with_ids", [True, False])
def test_goals_and_rewards_must_be_finite(key: NestedKey, bad: float, with_ids: bool) -> None:
    batch = make_batch([[4, 2], [6]], steps=7)  # the last episodes are held back
    batch = batch if with_ids else batch.exclude(("collector", "traj_ids"))
    batch[key][0, 1, 0] = bad
    buffer = writing()
    with pytest.raises(ValueError, match=f"the collected {re.escape(repr(key))} must be finite, got {bad}"):
        buffer.extend(batch)
    assert nothing_is_written(buffer)
    buffer = sampling()
    with pytest.raises(ValueError, match=f"the stored {re.escape(repr(key))} must be finite, got {bad}"):
        fill(buffer, batch)


def test_finite_numbers_whose_sum_overflows_are_written() -> None:
    batch = make_batch([[3]])
    for key in GOALS:
        batch[key][..., 1] = 3e38
    assert not batch["achieved_goal"].sum().isfinite()
    far = EnvReward(lambda a, d: -(a[..., :1] != d[..., :1]).float(), lambda a, d: a[..., :1] == d[..., :1])
    buffer = writing(far, k=1)
    buffer.extend(batch)
    assert len(buffer) == 6


@pytest.mark.parametrize("n_steps", [1, 3])
@pytest.mark.parametrize("make", [writing, sampling])
def test_rewards_that_the_function_gives_must_be_finite(
    make: Callable[..., TensorDictReplayBuffer], n_steps: int
) -> None:
    logarithm = EnvReward(lambda a, d: (a - d)[..., :1].log(), lambda a, d: (a == d).all(-1, keepdim=True))
    buffer = make(logarithm, n_steps=n_steps, gamma=0.9)
    with pytest.raises(ValueError, match="rewards of the reward function must be finite, got"):
        fill(buffer, make_batch([[3], [3]], terminated=True))
    assert make is sampling or nothing_is_written(buffer)


def raises_at(call: int) -> Callable[..., None]:
    calls: list[object] = []

    def fail(*own: object) -> None:
        calls.append(own)
        if len(calls) == call:
            raise RuntimeError("no more")

    return fail


@pytest.mark.parametrize("piece", [1, 2])  # the episodes are written in two
@pytest.mark.parametrize("what", ["on_write", "weights", "reward"])
@pytest.mark.parametrize("per", ["transition", "episode"])
def test_nothing_of_a_batch_is_written_if_something_raises(piece: int, what: str, per: str) -> None:
    fail = raises_at(piece)

    class Weights(GoalWeights):
        def update(self, goals: Tensor) -> None:
            fail()

    def reward(achieved: Tensor, desired: Tensor) -> tuple[Tensor, Tensor]:
        fail()
        return REWARD(achieved, desired)

    options = (
        {"on_write": fail} if what == "on_write" else {"weights": Weights()} if what == "weights" else {}
    )
    writer = HERWriter(reward if what == "reward" else REWARD, k=1, per=per, **options)  # type: ignore[arg-type]
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(16), writer=writer)
    with pytest.raises(RuntimeError, match="no more"):
        buffer.extend(make_batch([[5], [5]]))
    assert nothing_is_written(buffer)
    buffer.extend(make_batch([[2], [2]]))  # and it goes on
    assert writer.counts.real == 4


def test_what_on_write_has_counted_is_undone_if_a_later_piece_is_refused() -> None:
    norm = RunningNorm({"observation": 2})
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(16), writer=HERWriter(REWARD, k=1, on_write=norm.update)
    )
    batch = make_batch([[5], [5]])
    batch["observation"][1, 2] = math.nan  # of the second piece; no goal
    with pytest.raises(ValueError, match="'observation' must be finite to be counted"):
        buffer.extend(batch)
    assert norm.n.tolist() == [[0.0, 0.0]]
    assert nothing_is_written(buffer)


# What does not fit


@pytest.mark.parametrize("make", [writing, sampling])
@pytest.mark.parametrize(
    ("reward", "message"),
    [
        (lambda a, d: (a[:1, ..., :1], a[..., :1] == d[..., :1]), "one reward for each of"),
        (lambda a, d: (a[..., :1], a[:1, ..., :1] == d[:1, ..., :1]), "one bool for each of"),
        (lambda a, d: (a[..., :1], a[..., :1]), "one bool for each of .* got torch.float32"),
    ],
)
def test_reward_functions_must_give_one_reward_and_one_bool_for_each_pair(
    make: Callable[..., TensorDictReplayBuffer], reward: Any, message: str
) -> None:
    with pytest.raises(ValueError, match=f"the reward function must give {message}"):
        fill(make(reward), make_batch([[3], [3]]))


@pytest.mark.parametrize("make", [writing, sampling])
@pytest.mark.parametrize("shape", [(2, 3, 4, 4), (2, 3)])
def test_goals_must_be_vectors(make: Callable[..., TensorDictReplayBuffer], shape: tuple[int, ...]) -> None:
    batch = make_batch([[3], [3]])
    for key in GOALS:
        batch[key] = torch.zeros(shape)
    with pytest.raises(ValueError, match=r"goals must be vectors of one width, .*flatten images"):
        fill(make(), batch)
    batch["next", "achieved_goal"] = torch.zeros(2, 3, 5)
    with pytest.raises(ValueError, match="goals must be vectors of one width"):
        fill(make(), batch)


def test_without_virtual_goals_goals_may_be_images() -> None:
    batch = make_batch([[3]])
    for key in GOALS:
        batch[key] = torch.zeros(1, 3, 4, 4)
    buffer = writing(k=0)
    buffer.extend(batch)
    assert buffer[:]["desired_goal"].shape == (3, 4, 4)


def in_halves(batch: TensorDict) -> TensorDict:
    """The same; achieved goals lie between whole numbers, which desired ones are."""
    for key in GOALS[1::2]:
        batch[key] = batch[key].long()
    for key in GOALS[::2]:
        batch[key] = batch[key] + 0.4
    return batch


@pytest.mark.parametrize("make", [writing, sampling])
def test_desired_goals_of_whole_numbers_hold_no_fractions(
    make: Callable[..., TensorDictReplayBuffer],
) -> None:
    buffer = make()
    with pytest.raises(ValueError, match=r"desired_goal.* is of torch.int64, which cannot hold \d*.4"):
        fill(buffer, in_halves(make_batch([[3], [3]])))
    assert make is sampling or nothing_is_written(buffer)
    whole = in_halves(make_batch([[3], [3]]))
    for key in GOALS[::2]:
        whole[key] = whole[key].floor()
    assert fill(make(), whole)["desired_goal"].dtype == torch.int64


@pytest.mark.parametrize("make", [writing, sampling])
@pytest.mark.parametrize("n_steps", [1, 2])
def test_rewards_of_whole_numbers_hold_no_fractions(
    make: Callable[..., TensorDictReplayBuffer], n_steps: int
) -> None:
    batch = make_batch([[3], [3]])
    batch["next", "reward"] = batch["next", "reward"].long()
    half = EnvReward(
        lambda a, d: -0.5 * (a != d).any(-1, keepdim=True), lambda a, d: (a == d).all(-1, keepdim=True)
    )
    if make is writing and n_steps > 1:  # then sums are stored, which are no whole numbers
        assert fill(make(half, n_steps=2, gamma=0.5), batch)["next", "reward"].is_floating_point()
        return
    with pytest.raises(ValueError, match=r"'reward'\) is of torch.int64, which cannot hold -0.5"):
        fill(make(half, n_steps=n_steps, gamma=0.5), batch)


@pytest.mark.parametrize("make", [writing, sampling])
def test_fractions_that_were_wanted_do_not_become_whole_achieved_goals(
    make: Callable[..., TensorDictReplayBuffer],
) -> None:
    batch = make_batch([[3], [3]])
    for key in GOALS[::2]:
        batch[key] = batch[key].long()
    for key in GOALS[1::2]:
        batch[key] = batch[key] + 0.4
    with pytest.raises(ValueError, match=r"achieved_goal.* is of torch.int64, which cannot hold -6.5"):
        fill(make(goal_sources={"actual": 4}), batch)


def test_narrow_trajectory_ids_do_not_wrap_around() -> None:
    batch = make_batch([[2], [2]])
    batch["collector", "traj_ids"] = batch["collector", "traj_ids"].to(torch.int8)
    buffer = writing(per="episode", k=40)
    buffer.extend(batch.clone())
    with pytest.raises(ValueError, match=r"traj_ids'\) is of torch.int8, which cannot hold 162"):
        buffer.extend(batch)
    assert len(buffer[:]["collector", "traj_ids"].unique()) == 82  # of two episodes and 40 copies of each


@pytest.mark.parametrize("make", [writing, sampling])
@pytest.mark.parametrize("key", [*GOALS, *(("next", key) for key in ("reward", "truncated", "done"))])
def test_a_missing_entry_is_named(make: Callable[..., TensorDictReplayBuffer], key: NestedKey) -> None:
    with pytest.raises(KeyError, match=f"relabeling needs the entry {re.escape(repr(key))}, got "):
        fill(make(filter_achieved=True), make_batch([[3], [3]]).exclude(key))


@pytest.mark.parametrize("make", [writing, sampling])
def test_rows_of_several_stages_are_refused_where_one_reward_relabels_them(
    make: Callable[..., TensorDictReplayBuffer],
) -> None:
    batch = make_batch([[3], [3]]).set("stage", torch.zeros(2, 3, 1, dtype=torch.int64))
    with pytest.raises(ValueError, match=r"with a stage \('stage'\).* HERWriter\(stages=\[...\]\)"):
        fill(make(), batch)
    fill(make(stage_key="floor"), batch)
    writing(k=0).extend(batch)


@pytest.mark.parametrize("make", [writing, sampling])
def test_rewards_of_another_rule_are_named_once(make: Callable[..., TensorDictReplayBuffer]) -> None:
    buffer, batch = make(GoalReward(1e9)), make_batch([[4], [4]])
    with pytest.warns(UserWarning, match="gives 0 where the collected reward is -1, and other .* in 8 of 8"):
        fill(buffer, batch.clone())
    fill(buffer, batch)


# Lazy stacks


def names(environments: int, steps: int, begin: int) -> NonTensorStack:
    return NonTensorStack(
        *[
            NonTensorStack(*[NonTensorData(f"{env}:{begin + step}") for step in range(steps)])
            for env in range(environments)
        ]
    )


@pytest.mark.parametrize("kind", ["lazy", "strings"])
def test_open_episodes_of_lazy_stacks_and_strings_go_on(kind: str) -> None:
    batch = make_batch([[5], [3]], steps=5)
    assert batch.device is None
    first, second = batch[:, :3], batch[:, 3:]
    if kind == "lazy":
        first, second = (lazy_stack([part[env].clone() for env in range(2)]) for part in (first, second))
    else:
        first["name"], second["name"] = names(2, 3, 0), names(2, 2, 3)
    storage = LazyTensorStorage(100) if kind == "lazy" else LazyStackStorage(100)
    buffer = TensorDictReplayBuffer(storage=storage, writer=HERWriter(REWARD, k=1, strategy="final"))
    buffer.extend(first)
    assert buffer.writer.held_back == 3
    assert buffer.extend(second).tolist() == [[14, 15], [-1, -1]]
    if kind == "strings":
        assert [row["name"] for row in buffer[:]][-5:] == ["0:0", "0:1", "0:2", "0:3", "0:4"]
    else:
        assert buffer[:]["observation"][-5:, 0].tolist() == [0.0, 1.0, 2.0, 3.0, 4.0]


# Episodes of one step


@pytest.mark.parametrize("make", [writing, sampling])
def test_nothing_but_episodes_of_one_step_is_said_once(make: Callable[..., TensorDictReplayBuffer]) -> None:
    buffer, batch = make(), make_batch([[8]] * 3)
    batch["collector", "traj_ids"] = torch.arange(24).view(3, 8)
    batch["next", "done"] = torch.ones(3, 8, 1, dtype=torch.bool)
    with pytest.warns(UserWarning, match="all 24 episodes have one step: does time run along the last"):
        fill(buffer, batch.clone())
    fill(buffer, batch.clone())  # warnings are errors here
    fill(make(), batch[:1])  # eight may come by chance
    batch["next", "done"][0, 0] = False
    batch["collector", "traj_ids"][0, 1] = 0
    fill(make(), batch)  # one of them has two steps


# Windows


def test_windows_end_with_the_longest_episode() -> None:
    asked: list[int] = []

    def reward(achieved: Tensor, desired: Tensor) -> tuple[Tensor, Tensor]:
        asked.append(achieved[..., 0].numel())
        return REWARD(achieved, desired)

    long, short = (writing(reward, k=1, n_steps=n, gamma=0.5) for n in (10**9, 5))
    for buffer in (long, short):
        buffer.set_rng(torch.Generator().manual_seed(0))
        buffer.extend(make_batch([[5], [3]], steps=5))
    assert (long[:] == short[:]).all()
    assert max(asked) == 8 * 5  # rows of whole episodes, and the longest window
    unit = sampling(reward, n_steps=10**9, gamma=0.5)
    assert fill(unit, make_batch([[5], [5]]))["steps_to_next_obs"].max() <= 5
