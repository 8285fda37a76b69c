"""Normalization in a replay buffer and in a policy: after relabeling, and raw where rows are kept."""

from __future__ import annotations

import copy
from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.data.replay_buffers.samplers import SliceSampler
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_her import DecayingEpsilon, GoalReward, HERSampleUnit, HERWriter, make_actor
from torchrl_her.modules import (
    NormalizeBatch,
    NormalizedPolicy,
    RunningNorm,
    make_q_actor,
    make_stochastic_actor,
)
from torchrl_her.replay_buffers import PackedStorage, RunsPrioritizedSampler, rows_of_run
from torchrl_her_envs import make_env

from ..her_data import WANTED, make_batch

KEYS = ("observation", "desired_goal")


def make_norm(runs: int = 1) -> RunningNorm:
    return RunningNorm({"observation": 2, "desired_goal": 2}, runs=runs, clip=1e6)


def in_a_buffer(norm: RunningNorm, **options: object) -> TensorDictReplayBuffer:
    writer = HERWriter(GoalReward(0.5), on_write=norm.update, **options)  # type: ignore[arg-type]
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(1000), writer=writer, batch_size=400)
    buffer.append_transform(NormalizeBatch(norm))
    return buffer


# Learning


def test_statistics_are_those_of_all_that_is_stored() -> None:
    norm = make_norm()
    buffer = in_a_buffer(norm, k=4)
    buffer.extend(make_batch([[5, 3], [8]]))
    buffer.extend(make_batch([[4], [4]]))
    stored = buffer.storage[:]
    assert stored["virtual"].sum() > 0
    for key in KEYS:
        n, mean, var = norm.moments_of(key)
        assert n.tolist() == [len(stored)] * 2 == [5 * 24] * 2
        torch.testing.assert_close(mean, stored[key].double().mean(0))
        torch.testing.assert_close(var, stored[key].double().var(0, correction=0))


def test_virtual_goals_are_normalized_in_root_and_next_and_stored_as_they_are() -> None:
    norm = make_norm()
    buffer = in_a_buffer(norm, k=4)
    buffer.extend(make_batch([[4], [4]]))
    buffer.extend(make_batch([[5, 3], [8]]))
    stored, batch = buffer.storage[:], buffer.sample()
    assert stored["desired_goal"].min() == WANTED
    assert stored["desired_goal"].max() == 1008.0
    raw = stored[batch["index"]]
    mean, std = norm.moments_of("desired_goal").mean, norm.moments_of("desired_goal").var.sqrt()
    for key in ("desired_goal", ("next", "desired_goal")):
        expected = (raw[key][:, 0] - mean[0]) / std[0]
        torch.testing.assert_close(batch[key][:, 0], expected.float())
    assert torch.equal(batch["next", "achieved_goal"], raw["next", "achieved_goal"])
    assert torch.equal(batch["next", "reward"], raw["next", "reward"])


def test_a_sample_unit_s_goals_are_normalized_and_achieved_ones_counted_k_times() -> None:
    norm, hindsight = make_norm(), HERSampleUnit(GoalReward(0.5), k=4)
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(100),
        sample_unit=hindsight,
        collate_fn=hindsight.relabel,
        batch_size=200,
    )
    buffer.append_transform(NormalizeBatch(norm, counted_k=4))
    batch = make_batch([[3, 3]]).reshape(-1)
    buffer.extend(batch)
    wanted, achieved = batch["desired_goal"], batch["next", "achieved_goal"]
    goals = torch.cat([wanted, *[achieved] * 4]).double()
    n, mean, var = norm.moments_of("desired_goal")
    assert n.tolist() == [len(goals)] * 2
    torch.testing.assert_close(mean, goals.mean(0))
    torch.testing.assert_close(var, goals.var(0, correction=0))
    assert norm.moments_of("observation").n.tolist() == [6.0, 6.0]
    drawn = buffer.sample()
    assert drawn["virtual"].any()
    mean0, std0 = mean[0], var[0].sqrt()
    possible = (torch.cat((achieved, wanted))[:, 0] - mean0) / std0
    for key in ("desired_goal", ("next", "desired_goal")):
        gap = (drawn[key][:, :1] - possible.float()).abs().amin(1)
        assert gap.max() < 1e-5
    assert torch.equal(buffer.storage[:]["desired_goal"], wanted)


def test_a_transition_that_is_added_alone_is_counted() -> None:
    norm, row = make_norm(), make_batch([[3]]).reshape(-1)[0]
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(100))
    buffer.append_transform(NormalizeBatch(norm, counted_k=3))
    buffer.add(row)
    n, mean, _ = norm.moments_of("desired_goal")
    assert n.tolist() == [4.0] * 2  # its desired goal, and three times its achieved one
    torch.testing.assert_close(mean, ((row["desired_goal"] + 3 * row["next", "achieved_goal"]) / 4).double())


def test_each_run_of_a_buffer_has_its_own_statistics() -> None:
    runs, capacity = 2, 300
    generators = [torch.Generator().manual_seed(seed) for seed in range(runs)]
    norm = make_norm(runs)
    buffer = TensorDictReplayBuffer(
        storage=PackedStorage(runs * capacity),
        sampler=RunsPrioritizedSampler(capacity, alpha=0.6, beta=0.4, runs=runs, generators=generators),
        writer=HERWriter(GoalReward(0.5), k=2, runs=runs, generators=generators, on_write=norm.update),
        priority_key="td_error",
    )
    buffer.append_transform(NormalizeBatch(norm))
    buffer.extend(make_batch([[5, 3], [8], [6, 2], [4, 4]]))
    for run in range(runs):
        own = rows_of_run(buffer, run)
        assert norm.moments_of("observation", run).n.tolist() == [len(own)] * 2 == [48] * 2
        torch.testing.assert_close(
            norm.moments_of("desired_goal", run).mean, own["desired_goal"].double().mean(0)
        )
    drawn = buffer.sample(runs * 40)
    for run, block in enumerate(drawn.chunk(runs)):
        _, mean, var = norm.moments_of("observation", run)
        raw = block["observation"][:, 0] * var[0].sqrt() + mean[0]
        assert (raw.div(1000.0).floor() // 2 == run).all()  # of the run's own environments


@pytest.mark.parametrize("options", [{"n_steps": 3, "gamma": 0.9}, {"per": "episode"}, {"strategy": "final"}])
def test_other_ways_of_writing(options: dict[str, Any]) -> None:
    norm = make_norm()
    buffer = in_a_buffer(norm, k=2, **options)
    buffer.extend(make_batch([[5, 3], [8], [4, 4]]))
    stored = buffer.storage[:]
    for key in KEYS:
        torch.testing.assert_close(norm.moments_of(key).mean, stored[key].double().mean(0))
        for where in (key, ("next", key)):
            assert torch.equal(buffer[:][where], norm.normalize(key, stored[where]))


def test_sequences_are_normalized_too() -> None:
    norm, ids = make_norm(), ("collector", "traj_ids")
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(1000),
        writer=HERWriter(GoalReward(0.5), per="episode", k=2, on_write=norm.update),
        sampler=SliceSampler(slice_len=3, traj_key=ids, strict_length=False, pad_output=True),
        batch_size=30,
        prefetch=2,
    )
    buffer.append_transform(NormalizeBatch(norm))
    buffer.extend(make_batch([[6, 5], [11]]))
    drawn = buffer.sample()
    raw = buffer.storage[drawn["index"].flatten()]
    torch.testing.assert_close(drawn["desired_goal"], norm.normalize("desired_goal", raw["desired_goal"]))


def test_torchrl_saves_the_statistics_with_the_buffer() -> None:
    norm, other = make_norm(), make_norm()
    buffer, again = in_a_buffer(norm, k=1), in_a_buffer(other, k=1)
    buffer.extend(make_batch([[5, 3]]))
    again.load_state_dict(buffer.state_dict())
    assert torch.equal(other.moments_of("desired_goal").var, norm.moments_of("desired_goal").var)


def test_statistics_of_rows_that_could_not_be_stored_are_not_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    norm = make_norm()
    buffer = in_a_buffer(norm, k=1)
    buffer.extend(make_batch([[4]]))

    def full(*_: object) -> None:
        raise OSError("no space left")

    with monkeypatch.context() as patch:
        patch.setattr(buffer.storage, "set", full)
        with pytest.raises(OSError, match="no space left"):
            buffer.extend(make_batch([[5]]))
    assert norm.moments_of("observation").n.tolist() == [8.0, 8.0]
    buffer.extend(make_batch([[5]]))
    assert norm.moments_of("observation").n.tolist() == [18.0, 18.0]


@pytest.mark.parametrize("runs", [1, 2])
def test_achieved_goals_that_cannot_be_counted_are_named_before_anything_is(runs: int) -> None:
    norm = make_norm(runs)
    counting, batch = NormalizeBatch(norm, counted_k=4), make_batch([[3], [3]])
    key = ("next", "achieved_goal")
    with pytest.raises(KeyError, match=r"counted_k needs the entry \('next', 'achieved_goal'\), got \["):
        counting.inv(batch.exclude(key))
    broken = batch.clone()
    broken[key][-1, -1] = torch.inf
    with pytest.raises(ValueError, match=r"\('next', 'achieved_goal'\) must be finite to be counted"):
        counting.inv(broken)
    with pytest.raises(ValueError, match=r"'achieved_goal'\) must have a width of at most 2, got 3"):
        counting.inv(batch.clone().set(key, torch.ones(2, 3, 3)))
    assert norm.n.sum() == 0
    norm.frozen = True
    counting.inv(broken)  # nothing is counted


def test_what_a_batch_cannot_be_counted_by() -> None:
    for weight in (float("nan"), float("inf")):
        with pytest.raises(
            ValueError, match=rf"counted_k must be None or a finite number of at least 0, got {weight}"
        ):
            NormalizeBatch(make_norm(), counted_k=weight)
    with pytest.raises(ValueError, match=r"counted_k must be None or a finite number of at least 0, got -1"):
        NormalizeBatch(make_norm(), counted_k=-1)
    with pytest.raises(ValueError, match=r"counted_k needs 'desired_goal' to be normalized"):
        NormalizeBatch(RunningNorm({"observation": 2}), counted_k=4)


# Acting


def seen() -> TensorDict:
    return TensorDict({"observation": torch.randn(6, 2) + 3.0, "desired_goal": torch.randn(6, 2) * 9.0}, [6])


def counted_norm(runs: int = 1) -> RunningNorm:
    norm = make_norm(runs)
    norm.update(TensorDict({key: torch.randn(20, 2) * 5.0 + 2.0 for key in KEYS}, [20]))
    return norm


def make_actors() -> dict[str, TensorDictModule]:
    return {
        "deterministic": make_actor((2, 2), 3),
        "stochastic": make_stochastic_actor((2, 2), make_env("hand_v0").action_spec_unbatched),
        "discrete": make_q_actor((2, 2), 4)[0],
    }


@pytest.mark.parametrize("kind", ["deterministic", "stochastic", "discrete"])
def test_a_policy_sees_normalized_entries_and_leaves_raw_ones(kind: str) -> None:
    actor, norm, raw = make_actors()[kind], counted_norm(), seen()
    policy, before = NormalizedPolicy(actor, norm), raw.clone()
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        played, expected = policy(raw), actor(norm(before))
    assert played is raw
    assert all(torch.equal(played[key], before[key]) for key in KEYS)
    assert set(played.keys()) == set(expected.keys())
    for key in policy.out_keys:
        assert torch.equal(played[key], expected[key])


def test_stacked_runs_see_their_own_statistics() -> None:
    actor, norm, raw = make_actor((2, 2), 3, runs=2), counted_norm(2), seen()
    expected = actor(norm(raw))["action"]
    assert torch.equal(NormalizedPolicy(actor, norm)(raw.clone())["action"], expected)
    assert not torch.allclose(
        norm(raw)["observation"][:3], norm(torch.cat((raw[3:], raw[:3])))["observation"][3:]
    )


def test_collected_rows_are_raw_with_exploration_behind_the_policy() -> None:
    env = make_env("hand_v0", num_envs=4, seed=3)
    norm = RunningNorm({"observation": 9, "desired_goal": 2})
    norm.update(make_env("hand_v0", num_envs=50, seed=1).rollout(5))
    low = -torch.ones(3)
    policy = TensorDictSequential(
        NormalizedPolicy(make_actor((9, 2), 3), norm), DecayingEpsilon(low, -low, start=0.5)
    )
    collector = Collector(env, policy, frames_per_batch=40, auto_register_policy_transforms=False)
    batch = collector.next()
    assert batch["desired_goal"].abs().max() <= 1.0  # positions in the screen
    again = make_env("hand_v0", num_envs=4, seed=3).reset()
    assert torch.equal(batch["observation"][:, 0], again["observation"])
    assert torch.equal(batch["next", "observation"][:, 0], batch["observation"][:, 1])


def test_a_policy_s_state_holds_the_statistics() -> None:
    policy = NormalizedPolicy(make_actor((2, 2), 3), counted_norm())
    other = NormalizedPolicy(make_actor((2, 2), 3), make_norm())
    other.load_state_dict(policy.state_dict())
    raw = seen()
    assert torch.equal(policy(raw.clone())["action"], other(raw.clone())["action"])


def test_a_copied_policy_keeps_its_statistics() -> None:
    norm = counted_norm()
    policy = copy.deepcopy(NormalizedPolicy(make_actor((2, 2), 3), norm))
    raw = seen()
    before = policy(raw.clone())["action"]
    norm.update(TensorDict({key: torch.full((9, 2), 50.0) for key in KEYS}, [9]))
    assert torch.equal(policy(raw.clone())["action"], before)


def test_policies_that_cannot_be() -> None:
    actor = make_actor((2, 2), 3, in_keys=("position", "target"))
    with pytest.raises(ValueError, match=r"must read a normalized entry, .* got \['position', 'target'\]"):
        NormalizedPolicy(actor, make_norm())

    def same(observation: torch.Tensor) -> torch.Tensor:
        return observation

    writes = TensorDictModule(same, in_keys=["observation"], out_keys=["observation"])
    with pytest.raises(ValueError, match=r"must not write normalized entries, got \['observation'\]"):
        NormalizedPolicy(writes, make_norm())


def test_a_policy_may_read_some_of_what_is_normalized() -> None:
    def double(observation: torch.Tensor) -> torch.Tensor:
        return 2.0 * observation

    norm = counted_norm()
    policy = NormalizedPolicy(TensorDictModule(double, in_keys=["observation"], out_keys=["action"]), norm)
    raw: TensorDictBase = seen().exclude("desired_goal")
    assert torch.equal(policy(raw)["action"], 2.0 * norm.normalize("observation", raw["observation"]))


def test_an_entry_that_a_policy_misses_is_named() -> None:
    policy = NormalizedPolicy(make_actor((2, 2), 3), counted_norm())
    with pytest.raises(
        KeyError, match=r"normalization needs the entry 'desired_goal', got \['observation'\]"
    ):
        policy(seen().exclude("desired_goal"))


def test_a_policy_may_see_whole_numbers() -> None:
    actor, norm = make_actor((2, 2), 3), counted_norm()
    raw = seen().set("observation", torch.arange(12).view(6, 2))
    policy = NormalizedPolicy(actor, norm)
    expected = policy(raw.clone().set("observation", raw["observation"].float()))["action"]
    assert torch.equal(policy(raw)["action"], expected)
