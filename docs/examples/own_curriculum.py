"""A curriculum for an environment of somebody else's: gymnasium's mountain car fetches a parcel.

Run it as ``python docs/examples/own_curriculum.py``; with ``--direct`` it goes without the first layer.
The guide to it is ``docs/curriculum.md``.
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
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import Compose, EnvBase, GymWrapper, RenameTransform, SerialEnv, TransformedEnv

from torchrl_her import (
    Curriculum,
    CurriculumLayer,
    CurriculumProgress,
    DecayingEpsilon,
    FusedDDPGLearner,
    GoalReward,
    HERWriter,
    StackedLinear,
    StateToObs,
    Trainer,
    ZeroPad,
    enter_layer,
    evaluate,
    make_actor,
    make_critic,
    make_ddpg_loss,
    make_target_updater,
    success,
    zero_unused_inputs,
)

STEPS = 75  # of an episode
NAMES = {"car": [0, 1], "position": [0], "parcel": [2], "place": [3]}  # [position, speed | parcel | place]
DRIVE = CurriculumLayer(
    name="drive", observation="car", achieved_goal="position", desired_goal="parcel", threshold=0.1
)
DELIVER = CurriculumLayer(
    name="deliver", observation=["car", "parcel"], achieved_goal="parcel", desired_goal="place", threshold=0.1
)


class FetchParcel(gymnasium.Wrapper):
    """A parcel on the left slope is wanted on the right one; the car takes it along when it gets there."""

    def __init__(self, env: gymnasium.Env) -> None:
        super().__init__(env)
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (4,), np.float32)

    def reset(self, **kwargs: Any) -> tuple[np.ndarray, dict]:
        car, info = self.env.reset(**kwargs)
        self.parcel, self.place = self.np_random.uniform([-0.95, 0.4], [-0.6, 0.8])
        self.held = False
        return self._state(car), info

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        for _ in range(2):  # steps of the car in one of ours, also behind its flag, where it would end
            car, _, _, _, info = self.env.step(action)
            state = self._state(car)
        return state, 0.0, False, False, info  # StateToObs makes reward and ends, TimeLimit truncates

    def _state(self, car: np.ndarray) -> np.ndarray:
        position, speed = (car[0] + 0.3) / 0.9, car[1] / 0.07  # both within [-1, 1]
        self.held = self.held or abs(position - self.parcel) < DRIVE.threshold
        self.parcel = position if self.held else self.parcel
        return np.array([position, speed, self.parcel, self.place], np.float32)


def make_world() -> EnvBase:
    """One environment; the time limit belongs around whatever steps it."""
    car = gymnasium.make("MountainCarContinuous-v0").unwrapped
    return GymWrapper(gymnasium.wrappers.TimeLimit(FetchParcel(car), max_episode_steps=STEPS))


def make_env(worlds: int, progress: CurriculumProgress, *, seed: int) -> EnvBase:
    """``worlds`` for each run, run after run, as the layers of the runs see them."""
    layers = StateToObs(progress.curriculum, progress), ZeroPad(progress.curriculum, progress)
    env = SerialEnv(worlds * progress.runs, make_world)
    env = TransformedEnv(env, Compose(RenameTransform(["observation"], ["state"]), *layers))
    env.set_seed(seed)
    return env


def make_network(
    make: Callable[..., TensorDictModule], curriculum: Curriculum, runs: int
) -> TensorDictModule:
    """Of final width from the start; weights of inputs that the first layer does not use start at 0."""
    network = make([curriculum.input_width], 1, runs=runs, in_keys=["input"])
    first = next(module for module in network.modules() if isinstance(module, StackedLinear))
    first.weight.data = zero_unused_inputs(first.weight.data, curriculum.first_inputs, alpha=0.0)
    return network


def make_buffer(progress: CurriculumProgress, run: int, generator: torch.Generator) -> TensorDictReplayBuffer:
    """The replay buffer of one run: relabels what is written, and makes the input of what is sampled."""
    reward = GoalReward(progress.layer_of(run).threshold)
    writer = HERWriter(reward, filter_achieved=True, exclude=("state", "input"))
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(300_000), writer=writer)
    buffer.append_transform(ZeroPad(progress.curriculum, progress, run=run))
    buffer.set_rng(generator)
    return buffer


def train(
    layers: Sequence[CurriculumLayer] = (DRIVE, DELIVER),
    *,
    epochs: int = 14,
    epoch_frames: int = 2_000,
    worlds: int = 8,
    runs: int = 1,
    window: int = 40,
    success_threshold: float = 0.9,
    seed: int = 0,
) -> Iterator[tuple[int, list[str], list[float]]]:
    """Trains; yields after each epoch the frames, and the layer and the success of each run."""
    torch.manual_seed(seed)
    generators = [torch.Generator().manual_seed(seed + run) for run in range(runs)]
    curriculum = Curriculum(layers, 4, names=NAMES)
    progress = CurriculumProgress(curriculum, runs=runs, window=window, success_threshold=success_threshold)
    env = make_env(worlds, progress, seed=seed)
    eval_env = make_env(window, progress, seed=seed + 1_000_000)  # as many episodes as the window takes

    actor, critic = (make_network(make, curriculum, runs) for make in (make_actor, make_critic))
    low, high = -torch.ones(1), torch.ones(1)
    exploration = DecayingEpsilon(low, high, decay=0.9, noise=0.15, generators=generators)
    policy = TensorDictSequential(actor, exploration)
    loss = make_ddpg_loss(actor, critic, action_penalty=0.03, reduction="none")
    optimiser = torch.optim.Adam(loss.parameters(), lr=1e-3)
    target = make_target_updater(loss, tau=0.02, hard_interval=0)
    buffers = [make_buffer(progress, run, generator) for run, generator in enumerate(generators)]
    trainer = Trainer(
        collector=Collector(
            env,
            policy,
            frames_per_batch=5 * runs * worlds,
            total_frames=-1,
            auto_register_policy_transforms=False,
        ),
        buffers=buffers,
        learner=FusedDDPGLearner(loss, optimiser, target),
        schedules=[exploration],
        epoch_frames=epoch_frames,
        frames_per_update=4.0,
        warmup_frames=STEPS * worlds,  # an episode of each
    )
    for _ in range(epochs):
        trainer.epoch()
        samples = success(evaluate(eval_env, policy, max_steps=STEPS)).float().view(runs, window)
        names = [progress.layer_of(run).name for run in range(runs)]
        yield trainer.frames, names, samples.mean(1).tolist()
        for run in progress.record(samples).nonzero().flatten().tolist():
            enter_layer(buffers[run], progress.layer_of(run), exploration, run=run)
    trainer.collector.shutdown()
    eval_env.close()


if __name__ == "__main__":
    torch.set_num_threads(1)
    for frames, names, shares in train([DELIVER] if "--direct" in sys.argv else [DRIVE, DELIVER]):
        print(f"{frames:6} frames, {time.process_time():3.0f} s: {names[0]:7} {shares[0]:.2f}", flush=True)
