"""Behavior goals: which episodes ask for which goal, and what that does to their rewards and ends."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import EnvBase, SerialEnv, TransformedEnv
from torchrl.envs.utils import check_env_specs

from torchrl_her import EnvKeys, GoalReward, GoalWeights, HERSampleUnit, HERWriter
from torchrl_her.behavior import (
    BehaviorGoals,
    DiscoverScore,
    GoalCandidates,
    GoalFactor,
    GoalProposal,
    ValueCutoff,
)
from torchrl_her.goals import RareGoals, RewardFunction
from torchrl_her.trainers import collector_state_dict, load_collector_state_dict

from .line import WANTED, Line, walk

REWARD = GoalReward(0.5)


class Told(GoalWeights):
    """Prefers one goal, and remembers what it was told of."""

    def __init__(self, best: float) -> None:
        self.best, self.goals = best, []

    def __call__(self, goals: Tensor) -> Tensor:
        return (goals[..., 0] == self.best).float()

    def update(self, goals: Tensor) -> None:
        self.goals += goals.flatten().tolist()


class Farther(GoalFactor):
    """Prefers goals that were achieved farther from where the episode begins."""

    def __init__(self) -> None:
        self.ends: list[tuple[list[int], list[int]]] = []

    def __call__(self, candidates: GoalCandidates) -> Tensor:
        return (candidates.reached - candidates.start.unsqueeze(1)).squeeze(
            -1
        )  # observations are ten times goals

    def record(self, ended: Tensor, achieved: Tensor) -> None:
        self.ends.append((ended.tolist(), achieved.tolist()))


def made(base: int | EnvBase = 2, *, runs: int = 1, reward: RewardFunction = REWARD, **options: object):
    """An environment, by default a line of so many, with behavior goals; and these."""
    generators = [torch.Generator().manual_seed(seed) for seed in range(runs)]
    chooses = ("weights", "update_on", "factors", "greedy", "candidates")
    proposal = GoalProposal(**{name: options.pop(name) for name in chooses if name in options})  # type: ignore[arg-type]
    options = {"real_share": 0.0, "memory": 100, "proposal": proposal} | options
    behavior = BehaviorGoals(reward, runs=runs, generators=generators, **options)  # type: ignore[arg-type]
    return TransformedEnv(Line(base) if isinstance(base, int) else base, behavior), behavior


def played(env: TransformedEnv, steps: int = 5) -> TensorDictBase:
    return env.rollout(steps, walk, break_when_any_done=False)


def moved(env: TransformedEnv, steps: int, *, by: float) -> TensorDictBase:
    """Steps after a reset and a move of all environments."""
    first = env.reset()
    env.base_env.place += by
    return env.rollout(steps, walk, break_when_any_done=False, auto_reset=False, tensordict=first)


def wanted(rows: TensorDictBase) -> list[list[float]]:
    return rows["next", "desired_goal"].squeeze(-1).tolist()


def test_first_episodes_ask_for_the_tasks_goals() -> None:
    env, _ = made()
    rows = played(env)
    assert wanted(rows) == [[WANTED] * 5] * 2
    assert not rows["proposed"].any()


def test_later_ones_ask_for_what_was_achieved() -> None:
    env, _ = made(weights=Told(3.0))
    played(env)
    rows = played(env)
    assert rows["desired_goal"][:, 0].tolist() == [[3.0], [3.0]]
    # At 3 it is achieved: the episode ends there, and the next one asks for 3 again.
    first = rows[0]
    assert first["next", "achieved_goal"].flatten().tolist() == [1.0, 2.0, 3.0, 1.0, 2.0]
    assert first["next", "reward"].flatten().tolist() == [-1.0, -1.0, 0.0, -1.0, -1.0]
    assert first["next", "terminated"].flatten().tolist() == [False, False, True, False, False]
    assert torch.equal(first["next", "done"], first["next", "terminated"])
    assert first["next", "desired_goal"].flatten().tolist() == [3.0] * 5
    assert first["next", "real_desired_goal"].flatten().tolist() == [WANTED] * 5
    assert rows["proposed"].all()
    assert rows["next", "proposed"].all()


def test_a_goal_stays_while_others_begin_anew() -> None:
    class Cycle(GoalWeights):
        """First 2, then 4."""

        count = 0

        def __call__(self, goals: Tensor) -> Tensor:
            self.count += 1
            return (goals[..., 0] == (4.0 if self.count > 1 else 2.0)).float()

    env, _ = made(2, weights=[Cycle(), Cycle()], runs=2)
    played(env)
    first = env.reset()
    env.base_env.place[1] = -10.0  # far back, so that only the first environment achieves its goal
    rows = env.rollout(5, walk, break_when_any_done=False, auto_reset=False, tensordict=first)
    assert wanted(rows) == [[2.0, 2.0, 4.0, 4.0, 4.0], [2.0] * 5]


def test_an_episode_that_misses_is_truncated_as_it_would_be() -> None:
    env, behavior = made(Line(1, steps=3), weights=Told(3.0))
    played(env, 3)
    rows = moved(env, 3, by=-5.0)
    assert rows["proposed"].all()
    assert rows["next", "truncated"].flatten().tolist() == [False, False, True]
    assert not rows["next", "terminated"].any()
    assert rows["next", "reward"].flatten().tolist() == [-1.0] * 3
    assert behavior.success().tolist() == [0.0]


def test_the_tasks_goal_does_not_end_an_episode_with_another() -> None:
    env, _ = made(Line(1, steps=20), weights=Told(2.0), continues_after_termination=True)
    played(env, 11)  # the task's goal is achieved at 9, then two steps of the next episode
    rows = moved(env, 4, by=7.0)
    assert rows["next", "achieved_goal"].flatten().tolist() == [8.0, 9.0, 10.0, 11.0]
    assert not rows["next", "done"].any()
    assert rows["next", "reward"].flatten().tolist() == [-1.0] * 4


def test_an_environment_that_cannot_go_on_truncates() -> None:
    env, _ = made(Line(1, steps=20), weights=Told(2.0))
    played(env, 11)
    rows = moved(env, 2, by=7.0)
    assert rows["next", "terminated"].flatten().tolist() == [False, False]
    assert rows["next", "truncated"].flatten().tolist() == [False, True]
    assert rows["next", "done"].flatten().tolist() == [False, True]


def test_a_fall_is_one_whatever_the_goal() -> None:
    env, _ = made(Line(1, edge=3.5, steps=20), weights=Told(2.0), continues_after_termination=True)
    played(env, 3)
    rows = moved(env, 1, by=3.0)
    assert rows["next", "terminated"].item()
    assert rows["next", "reward"].item() == -1.0


def test_a_share_of_the_episodes_keeps_the_tasks_goal() -> None:
    env, _ = made(1_000, real_share=0.3, candidates=1, memory=5_000)
    played(env, 1)
    proposed = env.reset()["proposed"].float().mean().item()
    assert proposed == pytest.approx(0.7, abs=0.05)


def test_greedy_takes_the_greatest() -> None:
    env, _ = made(4, factors=[Farther()], greedy=True, candidates=60)
    played(env)
    assert env.reset()["desired_goal"].flatten().tolist() == [5.0] * 4


def test_others_are_drawn_in_proportion() -> None:
    env, _ = made(2_000, factors=[Farther()], candidates=50, memory=20_000)
    played(env)
    goals = env.reset()["desired_goal"].flatten()
    shares = goals.long().bincount(minlength=6) / len(goals)
    torch.testing.assert_close(shares, torch.arange(6.0) / 15, atol=0.04, rtol=0.0)


def test_weights_and_factors_multiply() -> None:
    class Few(GoalWeights):
        def __call__(self, goals: Tensor) -> Tensor:
            return (goals[..., 0] < 3.5).float()

    env, _ = made(4, weights=Few(), factors=[Farther()], greedy=True, candidates=60)
    played(env)
    assert env.reset()["desired_goal"].flatten().tolist() == [3.0] * 4


def test_without_a_goal_that_may_be_proposed_the_tasks_own_stays() -> None:
    env, _ = made(weights=Told(-1.0))
    played(env)
    begun = env.reset()
    assert begun["desired_goal"].flatten().tolist() == [WANTED] * 2
    assert not begun["proposed"].any()


@pytest.mark.parametrize(
    ("update_on", "goals"), [("achieved", [1.0, 1.0, 2.0, 2.0]), ("proposed", [2.0, 2.0])]
)
def test_goals_that_weights_are_updated_on(update_on: str, goals: list[float]) -> None:
    weights = Told(2.0)
    env, _ = made(weights=weights, update_on=update_on, candidates=50)
    played(env, 2)
    env.reset()
    assert weights.goals == goals


def test_factors_are_told_how_episodes_ended() -> None:
    factor = Farther()
    env, behavior = made(4, factors=[factor], runs=2, greedy=True, candidates=60)
    played(env)
    assert factor.ends == []  # none was proposed
    first = env.reset()
    env.base_env.place[0] = 100.0  # never at 5 again
    env.rollout(5, walk, break_when_any_done=False, auto_reset=False, tensordict=first)
    assert factor.ends == [([2, 2], [1, 2])]
    assert behavior.success().tolist() == [0.5, 1.0]
    assert behavior.success().isnan().all()


def test_a_run_does_not_depend_on_others() -> None:
    def goals(env: TransformedEnv) -> Tensor:
        return torch.cat([played(env, 7)["desired_goal"] for _ in range(4)], 1)

    both, _ = made(6, runs=2, real_share=0.5, candidates=3)
    alone, behavior = made(3, real_share=0.5, candidates=3)
    behavior.generators = [torch.Generator().manual_seed(1)]
    assert torch.equal(goals(both)[3:], goals(alone))


def test_runs_that_take_no_part() -> None:
    env, behavior = made(4, runs=2)
    behavior.set_active(False, run=0)
    played(env)
    assert behavior.memory.sizes == [0, 10]
    assert env.reset()["proposed"].flatten().tolist() == [False, False, True, True]


def test_stages_that_take_no_part() -> None:
    class Stages(Line):
        """Two environments in two stages."""

        def _shown(self) -> dict[str, Tensor]:
            return super()._shown() | {"stage": torch.tensor([[0], [1]])}

    line = Stages(2)
    seen = line.observation_spec.clone()
    seen["stage"] = seen["observation"].to(torch.int64)
    line.observation_spec = seen
    env, behavior = made(line, stage_key="stage", stage=1)
    played(env)
    assert behavior.memory.sizes == [5]
    assert env.reset()["proposed"].flatten().tolist() == [False, True]


def test_specs_hold() -> None:
    env, _ = made(2)
    check_env_specs(env)
    played(env)
    check_env_specs(env)


def test_it_is_right_under_a_collector() -> None:
    env, _ = made(3, real_share=0.3, memory=1_000)
    collector = Collector(
        env, walk, frames_per_batch=3 * 40, total_frames=-1, auto_register_policy_transforms=False
    )
    batch = collector.next()
    for goal, ids in zip(batch["desired_goal"], batch["collector", "traj_ids"], strict=True):
        for episode in ids.unique():
            assert len(goal[ids == episode].unique()) == 1
    assert torch.equal(batch["next", "desired_goal"], batch["desired_goal"])
    reward, _ = REWARD(batch["next", "achieved_goal"], batch["desired_goal"])
    assert torch.equal(batch["next", "reward"], reward)
    assert batch["proposed"].any()
    assert not batch["proposed"].all()
    collector.shutdown()


def test_it_goes_on_from_a_collectors_state() -> None:
    def collector() -> Collector:
        env, _ = made(3, real_share=0.3, memory=50, weights=Told(3.0), factors=[Farther()])
        return Collector(
            env, walk, frames_per_batch=3 * 8, total_frames=-1, auto_register_policy_transforms=False
        )

    first, second = collector(), collector()
    first.next()
    second.next()
    second.next()  # elsewhere
    load_collector_state_dict(second, collector_state_dict(first))
    own, line = first.env.base_env, second.env.base_env
    line.place, line.time = own.place.clone(), own.time.clone()
    for _ in range(3):
        assert torch.equal(first.next()["desired_goal"], second.next()["desired_goal"])
    first.shutdown()
    second.shutdown()


def test_other_parts_have_another_state() -> None:
    _, behavior = made(weights=Told(3.0))
    _, other = made()
    with pytest.raises(ValueError, match="the state must have 0 weights, got 1"):
        other.load_state_dict(behavior.state_dict())


@pytest.mark.parametrize("part", ["writer", "sample unit"])
def test_actual_goals_are_those_of_the_task(part: str) -> None:
    env, _ = made(weights=Told(3.0))
    played(env)
    rows = played(env)
    assert rows["proposed"].all()
    options: dict[str, object] = {"goal_sources": {"actual": 4}}
    storage = LazyTensorStorage(100)
    if part == "writer":
        buffer = TensorDictReplayBuffer(storage=storage, writer=HERWriter(REWARD, **options), batch_size=60)
        buffer.extend(rows)
        sampled = buffer[:]
    else:
        unit = HERSampleUnit(REWARD, generator=torch.Generator(), **options)
        buffer = TensorDictReplayBuffer(
            storage=storage, batch_size=60, sample_unit=unit, transform=unit.relabel
        )
        buffer.extend(rows.reshape(-1))
        sampled = buffer.sample()
    assert "real_desired_goal" not in sampled.keys()
    assert "real_desired_goal" not in sampled["next"].keys()
    virtual = sampled["virtual"].squeeze(-1)
    assert set(sampled["desired_goal"][virtual].flatten().tolist()) == {WANTED}
    assert set(sampled["desired_goal"][~virtual].flatten().tolist()) == {3.0}


def test_around_several_environments() -> None:
    env, _ = made(SerialEnv(2, lambda: Line(1)), weights=Told(3.0))  # a batch of [2, 1]
    played(env)
    assert played(env)["next", "desired_goal"].flatten().tolist() == [3.0] * 10


def test_bad_options() -> None:
    with pytest.raises(ValueError, match=r"real_share must be in \[0, 1\], got 2"):
        BehaviorGoals(REWARD, real_share=2)
    with pytest.raises(ValueError, match="candidates must be at least 1, got 0"):
        GoalProposal(candidates=0)
    with pytest.raises(ValueError, match="update_on must be one of achieved, proposed, got 'nothing'"):
        GoalProposal(update_on="nothing")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="2 runs need a list of 2 weights, one for each run, got 1"):
        BehaviorGoals(
            REWARD, runs=2, proposal=GoalProposal(weights=Told(1.0)), generators=[torch.Generator()] * 2
        )


def test_missing_entries() -> None:
    with pytest.raises(KeyError, match="BehaviorGoals needs the entry 'desired_goal'"):
        BehaviorGoals(REWARD)._reset(TensorDict(), TensorDict({"observation": torch.zeros(1, 1)}, [1]))


def test_environments_that_cannot_be_shared_out() -> None:
    env, _ = made(3, runs=2)
    with pytest.raises(ValueError, match="a batch must have a multiple of runs=2 environments, got 3"):
        env.reset()


def test_it_is_not_for_buffers() -> None:
    with pytest.raises(RuntimeError, match="sampled transitions have their goals already"):
        BehaviorGoals(REWARD)(TensorDict({"observation": torch.zeros(1)}, []))


def test_it_works_where_the_environments_are(
    device: torch.device, make_generator: Callable[[int], torch.Generator]
) -> None:
    def first_goals(place: torch.device, generators: list[torch.Generator]) -> TensorDictBase:
        def nearness(observation: Tensor, goals: Tensor, counts: object) -> Tensor:
            return -goals.abs().expand(-1, max(observation.shape[-2], goals.shape[1]), -1)

        behavior = BehaviorGoals(
            REWARD,
            proposal=GoalProposal(
                weights=[RareGoals(k=2, estimator="neighbors"), RareGoals(k=2, estimator="neighbors")],
                factors=[ValueCutoff(nearness, runs=2), DiscoverScore(nearness, runs=2)],
                greedy=True,
                candidates=20,
            ),
            real_share=0.3,
            memory=100,
            runs=2,
            generators=generators,
        )
        env = TransformedEnv(Line(4, device=place), behavior)
        return env.rollout(20, walk, break_when_any_done=False, auto_cast_to_device=False)

    rows = first_goals(device, [make_generator(seed) for seed in (0, 1)])
    assert {entry.device for entry in rows.values(True, True)} == {device}
    assert rows["proposed"].any()
    if device.type == "cpu":
        return
    assert not rows["proposed"].all()


def test_a_single_environment_without_a_batch() -> None:
    behavior = BehaviorGoals(
        REWARD, proposal=GoalProposal(weights=Told(3.0)), real_share=0.0, generators=[torch.Generator()]
    )
    behavior._step(
        TensorDict({"proposed": torch.tensor([False]), "proposed_reached": torch.tensor([False])}, []),
        TensorDict(
            {
                "observation": torch.tensor([30.0]),
                "achieved_goal": torch.tensor([3.0]),
                "desired_goal": torch.tensor([WANTED]),
                "reward": torch.tensor([-1.0]),
                **dict.fromkeys(("terminated", "truncated", "done"), torch.tensor([False])),
            },
            [],
        ),
    )
    seen = {"observation": torch.tensor([0.0]), "desired_goal": torch.tensor([WANTED])}
    begun = behavior._reset(TensorDict(), TensorDict(seen, []))
    assert begun["desired_goal"].tolist() == [3.0]
    assert begun["proposed"].tolist() == [True]


def test_a_success_counts_at_whatever_step_it_was() -> None:
    def lasting(achieved: Tensor, desired: Tensor) -> tuple[Tensor, Tensor]:
        """As in tasks of Gymnasium-Robotics: nothing terminates."""
        reward, _ = REWARD(achieved, desired)
        return reward, torch.zeros_like(reward, dtype=torch.bool)

    env, behavior = made(1, reward=lasting, weights=Told(2.0))
    played(env)
    rows = played(env)
    assert rows["next", "reward"].flatten().tolist() == [-1.0, 0.0, -1.0, -1.0, -1.0]
    assert rows["next", "proposed_reached"].flatten().tolist() == [False, True, True, True, True]
    assert behavior.success().tolist() == [1.0]


def test_a_success_with_another_reward_is_no_fall() -> None:
    class Costly(Line):
        """Each step costs a little, also the last one."""

        def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
            after = super()._step(tensordict)
            return after.set("reward", after["reward"] - 0.01)

    env, _ = made(Costly(1, steps=20), weights=Told(2.0), continues_after_termination=True)
    played(env, 3)
    rows = moved(env, 1, by=8.0)
    assert rows["next", "achieved_goal"].item() == WANTED
    assert not rows["next", "done"].any()


def test_without_a_time_limit() -> None:
    options = {"keys": EnvKeys(truncated=None), "continues_after_termination": True}
    env, _ = made(Line(1, steps=1000), weights=Told(2.0), **options)
    played(env, 10)
    env.reset()
    rows = played(env, 3)
    assert rows["next", "done"].flatten().tolist() == [False, True, False]
    with pytest.raises(ValueError, match="continues_after_termination=False needs a key for truncated"):
        BehaviorGoals(REWARD, keys=EnvKeys(truncated=None))


def test_goals_that_are_not_finite_are_not_remembered() -> None:
    _, behavior = made(2)
    behavior.memory.add(torch.tensor([[torch.nan], [1.0]]), torch.zeros(2, 1))
    assert behavior.memory.sizes == [1]
