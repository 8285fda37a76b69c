"""SAC of SBX (Stable-Baselines in JAX), with the HER of Stable-Baselines3."""

from __future__ import annotations

from sbx import SAC

from peers.baselines import make_envs, options, steps_each
from torchrl_her_recipes import Recipe

ENTROPY = 0.05  # entropy coefficient (weight of entropy beside reward): the best fixed value on FetchPush


def make_sac(recipe: Recipe) -> SAC:
    """Makes SAC with the options and the number of environments of a recipe, to compare success.

    It stores real rows only, relabels while it samples, and has no prioritized replay.

    Args:
        recipe: recipe whose options the model gets.
    """
    return SAC(
        env=make_envs(recipe),
        train_freq=(1, "step"),
        gradient_steps=steps_each(recipe),
        learning_starts=recipe.collection.warmup_frames,
        ent_coef=ENTROPY,
        **options(recipe),
    )
