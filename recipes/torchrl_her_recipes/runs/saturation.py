"""Notices runs whose actor is stuck: nearly all greedy actions at their bounds, and hardly any success."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from torchrl_her_recipes.config.recipe import Recipe

_AT_BOUND = 0.99  # of the way from the middle of the range to its end
_NEARLY_ALL = 0.95  # of the entries of all actions
_EPOCHS = 3  # in a row
_LITTLE = 0.5  # success from which on full speed may well be the right policy


def saturation(action: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """The share of an action's entries that are at their bounds.

    Args:
        action: [..., a].
        low: [a], the least action; with an infinite bound, an entry is never at it.
        high: [a], the greatest action.

    Returns:
        [...], from 0 to 1.

    Example:
        >>> import torch
        >>> high = torch.tensor([1.0, 2.0])
        >>> saturation(torch.tensor([[1.0, 0.0], [-0.995, 2.0]]), -high, high)
        tensor([0.5000, 1.0000])
    """
    middle, half = (high + low) / 2, (high - low) / 2
    bounded = half.isfinite()
    return (((action - middle).abs() >= _AT_BOUND * half) & bounded).float().mean(-1)


def saturation_notices(rows: Sequence[dict[str, float]], recipe: Recipe) -> list[str]:
    """One line for each run of which the newest epoch shows for the first time that it is stuck.

    An actor that ends in tanh gets almost no gradient where its actions are at their bounds, so it may stay
    there for the rest of the run. Since such actions are the best ones in some tasks, the line comes only if
    success is low as well, three epochs in a row.

    Args:
        rows: the table of metrics so far, one row for each epoch and run.
        recipe: of the runs.

    Returns:
        The lines; none where actions are discrete.
    """
    runs: dict[float, list[dict[str, float]]] = {}
    for row in rows:
        runs.setdefault(row["run"], []).append(row)
    return [_line(own[-1], recipe) for own in runs.values() if _first_stuck(own) == len(own)]


def _first_stuck(rows: Sequence[dict[str, float]]) -> int:
    """After how many epochs a run was stuck for the first time; 0 for never."""
    streak = 0
    for count, row in enumerate(rows, start=1):
        success = row.get("layer_success", row["success"])  # in a curriculum, at what is learned now
        stuck = row.get("saturation", 0.0) >= _NEARLY_ALL and success < _LITTLE
        streak = streak + 1 if stuck else 0
        if streak == _EPOCHS:
            return count
    return 0


def _line(row: dict[str, float], recipe: Recipe) -> str:
    learner, envs = recipe.learner, recipe.collection.num_envs
    penalty = getattr(learner, "action_penalty", None)
    success = row.get("layer_success", row["success"])
    helps = [f"learning_rate below {learner.learning_rate:g}", f"num_envs above {envs}"]
    if penalty is not None:
        helps.insert(0, f"action_penalty above {penalty:g}")
    return (
        f"seed {row['seed']:.0f}: nearly all greedy actions have been at their bounds for {_EPOCHS} epochs "
        f"(now {row['saturation']:.0%}), with {success:.0%} success; this actor may not learn any more. "
        f"What helps: {', '.join(helps[:-1])} or {helps[-1]}"
    )
