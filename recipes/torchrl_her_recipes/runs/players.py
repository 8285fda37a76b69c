"""Policies that are to be seen: found by what somebody calls them, with environments to play in."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from torchrl_her.modules.networks import take_run
from torchrl_her_envs.common.goal_env import goal_env
from torchrl_her_envs.common.rendering.live import LiveEpisodes
from torchrl_her_envs.registry import get_task_spec
from torchrl_her_recipes.components.agents import make_player
from torchrl_her_recipes.components.curricula import make_curriculum, make_played_env
from torchrl_her_recipes.components.envs import make_task_envs
from torchrl_her_recipes.config.groups import TaskConfig
from torchrl_her_recipes.config.shipped import policy_names
from torchrl_her_recipes.runs.kept import KeptPolicy
from torchrl_her_recipes.runs.policies import load_trained


@dataclass(frozen=True, kw_only=True)
class Player:
    """A policy with environments to play in.

    Attributes:
        source: what it was called.
        task: that is played.
        env: its environments, one for each goal.
        actor: the greedy policy.
    """

    source: str
    task: TaskConfig
    env: EnvBase
    actor: TensorDictModuleBase

    def episodes(self, *, size: int) -> LiveEpisodes:
        """Its episodes, to be shown.

        Args:
            size: pixels of one environment.

        Raises:
            ValueError: the environment gives no pictures.
        """
        if not goal_env(self.env).can_render:
            raise ValueError(f"{self.source} cannot be filmed: its environment gives no pictures")
        return LiveEpisodes(self.env, self.actor, size=size)

    def close(self) -> None:
        """Closes its environments."""
        self.env.close(raise_if_closed=False)


def find_player(
    source: str | Path,
    *,
    goals: int,
    seed: int,
    run: int = 0,
    best: bool = False,
) -> Player:
    """A policy, and environments that give pictures if they can.

    Args:
        source: the folder of a run, ``policy.pt`` or ``best.pt`` in it, the .pt or .onnx file of an exported
            policy, or the name of a task whose policy comes with the package.

    Keyword Args:
        goals: how many environments.
        seed: of their starts and goals.
        run: which one, if there are several side by side in the folder.
        best: whether to take the best policy of the folder.

    Raises:
        ValueError: there is neither such a run nor such a policy, ``best`` without the folder of a run, or
            its task names a module that must not be imported.
        OSError: the run has not saved a policy yet.
    """
    kept = KeptPolicy.of(source, best=best)
    if kept is None and (str(source) in policy_names() or Path(source).is_file()):
        trained = load_trained(source)
        recipe = trained.recipe.replace(task=trained.task)
        env = make_task_envs(recipe, goals, [seed], pictures=True, scaled=False)
        trained.card.check_plays(env, trained.task)
        return Player(source=str(source), task=recipe.task, env=env, actor=trained.actor)
    if kept is None:
        known = ", ".join(policy_names())
        raise ValueError(
            f"{source} is neither the folder of a run, nor the file of an exported policy, nor one of the "
            f"trained policies: {known}"
        )
    recipe, actor = kept.home.recipe(), actor_of(kept, run)
    env = make_played_env(recipe, goals, [seed], pictures=True)
    return Player(source=str(source), task=recipe.task, env=env, actor=actor)


def actor_of(kept: KeptPolicy, run: int) -> TensorDictModuleBase:
    """The greedy policy of one of the runs in a folder.

    Raises:
        ValueError: there is no such run, its policy is damaged, it has no best policy, or its task names a
            module that must not be imported.
        OSError: the run has not saved a policy yet.
    """
    recipe = kept.home.recipe()
    if not 0 <= run < recipe.run.num_runs:
        runs = recipe.run.num_runs
        raise ValueError(f"there is no run {run} in {kept.home.path}; it has runs 0 to {runs - 1}")
    env = make_played_env(recipe, 1, [0])
    actor = make_player(recipe.replace(num_runs=1), env, curriculum=make_curriculum(recipe, env))
    actor.load_state_dict(take_run(kept.load()["actor"], run, recipe.run.num_runs))
    return actor


def check_comparable(players: Sequence[Player]) -> None:
    """Refuses policies of different tasks: with the same seeds they would not have the same goals.

    Raises:
        ValueError: two tasks, or two settings of one.
    """
    first = players[0]
    for other in players[1:]:
        ours, theirs = _described(first.task), _described(other.task)
        if ours != theirs:
            raise ValueError(
                f"only policies of the same task can be compared: {first.source} plays {ours}, and "
                f"{other.source} plays {theirs}"
            )


def labels_of(players: Sequence[Player]) -> list[str]:
    """Short names of policies that tell them apart: the last part of each path, or all of it.

    Two that are called the same stay so.
    """
    short = [Path(player.source).name or player.source for player in players]
    return [
        name if short.count(name) == 1 else player.source for name, player in zip(short, players, strict=True)
    ]


def _described(task: TaskConfig) -> str:
    """A task with those of its options that are not as usual, in words."""
    usual: dict[str, Any] = dict(get_task_spec(task.name).options)
    own = {**usual, **(task.options or {})}
    if task.threshold is not None:
        own["threshold"] = task.threshold
    other = [f"{name}={value}" for name, value in sorted(own.items()) if value != usual.get(name)]
    return " ".join([task.name, *other])
