"""Options that have no effect together with others. They are refused by name, so that nobody tunes them."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

from torchrl_her_envs.registry import get_task_spec
from torchrl_her_recipes.config.algorithms import get_algorithm
from torchrl_her_recipes.config.options import AUTO

WEIGHTS = ("ibs", "novelty")  # the groups of options of weights of goals
FILTER = ("redraw", "refill")  # options that go by the filter of achieved goals


def without_effect(groups: Any) -> dict[tuple[str, str], str]:
    """The options that have no effect, as (group, name), and with what they have none.

    Args:
        groups: a recipe, or any object with its groups as attributes.
    """
    algorithm = get_algorithm(groups.hindsight.algo)
    idle: dict[tuple[str, str], str] = {}

    def all_of(group: str, why: str, *, but: tuple[str, ...] = ()) -> None:
        for own in fields(getattr(groups, group)):
            if own.name not in but:
                idle[group, own.name] = why

    task = groups.task.name
    for group, name, taken in (
        ("task", "threshold", "threshold"),
        ("task", "failure", "termination"),  # tasks of this package end at their goals alone
        ("run", "dtype", "dtype"),
    ):
        if taken not in get_task_spec(task).options:
            idle[group, name] = f"with task={task}"
    with_algo = f"with algo={algorithm.name}"
    if not algorithm.hindsight:
        for name in ("k", "strategy", "goal_sources", *FILTER):
            idle["hindsight", name] = with_algo
        for group in WEIGHTS:
            all_of(group, with_algo)
    elif not groups.hindsight.sources:
        for name in ("strategy", *FILTER):
            idle["hindsight", name] = "with k=0"
        for group in WEIGHTS:
            all_of(group, "with k=0")
    elif algorithm.weights:
        if (reads := algorithm.reads) is not None:
            for group in WEIGHTS:
                all_of(
                    group,
                    with_algo,
                    but=tuple(own.partition(".")[2] for own in reads if own.startswith(f"{group}.")),
                )
    else:
        all_of("novelty", with_algo)
        if algorithm.instructive is None:
            all_of("ibs", with_algo, but=("cells", "recent"))  # the goals of HER are counted, too
        elif groups.ibs.estimator == "kernel":
            for name in ("cells", "recent", "floor_is_relative"):
                idle["ibs", name] = "with estimator=kernel"
        if algorithm.instructive == "sequential":
            idle["ibs", "floor"] = idle["ibs", "floor_is_relative"] = with_algo
    if not algorithm.filter_achieved:
        for name in FILTER:
            idle["hindsight", name] = with_algo
    if algorithm.hindsight and groups.hindsight.goal_sources not in (None, AUTO):
        idle["hindsight", "k"] = idle["hindsight", "strategy"] = "with goal_sources"
    if not algorithm.curriculum:
        all_of("curriculum", with_algo)
    elif not groups.learner.has_epsilon:
        idle["curriculum", "layer_epsilon"] = f"with learner={groups.learner.name}"
    if algorithm.curriculum and groups.curriculum.guided_share == 0:
        idle["curriculum", "guided_per"] = "with guided_share=0"
    if algorithm.curriculum and groups.curriculum.order != "threshold":
        for name in ("window", "success_threshold", "layer_epsilon"):
            idle["curriculum", name] = f"with order={groups.curriculum.order}"
    behavior = groups.behavior.name
    if behavior == "real":
        all_of("behavior", "with behavior=real", but=("name",))
    elif behavior != "mega":
        idle["behavior", "cutoff"] = f"with behavior={behavior}"
    if behavior == "uniform_achieved":
        idle["behavior", "candidates"] = "with behavior=uniform_achieved"
    if behavior != "real" and groups.behavior.real_share == 1.0:
        for name in ("candidates", "goal_memory", "cutoff"):
            idle["behavior", name] = "with real_share=1"
    if not algorithm.hindsight or not groups.hindsight.sources:
        idle["evaluation", "virtual_goals"] = with_algo if not algorithm.hindsight else "with k=0"
    if behavior == "ibs":  # its goals are weighted by IBS, whatever virtual ones are
        idle = {own: why for own, why in idle.items() if own[0] != "ibs"}
        if groups.ibs.estimator == "kernel":
            idle["ibs", "cells"] = idle["ibs", "recent"] = "with estimator=kernel"
    shown = groups.demonstrations
    if shown.episodes == 0:
        all_of("demonstrations", "with demonstrations.episodes=0", but=("episodes",))
    else:
        if shown.share == 0:
            for name in ("bc_weight", "q_filter"):
                idle["demonstrations", name] = "with demonstrations.share=0"
        elif not groups.learner.clones:
            for name in ("bc_weight", "q_filter"):
                idle["demonstrations", name] = f"with learner={groups.learner.name}"
        elif shown.bc_weight == 0:
            idle["demonstrations", "q_filter"] = "with demonstrations.bc_weight=0"
        if shown.starts_share == 0:
            for own in fields(shown):
                if own.name.startswith("starts_"):
                    idle["demonstrations", own.name] = "with demonstrations.starts_share=0"
        elif groups.collection.processes > 0:
            processes = groups.collection.processes
            idle["demonstrations", "starts_share"] = f"with processes={processes}"
    if groups.collection.processes == 0:
        idle["collection", "sync"] = "with processes=0"
    if groups.replay.sampler != "prioritized":
        for name in ("priority_alpha", "priority_beta", "priority_beta_end"):
            idle["replay", name] = f"with sampler={groups.replay.sampler}"
    if not groups.learner.normalize:
        for name in ("normalize_clip", "normalize_least_std"):
            idle["learner", name] = "with normalize=false"
    if groups.learner.compile == "never":
        idle["learner", "products"] = "with compile=never"
    elif not groups.learner.device.startswith(("cpu", "auto")):
        idle["learner", "products"] = f"with learner.device={groups.learner.device}"
    elif groups.run.dtype == "float64":
        idle["learner", "products"] = "with dtype=float64"
    elif groups.learner.norm == "batch":
        idle["learner", "products"] = "with norm=batch"
    elif groups.learner.hidden < 32:
        idle["learner", "products"] = "with hidden below 32"
    if getattr(groups.learner, "uniform_share", None) == 1.0:
        idle["learner", "action_noise"] = "with uniform_share=1"
    if getattr(groups.learner, "epsilon_start", None) == 0.0 and not algorithm.curriculum:
        for name in ("action_noise", "uniform_share"):
            if hasattr(groups.learner, name):
                idle["learner", name] = "with epsilon_start=0"
    if groups.learner.hard_update_interval > 0:
        idle["learner", "tau"] = "with hard target updates"
    return idle
