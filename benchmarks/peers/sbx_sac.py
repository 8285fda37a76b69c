"""SBX's SAC, the JAX twin of Stable-Baselines3's, with the HER of Stable-Baselines3."""

from __future__ import annotations

from sbx import SAC

from peers.baselines import make_envs, options, steps_each
from torchrl_her_recipes import Recipe

ENTROPY = 0.05  # what the return of a step is worth beside its entropy: the fixed one that does best on Push


def make_sac(recipe: Recipe) -> SAC:
    """A model that trains as the recipe says, in as many environments, for comparing what is learned.

    It keeps real rows only, relabels while it samples, and has no prioritized replay.

    Args:
        recipe: what to be like.
    """
    return SAC(
        env=make_envs(recipe),
        train_freq=(1, "step"),
        gradient_steps=steps_each(recipe),
        learning_starts=recipe.collection.warmup_frames,
        ent_coef=ENTROPY,
        **options(recipe),
    )
