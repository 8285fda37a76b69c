"""Trained policies: loaded from runs, from files, or from those that come with the package."""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase

from torchrl_her.modules.networks import take_run
from torchrl_her.trainers.metrics import reached, success
from torchrl_her.trainers.trainer import evaluate
from torchrl_her_envs.common.goal_env import goal_env
from torchrl_her_recipes.components.agents import find_learner, shape_of
from torchrl_her_recipes.components.curricula import make_curriculum
from torchrl_her_recipes.components.envs import TaskEnvs, evaluation_envs, judging, play_episodes
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

_MEASURED = 1 << 41  # seeds that no training uses: for episodes that measure a policy,
_COMPARED = 1 << 42  # and for those on whose states an ONNX file is compared with it


class Policy(TensorDictModuleBase):
    """A trained greedy policy: reads ``observation`` and ``desired_goal``, writes ``action``.

    It acts in TorchRL's environments and collectors and in :func:`~torchrl_her.evaluate`. For gymnasium's
    arrays it has :meth:`predict`.

    Args:
        info: Inputs, actions and success of the policy.
        recipe: Recipe of the run that trained it, with this run's seed only. Its task may be a harder one.
        weights: Weights of the run's actor, with its normalization if there is one.
        source: Name, folder or file that the policy was loaded from.

    Raises:
        ValueError: The weights do not fit the actor that info and recipe describe.

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
        self.module = load_network(info, recipe.learner, weights)
        self.info, self.recipe, self.source = info, recipe, source
        self._weights = dict(weights)

    @classmethod
    def load(cls, source: str | Path, *, run: int | None = None, best: bool = False) -> Policy:
        """Loads the policy of a task, a run or a file.

        Loading a file imports no module, even if its task names one. Loading a run makes an environment of
        its task.

        Args:
            source: Name of a policy that comes with the package, or of its task, a ``.safetensors`` file that
                :meth:`save` wrote, the folder of a run, or the file of a policy in it.
            run: Index of the run, if the folder has several side by side; the run with the median success
                if None.
            best: Whether to take the policy of the evaluation with the best median success, not the last.

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
            if path in policy_files().values():  # this package's own files may name modules
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
        description = describe_env(env)
        info = PolicyInfo(
            task=recipe.task.name,
            **{**description, "action_dtype": description.get("action_dtype", recipe.run.dtype)},
            dtype=recipe.run.dtype,
            normalize_clip=recipe.learner.normalize_clip if recipe.learner.normalize else None,
            algorithm=recipe.hindsight.algo,
            learner=find_learner(recipe.learner, shape_of(recipe.task.name, recipe.run, env)).name,
            seed=recipe.run.seed + chosen,
            frames=int(rows[-1]["frames"]),
            versions=present_versions(),
        )
        curriculum, width = make_curriculum(envs.curriculum, env), sum(info.widths.values())
        # positions of the network's inputs in the concatenated observation and desired goal
        places = torch.arange(width)
        if curriculum is not None:
            last = curriculum.state_index[-1]
            places = torch.cat((last[: curriculum.observation_width], last[-curriculum.goal_width :]))
        with naming(file):
            weights = _as_shown(take_run(actor, chosen, runs), places, width)
            return cls(info, recipe.replace(num_runs=1, seed=info.seed), weights, source)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes ``action`` [..., width], or integers [...] where actions are discrete."""
        return self.module(tensordict)

    @torch.no_grad()
    def predict(self, observation: Mapping[str, np.ndarray], **_kwargs: Any) -> tuple[np.ndarray, None]:
        """Returns actions for one observation of gymnasium's or for several, like Stable-Baselines3's method.

        Args:
            observation: Arrays ``observation`` and ``desired_goal``, [width] or [n, width]; other entries are
                not read.
            _kwargs: Arguments of Stable-Baselines3, as ``deterministic`` and ``state``. They have no effect:
                the policy is greedy and has no state.

        Returns:
            The action, [width] or [n, width], within the task's own bounds and of its type; and None in place
            of a recurrent state.

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
            return action, None
        action = np.clip(action, np.array(self.info.low), np.array(self.info.high))  # in float64
        return (np.rint(action) if self.info.whole else action).astype(self.info.task_dtype), None

    def envs(self, number: int, *, seed: int = 0, pictures: bool = False) -> EnvBase:
        """Makes environments of the policy's task.

        Args:
            number: Number of environments.
            seed: Seed of their starts and goals.
            pictures: Whether the environments render pictures, if they can.

        Raises:
            ValueError: The environments differ from those that the policy was trained on, or the task names a
                module that must not be imported.
        """
        envs = TaskEnvs.of(self.recipe.replace(task=self.info.task))
        env = envs.make(number, [seed], pictures=pictures, scaled=False)
        self.info.check_plays(env, self.info.task)
        return env

    def measure(self, episodes: int = 1_000, *, seed: int = _MEASURED) -> tuple[float, float]:
        """Returns the shares of episodes whose goal is achieved at the last step, and at some step."""
        with closing(self.envs(evaluation_envs(self.info.task, episodes), seed=seed)) as env:
            rollout = play_episodes(env, self, episodes)
            at_last, at_some = (
                metric(rollout, **judging(env)).double().mean() for metric in (success, reached)
            )
        return float(at_last), float(at_some)

    def save(self, path: str | Path, *, card: bool = True) -> None:
        """Writes the policy as a file: for :meth:`load` if its suffix is ``.safetensors``, for onnxruntime if
        it is ``.onnx``.

        An ONNX file is removed unless onnxruntime returns the policy's actions with it, to 1e-5, on states
        of the task.

        Args:
            path: The file.
            card: Whether a model card is written beside the file, with the suffix ``.md``.

        Raises:
            ValueError: The suffix is another one, the card would replace a page that is not a model card, or
                the actions of the ONNX file differ from the policy's.
            ImportError: The suffix is ``.onnx``, and the extra ``onnx`` is missing.
            OSError: The file cannot be written.
        """
        path, info = Path(path), self.info
        _check_out(path, card=card)
        if path.suffix == SUFFIX:
            with closing(self.envs(16, seed=_COMPARED)) as env:
                states = evaluate(env, self, max_steps=goal_env(env).max_steps).select(*KEYS).flatten()
            info = write_onnx(self.module, info, self.recipe.to_dict(), path, states=states)
        else:
            write_policy(path, self._weights, {"info": info.to_dict(), "recipe": self.recipe.to_dict()})
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
    """Measures the policy of a run on 1,000 episodes, and writes it to a small file and a page about it.

    Args:
        source: The policy, as for :meth:`Policy.load`.
        out: The file; its suffix ``.safetensors`` or ``.onnx`` is its format, see :meth:`Policy.save`.
        run: Index of the run, if the folder has several side by side; the run with the median success if
            None.
        task: Name of the task that the policy is for, if not the run's own. Its observations, goals and
            actions must have the same widths.
        best: Whether to take the policy of the evaluation with the best median success, not the last.
        card: Whether a model card is written beside the file, with the suffix ``.md``.

    Returns:
        The policy that was written.

    Raises:
        ValueError: See :meth:`Policy.load` and :meth:`Policy.save`, or the policy cannot play the task.
        ImportError: The suffix is ``.onnx``, and the extra ``onnx`` is missing.
        OSError: The run has not saved a policy yet, or the file cannot be written.
    """
    out = Path(out)
    _check_out(out, card=card)
    policy = Policy.load(source, run=run, best=best)
    info = replace(policy.info, task=task or policy.info.task, versions=present_versions())
    if task is not None:
        permit_task(task)  # named by the caller
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
    """Refuses a file that cannot be written, before any long computation."""
    if path.suffix not in (POLICY_SUFFIX, SUFFIX):
        raise ValueError(f"a policy's file must end with {POLICY_SUFFIX} or {SUFFIX}, got {path.name!r}")
    if card:
        check_free(card_path(path))
    if path.suffix == SUFFIX:
        need_onnx()


def _as_shown(actor: dict[str, Tensor], places: Tensor, width: int) -> dict[str, Tensor]:
    """Returns an actor's weights for the inputs in another order; inputs that it does not use get weight 0.

    Args:
        actor: Weights of the actor and its normalization.
        places: New position of each input.
        width: Number of inputs in the new order.
    """
    moved = dict(actor)
    for key, value in actor.items():
        if key.endswith("layers.0.0.weight"):
            moved[key] = _wider(value, -2, width).index_add(-2, places, value)
        elif key in ("norm.n", "norm.mean", "norm.var"):
            moved[key] = _wider(value, -1, width, key == "norm.var").index_copy(-1, places, value)
    return moved


def _wider(value: Tensor, dim: int, width: int, fill: float = 0.0) -> Tensor:
    shape = list(value.shape)
    shape[dim] = width
    return value.new_full(shape, fill)
