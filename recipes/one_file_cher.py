"""Filtered-HER with a curriculum (CHER) in one file: a hand picks a ball up and throws it into a hole.

    python recipes/one_file_cher.py --seed 0    # takes about a minute; success of 96 to 100 % at the end

This file contains a complete run: environments for each stage, the writer that relabels, networks, the loop
of collection and gradient steps, and the change of stage. It uses only the library and its tasks. The package
``torchrl_her_recipes`` adds options, several runs at once, checkpoints and reports.

Filtered-HER and CHER: Manela, Deep Reinforcement Learning for Complex Manipulation Tasks with Sparse
Feedback, 2020, algorithms 10 and 14. HER: Andrychowicz et al., 2017 (arXiv 1707.01495). DDPG: Lillicrap et
al., 2015 (arXiv 1509.02971). Prioritized replay: Schaul et al., 2015 (arXiv 1511.05952).
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import torch
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, PrioritizedSampler, TensorDictReplayBuffer
from torchrl.envs import Compose, EnvBase, TransformedEnv

from torchrl_her import (
    Curriculum,
    CurriculumProgress,
    CurriculumStage,
    DecayingEpsilon,
    FusedLearner,
    GoalReward,
    HERWriter,
    NetworkShape,
    StateToObs,
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
from torchrl_her.modules import PolicyAverage, StackedLinear
from torchrl_her.objectives import ActorTerms, Targets
from torchrl_her_envs import make_env


@dataclass(frozen=True)
class Options:
    """Options of a run; frames are environment steps."""

    seed: int = 0
    epochs: int = 30
    epoch_frames: int = 10_240
    num_envs: int = 64
    steps_per_batch: int = 10  # steps of each environment in a collected batch
    frames_per_update: int = 5
    warmup_frames: int = 3_200
    episodes: int = 100  # number of episodes of an evaluation
    # Hindsight
    k: int = 4  # virtual goals per transition
    capacity: int = 1_000_000  # number of real and virtual transitions in the replay buffer
    priority_alpha: float = 0.3  # exponent of the squared TD error (in Schaul et al.: 0.6, of the error)
    priority_beta: float = 0.4
    # Curriculum
    window: int = 20  # greedy episodes whose mean success is compared with success_threshold
    success_threshold: float = 0.9  # mean success at which a stage ends
    # DDPG
    hidden: int = 64
    batch_size: int = 256
    learning_rate: float = 1e-3
    gamma: float = 0.98
    tau: float = 0.02
    action_penalty: float = 0.3  # keeps the actor's tanh away from -1 and 1, where its gradient vanishes
    max_grad_norm: float = 3.0
    ema_decay: float = 0.9995  # decay of the moving average of the actor's weights; the average is evaluated
    # Exploration: a fraction epsilon of the actions explores; a fifth of these are uniform, the others noisy
    epsilon_decay: float = 0.9  # factor by which epsilon shrinks after each epoch
    epsilon_end: float = 0.05
    noise: float = 0.05


class Evaluation(NamedTuple):
    """Result of an epoch: frames so far, the stage that was trained, and its success in greedy episodes."""

    frames: int
    stage: str
    success: float


def make_stages() -> CurriculumProgress:
    """Makes the curriculum of ``hand_v1`` (reach, then throw); its progress begins at the first stage."""
    task = make_env("hand_v1")
    width = task.observation_spec["state"].shape[-1]
    stages = [CurriculumStage(**stage) for stage in task.stages()]
    return CurriculumProgress(Curriculum(stages, width, names=task.state_names()))


def make_staged_env(progress: CurriculumProgress, num_envs: int, seed: int) -> EnvBase:
    """Makes environments that show the observation and goals of the current stage.

    ``StateToObs`` reads observation and goals from the state, and rewards achieving the stage's goal.
    ``ZeroPad`` writes the networks' ``input``, in which each entry of the state has the same index in all
    stages, and entries that the stage does not use are 0.
    """
    stages = StateToObs(progress.curriculum, progress), ZeroPad(progress.curriculum, progress)
    return TransformedEnv(make_env("hand_v1", num_envs=num_envs, seed=seed), Compose(*stages))


def make_network(
    make: Callable[..., TensorDictModule], curriculum: Curriculum, hidden: int
) -> TensorDictModule:
    """Makes an actor or a critic; initial weights of inputs that the first stage does not use are 0."""
    shape = NetworkShape(hidden=hidden, norm="layer")
    network = make([curriculum.input_width], 3, shape=shape, in_keys=["input"])
    first = next(module for module in network.modules() if isinstance(module, StackedLinear))
    first.weight.data = zero_unused_inputs(first.weight.data, curriculum.first_inputs, alpha=0.0)
    return network


def make_buffer(options: Options, progress: CurriculumProgress) -> TensorDictReplayBuffer:
    """Makes a prioritized replay buffer that relabels transitions when they are written."""
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(options.capacity),
        sampler=PrioritizedSampler(
            options.capacity, alpha=options.priority_alpha, beta=options.priority_beta
        ),
        writer=HERWriter(
            progress.stage_of(0).reward_fn or GoalReward(0.1),
            k=options.k,
            strategy="future",
            filter_achieved=True,  # leaves out virtual goals that were achieved before the action
            exclude=("state", "input"),
        ),
        priority_key="td_error",
    )
    # ``input`` contains the goal, so it must be computed after relabeling.
    buffer.append_transform(ZeroPad(progress.curriculum, progress))
    return buffer


def train(options: Options) -> Iterator[Evaluation]:
    """Trains stage after stage, and yields an evaluation after each epoch."""
    torch.manual_seed(options.seed)
    progress = make_stages()
    progress.window, progress.success_threshold = options.window, options.success_threshold
    env = make_staged_env(progress, options.num_envs, options.seed)
    test_env = make_staged_env(progress, options.episodes, options.seed + 1_000_000)
    max_steps = 50

    actor = make_network(make_actor, progress.curriculum, options.hidden)
    critic = make_network(make_critic, progress.curriculum, options.hidden)
    low, high = -torch.ones(3), torch.ones(3)
    exploration = DecayingEpsilon(
        low, high, decay=options.epsilon_decay, end=options.epsilon_end, noise=options.noise
    )
    policy = TensorDictSequential(actor, exploration)
    loss = make_ddpg_loss(
        actor,
        critic,
        targets=Targets(gamma=options.gamma, reward_range=(-1.0, 0.0)),
        terms=ActorTerms(action_penalty=options.action_penalty),
    )
    optimizer = torch.optim.Adam(loss.parameters(), lr=options.learning_rate)
    target = make_target_updater(loss, tau=options.tau, hard_interval=0)
    learner = FusedLearner(loss, optimizer, target, max_grad_norm=options.max_grad_norm)
    average = PolicyAverage(actor, decay=options.ema_decay)  # steadier than the actor itself
    buffer = make_buffer(options, progress)
    buffer.set_rng(torch.Generator().manual_seed(options.seed))
    collector = Collector(
        env,
        policy,
        frames_per_batch=options.num_envs * options.steps_per_batch,
        total_frames=-1,
        auto_register_policy_transforms=False,
    )

    frames = updates = 0
    for epoch in range(1, options.epochs + 1):
        while frames < epoch * options.epoch_frames:
            batch = collector.next()
            buffer.extend(batch)  # writes finished episodes, each transition with real and k virtual goals
            frames += batch.numel()
            if frames < options.warmup_frames:
                updates = frames // options.frames_per_update
                continue
            steps = frames // options.frames_per_update - updates
            if len(buffer) > 0 and steps > 0:
                rows = buffer.sample(steps * options.batch_size)
                learner.update(rows, steps)  # ``steps`` gradient steps, each with ``batch_size`` of the rows
                average.follow(steps)
                buffer.update_tensordict_priority(rows)
            updates += steps
        exploration.step()
        achieved = success(evaluate(test_env, average.module, max_steps=max_steps)).float()
        yield Evaluation(frames, progress.stage_of(0).name, float(achieved.mean()))
        if progress.record(achieved.view(1, -1))[
            0
        ]:  # mean success in the window has reached the threshold: the next stage begins
            enter_stage(buffer, progress.stage_of(0), exploration)
            collector.reset()
            buffer.writer.end_episodes()
    collector.shutdown()
    test_env.close()


def main() -> None:
    """Trains with the options of the command line, and prints a line for each epoch."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    for name, default in vars(Options()).items():
        parser.add_argument(f"--{name}", type=type(default), default=default)
    torch.set_num_threads(1)
    began = time.perf_counter()
    for result in train(Options(**vars(parser.parse_args()))):
        seconds = time.perf_counter() - began
        print(f"{result.frames:7,} frames, {seconds:3.0f} s: {result.stage} {result.success:.0%}", flush=True)


if __name__ == "__main__":
    main()
