"""Advice on options from random actions on a task."""

from __future__ import annotations

from typing import Any

from torchrl_her_recipes.components.first_look import Facts, resolved
from torchrl_her_recipes.config.algorithms import Algorithm
from torchrl_her_recipes.config.recipe import Recipe

_SELDOM = 0.5  # fraction of the episodes below which something happens seldom
_UNLIKE = 100  # ratio of scales above which observations need normalization
_SLOW = 5e-3  # seconds of a step in a slow environment: about the time of a gradient step
_MOSTLY = 0.5
_ROUNDED = 0.005

_STILL = (
    "random actions change the achieved goal, by the reward, in {moved} of the episodes: most virtual goals "
    "are achieved already, and the filter keeps others for {facts.kept:.1%} of the transitions."
)


def advice(facts: Facts, recipe: Recipe, stages_file: str = "stages.yaml") -> list[str]:
    """Returns a line for each problem that the facts show, with the options to set.

    Args:
        facts: Facts of :func:`look_at`.
        recipe: Recipe of the planned run.
        stages_file: File of the proposed stages.
    """
    recipe, lines = resolved(recipe), []
    if facts.disagree:
        lines.append(
            f"{_percent(facts.disagree)} of the steps have another reward than compute_reward gives, and "
            "virtual transitions lack the difference: if compute_reward reads info, name its keys "
            "(task.options.info_keys=[KEY])"
        )
    if facts.goal_inside:
        lines.append(
            f"entries {facts.goal_inside[0]} to {facts.goal_inside[-1]} of the observation are the desired "
            "goal, which relabeling cannot change there: leave them out of the observation"
        )
    if facts.moved < _SELDOM:
        remedy = _remedy(facts, recipe.hindsight.algorithm, recipe.curriculum.stages, stages_file)
        lines.append(f"{_STILL.format(facts=facts, moved=_percent(facts.moved))} {remedy}")
    if not facts.moved:
        lines.append("by the reward, achieved_goal never changed: does it hold what the goal is about?")
    if facts.fallen and recipe.task.failure == "environment":
        lines.append(
            f"{facts.fallen:.1%} of the episodes terminate without the goal: if each step costs a reward of "
            "-1, ending soon is the best. With failure=never_pays it is not"
        )
    if not recipe.learner.normalize and facts.scales[1] > _UNLIKE * facts.scales[0]:
        lines.append("entries of the observation are of very different scales: normalize=true")
    if facts.seconds > _SLOW and recipe.collection.processes == 0:
        lines.append(
            f"a step takes {1e3 * facts.seconds:.0f} ms, more than learning from it: processes=2 lets two "
            "processes collect beside the learner"
        )
    if facts.achieved > _MOSTLY:
        lines.append(
            f"random actions achieve {facts.achieved:.0%} of the goals: such a success rate shows no learning"
        )
    return lines


def _percent(share: float) -> str:
    """Formats a fraction as a percentage; a fraction above 0 never becomes 0%."""
    return "less than 1%" if 0 < share < _ROUNDED else f"{share:.0%}"


def _remedy(facts: Facts, algorithm: Algorithm, stages: Any, stages_file: str) -> str:
    demonstrations = "demonstrations (demonstrations.file=FILE)"
    if algorithm.curriculum and algorithm.filter:
        goals = (
            stages and f", whose first goals are for entries {stages[0]['achieved_goal']} of the observation"
        )
        return f"This recipe has a curriculum{goals or ''}; {demonstrations} help, too"
    if facts.own_stages:
        return f"What helps: the task's own curriculum (algo=cher) or {demonstrations}"
    if facts.stages:
        inside = facts.stages[0]["achieved_goal"]
        return (
            f"What helps: a curriculum that first brings entries {inside[0]} to {inside[-1]} of the "
            f"observation near it (algo=cher curriculum={stages_file}) or {demonstrations}"
        )
    return f"What helps: a curriculum (algo=cher curriculum=FILE) or {demonstrations}"
