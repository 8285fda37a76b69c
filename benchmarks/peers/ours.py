"""This project's learners, and TorchRL's own loss and buffer in this project's training loop."""

from __future__ import annotations

import math
from typing import ClassVar

from torchrl_her import LossLearner, Trainer
from torchrl_her_recipes import Recipe, build


class Ours:
    """This project's trainer with DDPG, as ``torchrl-her train`` makes it from a recipe."""

    name: ClassVar[str] = "this, DDPG"
    differs: ClassVar[str] = (
        "prioritized replay, gradients clipped by norm, targets clamped to possible returns, an action L2 "
        "penalty; virtual transitions are made when an episode is stored; `batches_per_sample` gradient "
        "steps in a draw."
    )

    def __init__(self, recipe: Recipe) -> None:
        self.trainer = self.make(recipe)

    def make(self, recipe: Recipe) -> Trainer:
        return build(recipe).trainer()

    @property
    def updates(self) -> int:
        return self.trainer.updates

    # A trainer has no public method for gradient steps alone, so two private names are used.

    def fill(self, frames: int) -> None:
        self.trainer.warmup_frames = math.inf
        self.trainer.run(frames)
        self.trainer.warmup_frames = 0
        self.trainer._credit = 0.0  # skips the gradient steps that these frames would earn

    def gradient_steps(self, steps: int) -> int:
        before = self.updates
        self.trainer._credit = float(steps)
        self.trainer._learn()
        return self.updates - before

    def loop(self, frames: int) -> int:
        before = self.trainer.frames
        self.trainer.run(frames)
        return self.trainer.frames - before


class OursHalf(Ours):
    """This project's trainer with DDPG and matrix products in bfloat16."""

    name: ClassVar[str] = "this, DDPG, bfloat16"
    differs: ClassVar[str] = (
        "as our DDPG, with `matmul_dtype=bfloat16`: products between hidden layers are of three digits."
    )

    def make(self, recipe: Recipe) -> Trainer:
        return super().make(recipe.replace(matmul_dtype="bfloat16"))


class OursTD3(Ours):
    """This project's trainer with TD3."""

    name: ClassVar[str] = "this, TD3"
    differs: ClassVar[str] = "as our DDPG, with two critics and smoothed targets."

    def make(self, recipe: Recipe) -> Trainer:
        return super().make(recipe.replace(learner="td3"))


class OursSAC(Ours):
    """This project's trainer with SAC."""

    name: ClassVar[str] = "this, SAC"
    differs: ClassVar[str] = "as our TD3, with a stochastic actor and a learned temperature."

    def make(self, recipe: Recipe) -> Trainer:
        return super().make(recipe.replace(learner="sac"))


class TorchRLPieces(Ours):
    """TorchRL's loss module, autograd, optimizer and buffer; samples the buffer for each gradient step."""

    name: ClassVar[str] = "TorchRL's loss and buffer"
    differs: ClassVar[str] = (
        "the same algorithm as our DDPG, through TorchRL's loss module and autograd, with one draw from the "
        "replay buffer for each gradient step."
    )

    def make(self, recipe: Recipe) -> Trainer:
        components = build(recipe.replace(batches_per_sample=1))
        trainer = components.trainer()
        trainer.learner = LossLearner(
            components.loss,
            components.optimizer,
            components.target,
            max_grad_norm=recipe.learner.max_grad_norm,
            runs=recipe.run.num_runs,
        )
        return trainer
