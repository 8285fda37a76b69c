"""The loop, and that it learns: a task of one dimension that is solved in seconds."""

from __future__ import annotations

import math
import re
from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictSequential
from torch import Tensor
from torchrl.collectors import Collector
from torchrl.data import Binary, Bounded, Composite, LazyTensorStorage, TensorDictReplayBuffer, Unbounded
from torchrl.envs import EnvBase

from torchrl_her import (
    DecayingEpsilon,
    FusedLearner,
    GoalReward,
    HERWriter,
    LossLearner,
    Trainer,
    evaluate,
    make_actor,
    make_critic,
    make_ddpg_loss,
    make_target_updater,
    success,
)
from torchrl_her.modules import NetworkShape
from torchrl_her.objectives import PenalizedDDPGLoss, Targets
from torchrl_her.replay_buffers import PackedStorage, RunsPrioritizedSampler, empty_run
from torchrl_her.trainers import RunsAdam

N, STEPS = 8, 10


class LineEnv(EnvBase):
    """A point on a line from -1 to 1 that moves by a tenth of the action; the goal is to be somewhere."""

    def __init__(self, seed: int = 0, shape: tuple[int, ...] = (N,)) -> None:
        super().__init__(device="cpu", batch_size=shape)
        self.reward = GoalReward(0.1)
        self.entry = entry = (*shape, 1)

        def line() -> Unbounded:
            return Unbounded(shape=entry)

        def flag() -> Binary:
            return Binary(n=1, shape=entry, dtype=torch.bool)

        self.observation_spec = Composite(
            observation=line(), achieved_goal=line(), desired_goal=line(), shape=shape
        )
        self.action_spec = Bounded(-1.0, 1.0, shape=entry)
        self.reward_spec = Unbounded(shape=entry)
        self.done_spec = Composite(done=flag(), terminated=flag(), truncated=flag(), shape=shape)
        self.x, self.goal, self.t = torch.zeros(entry), torch.zeros(entry), torch.zeros(entry)
        self.set_seed(seed)

    def _set_seed(self, seed: int | None) -> None:
        self.rng = torch.Generator().manual_seed(seed or 0)

    def _shown(self) -> dict[str, Tensor]:
        return {
            "observation": self.x.clone(),
            "achieved_goal": self.x.clone(),
            "desired_goal": self.goal.clone(),
        }

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        mask = torch.ones(self.entry, dtype=torch.bool) if mask is None else mask.view(self.entry)
        start = torch.rand(2, *self.entry, generator=self.rng) * 2 - 1
        self.x, self.goal = torch.where(mask, start[0], self.x), torch.where(mask, start[1], self.goal)
        self.t = self.t.masked_fill(mask, 0)
        return TensorDict(self._shown(), batch_size=self.batch_size)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self.x = (self.x + 0.25 * tensordict["action"]).clamp(-1, 1)
        self.t = self.t + 1
        reward, terminated = self.reward(self.x, self.goal)
        truncated = self.t >= STEPS
        flags = {"terminated": terminated, "truncated": truncated, "done": terminated | truncated}
        return TensorDict({**self._shown(), "reward": reward, **flags}, batch_size=self.batch_size)


def make_trainer(
    seed: int = 0,
    *,
    make_learner: Any = LossLearner,
    shape: tuple[int, ...] = (N,),
    frames_per_batch: int = N * STEPS,
    **options: Any,
) -> tuple[Trainer, TensorDictSequential]:
    torch.manual_seed(seed)
    generator = torch.Generator().manual_seed(seed)
    small = NetworkShape(hidden=32)
    actor, critic = make_actor((1, 1), 1, shape=small), make_critic((1, 1), 1, shape=small)
    exploration = DecayingEpsilon(-torch.ones(1), torch.ones(1), decay=0.8, generators=[generator])
    policy = TensorDictSequential(actor, exploration)
    loss = make_ddpg_loss(actor, critic, targets=Targets(gamma=0.9, reward_range=(-1.0, 0.0)))
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(20_000), writer=HERWriter(GoalReward(0.1), filter_achieved=True)
    )
    buffer.set_rng(generator)
    trainer = Trainer(
        collector=Collector(
            LineEnv(seed, shape),
            policy,
            frames_per_batch=frames_per_batch,
            total_frames=-1,
            auto_register_policy_transforms=False,
        ),
        buffer=buffer,
        learner=make_learner(
            loss,
            torch.optim.Adam(loss.parameters(), lr=1e-3),
            make_target_updater(loss, tau=0.05, hard_interval=0),
        ),
        schedules=[exploration],
        **{"epoch_frames": 800, "frames_per_update": 2.0, "batches_per_sample": 8, **options},
    )
    return trainer, policy


@pytest.mark.parametrize("make_learner", [FusedLearner, pytest.param(LossLearner, marks=pytest.mark.full)])
def test_it_learns_a_task_of_one_dimension(make_learner: Any) -> None:
    trainer, policy = make_trainer(make_learner=make_learner)
    before = success(evaluate(LineEnv(1), policy, max_steps=STEPS)).float().mean()
    assert before < 0.7
    after = torch.zeros(())
    while after <= 0.95 and trainer.epochs < 5:
        trainer.epoch()
        shares = [
            success(evaluate(LineEnv(seed), policy, max_steps=STEPS)).float().mean() for seed in range(10)
        ]
        after = torch.stack(shares).mean()
    assert after > 0.95


def test_frames_updates_and_epsilon_by_hand() -> None:
    trainer, _ = make_trainer(epoch_frames=160, frames_per_update=10.0)
    measured = trainer.epoch()
    assert (trainer.frames, trainer.updates, trainer.epochs) == (160, 16, 1)
    assert set(measured) == {"loss_actor", "loss_value"}
    assert float(trainer.schedules[0].epsilon) == pytest.approx(0.8)


def test_frames_that_do_not_divide_are_not_lost() -> None:
    trainer, _ = make_trainer(epoch_frames=200, frames_per_update=30.0)
    for _ in range(4):
        trainer.epoch()
    assert trainer.frames == 800
    assert trainer.updates == 800 // 30


@pytest.mark.parametrize("frames_per_update", [0.5, 0.3])
def test_several_gradient_steps_for_each_frame(frames_per_update: float) -> None:
    trainer, _ = make_trainer(
        epoch_frames=160, frames_per_update=frames_per_update, batch_size=4, make_learner=FusedLearner
    )
    for epoch in (1, 2, 3):
        trainer.epoch()
        assert trainer.frames == 160 * epoch
        assert trainer.updates == pytest.approx(160 * epoch / frames_per_update, abs=1.0)


def test_progress_is_told_after_each_batch() -> None:
    trainer, _ = make_trainer(epoch_frames=240, frames_per_update=40.0)
    seen: list[int] = []
    trainer.epoch(lambda own: seen.append(own.frames))
    assert seen == [80, 160, 240]


def test_the_next_batch_is_collected_during_learning_until_the_epoch_ends() -> None:
    trainer, _ = make_trainer(epoch_frames=240, frames_per_update=40.0)  # three batches
    done: list[str] = []
    collector, update = trainer.collector, trainer.learner.update

    class Ahead:
        def reset(self) -> None:
            done.append("reset")
            collector.reset()

        def next(self) -> TensorDictBase:
            done.append("next")
            return collector.next()

        def collect_ahead(self) -> None:
            done.append("ahead")

    def learn(*arguments: Any, **options: Any) -> dict[str, Tensor]:
        if done[-1] != "learn":
            done.append("learn")
        return update(*arguments, **options)

    trainer.collector, trainer.learner.update = Ahead(), learn  # type: ignore[assignment,method-assign]
    epoch = ["reset", "next", "ahead", "learn", "next", "ahead", "learn", "next", "learn"]
    for _ in range(2):
        trainer.epoch()
    assert done == epoch * 2
    trainer.run(160)
    assert done[len(epoch) * 2 :] == ["next", "ahead", "learn", "next", "learn"]


def test_seeds_make_training_repeat_bit_for_bit() -> None:
    weights = []
    for seed in (0, 0, 1):
        trainer, policy = make_trainer(seed, epoch_frames=240, frames_per_update=10.0)
        trainer.epoch()
        weights.append(torch.cat([p.detach().flatten() for p in policy.parameters()]))
    assert torch.equal(weights[0], weights[1])
    assert not torch.equal(weights[0], weights[2])


@pytest.mark.parametrize(
    "key", ["action", "observation", "achieved_goal", ("next", "desired_goal"), ("next", "reward")]
)
def test_nan_is_noticed_and_named(key: str | tuple[str, str]) -> None:
    trainer, _ = make_trainer()
    batch = trainer.collector.next()
    batch[key][0, 0] = float("nan")
    trainer.collector.next = lambda: batch  # type: ignore[method-assign]
    with pytest.raises(ValueError, match=f"the collected {re.escape(repr(key))} must be finite"):
        trainer.epoch()


def test_evaluation_is_greedy_and_leaves_training_alone() -> None:
    trainer, policy = make_trainer()
    state = trainer.schedules[0].generators[0].get_state()
    rollout = evaluate(LineEnv(1), policy, max_steps=STEPS)
    assert rollout.shape == (N, STEPS)
    greedy = policy[0](rollout.select("observation", "desired_goal"))["action"]
    torch.testing.assert_close(greedy, rollout["action"])
    assert torch.equal(trainer.schedules[0].generators[0].get_state(), state)


def test_a_run_whose_buffer_is_empty_waits_and_holds_no_other_back() -> None:
    runs = 2

    def make() -> tuple[Trainer, PenalizedDDPGLoss]:
        torch.manual_seed(0)
        loss = make_ddpg_loss(
            make_actor((1, 1), 1, shape=NetworkShape(hidden=8), runs=runs),
            make_critic((1, 1), 1, shape=NetworkShape(hidden=8), runs=runs),
            reduction="none",
        )
        optimizer = RunsAdam(loss, lr=1e-2, runs=runs)
        learner = FusedLearner(loss, optimizer, make_target_updater(loss, tau=0.1, hard_interval=0))
        generators = [torch.Generator().manual_seed(run) for run in range(runs)]
        buffer = TensorDictReplayBuffer(
            storage=PackedStorage(runs * 1_000),
            writer=HERWriter(GoalReward(0.1), runs=runs, generators=generators),
            sampler=RunsPrioritizedSampler(1_000, 0.6, 0.4, runs=runs, generators=generators),
            priority_key="td_error",
        )
        collector = Collector(LineEnv(), None, frames_per_batch=N * STEPS, total_frames=-1)
        trainer = Trainer(
            collector=collector,
            buffer=buffer,
            learner=learner,
            runs=runs,
            frames_per_update=4.0,
            batch_size=16,
        )
        return trainer, loss

    both, loss_of_both = make()
    alone, loss_of_one = make()
    for trainer in (both, alone):
        torch.manual_seed(1)
        trainer.run(N * STEPS)
    before = {name: value.clone() for name, value in loss_of_one.state_dict().items()}
    empty_run(alone.buffer, 1)
    for trainer, empty in ((both, False), (alone, True)):
        trainer._credit = 6.0
        measured = trainer._learn()
        assert trainer._credit == 0.0
        assert bool((measured[0]["loss_value"][:, 1] == -torch.inf).all()) == empty
        assert measured[0]["loss_value"][:, 0].isfinite().all()
    priorities = [trainer.buffer.sampler.state_dict()["values"] for trainer in (both, alone)]
    assert torch.equal(priorities[0][0], priorities[1][0])  # though its rows stood in for those of the other
    assert len(priorities[1][1]) == 0
    expected = loss_of_both.state_dict()
    stacked = {name: value for name, value in loss_of_one.state_dict().items() if value.ndim > 0}
    assert len(stacked) == 32
    for name, value in stacked.items():
        assert torch.equal(value[0], expected[name][0]), name  # learns as if nothing were the matter
        assert torch.equal(value[1], before[name][1]), name  # stays as it was
    empty_run(alone.buffer, 0)
    alone._credit = 3.0
    assert alone._learn() == []
    assert alone._credit == 0.0  # these steps pass


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"epoch_frames": 0}, "epoch_frames must be at least 1, got 0"),
        ({"batches_per_sample": 0}, "batches_per_sample must be at least 1, got 0"),
        ({"batch_size": 0}, "batch_size must be at least 1, got 0"),
        ({"frames_per_update": -1.0}, "frames_per_update must be positive and finite, got -1.0"),
        ({"frames_per_update": math.inf}, "frames_per_update must be positive and finite, got inf"),
        ({"frames_per_update": math.nan}, "frames_per_update must be positive and finite, got nan"),
    ],
)
def test_numbers_that_cannot_be(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_trainer(**options)


def test_environments_must_be_equal_blocks() -> None:
    trainer, _ = make_trainer()
    trainer.runs = 3
    with pytest.raises(ValueError, match=f"a batch must have a multiple of runs=3 rows, got {N}"):
        trainer.epoch()


@pytest.mark.parametrize("runs", [2, 3])
def test_the_buffer_must_be_for_as_many_runs(runs: int) -> None:
    trainer, _ = make_trainer()
    with pytest.raises(ValueError, match=f"there are {runs} runs, but the buffer's writer is for 1"):
        Trainer(collector=trainer.collector, buffer=trainer.buffer, learner=trainer.learner, runs=runs)


def test_trajectories_must_be_marked(monkeypatch: pytest.MonkeyPatch) -> None:
    trainer, _ = make_trainer()
    collect = trainer.collector.next
    monkeypatch.setattr(trainer.collector, "next", lambda: collect().exclude(("collector", "traj_ids")))
    with pytest.raises(ValueError, match=r"batches need \('collector', 'traj_ids'\)"):
        trainer.epoch()


# Episodes that are open when an epoch ends


@pytest.mark.parametrize(
    ("shape", "frames_per_batch", "epoch_frames"), [((), 4, 26), ((), 7, 21), ((N,), 3 * N, 13 * N)]
)
def test_no_row_is_lost_where_epochs_end(
    shape: tuple[int, ...], frames_per_batch: int, epoch_frames: int
) -> None:
    trainer, _ = make_trainer(
        shape=shape, frames_per_batch=frames_per_batch, epoch_frames=epoch_frames, warmup_frames=10**6
    )
    writer = trainer.buffer.writer
    for _ in range(4):
        trainer.epoch()
        assert (writer.held_back, writer.counts.real) == (0, trainer.frames)
    assert trainer.frames >= 4 * epoch_frames


def test_epochs_that_follow_a_run_lose_nothing_either() -> None:
    trainer, _ = make_trainer(shape=(), frames_per_batch=4, epoch_frames=26, warmup_frames=10**6)
    writer = trainer.buffer.writer
    trainer.run(13)
    assert writer.held_back > 0
    assert writer.held_back + writer.counts.real == trainer.frames == 16
    trainer.epoch()
    assert (writer.held_back, writer.counts.real) == (0, trainer.frames)


def test_an_epoch_after_a_run_collects_as_many_frames_as_any_other() -> None:
    options: dict[str, Any] = {"epoch_frames": 2 * N * STEPS, "frames_per_update": 40.0}
    trainer, _ = make_trainer(**options)
    trainer.run(10 * N * STEPS)
    trainer.epoch()
    assert trainer.frames == 12 * N * STEPS
    state, (other, _) = trainer.state_dict(), make_trainer(**options)
    other.load_state_dict(state)
    other.epoch()
    assert other.frames == 14 * N * STEPS
