"""Finds options that have no effect because of other options of a recipe, so that they can be refused."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import fields

from torchrl_her_envs.registry import get_task_spec
from torchrl_her_recipes.config.choices.behavior import Proposed
from torchrl_her_recipes.config.groups import Groups


def without_effect(groups: Groups) -> dict[tuple[str, str], str]:
    """Returns the options that have no effect, as (group, name), each with the reason ("with k=0")."""
    idle = {
        (group, name): why
        for group, section in vars(groups).items()
        for name, why in section.idle_options().items()
    }
    for holds, why, options in _rules(groups):
        for group, _, name in (option.partition(".") for option in options if holds):
            idle |= {(group, name): why} if hasattr(getattr(groups, group), name) else {}
    return idle


def _rules(groups: Groups) -> Iterator[tuple[bool, str, Iterable[str]]]:
    """Yields rules: whether a condition holds, its text for messages, and options without effect then."""
    algorithm = groups.hindsight.algorithm
    learner, sources = groups.learner, groups.hindsight.sources
    takes, with_task = get_task_spec(groups.task.name).options, f"with task={groups.task.name}"
    yield "threshold" not in takes, with_task, ["task.threshold"]
    # Tasks without this option terminate episodes only at their goals, so there are no failures.
    yield "termination" not in takes, with_task, ["task.failure"]
    yield "dtype" not in takes, with_task, ["run.dtype"]

    mixed = algorithm.virtual and groups.hindsight.goal_sources is not None
    yield mixed, "with goal_sources", ["hindsight.k", "hindsight.strategy"]
    with_algo = f"with algo={algorithm.name}"
    of_filter = ["hindsight.redraw", "hindsight.refill"]
    yield not algorithm.filter, with_algo, of_filter
    relabeling = ["hindsight.strategy", *of_filter, "evaluation.virtual_goals", *_options(groups, "weights")]
    yield not sources, "with k=0", relabeling
    yield not algorithm.virtual, with_algo, [*relabeling, "hindsight.k", "hindsight.goal_sources"]

    yield not learner.has_epsilon, f"with learner={learner.name}", ["order.stage_epsilon"]
    stages = [*_options(groups, "curriculum"), "order.name", *_options(groups, "order")]
    yield not algorithm.curriculum, with_algo, stages
    greedy = getattr(learner, "epsilon_start", None) == 0.0 and not algorithm.curriculum
    yield greedy, "with epsilon_start=0", ["learner.action_noise", "learner.uniform_share"]
    cloning = ["demonstrations.bc_weight", "demonstrations.q_filter"]
    yield not learner.clones, f"with learner={learner.name}", cloning
    others = set(_options(groups, "behavior")) - {"behavior.real_share"}
    yield getattr(groups.behavior, "real_share", 0.0) == 1.0, "with real_share=1", others
    processes, behavior = groups.collection.processes, groups.behavior
    yield processes > 0, f"with processes={processes}", ["demonstrations.starts_share"]
    yield isinstance(behavior, Proposed), f"with behavior={behavior.name}", ["demonstrations.starts_share"]
    on_gpu = not learner.device.startswith(("cpu", "auto"))
    yield on_gpu, f"with learner.device={learner.device}", ["learner.matmul_dtype"]
    yield groups.run.dtype == "float64", "with dtype=float64", ["learner.matmul_dtype"]


def _options(groups: Groups, group: str) -> list[str]:
    return [f"{group}.{option.name}" for option in fields(getattr(groups, group))]
