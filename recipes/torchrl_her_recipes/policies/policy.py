"""The class :class:`Policy`, a trained policy from a run, a file or the package, and its export."""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import closing
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase

from torchrl_her.goals.rewards import EnvReward
from torchrl_her.modules.networks import take_run
from torchrl_her.trainers.metrics import reached, success
from torchrl_her.trainers.trainer import evaluate
from torchrl_her_envs.common.goal_env import goal_env
from torchrl_her_recipes.components.agents import find_learner, shape_of
from torchrl_her_recipes.components.curricula import make_curriculum
from torchrl_her_recipes.components.envs import TaskEnvs, evaluation_envs, play_episodes
from torchrl_her_recipes.config.imports import permit_task
from torchrl_her_recipes.config.plain_files import naming
from torchrl_her_recipes.config.policy_header import POLICY_SUFFIX
from torchrl_her_recipes.config.recipe import Recipe
from torchrl_her_recipes.config.shipped import find_policy, policy_files
from torchrl_her_recipes.policies.info import KEYS, PolicyInfo, describe_env, present_versions
from torchrl_her_recipes.policies.model_card import card_path, check_free, write_model_card
from torchrl_her_recipes.policies.network import load_network
from torchrl_her_recipes.policies.onnx import SUFFIX, need_onnx, write_onnx
from torchrl_her_recipes.runs.folder import RunFolder
from torchrl_her_recipes.runs.policy_file import read_policy, write_policy
from torchrl_her_recipes.runs.scores import median_run

_MEASURED = 1 << 41  # seed of episodes that measure a policy; no training uses it
_COMPARED = 1 << 42  # seed of episodes on whose states an ONNX file is compared with its policy


class Policy(TensorDictModuleBase):
    """A trained greedy policy: reads ``observation`` and ``desired_goal``, writes ``action``.

    It can act in TorchRL's environments and collectors and in :func:`~torchrl_her.evaluate`; :meth:`predict`
    takes arrays of gymnasium.

    Args:
        info: Inputs, actions and success of the policy.
        recipe: Recipe of the run that trained the policy, for this run's seed only. Its task can differ from
            ``info.task``, for which the policy was exported.
        weights: Weights of the run's actor and, if there is one, its normalization.
        source: Name, folder or file from which the policy was loaded.

    Raises:
        ValueError: The weights do not fit the actor that ``info`` and ``recipe`` describe.

    Example:
        >>> policy = Policy.load("hand_v1")
        >>> policy
        Policy('hand_v1', task='hand_v1')
        >>> from torchrl_her_envs import make_env
        >>> make_env("hand_v1", num_envs=2).rollout(10, policy)["action"].shape
        torch.Size([2, 10, 3])
    """

    def __init__(
        self,
        info: PolicyInfo,
        recipe: Recipe,
        weights: Mapping[str, Tensor],
        source: str = "",
    ) -> None:
        super().__init__()
        self.in_keys, self.out_keys = list(KEYS), ["action"]
        self.module, player = load_network(info, recipe.learner, weights)
        self.info, self.recipe, self.source = info, recipe, source
        self._player = [player]  # in a list, since it is not a further submodule: it shares its weights

    @classmethod
    def load(cls, source: str | Path, *, run: int | None = None, best: bool = False) -> Policy:
        """Loads the policy of a task, a run or a file.

        Loading a file imports no module, even if its task names one. Loading a run makes an environment of
        its task.

        Args:
            source: Name or task of a policy that comes with the package, a ``.safetensors`` file that
                :meth:`save` wrote, the folder of a run, or a policy's file in this folder.
            run: Index of the run, if the folder has several runs side by side; by default, the run with the
                median success.
            best: Whether to load the policy with the best success in an evaluation instead of the last one.

        Raises:
            ValueError: There is no such policy or run, the file is damaged, ``run`` or ``best`` is given for
                a file, or the run's task names a module that must not be imported.
            OSError: The run has not saved a policy yet.
        """
        home = RunFolder.of(source)
        if best and (home is None or home.path != Path(source)):
            raise ValueError(f"best needs the folder of a run, got {source}")
        if home is not None:
            file = Path(source) if home.path != Path(source) else home.best if best else home.policy
            return cls._of_run(home, file, run, str(source))
        if run is not None:
            raise ValueError(
                f"run={run} has no effect with {source}, which holds a single policy: leave it out"
            )
        path = find_policy(source)
        if path.suffix != POLICY_SUFFIX:
            why = "is for onnxruntime" if path.suffix == SUFFIX else f"does not end with {POLICY_SUFFIX}"
            raise ValueError(
                f"{path} {why} and cannot be loaded: `torchrl-her export RUN` writes a file that can"
            )
        described, weights = read_policy(path)
        if not {"info", "recipe"} <= set(described):
            raise ValueError(
                f"{path} is not an exported policy: `torchrl-her export RUN` writes one from a run's folder"
            )
        with naming(path, "is not an exported policy"):
            info, recipe = PolicyInfo.from_dict(described["info"]), Recipe.from_dict(described["recipe"])
            if path in policy_files().values():  # files of the package are trusted to name a task's module
                permit_task(info.task)
            return cls(info, recipe, weights, str(source))

    @classmethod
    def _of_run(cls, home: RunFolder, file: Path, run: int | None, source: str) -> Policy:
        recipe, rows = home.recipe(), home.rows()
        if file == home.best and not file.exists():
            raise ValueError(f"{home.path} has no {file.name}: the run has not been evaluated yet")
        described, actor = read_policy(file)
        with naming(file):
            rows = [row for row in rows if row["epoch"] <= described.get("epoch", math.inf)]
            if not rows:
                raise ValueError(f"the run in {home.path} has not been evaluated yet")
        chosen = median_run(rows) if run is None else run
        runs = recipe.run.num_runs
        if chosen not in range(runs):
            raise ValueError(f"there is no run {chosen} in {home.path}; it has runs 0 to {runs - 1}")
        envs = TaskEnvs.of(recipe)
        env = envs.make(1, [0], scaled=False)
        info = PolicyInfo(
            task=recipe.task.name,
            **{"action_dtype": recipe.run.dtype, **describe_env(env)},
            dtype=recipe.run.dtype,
            normalize_clip=recipe.learner.normalize_clip if recipe.learner.normalize else None,
            algorithm=recipe.hindsight.algo,
            learner=find_learner(recipe.learner, shape_of(recipe.task.name, recipe.run, env)).name,
            seed=recipe.run.seed + chosen,
            frames=int(rows[-1]["frames"]),
            versions=present_versions(),
        )
        curriculum, width = make_curriculum(envs.curriculum, env), sum(info.widths.values())
        with naming(file):
            weights = take_run(actor, chosen, runs)
            if curriculum is not None and getattr(recipe.order, "relay", False):
                info = replace(info, stages=tuple(map(asdict, curriculum.resolved)))
            elif curriculum is not None:
                last = curriculum.state_index[-1]
                places = torch.cat((last[: curriculum.observation_width], last[-curriculum.goal_width :]))
                weights = _as_shown(weights, places, width)
            return cls(info, recipe.replace(num_runs=1, seed=info.seed), weights, source)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes ``action``: [..., width], or [...] of integers if actions are discrete."""
        return self.module(tensordict)

    @torch.no_grad()
    def predict(self, observation: Mapping[str, np.ndarray], **_kwargs: Any) -> tuple[np.ndarray, None]:
        """Returns actions for one or several observations of gymnasium, like Stable-Baselines3's ``predict``.

        Args:
            observation: Arrays ``observation`` and ``desired_goal``, [width] or [n, width]; other entries are
                not read.
            _kwargs: Arguments of Stable-Baselines3, such as ``deterministic`` and ``state``, which have no
                effect: the policy is greedy and has no state.

        Returns:
            The action, [width] or [n, width], in the task's bounds and dtype; and None, where
            Stable-Baselines3 returns a recurrent state.

        Example:
            >>> import gymnasium, torchrl_her_envs
            >>> env = gymnasium.make("torchrl_her/HandThrow-v1")
            >>> observation, _ = env.reset(seed=0)
            >>> action, _ = Policy.load("hand_v1").predict(observation)
            >>> env.action_space.contains(action)
            True
        """
        inputs = {
            key: torch.as_tensor(observation[key], dtype=getattr(torch, self.info.dtype)) for key in KEYS
        }
        for key, value in inputs.items():
            if value.shape[-1:] != (self.info.widths[key],):
                raise ValueError(
                    f"{key} must have {self.info.widths[key]} numbers for a policy of {self.info.task}, "
                    f"got shape {list(value.shape)}"
                )
        batch = inputs["observation"].shape[:-1]
        action = self.module(TensorDict(inputs, batch))["action"].numpy()
        if self.info.discrete:
            return action + int(self.info.low[0]), None
        action = np.clip(action, np.array(self.info.low), np.array(self.info.high))  # bounds are float64
        return (np.rint(action) if self.info.whole else action).astype(self.info.task_dtype), None

    def envs(self, number: int, *, seed: int = 0, pictures: bool = False) -> EnvBase:
        """Makes environments of the policy's task.

        Args:
            number: Number of environments.
            seed: Seed of starts and goals.
            pictures: Whether environments that can render pictures are made so that they do.

        Raises:
            ValueError: The environments have other observations, goals or actions than the policy, or the
                task names a module that must not be imported.
        """
        envs = TaskEnvs.of(self.recipe.replace(task=self.info.task))
        env = envs.make(number, [seed], pictures=pictures, scaled=False)
        self.info.check_plays(env, self.info.task)
        return env

    def measure(self, episodes: int = 1_000, *, seed: int = _MEASURED) -> tuple[float, float]:
        """Plays episodes; returns the shares whose goal is achieved at the last step, and at some step."""
        with closing(self.envs(evaluation_envs(self.info.task, episodes), seed=seed)) as env:
            rollout = play_episodes(env, self, episodes)
            at_last, at_some = (
                metric(rollout, EnvReward.of(env)).double().mean() for metric in (success, reached)
            )
        return float(at_last), float(at_some)

    def save(self, path: str | Path, *, card: bool = True) -> None:
        """Writes the policy to a ``.safetensors`` file, for :meth:`load`, or ``.onnx`` file, for onnxruntime.

        An ONNX file is checked: on states of the task, onnxruntime must return the policy's actions with it,
        up to 1e-5. Otherwise the file is removed.

        Args:
            path: Path of the file; its suffix determines the format.
            card: Whether to write a model card beside the file, with the suffix ``.md``.

        Raises:
            ValueError: The suffix is unknown, the card would replace a page that is not a model card, or the
                ONNX file does not pass the check.
            ImportError: The suffix is ``.onnx``, but the extra ``onnx`` is not installed.
            OSError: The file cannot be written.
        """
        path, info = Path(path), self.info
        _check_out(path, card=card)
        if path.suffix == SUFFIX:
            with closing(self.envs(16, seed=_COMPARED)) as env:
                states = evaluate(env, self, max_steps=goal_env(env).max_steps).select(*KEYS).flatten()
            info = write_onnx(self.module, info, self.recipe.to_dict(), path, states=states)
        else:
            described = {"info": info.to_dict(), "recipe": self.recipe.to_dict()}
            write_policy(path, self._player[0].state_dict(), described)
        if card:
            write_model_card(card_path(path), path.name, info, self.recipe)

    def __repr__(self) -> str:
        return f"Policy({self.source!r}, task={self.info.task!r})"


def load_policy(source: str | Path, *, run: int | None = None, best: bool = False) -> Policy:
    """Loads the policy of a task, a run or a file; see :meth:`Policy.load`."""
    return Policy.load(source, run=run, best=best)


def export_policy(
    source: str | Path,
    out: str | Path,
    *,
    run: int | None = None,
    task: str | None = None,
    best: bool = False,
    card: bool = True,
) -> Policy:
    """Loads a policy, measures its success in 1,000 episodes, and writes it to a file with a model card.

    Args:
        source: Run, file or name of the policy, see :meth:`Policy.load`.
        out: Path of the file, with the suffix ``.safetensors`` or ``.onnx``, see :meth:`Policy.save`.
        run: Index of the run, if the folder has several runs side by side; by default, the run with the
            median success.
        task: Name of the task for which the policy is exported; by default, the task of its run.
            Observations, goals and actions of both tasks must have the same widths.
        best: Whether to export the policy with the best success in an evaluation instead of the last one.
        card: Whether to write a model card beside the file, with the suffix ``.md``.

    Returns:
        The policy that was written.

    Raises:
        ValueError: See :meth:`Policy.load` and :meth:`Policy.save`; or the policy does not fit the task.
        ImportError: The suffix is ``.onnx``, but the extra ``onnx`` is not installed.
        OSError: The run has not saved a policy yet, or the file cannot be written.
    """
    out = Path(out)
    _check_out(out, card=card)
    policy = Policy.load(source, run=run, best=best)
    info = replace(policy.info, task=task or policy.info.task, versions=present_versions())
    if task is not None:
        permit_task(task)  # its module may be imported, since the caller named this task
        with closing(TaskEnvs.of(policy.recipe.replace(task=task)).make(1, [0], scaled=False)) as env:
            policy.info.check_plays(env, task)
    measured = info.task == policy.info.task and not math.isnan(info.success)
    policy.info = info
    if not measured:
        at_last, at_some = policy.measure()
        policy.info = replace(info, success=at_last, reached=at_some)
    policy.save(out, card=card)
    return policy


def _check_out(path: Path, *, card: bool) -> None:
    """Checks the suffix, the model card and the packages of an export, before any long computation."""
    if path.suffix not in (POLICY_SUFFIX, SUFFIX):
        raise ValueError(f"a policy's file must end with {POLICY_SUFFIX} or {SUFFIX}, got {path.name!r}")
    if card:
        check_free(card_path(path))
    if path.suffix == SUFFIX:
        need_onnx()


def _as_shown(actor: dict[str, Tensor], places: Tensor, width: int) -> dict[str, Tensor]:
    """Converts an actor's weights to another order of inputs; new inputs get the weight 0.

    Args:
        actor: Weights of the actor and its normalization.
        places: Position of each of the actor's inputs in the concatenated observation and desired goal.
        width: Number of these entries.
    """
    moved = dict(actor)
    for key, value in actor.items():
        if key.endswith("layers.0.0.weight"):
            moved[key] = value.new_zeros(1, width, value.shape[-1]).index_add(1, places, value)
        elif key in ("norm.n", "norm.mean", "norm.var"):
            usual = value.new_full((1, width), float(key == "norm.var"))
            moved[key] = usual.index_copy(1, places, value)
    return moved
