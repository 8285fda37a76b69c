"""A curriculum for an environment from elsewhere: gymnasium's mountain car fetches a parcel.

Run it with ``python docs/examples/own_curriculum.py``; ``--direct`` leaves out the first stage.
``docs/curriculum.md`` explains it.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import gymnasium
import numpy as np
import torch
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.collectors import Collector
from torchrl.data import TensorDictReplayBuffer
from torchrl.envs import Compose, EnvBase, GymWrapper, RenameTransform, SerialEnv, TransformedEnv

from torchrl_her import (
    Curriculum,
    CurriculumProgress,
    CurriculumStage,
    DecayingEpsilon,
    FusedLearner,
    GoalReward,
    HERWriter,
    StateToObs,
    Trainer,
    ZeroPad,
    enter_stage,
    evaluate,
    make_actor,
    make_critic,
    make_ddpg_loss,
    make_target_updater,
    success,
)
from torchrl_her.curriculum import zero_unused_inputs
from torchrl_her.modules import StackedLinear
from torchrl_her.objectives import ActorTerms
from torchrl_her.replay_buffers import PackedStorage, RunsSampler

STEPS = 75  # of an episode
NAMES = {"car": [0, 1], "position": [0], "parcel": [2], "place": [3]}  # [position, speed | parcel | place]
DRIVE = CurriculumStage(
    name="drive", observation="car", achieved_goal="position", desired_goal="parcel", threshold=0.1
)
DELIVER = CurriculumStage(
    name="deliver", observation=["car", "parcel"], achieved_goal="parcel", desired_goal="place", threshold=0.1
)


class FetchParcel(gymnasium.Wrapper):
    """The car picks up a parcel on the left slope and has to take it to a place on the right one."""

    def __init__(self, env: gymnasium.Env) -> None:
        super().__init__(env)
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (4,), np.float32)

    def reset(self, **kwargs: Any) -> tuple[np.ndarray, dict]:
        car, info = self.env.reset(**kwargs)
        self.parcel, self.place = self.np_random.uniform([-0.95, 0.4], [-0.6, 0.8])
        self.held = False
        return self._state(car), info

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        for _ in range(2):  # two steps of the car for one of ours; they ignore that it reached its flag
            car, _, _, _, info = self.env.step(action)
            state = self._state(car)
        there = bool(abs(state[2] - state[3]) < DELIVER.threshold)
        return state, float(there) - 1.0, there, False, info  # of the last stage; TimeLimit sets truncated

    def _state(self, car: np.ndarray) -> np.ndarray:
        position, speed = (car[0] + 0.3) / 0.9, car[1] / 0.07  # both in [-1, 1]
        self.held = self.held or abs(position - self.parcel) < DRIVE.threshold
        self.parcel = position if self.held else self.parcel
        return np.array([position, speed, self.parcel, self.place], np.float32)


def make_single_env() -> EnvBase:
    """One environment with its time limit."""
    car = gymnasium.make("MountainCarContinuous-v0").unwrapped
    return GymWrapper(gymnasium.wrappers.TimeLimit(FetchParcel(car), max_episode_steps=STEPS))


def make_env(num_envs: int, progress: CurriculumProgress, *, seed: int) -> EnvBase:
    """``num_envs`` environments for each run, one run after the other, each as its run's stage sees it."""
    stages = StateToObs(progress.curriculum, progress), ZeroPad(progress.curriculum, progress)
    env = SerialEnv(num_envs * progress.runs, make_single_env)
    env = TransformedEnv(env, Compose(RenameTransform(["observation"], ["state"]), *stages))
    env.set_seed(seed)
    return env


def make_network(
    make: Callable[..., TensorDictModule], curriculum: Curriculum, runs: int
) -> TensorDictModule:
    """A network with all inputs; the weights of those that the first stage does not use start at 0."""
    network = make([curriculum.input_width], 1, runs=runs, in_keys=["input"])
    first = next(module for module in network.modules() if isinstance(module, StackedLinear))
    first.weight.data = zero_unused_inputs(first.weight.data, curriculum.first_inputs, alpha=0.0)
    return network


def make_buffer(
    progress: CurriculumProgress, generators: Sequence[torch.Generator], *, capacity: int = 300_000
) -> TensorDictReplayBuffer:
    """The replay buffer of all runs: it relabels when written to, and makes ``input`` when sampled."""
    runs = {"runs": len(generators), "generators": generators}
    buffer = TensorDictReplayBuffer(
        storage=PackedStorage(len(generators) * capacity),  # a block of rows for each run
        writer=HERWriter(
            GoalReward(progress.stage_of(0).threshold),  # all runs begin in the first stage
            filter_achieved=True,
            exclude=("state", "input"),
            **runs,
        ),
        sampler=RunsSampler(capacity, **runs),
    )
    buffer.append_transform(ZeroPad(progress.curriculum, progress))
    return buffer


def train(
    stages: Sequence[CurriculumStage] = (DRIVE, DELIVER),
    *,
    epochs: int = 14,
    epoch_frames: int = 2_000,
    num_envs: int = 8,
    runs: int = 1,
    window: int = 40,
    success_threshold: float = 0.9,
    seed: int = 0,
) -> Iterator[tuple[int, list[str], list[float]]]:
    """Trains, and yields after each epoch the frames so far, and the stage and the success of each run."""
    torch.manual_seed(seed)
    generators = [torch.Generator().manual_seed(seed + run) for run in range(runs)]
    curriculum = Curriculum(stages, 4, names=NAMES)
    progress = CurriculumProgress(curriculum, runs=runs, window=window, success_threshold=success_threshold)
    env = make_env(num_envs, progress, seed=seed)
    eval_env = make_env(window, progress, seed=seed + 1_000_000)  # as many episodes as the window holds

    actor, critic = (make_network(make, curriculum, runs) for make in (make_actor, make_critic))
    low, high = -torch.ones(1), torch.ones(1)
    exploration = DecayingEpsilon(low, high, decay=0.9, noise=0.15, generators=generators)
    policy = TensorDictSequential(actor, exploration)
    loss = make_ddpg_loss(actor, critic, terms=ActorTerms(action_penalty=0.03), reduction="none")
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)
    target = make_target_updater(loss, tau=0.02, hard_interval=0)
    buffer = make_buffer(progress, generators)
    trainer = Trainer(
        collector=Collector(
            env,
            policy,
            frames_per_batch=5 * runs * num_envs,
            total_frames=-1,
            auto_register_policy_transforms=False,
        ),
        buffer=buffer,
        learner=FusedLearner(loss, optimizer, target),
        schedules=[exploration],
        runs=runs,
        epoch_frames=epoch_frames,
        frames_per_update=4.0,
        warmup_frames=STEPS * num_envs,  # one episode of each environment
    )
    for _ in range(epochs):
        trainer.epoch()
        samples = success(evaluate(eval_env, policy, max_steps=STEPS)).float().view(runs, window)
        names = [progress.stage_of(run).name for run in range(runs)]
        yield trainer.frames, names, samples.mean(1).tolist()
        for run in progress.record(samples).nonzero().flatten().tolist():
            enter_stage(buffer, progress.stage_of(run), exploration, run=run)
    trainer.collector.shutdown()
    eval_env.close()


if __name__ == "__main__":
    torch.set_num_threads(1)
    for frames, names, shares in train([DELIVER] if "--direct" in sys.argv else [DRIVE, DELIVER]):
        print(f"{frames:6} frames, {time.process_time():3.0f} s: {names[0]:7} {shares[0]:.2f}", flush=True)
