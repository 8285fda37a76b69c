"""What each stage sees and is rewarded for, run by run; TorchRL's list of tests for transforms."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, replace
from functools import partial
from typing import Any

import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictSequential
from torch import Tensor, nn
from torchrl.collectors import Collector
from torchrl.data import Binary, Composite, LazyTensorStorage, TensorDictReplayBuffer, Unbounded
from torchrl.envs import (
    Compose,
    EnvBase,
    EnvCreator,
    ParallelEnv,
    SerialEnv,
    StepCounter,
    Transform,
    TransformedEnv,
)
from torchrl.envs.utils import check_env_specs

from torchrl_her import (
    Curriculum,
    CurriculumProgress,
    CurriculumStage,
    EnvKeys,
    GoalReward,
    HERWriter,
    StateToObs,
    ZeroPad,
    make_actor,
)
from torchrl_her_envs import make_env

from ...forks import server


class TinyEnv(EnvBase):
    """Worlds of four numbers [a, b, c, d]; an action is added to a.

    World n starts at 1000 n + (10, 20, 30, 40). Its own goal is a near d: it terminates there, but
    goes on when stepped further. Its own reward is always 7.
    """

    def __init__(
        self, batch: tuple[int, ...] = (), *, group: str | None = None, horizon: int = 50, width: int = 4
    ) -> None:
        super().__init__(batch_size=batch)
        self.group, self.horizon = group, horizon
        worlds = torch.arange(float(torch.Size(batch).numel())).view(*batch, 1)
        self.start = 1000 * worlds + 10.0 * torch.arange(1, width + 1)
        one, flag = partial(Unbounded, shape=(*batch, 1)), partial(Binary, n=1, shape=(*batch, 1))
        self.observation_spec = self._spec(state=Unbounded(shape=(*batch, width)))
        self.action_spec = self._spec(action=one())
        self.reward_spec = self._spec(reward=one())
        self.done_spec = self._spec(
            **{key: flag(dtype=torch.bool) for key in ("done", "terminated", "truncated")}
        )

    def _spec(self, **entries: Any) -> Composite:
        inner = Composite(entries, shape=self.batch_size)
        return inner if self.group is None else Composite({self.group: inner}, shape=self.batch_size)

    def _pack(self, **entries: Tensor) -> TensorDict:
        inner = TensorDict(entries, self.batch_size)
        return inner if self.group is None else TensorDict({self.group: inner}, self.batch_size)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get(self.reset_keys[0], None)
        if mask is None:
            mask = torch.ones(*self.batch_size, 1, dtype=torch.bool)
            self.state, self.count = self.start.clone(), torch.zeros_like(mask, dtype=torch.int64)
        self.state = torch.where(mask, self.start, self.state)
        self.count = torch.where(mask, 0, self.count)
        off = torch.zeros_like(mask)
        return self._pack(state=self.state.clone(), done=off, terminated=off.clone(), truncated=off.clone())

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = (tensordict if self.group is None else tensordict[self.group])["action"]
        self.state = torch.cat((self.state[..., :1] + action, self.state[..., 1:]), -1)
        self.count = self.count + 1
        terminated = (self.state[..., :1] - self.state[..., -1:]).abs() < 0.5
        truncated = self.count >= self.horizon
        return self._pack(
            state=self.state.clone(),
            reward=torch.full_like(action, 7.0),
            terminated=terminated,
            truncated=truncated,
            done=terminated | truncated,
        )

    def _set_seed(self, seed: int | None) -> None:
        pass


def make_three(threshold: float = 0.5) -> Curriculum:
    """a goes to b, then b to c, then c to d."""
    return Curriculum(
        [
            CurriculumStage(
                name=f"stage {i}",
                observation=range(i + 1),
                achieved_goal=[i],
                desired_goal=[i + 1],
                threshold=threshold * 10**i,
            )
            for i in range(3)
        ],
        4,
    )


def make_hand() -> Curriculum:
    reach = CurriculumStage(
        name="reach", observation=range(5), achieved_goal=[0, 1], desired_goal=[5, 6], threshold=0.06
    )
    throw = CurriculumStage(
        name="throw", observation=range(9), achieved_goal=[5, 6], desired_goal=[9, 10], threshold=0.1
    )
    return Curriculum([reach, throw], 11)


def at(curriculum: Curriculum, *stages: int) -> CurriculumProgress:
    """Progress of as many runs as stages are given."""
    progress = CurriculumProgress(curriculum, runs=len(stages))
    for run, stage in enumerate(stages):
        progress.set_stage(run, stage)
    return progress


def both(progress: CurriculumProgress) -> Compose:
    return Compose(StateToObs(progress.curriculum, progress), ZeroPad(progress.curriculum, progress))


def wrap(env: EnvBase, *stages: int, threshold: float = 0.5) -> TransformedEnv:
    return TransformedEnv(env, both(at(make_three(threshold), *stages)))


def act(env: EnvBase, actions: list[float]) -> TensorDictBase:
    """What a step gives after a reset."""
    tensordict = env.reset()
    tensordict["action"] = torch.tensor(actions).view(*env.batch_size, 1)
    return env.step(tensordict)["next"]


# What is seen


def test_each_run_sees_its_own_stage() -> None:
    seen = wrap(TinyEnv((6,)), 1, 0, 2).reset()
    assert seen["observation"].tolist() == [
        [10, 20, 0],
        [1010, 1020, 0],
        [2010, 0, 0],
        [3010, 0, 0],
        [4010, 4020, 4030],
        [5010, 5020, 5030],
    ]
    assert seen["achieved_goal"].flatten().tolist() == [20, 1020, 2010, 3010, 4030, 5030]
    assert seen["desired_goal"].flatten().tolist() == [30, 1030, 2020, 3020, 4040, 5040]
    assert seen["input"].tolist() == [
        [10, 20, 30, 0],
        [1010, 1020, 1030, 0],
        [2010, 2020, 0, 0],
        [3010, 3020, 0, 0],
        [4010, 4020, 4030, 4040],
        [5010, 5020, 5030, 5040],
    ]
    assert seen["state"][0].tolist() == [10, 20, 30, 40]  # stays


def test_indices_need_not_be_in_order() -> None:
    stage = CurriculumStage(
        name="odd", observation=[3, 0], achieved_goal=[0, 3], desired_goal=[2, 1], threshold=1.0
    )
    seen = TransformedEnv(TinyEnv(), both(at(Curriculum([stage], 4), 0))).reset()
    assert seen["observation"].tolist() == [40, 10]
    assert seen["achieved_goal"].tolist() == [10, 40]
    assert seen["input"].tolist() == [40, 10, 30, 20]


@pytest.mark.parametrize("device", [None, "cpu"])
@pytest.mark.parametrize("changed", [(1, 1), (0, 2)])
def test_a_change_in_mid_episode_leaves_no_row_of_two_stages(
    changed: tuple[int, int], device: str | None
) -> None:
    env = wrap(TinyEnv((4,)), 0, 0, threshold=0.05)
    progress = env.transform[0].progress
    collector = Collector(
        env,
        lambda td: td.set("action", torch.ones(4, 1)),
        frames_per_batch=12,
        total_frames=-1,
        device=device,
        trust_policy=True,
        auto_register_policy_transforms=False,
    )
    before = collector.next().clone()
    assert not before["next", "done"].any()
    kept = collector.next()
    copy = kept.clone()
    for run, stage in enumerate(changed):
        progress.set_stage(run, stage)
    after = collector.next().clone()
    collector.shutdown()
    assert (kept == copy).all()  # what was collected earlier stays as it is
    expected = after.clone()
    for part in (expected, expected["next"]):
        shown = both(progress)
        shown[0]._call(part)
        shown[1]._call(part)
    for key in ("observation", "achieved_goal", "desired_goal", "input"):
        for name in (key, ("next", key)):
            assert torch.equal(after[name], expected[name]), name
    cut = torch.tensor(changed).repeat_interleave(2) > 0  # stages that changed
    for flag in ("truncated", "done"):
        assert after["next", flag][:, 0, 0].tolist() == cut.tolist()
        assert not after["next", flag][:, 1:].any()
    counts = after["state"][:, 0, 0] - env.base_env.start[:, 0]
    assert counts.tolist() == [6.0] * 4  # steps before
    fresh = after["state"][:, 1, 0] == env.base_env.start[:, 0]
    assert fresh.tolist() == cut.tolist()


def test_environments_that_were_reset_after_a_change_are_not_cut() -> None:
    env = wrap(TinyEnv((4,)), 0, 0, threshold=0.05)
    seen = env.reset()
    env.transform[0].progress.set_stage(1, 2)
    half = torch.tensor([[False], [False], [True], [False]])
    seen = env.reset(seen.set("_reset", half))
    assert seen["observation"][:, 1].tolist() == [0, 0, 2020, 0]
    seen["action"] = torch.ones(4, 1)
    after = env.step(seen)
    assert after["observation"][:, 1].tolist() == [0, 0, 2020, 3020]
    assert after["next", "truncated"].flatten().tolist() == [False, False, False, True]
    env.transform[0].progress.set_stage(0, 1)
    seen = env.reset()
    seen["action"] = torch.ones(4, 1)
    assert not env.step(seen)["next", "done"].any()


# Reward and ends


def test_stages_below_have_the_rewards_that_they_are_given() -> None:
    stages = [replace(stage, rewards=(-4.0, -1.5)) for stage in make_three().stages]
    progress = at(Curriculum(stages, 4), 0, 2)
    env = TransformedEnv(TinyEnv((4,)), StateToObs(progress.curriculum, progress))
    assert act(env, [10.0, 0.0, 30.0, 0.0])["reward"].flatten().tolist() == [-1.5, -4.0, 7.0, 7.0]


def test_a_stage_whose_goal_must_be_held_goes_on_there() -> None:
    stages = [replace(stage, terminates=False) for stage in make_three().stages]
    progress = at(Curriculum(stages, 4), 0)
    env = TransformedEnv(TinyEnv((2,)), StateToObs(progress.curriculum, progress))
    after = act(env, [10.0, 0.0])
    assert after["reward"].flatten().tolist() == [0.0, -1.0]
    assert not after["done"].any()


def test_an_end_by_the_environments_own_goal_is_none() -> None:
    assert act(TinyEnv((2,)), [30.0, 0.0])["done"].flatten().tolist() == [True, False]
    env = wrap(TinyEnv((2,)), 0)
    tensordict = env.reset()
    tensordict["action"] = torch.tensor([[30.0], [0.0]])  # to d
    after = env.step(tensordict)["next"]
    assert not after["done"].any()
    assert not after["terminated"].any()
    assert after["reward"].flatten().tolist() == [-1.0, -1.0]
    assert env.rollout(10, lambda td: td.set("action", torch.full((2, 1), 30.0))).shape == (2, 10)


def test_the_time_limit_is_kept() -> None:
    env = wrap(TinyEnv((2,), horizon=1), 0)
    after = act(env, [30.0, 10.0])  # the first achieves the environment's goal, the second the stage's
    assert after["truncated"].flatten().tolist() == [True, True]
    assert after["terminated"].flatten().tolist() == [False, True]
    assert after["done"].flatten().tolist() == [True, True]


def test_no_time_limit_below() -> None:
    progress = at(make_three(), 0)
    transform = StateToObs(progress.curriculum, progress, keys=EnvKeys(truncated=None))
    env = TransformedEnv(TinyEnv((2,), horizon=1), transform)
    assert act(env, [10.0, 0.0])["done"].flatten().tolist() == [True, False]


def test_a_step_counter_behind_ends_episodes() -> None:
    env = wrap(TinyEnv((2,)), 0).append_transform(StepCounter(3))
    check_env_specs(env)
    rollout = env.rollout(10, lambda td: td.set("action", torch.zeros(2, 1)))
    assert rollout["next", "truncated"].squeeze(-1).tolist() == [[False, False, True]] * 2
    assert not rollout["next", "terminated"].any()


@settings(max_examples=100, deadline=None)
@given(
    st.lists(st.floats(-2.0, 2.0, width=32), min_size=6, max_size=6),
    st.floats(0.01, 2.0),
    st.tuples(*[st.integers(0, 1)] * 3),
)
@example([0.7] * 6, 0.7, (0, 1, 0))
def test_rewards_agree_with_goal_reward_to_the_last_bit(
    offsets: list[float], threshold: float, stages: tuple[int, int, int]
) -> None:
    env = TinyEnv((6,))
    env.start = torch.zeros(6, 4)
    env.start[:, 2] = 0.1
    transformed = wrap(env, *stages, threshold=threshold)
    after = act(transformed, offsets)
    for row in range(6):
        reward, terminated = GoalReward(threshold * 10 ** stages[row // 2])(
            after["achieved_goal"][row], after["desired_goal"][row]
        )
        assert torch.equal(after["reward"][row], reward)
        assert torch.equal(after["terminated"][row], terminated)


def test_a_task_that_goes_on_at_its_goal_does_so_in_the_last_stage() -> None:
    """What a step gives is what it would give without the curriculum, also where the goal is near."""
    base, env = TinyEnv((3,)), wrap(TinyEnv((3,)), 2, threshold=100.0)
    for actions in ([0.0, 30.0, 31.0], [30.0, 0.0, -1.0]):
        assert (
            act(env, actions).select("reward", "terminated", "truncated", "done")
            == act(base, actions).select("reward", "terminated", "truncated", "done")
        ).all()


def test_the_last_stage_is_the_environment_itself() -> None:
    base, env = (make_env("hand_v2", num_envs=64, seed=3) for _ in range(2))
    transformed = TransformedEnv(env, StateToObs(make := make_hand(), at(make, 1, 1)))
    torch.manual_seed(0)
    expected = base.rollout(60, break_when_any_done=False)
    torch.manual_seed(0)
    batch = transformed.rollout(60, break_when_any_done=False)
    assert (batch == expected).all()
    assert expected["next", "truncated"].any()


# TorchRL's list of tests for transforms


@pytest.mark.parametrize(
    ("batch", "stages"), [((), (1,)), ((2, 3), (1,)), ((4,), (0, 0)), ((4,), (0, 1)), ((4,), (1, 1))]
)
def test_specs(batch: tuple[int, ...], stages: tuple[int, ...]) -> None:
    env = wrap(TinyEnv(batch), *stages)
    check_env_specs(env)
    assert env.observation_spec["observation"].shape == (*batch, 3)
    assert env.observation_spec["input"].shape == (*batch, 4)
    assert env.full_reward_spec["reward"].shape == (*batch, 1)


def test_float64_stays() -> None:
    env = TransformedEnv(make_env("hand_v1", num_envs=4, dtype=torch.float64), both(at(make_hand(), 0, 1)))
    check_env_specs(env)
    after = env.rand_step(env.reset())["next"]
    assert {after[key].dtype for key in ("observation", "input", "reward")} == {torch.float64}


def test_inside_of_a_serial_env() -> None:
    progress = at(make_three(), 1)
    env = SerialEnv(2, lambda: TransformedEnv(TinyEnv((2,)), both(progress)))
    check_env_specs(env)
    progress.set_stage(0, 2)  # one process: its environments follow
    assert env.reset()["observation"][1].tolist() == [[10, 20, 30], [1010, 1020, 1030]]


def test_around_a_serial_env() -> None:
    env = wrap(SerialEnv(2, partial(TinyEnv, (2,))), 0, 2)
    check_env_specs(env)
    seen = env.reset()
    assert seen["observation"][0].tolist() == [[10, 0, 0], [1010, 0, 0]]
    assert seen["observation"][1].tolist() == [[10, 20, 30], [1010, 1020, 1030]]


@pytest.fixture(scope="module")
def parallel_env() -> Iterator[ParallelEnv]:
    """Two workers, each with transforms inside in the first stage."""
    server()  # so that they need not import torch
    make = partial(make_env, "hand_v1", num_envs=2)
    env = ParallelEnv(
        2, EnvCreator(lambda: TransformedEnv(make(), both(at(make_hand(), 0)))), mp_start_method="forkserver"
    )
    yield env
    env.close()


@pytest.mark.long
@pytest.mark.parametrize("inside", [True, False])
def test_in_and_around_a_parallel_env(inside: bool, parallel_env: ParallelEnv) -> None:
    # Transforms around it write again all that those inside wrote.
    env = parallel_env if inside else TransformedEnv(parallel_env, both(at(make_hand(), 0, 1)))
    check_env_specs(env)
    seen = env.rand_step(env.reset())["next"]
    assert (seen["input"][0, :, 7:] == 0).all()
    assert (seen["input"][1, :, 7:] == 0).all().item() is inside


def test_partial_resets_leave_other_worlds_as_they_are() -> None:
    env = wrap(TinyEnv((4,)), 0, 2)
    after = act(env, [1.0, 2.0, 3.0, 4.0])
    mask = torch.tensor([False, True, True, False]).unsqueeze(-1)
    reset = env.reset(after.clone().set("_reset", mask))
    assert reset["observation"][:, 0].tolist() == [11, 1010, 2010, 3014]
    assert reset["input"][3].tolist() == [3014, 3020, 3030, 3040]


def test_with_tensors_in_place_of_a_tensordict() -> None:
    progress = at(make_three(), 0)
    pad = ZeroPad(progress.curriculum, progress)
    padded = pad(observation=torch.tensor([1.0, 2.0, 3.0]), desired_goal=torch.tensor([9.0]))
    assert padded.tolist() == [1, 9, 0, 0]


@pytest.mark.parametrize("composed", [False, True])
def test_state_to_obs_is_for_environments(composed: bool) -> None:
    """Also the "replay buffer" and "model" entries of the list."""
    progress = at(make_three(), 0)
    transform: Transform = StateToObs(progress.curriculum, progress)
    transform = Compose(transform) if composed else transform
    rows = TensorDict({"state": torch.zeros(5, 4)}, [5])
    with pytest.raises(RuntimeError, match="StateToObs is for environments: in a replay buffer"):
        transform(rows)
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(5), batch_size=2, transform=transform)
    buffer.extend(rows)
    with pytest.raises(RuntimeError, match="StateToObs is for environments"):
        buffer.sample()


def make_rows(n: int, shape: tuple[int, ...] | None = None) -> TensorDict:
    """Row i has the observation 10 i + (1, 2, 3) and the goal 100 + i."""
    i = torch.arange(float(n)).unsqueeze(-1)
    rows = TensorDict({"observation": 10 * i + torch.arange(1.0, 4.0), "desired_goal": 100 + i}, [n])
    return rows if shape is None else rows.reshape(shape)


def test_in_a_replay_buffer() -> None:
    progress = at(make_three(), 0, 1)
    pad = ZeroPad(progress.curriculum, progress, run=1)
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(20), batch_size=8)
    buffer.append_transform(pad)
    rows = make_rows(20)
    buffer.extend(rows.set("next", make_rows(20) + 1000))
    assert "input" not in buffer.storage[:].keys(True)
    sample = buffer.sample()
    for part in (sample, sample["next"]):
        assert torch.equal(part["input"][:, :2], part["observation"][:, :2])
        assert torch.equal(part["input"][:, 2:3], part["desired_goal"])
        assert (part["input"][:, 3] == 0).all()
    progress.set_stage(1, 2)
    sample = buffer.sample()
    assert torch.equal(sample["input"], torch.cat((sample["observation"], sample["desired_goal"]), -1))
    progress.set_stage(0, 2)  # another run's
    progress.set_stage(1, 0)
    assert (buffer.sample()["input"][:, 2:] == 0).all()


@pytest.mark.parametrize("shape", [(), (6,), (3, 2), (1, 3, 2)])
def test_rows_of_one_run_may_have_any_shape(shape: tuple[int, ...]) -> None:
    progress = at(make_three(), 2, 0)
    n = torch.Size(shape).numel()
    flat = ZeroPad(progress.curriculum, progress, run=1)(make_rows(n))
    shaped = ZeroPad(progress.curriculum, progress, run=1)(make_rows(n, shape))
    assert torch.equal(shaped["input"], flat["input"].view(*shape, 4))
    assert flat["input"][0].tolist() == [1, 100, 0, 0]


@pytest.mark.parametrize("stages", [(0, 0), (0, 2)])
def test_no_rows(stages: tuple[int, int]) -> None:
    progress = at(make_three(), *stages)
    assert ZeroPad(progress.curriculum, progress)(make_rows(0))["input"].shape == (0, 4)


@settings(max_examples=50, deadline=None)
@given(st.lists(st.integers(0, 2), min_size=1, max_size=4), st.integers(1, 4), st.integers(1, 3))
def test_inputs_by_the_book(stages: list[int], worlds: int, steps: int) -> None:
    progress = at(make_three(), *stages)
    shape = (len(stages) * worlds, steps)
    rows = make_rows(shape[0] * steps, shape)
    out = ZeroPad(progress.curriculum, progress)(rows)["input"]
    for i in range(shape[0]):
        for t in range(steps):
            n = stages[i // worlds] + 1
            expected = [*rows["observation"][i, t, :n].tolist(), *rows["desired_goal"][i, t].tolist()]
            assert out[i, t].tolist() == expected + [0.0] * (3 - n)


def test_in_a_model() -> None:
    progress = at(make_three(), 0)
    pad = ZeroPad(progress.curriculum, progress)
    actor = make_actor([4], 1, in_keys=["input"])
    for model in (nn.Sequential(pad, actor), TensorDictSequential(pad, actor)):
        assert model(make_rows(5))["action"].shape == (5, 1)


def test_clones_follow_the_same_progress() -> None:
    progress = at(make_three(), 0)
    clones = [transform.clone() for transform in both(progress)]
    progress.set_stage(0, 1)
    assert TransformedEnv(TinyEnv(), Compose(*clones)).reset()["input"].tolist() == [10, 20, 30, 0]


def test_nested_keys() -> None:
    progress = at(make_three(), 0, 2)
    keys = EnvKeys(**{field.name: ("agent", field.name) for field in fields(EnvKeys)})
    env = TransformedEnv(
        TinyEnv((2,), group="agent"),
        Compose(
            StateToObs(progress.curriculum, progress, state_key=("agent", "state"), keys=keys),
            ZeroPad(progress.curriculum, progress, keys=keys, input_key=("net", "input")),
        ),
    )
    check_env_specs(env)
    tensordict = env.reset()
    tensordict["agent", "action"] = torch.tensor([[10.0], [30.0]])
    after = env.step(tensordict)["next"]
    assert after["net", "input"].tolist() == [[20, 20, 0, 0], [1040, 1020, 1030, 1040]]
    assert after["agent", "terminated"].flatten().tolist() == [True, True]  # 10 < 50
    assert after["agent", "reward"].flatten().tolist() == [0.0, 7.0]  # the second one's is the environment's
    assert "observation" not in after.keys()


# What does not fit is said


def test_batches_that_are_no_blocks_are_refused() -> None:
    # Also while all runs are in one stage: it must not come out at the first change
    for batch in ((), (3,), (3, 2)):
        with pytest.raises(ValueError, match=r"must be 2 equal blocks, one for each run, got a batch of \["):
            wrap(TinyEnv(batch), 0, 0).reset()
        with pytest.raises(ValueError, match=r"must be 2 equal blocks"):
            _ = wrap(TinyEnv(batch), 0, 0).observation_spec
    progress = at(make_three(), 0, 1)
    with pytest.raises(ValueError, match=r"2 equal blocks, one for each run, got a batch of \[3\]"):
        ZeroPad(progress.curriculum, progress)(make_rows(3))


def test_a_state_of_another_width_is_refused() -> None:
    with pytest.raises(ValueError, match=r"the curriculum needs 'state' of width 4, got 5"):
        wrap(TinyEnv(width=5), 0).reset()
    with pytest.raises(ValueError, match=r"needs 'state' of width 4, got 5"):
        _ = wrap(TinyEnv(width=5), 0).observation_spec


def test_missing_entries_are_named() -> None:
    progress = at(make_three(), 0)
    for options, message in (
        ({"state_key": "words"}, "StateToObs needs the (entry|observation) 'words'"),
        ({"keys": EnvKeys(truncated="cut")}, "StateToObs needs the flag 'cut' of the environment"),
    ):
        with pytest.raises(KeyError, match=message):
            check_env_specs(TransformedEnv(TinyEnv(), StateToObs(progress.curriculum, progress, **options)))
    pad = ZeroPad(progress.curriculum, progress)
    with pytest.raises(KeyError, match="ZeroPad needs the entry 'desired_goal'"):
        pad(make_rows(3).exclude("desired_goal"))
    with pytest.raises(KeyError, match="ZeroPad needs the observation 'observation'"):
        _ = TransformedEnv(TinyEnv(), pad).observation_spec
    with pytest.raises(ValueError, match="needs 'observation' of width 3, got 4"):
        pad(make_rows(2).set("observation", torch.zeros(2, 4)))
    with pytest.raises(ValueError, match="needs 'desired_goal' of width 1, got 2"):
        pad(make_rows(2).set("desired_goal", torch.zeros(2, 2)))


def test_parts_that_do_not_belong_together_are_refused() -> None:
    progress = at(make_three(), 0, 0)
    for transform in (StateToObs, ZeroPad):
        with pytest.raises(ValueError, match="progress must have the same curriculum object"):
            transform(make_three(), progress)
    for run in (-1, 2):
        with pytest.raises(ValueError, match=rf"run must be None or in \[0, 1\], got {run}"):
            ZeroPad(progress.curriculum, progress, run=run)


# Downstream: hindsight in a stage


def test_an_input_that_was_stored_is_replaced() -> None:
    progress = at(make_hand(), 0)
    env = TransformedEnv(make_env("hand_v1", num_envs=4, seed=0), both(progress))
    reach = TensorDictReplayBuffer(
        storage=LazyTensorStorage(5000), writer=HERWriter(GoalReward(0.06), k=4), batch_size=256
    )
    reach.extend(env.rollout(60, break_when_any_done=False))
    virtual = reach[:]["virtual"].squeeze(-1)
    stale = (reach[:]["input"][:, 5:7] != reach[:]["desired_goal"]).any(-1)
    assert stale[virtual].any()  # the trap: it was computed before the relabeling
    assert not stale[~virtual].any()
    reach.append_transform(ZeroPad(progress.curriculum, progress, run=0))
    sample = reach.sample()
    assert torch.equal(sample["input"][:, 5:7], sample["desired_goal"])
    assert torch.equal(sample["next", "input"][:, 5:7], sample["next", "desired_goal"])


# Environments that cannot go on after an end of their own


@pytest.mark.parametrize(
    ("threshold", "terminated", "truncated"),
    [(0.5, [False, False], [True, False]), (21.0, [True, True], [False, False])],  # 40 is 20 away from 20
    ids=["cut off", "the stage's goal achieved as well"],
)
def test_an_end_of_the_environment_ends_the_stage_s_episode(
    threshold: float, terminated: list[bool], truncated: list[bool]
) -> None:
    """World 0 moves from 10 to 40, its own goal; the stage's goal is 20."""
    progress = at(make_three(threshold), 0)
    transform = StateToObs(progress.curriculum, progress, continues_after_termination=False)
    after = act(TransformedEnv(TinyEnv((2,)), transform), [30.0, 0.0])
    assert after["terminated"].flatten().tolist() == terminated
    assert after["truncated"].flatten().tolist() == truncated
    assert after["done"].flatten().tolist() == [True, threshold > 20]
    assert after["reward"].flatten().tolist() == [float(own) - 1.0 for own in terminated]


def test_an_end_needs_a_flag_to_be_noted_in() -> None:
    progress = at(make_three(), 0)
    with pytest.raises(ValueError, match="continues_after_termination=False needs a key for truncated"):
        StateToObs(
            progress.curriculum, progress, continues_after_termination=False, keys=EnvKeys(truncated=None)
        )
