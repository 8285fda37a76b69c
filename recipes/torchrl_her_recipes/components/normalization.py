"""Normalization of the inputs of networks."""

from __future__ import annotations

from collections.abc import Mapping

from tensordict.nn import TensorDictModuleBase

from torchrl_her.modules.normalization import RunningNorm
from torchrl_her.modules.normalized import NormalizedPolicy
from torchrl_her_recipes.config.choices.learners import LearnerConfig


def make_norm(options: LearnerConfig, widths: Mapping[str, int], *, runs: int) -> RunningNorm | None:
    """The statistics of each run, before anything was counted; None if the learner does not normalize."""
    if not options.normalize:
        return None
    return RunningNorm(
        dict(widths), runs=runs, clip=options.normalize_clip, least_std=options.normalize_least_std
    )


def acting(actor: TensorDictModuleBase, norm: RunningNorm | None) -> TensorDictModuleBase:
    """An actor as it plays, on what environments show."""
    return actor if norm is None else NormalizedPolicy(actor, norm)
