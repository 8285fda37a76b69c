"""Writing a run's policy as a file of its own."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, get_args

from tensordict import TensorDictBase
from torch import Tensor

from torchrl_her.trainers.checkpoint import save_checkpoint
from torchrl_her.trainers.metrics import reached, success
from torchrl_her.trainers.trainer import evaluate
from torchrl_her_envs.common.goal_env import goal_env
from torchrl_her_recipes.components.envs import judging, make_task_envs
from torchrl_her_recipes.config.imports import permit_task
from torchrl_her_recipes.config.shipped import policy_names
from torchrl_her_recipes.runs.exported.card import KEYS, PolicyCard, present_versions
from torchrl_her_recipes.runs.exported.model_card import card_path, check_free, write_model_card
from torchrl_her_recipes.runs.exported.onnx_export import write_onnx
from torchrl_her_recipes.runs.exported.onnx_file import SUFFIX, need_onnx
from torchrl_her_recipes.runs.kept import KeptPolicy
from torchrl_her_recipes.runs.policies import (
    TrainedPolicy,
    load_trained,
    policy_of_run,
    read_card,
    read_weights,
)

Format = Literal["torch", "onnx"]


def export_policy(
    source: str | Path,
    out: str | Path,
    *,
    run: int | None = None,
    task: str | None = None,
    best: bool = False,
    format: Format | None = None,
    card: bool = True,
) -> TrainedPolicy:
    """Writes the policy of a finished run as a small file of its own, and a page about it.

    Args:
        source: the folder of the run, or ``policy.pt`` or ``best.pt`` in it; or the .pt file of an exported
            policy or the name of one that comes with the package, to write it in another format.
        out: the file.

    Keyword Args:
        run: which one, of several side by side in a folder; the median of them if None.
        task: that the policy is for, if not the run's own: one that shows and wants the same.
        best: whether to take the policy of the evaluation with the best median success, not the last.
        format: ``"torch"`` (.pt), or ``"onnx"`` (.onnx), which onnxruntime plays; None: as the file's suffix
            says. An ONNX file is only left behind if onnxruntime gives the same actions to 1e-5 on states of
            the task.
        card: whether a model card is written beside the file, with the suffix .md.

    Returns:
        What was written.

    Raises:
        ValueError: there is neither such a run nor such a policy, the learner's policy cannot be exported,
            it has no best policy, the task is one that it cannot play or names a module that must not be
            imported, the suffix is that of another format, or the written file does not act as the policy
            does.
        ImportError: the format is ONNX, and the extra ``onnx`` is missing.
        OSError: the run has not saved a policy yet, or the file cannot be written.
    """
    out, page = Path(out), card_path(out)
    as_onnx = _format_of(out, format) == "onnx"
    if as_onnx:
        need_onnx(writes=True)  # before anything takes long
    if card:
        check_free(page)
    kept = KeptPolicy.of(source, best=best)
    if kept is not None:
        policy, weights = _policy_of_run(kept, run, task)
    else:
        policy, weights = _policy_of_file(source, run, task)
    own = policy.card
    if as_onnx:
        write_onnx(policy.actor, own, policy.recipe, out, states=played_states(policy))
    else:
        state = {"card": _plain(own), "recipe": policy.recipe.to_dict(), "actor": weights}
        save_checkpoint(state, out)
    if card:
        write_model_card(page, out.name, read_card(out), policy.recipe)
    return policy


def measure_success(
    policy: TrainedPolicy, *, episodes: int = 1_000, seed: int = 1 << 41
) -> tuple[float, float]:
    """Shares of greedy episodes in which a policy's goal is achieved at the last step, and at some step."""
    env = make_task_envs(policy.recipe.replace(task=policy.task), episodes, [seed], scaled=False)
    rollout = evaluate(env, policy.actor, max_steps=goal_env(env).max_steps)
    at_last, at_some = (measure(rollout, **judging(env)).float().mean() for measure in (success, reached))
    env.close()
    return float(at_last), float(at_some)


def played_states(policy: TrainedPolicy, *, episodes: int = 16, seed: int = 1 << 42) -> TensorDictBase:
    """What a policy sees in some greedy episodes of its task, [rows]."""
    env = make_task_envs(policy.recipe.replace(task=policy.task), episodes, [seed], scaled=False)
    rollout = evaluate(env, policy.actor, max_steps=goal_env(env).max_steps)
    env.close()
    return rollout.select(*KEYS).flatten()


def _format_of(out: Path, format: Format | None) -> Format:
    """The format of a file that is asked for.

    Raises:
        ValueError: there is no such format, or the suffix is that of another one.
    """
    by_suffix: Format = "onnx" if out.suffix == SUFFIX else "torch"
    if format not in (None, *get_args(Format)):
        raise ValueError(f"format must be one of {', '.join(get_args(Format))}, got {format!r}")
    if format is not None and format != by_suffix:
        wanted = SUFFIX if format == "onnx" else ".pt"
        raise ValueError(f"a file of format={format} must have the suffix {wanted}, got {out.name!r}")
    return by_suffix


def _policy_of_run(
    kept: KeptPolicy, run: int | None, task: str | None
) -> tuple[TrainedPolicy, dict[str, Tensor]]:
    """A policy of a run's folder, measured, and its weights."""
    if task is not None:
        permit_task(task)
    policy, weights = policy_of_run(kept, run)
    return _for_task(policy, task or policy.task), weights


def _policy_of_file(
    name: str | Path, run: int | None, task: str | None
) -> tuple[TrainedPolicy, dict[str, Tensor]]:
    """An exported policy, and its weights."""
    if not (str(name) in policy_names() or Path(name).is_file()):
        raise ValueError(f"{name} is no folder of a run: it has no config.yaml")
    if run is not None:
        raise ValueError(f"run={run} has no effect with {name}, which holds a single policy: leave it out")
    if Path(name).suffix == SUFFIX:
        raise ValueError(
            f"{name} cannot be exported again: its weights are part of a graph; export the .pt file"
        )
    policy = load_trained(name)
    policy = replace(policy, card=replace(policy.card, versions=present_versions()))
    if task is not None and task != policy.task:
        permit_task(task)
        policy = _for_task(policy, task)
    return policy, read_weights(name)


def _for_task(policy: TrainedPolicy, task: str) -> TrainedPolicy:
    """A policy for a task, and its success there.

    Raises:
        ValueError: the task shows or wants something else than what the policy reads and writes.
    """
    if task != policy.task:
        policy.card.check_plays(make_task_envs(policy.recipe.replace(task=task), 1, [0], scaled=False), task)
    policy = replace(policy, card=replace(policy.card, task=task))
    at_last, at_some = measure_success(policy)
    return replace(policy, card=replace(policy.card, success=at_last, reached=at_some))


def _plain(card: PolicyCard) -> dict[str, Any]:
    return json.loads(json.dumps(card.to_dict()))  # lists for tuples
