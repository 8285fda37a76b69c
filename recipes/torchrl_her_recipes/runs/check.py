"""Derives advice on options from facts that random actions show about a task."""

from __future__ import annotations

from typing import Any

from torchrl_her_recipes.components.first_look import SELDOM, Facts, resolved
from torchrl_her_recipes.config.algorithms import Algorithm
from torchrl_her_recipes.config.recipe import Recipe
from torchrl_her_recipes.config.resolve import SHAPING, left_open

_UNLIKE = 100  # ratio of scales above which observations need normalization
_SLOW = 5e-3  # seconds of a step above which an environment is slow; a gradient step takes about as long
_MOSTLY = 0.5  # fraction of achieved goals above which success says little about learning
_ROUNDED = 0.005  # fraction below which a percentage would be rounded to 0%

_STILL = (
    "random actions change the achieved goal, by the reward, in {moved} of the episodes: most virtual goals "
    "are achieved already, and the filter keeps others for {facts.kept:.1%} of the transitions."
)


def advice(facts: Facts, recipe: Recipe, stages_file: str = "stages.yaml") -> list[str]:
    """Returns a line for each problem that the facts show, with the options that help.

    Args:
        facts: Facts that :func:`look_at` returned.
        recipe: Recipe of the planned run.
        stages_file: Name of the file in which proposed stages are saved, for the text of the advice.
    """
    recipe, lines = resolved(recipe), []
    if facts.disagree:
        lines.append(
            f"in {_percent(facts.disagree)} of the steps, the reward differs from compute_reward, which "
            "virtual transitions use: if compute_reward reads info, name its keys "
            "(task.options.info_keys=[KEY])"
        )
    if facts.goal_inside:
        lines.append(
            f"entries {facts.goal_inside[0]} to {facts.goal_inside[-1]} of the observation are the desired "
            "goal, but relabeling does not change the observation: leave them out"
        )
    if facts.moved < SELDOM:
        remedy = _remedy(facts, recipe.hindsight.algorithm, recipe.curriculum.stages, stages_file)
        lines.append(f"{_STILL.format(facts=facts, moved=_percent(facts.moved))} {remedy}")
    elif facts.shaping and left_open(recipe.task, SHAPING):
        lines.append(
            "random actions never come near a goal: higher rewards near it help "
            f"(task.options.{SHAPING}=[{','.join(map(str, facts.shaping))}])"
        )
    if not facts.moved:
        lines.append("by the reward, achieved_goal never changed: does it hold what the goal is about?")
    if facts.fallen and recipe.task.failure == "environment":
        lines.append(
            f"{facts.fallen:.1%} of the episodes terminate without the goal: with a reward of -1 for each "
            "step, a policy learns to fail early. failure=never_pays prevents this"
        )
    if not recipe.learner.normalize and facts.scales[1] > _UNLIKE * facts.scales[0]:
        lines.append("entries of the observation are of very different scales: normalize=true")
    if facts.seconds > _SLOW and recipe.collection.processes == 0:
        lines.append(
            f"a step takes {1e3 * facts.seconds:.0f} ms, longer than a gradient step: with "
            "processes=2, two processes collect while the main process learns"
        )
    if facts.achieved > _MOSTLY:
        lines.append(
            f"random actions achieve {facts.achieved:.0%} of the goals: only more success shows learning"
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
