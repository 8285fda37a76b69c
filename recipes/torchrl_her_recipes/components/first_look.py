"""Facts about a task from random actions, before anything is trained."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from typing import Any, cast

import gymnasium
import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_her.goals.rewards import EnvReward, Outcome, ask_reward, is_achieved, missed, outcomes
from torchrl_her_envs.common.goal_env import GoalEnv, goal_env
from torchrl_her_envs.common.goal_rules import GoalEnds, say_once
from torchrl_her_envs.registry import GYM, get_task_spec
from torchrl_her_recipes.components.envs import TaskEnvs, action_bounds
from torchrl_her_recipes.config.options import AUTO
from torchrl_her_recipes.config.recipe import Recipe
from torchrl_her_recipes.config.resolve import TERMINATION, EnvFacts, auto_options, left_open, resolve

_AT_ONCE = 8
_STEPS = 3_000
SELDOM = 0.5  # goals change seldom if a smaller share of episodes changes them; Panda: 0.15 to 0.35
_FACTS: dict[str, tuple[object, EnvFacts]] = {}  # cached facts of each task, and the code that they are about
_SECONDS = 20.0  # seconds after which no further episodes begin
_FUTURE = 16  # number of later goals of the episode that each transition is tried with
_DIGITS = 1e-4  # two rewards with at most this relative difference count as equal
_TOUCH = 0.1  # quantile of the hand's distances in steps that move the object; nearer hands touch it
_NEAR = 0.5  # a touching hand is nearer to the object than this share of its distance in other steps
_FAR = 10.0  # rewards begin to grow at this multiple of the distance at which goals are achieved
_AWAY = 5.0  # a goal at more than this multiple is far away
_PAIRS = 32  # number of pairs of goals to estimate the distance below which a goal is achieved
_HALVINGS = 20

Meets = Callable[[Outcome, Tensor], Tensor]


@dataclass(frozen=True, kw_only=True)
class Facts:
    """Facts about a task from random actions.

    Attributes:
        steps, episodes: numbers of steps and of finished episodes.
        seconds: duration of one step.
        max_steps: length of an episode.
        actions: the least and the greatest value of each entry of actions; None if actions are discrete.
        scales: the least and the greatest standard deviation of entries of the observation.
        disagree: share of steps, except failures, whose reward differs from that of ``compute_reward``.
        achieved: share of the episodes in which the goal was achieved.
        moved: share of the episodes that achieve a goal that their first state does not achieve.
        kept: share of transitions with a later goal of the episode that the filter keeps.
        fallen: share of the episodes that terminated without the goal, as by a fall.
        constant: entries of the observation that never changed.
        goal_inside: entries of the observation that are the desired goal.
        own_stages: whether the task has a curriculum of its own.
        stages: stages that ``propose_stages`` returns; empty if it proposes none, or if rewards depend on
            more than goals.
        shaping: distances that ``propose_shaping`` returns; None also if rewards depend on more than goals,
            or if an episode achieved its goal or failed.
        ends: rule that ends an episode at its goal, and what the environment did at goals; None if the
            environment has such a rule for all goals.
    """

    steps: int
    episodes: int
    seconds: float
    max_steps: int
    actions: list[tuple[float, float]] | None
    scales: tuple[float, float]
    disagree: float
    achieved: float
    moved: float
    kept: float
    fallen: float
    constant: list[int]
    goal_inside: list[int]
    own_stages: bool
    stages: list[dict[str, Any]]
    shaping: list[float] | None
    ends: GoalEnds | None


def resolved(recipe: Recipe) -> Recipe:
    """Returns the recipe with a value for each option that is ``auto``, chosen from facts about the task.

    If environments are stepped one by one, random actions are taken if stages may have to be found, or if
    it is unknown what ends an episode at its goal. Stages are looked for if ``algo`` is ``auto``, or if the
    algorithm learns stages and neither the recipe nor the task has any. With ``algo=auto``, rewards of a
    gymnasium environment may be shaped. The recipe stores the result, so that a resumed run and other
    processes need not take random actions again.
    """
    auto = recipe.hindsight.algo == AUTO and recipe.demonstrations.episodes == 0
    needs_stages = auto or (recipe.hindsight.algorithm.curriculum and recipe.curriculum.stages is None)
    if not (auto_options(recipe) or left_open(recipe.task, TERMINATION) or needs_stages):
        return recipe
    known = f"{get_task_spec(recipe.task.name)} {recipe.task} {needs_stages} {auto}"
    code, facts = _FACTS.get(known, (None, None))
    if facts is None or code is not _code_of(recipe.task.name):
        with closing(_watched(TaskEnvs.of(recipe)).make(1, [0])) as env:
            task = goal_env(env)
            facts = EnvFacts(max_steps=task.max_steps, batched=task.batched)
            ends: GoalEnds | None = getattr(task, "goal_ends", None)
            needs_stages = needs_stages and (auto or not _has_stages(task))
        open_ends = ends is not None and ends.env_ends is None and left_open(recipe.task, TERMINATION)
        if (needs_stages or open_ends) and not facts.batched:
            look = look_at(recipe.replace(seed=0), seconds=None)
            stages = _needed_stages(look, auto) if needs_stages else None
            shaping = look.shaping if auto and stages is None else None
            facts, ends = replace(facts, stages=stages, shaping=shaping), look.ends
        if ends is not None and left_open(recipe.task, TERMINATION):
            facts = replace(facts, ends=ends.found() or "never")
            say_once(ends.line())
        _FACTS[known] = _code_of(recipe.task.name), facts
    return resolve(recipe, facts)


def _code_of(task: str) -> object:
    """Returns the object that makes a user's environment, which a notebook may define again."""
    if task.startswith(GYM):
        return gymnasium.registry.get(task.rpartition(":")[2])
    module, _, name = (task if ":" in task else get_task_spec(task).make).partition(":")
    return getattr(sys.modules.get(module), name, None)


def _watched(envs: TaskEnvs) -> TaskEnvs:
    """Returns ``envs`` with the environment's rewards of failures and, for ``termination=auto``, its ends."""
    ends = {TERMINATION: "watch"} if left_open(envs.task, TERMINATION) else {}
    options = {**(envs.task.options or {}), **ends} or None
    return replace(envs, task=replace(envs.task, options=options, failure="environment"))


def _needed_stages(facts: Facts, auto: bool) -> list[dict[str, Any]] | None:
    """Returns stages for a task, the same for each seed; None if none are found or needed.

    A task in which episodes end in failures gets no stages: a failure says nothing about the goals of an
    earlier stage. If ``algo`` is ``auto`` and chance often changes the achieved goal, none are needed.
    """
    if facts.fallen > 0 or (auto and facts.moved >= SELDOM):
        return None
    return facts.stages or None


def look_at(recipe: Recipe, *, steps: int = _STEPS, seconds: float | None = _SECONDS) -> Facts:
    """Takes random actions in the task of a recipe, and returns facts about the task.

    Args:
        recipe: recipe with the task, and with the seed of environments and actions.

    Keyword Args:
        steps: number of steps.
        seconds: time after which no further episodes begin; None for no limit.

    Raises:
        ValueError: the task cannot be made.

    Example:
        >>> from torchrl_her_recipes import make_recipe
        >>> look_at(make_recipe(task="hand_v1"), steps=800).moved < 0.5  # the ball lies still
        True
    """
    with (
        closing(_watched(TaskEnvs.of(recipe)).make(_AT_ONCE, [recipe.run.seed])) as env,
        torch.random.fork_rng(devices=[]),
    ):
        torch.manual_seed(recipe.run.seed)
        task, began = goal_env(env), time.perf_counter()
        played: list[TensorDictBase] = []
        while not played or (
            sum(len(trajectory) for trajectory in played) < steps
            and (seconds is None or time.perf_counter() - began < seconds)
        ):
            rows = env.rollout(task.max_steps, break_when_any_done=False)
            played += [episode for env_rows in rows.unbind(0) for episode in _episodes(env_rows)]
        duration = (time.perf_counter() - began) / sum(len(trajectory) for trajectory in played)
        low, high = (bound.tolist() for bound in action_bounds(env))
        discrete = env.action_spec.dtype == torch.int64
        return _facts(played, task, duration, None if discrete else list(zip(low, high, strict=True)))


def _episodes(rows: TensorDictBase) -> Iterator[TensorDictBase]:
    """Yields the episodes in an environment's rows [T]; the last episode may be unfinished."""
    begin = 0
    for end in (rows["next", "done"].flatten().nonzero().flatten() + 1).tolist():
        yield rows[begin:end]
        begin = end
    if begin < len(rows):
        yield rows[begin:]


def _facts(
    played: list[TensorDictBase], task: GoalEnv, seconds: float, actions: list[tuple[float, float]] | None
) -> Facts:
    rows = cast(TensorDictBase, torch.cat(cast(list[Tensor], played)))
    rule = EnvReward.of(task)

    def meets(achieved: Outcome, desired: Tensor) -> Tensor:
        """Returns whether goals are achieved, [...] of bool."""
        return ~missed(rule, achieved, desired)

    moved, some_kept, achieved, fallen = [], [], [], []
    for episode in played:
        goals = episode["next", "achieved_goal"]
        before = outcomes(rule, episode["achieved_goal"], episode)
        after = outcomes(rule, goals, episode["next"])
        some_kept.append(_kept(before, goals, meets))
        if not episode["next", "done"][-1]:
            continue  # the last episode, which was cut off
        moved.append(not bool(meets(before[:1], goals).all()))
        achieved.append(bool(meets(after, episode["next", "desired_goal"]).any()))
        last = episode["next"][-1:]
        fallen.append(bool(last["terminated"].all() and not is_achieved(last, rule).all()))
    reached = outcomes(rule, rows["next", "achieved_goal"], rows["next"])
    computed, reward = ask_reward(rule, reached, rows["next", "desired_goal"])[0], rows["next", "reward"]
    # A failure may have a penalty that ``compute_reward`` does not give.
    went_on = ~rows["next", "terminated"] | (computed >= task.achieved_reward)
    differ = went_on & ((reward - computed).abs() > _DIGITS * (1 + computed.abs()))
    observations = rows["observation"].double()
    spread = observations.std(0)
    moving = spread[spread > 0]
    count = len(moved)
    return Facts(
        steps=len(rows),
        episodes=count,
        seconds=seconds,
        max_steps=task.max_steps,
        actions=actions,
        scales=(float(moving.min()), float(moving.max())) if len(moving) else (0.0, 0.0),
        disagree=float(differ.float().mean()),
        achieved=sum(achieved) / count,
        moved=sum(moved) / count,
        kept=float(torch.cat(some_kept).float().mean()),
        fallen=sum(fallen) / count,
        constant=(spread == 0).nonzero().flatten().tolist(),
        goal_inside=_columns(observations, rows["desired_goal"].double()),
        own_stages=_has_stages(task),
        stages=[] if task.info_keys else propose_stages(rows, meets),
        shaping=None if task.info_keys or any(achieved) or any(fallen) else propose_shaping(rows, meets),
        ends=getattr(task, "goal_ends", None),
    )


def _has_stages(task: GoalEnv) -> bool:
    try:
        return len(task.stages()) > 1
    except ValueError:
        return False


def _kept(before: Outcome, after: Tensor, meets: Meets) -> Tensor:
    """Returns whether each transition has a later goal that was not achieved before it, [T] of bool."""
    steps = len(after)
    later = torch.linspace(0, 1, min(_FUTURE, steps))
    chosen = (
        torch.arange(steps)[:, None] + (later * (steps - 1 - torch.arange(steps))[:, None]).round().long()
    )
    goals = after[chosen]  # [T, later, g]
    return ~meets(before.unsqueeze(1), goals).all(-1)


def _columns(observations: Tensor, goal: Tensor) -> list[int]:
    """Finds g neighboring entries of observations [n, w] that always equal goals [n, g]; empty if none do."""
    width = goal.shape[-1]
    for first in range(observations.shape[-1] - width + 1):
        if torch.allclose(observations[:, first : first + width], goal, rtol=1e-5, atol=1e-6):
            return list(range(first, first + width))
    return []


def propose_stages(rows: TensorDictBase, meets: Meets) -> list[dict[str, Any]]:
    """Proposes a curriculum of two stages: bringing the hand to the object, then the task itself.

    The achieved goal, g numbers, is taken as the object's position; the observation must contain it. The hand
    is the g neighboring entries of the observation that are nearest to the object in steps that move it, and
    farther away in other steps. The first stage is achieved if the hand touches the object. Fingers around
    the object may come nearer than half of the distance at which the task's goals are achieved; in this case
    the threshold of the first stage is half of that distance.

    Args:
        rows: transitions [n] of random actions.
        meets: returns whether achieved goals [..., g] are the desired goals [..., g], as [...] of bool.

    Returns:
        Stages in the form of ``curriculum=FILE.yaml``; empty if no entries of the observation are a hand.
    """
    observations, goal = rows["observation"].double(), rows["achieved_goal"].double()
    width, wide = goal.shape[-1], observations.shape[-1]
    place = _columns(observations, goal)
    step = (rows["next", "achieved_goal"].double() - goal).norm(dim=-1)
    moving = step > 0.1 * step.max()
    if not place or not bool(step.max() > 0) or bool(moving.all()) or wide < 2 * width:
        return []
    gaps: dict[int, Tensor] = {}
    for first in range(wide - width + 1):
        entries = observations[:, first : first + width]
        if set(range(first, first + width)) & set(place) or bool((entries.std(0) == 0).any()):
            continue
        gaps[first] = (entries - goal).norm(dim=-1)
    touch = {first: float(gap[moving].quantile(_TOUCH)) for first, gap in gaps.items()}
    best = min(touch, key=touch.__getitem__, default=None)
    if best is None or touch[best] > _NEAR * float(gaps[best][~moving].median()):
        return []
    if (radius := _radius(rows, meets)) is None:
        return []
    others = [
        entry for entry in range(wide) if entry not in place
    ]  # without the object, which is the first stage's goal
    reach = {
        "observation": others,
        "achieved_goal": list(range(best, best + width)),
        "desired_goal": list(place),
    }
    task = {"observation": others + place, "achieved_goal": list(place), "desired_goal": "desired_goal"}
    around = float(gaps[best].min()) < radius / 2
    threshold = float(f"{radius / 2 if around else max(touch[best], radius):.2g}")
    return [{"name": "reach", **reach, "threshold": threshold}, {"name": "task", **task}]


def propose_shaping(rows: TensorDictBase, meets: Meets) -> list[float] | None:
    """Proposes rewards for being near goals that are small and far away.

    Args:
        rows: transitions [n] of random actions.
        meets: returns whether achieved goals [..., g] are the desired goals [..., g], as [...] of bool.

    Returns:
        The option ``shaping`` of a gymnasium environment: the distance at which goals are achieved, and ten
        times this distance. None if goals have no such distance, or if random actions come within five times
        of it in more than one of ten steps.
    """
    radius = _radius(rows, meets)
    away = (rows["achieved_goal"] - rows["desired_goal"]).double().norm(dim=-1)
    if radius is None or float(away.quantile(0.1)) < _AWAY * radius:
        return None
    return [float(f"{times * radius:.2g}") for times in (1.0, _FAR)]


def _radius(rows: TensorDictBase, meets: Meets) -> float | None:
    """Returns the distance within which goals count as achieved; None if it differs between goals."""
    achieved, desired = rows["achieved_goal"], rows["desired_goal"]
    far = ~meets(achieved, desired)
    achieved, desired = achieved[far][:_PAIRS], desired[far][:_PAIRS]
    if not len(achieved) or not bool(meets(desired, desired).all()):
        return None
    near, away = torch.zeros(len(desired), 1), torch.ones(len(desired), 1)
    for _ in range(_HALVINGS):
        middle = (near + away) / 2
        met = meets(desired + middle * (achieved - desired), desired)[:, None]
        near, away = torch.where(met, middle, near), torch.where(met, away, middle)
    radius = (near * (achieved - desired)).norm(dim=-1)
    return float(radius.mean()) if float(radius.max() - radius.min()) < 0.05 * float(radius.mean()) else None
