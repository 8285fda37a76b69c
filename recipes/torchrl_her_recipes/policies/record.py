"""Records demonstrations: episodes of a scripted controller or of a trained policy, in a file."""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from torchrl.envs import EnvBase

from torchrl_her import __version__
from torchrl_her.demonstrations.dataset import Demonstrations, check_free
from torchrl_her.demonstrations.play import demonstrate
from torchrl_her_envs.common.goal_env import goal_env, reward_range
from torchrl_her_envs.registry import GYM
from torchrl_her_envs.throwing.experts.controller import make_controller
from torchrl_her_recipes.components.envs import Player, TaskEnvs
from torchrl_her_recipes.config.recipe import make_recipe
from torchrl_her_recipes.policies.policy import Policy

EXPERT = "expert"
_AT_ONCE, _OF_GYM_AT_ONCE = 100, 10  # largest numbers of environments, in general and for gymnasium's
_MOST = 10  # largest number of episodes that are played, per requested episode


@dataclass(frozen=True)
class Recorded:
    """Result of a recording.

    Attributes:
        demonstrations: the demonstrations in the file.
        played: number of episodes that were played.
        achieved: number of played episodes that achieved their goal.
    """

    demonstrations: Demonstrations
    played: int
    achieved: int


def record_demonstrations(
    task: str,
    out: str | Path,
    *,
    episodes: int = 100,
    policy: str | Path | None = None,
    seed: int = 0,
    keep_all: bool = False,
    force: bool = False,
) -> Recorded:
    """Plays episodes of a task and writes those that achieve their goal to a file.

    For this library's own environments, the file also has their physical states, from which episodes can
    start. :meth:`~torchrl_her.demonstrations.Demonstrations.load` reads the file.

    Args:
        task: name of the task.
        out: file for the demonstrations.

    Keyword Args:
        episodes: number of episodes to write; at most ten times this number is played.
        policy: policy that plays: ``"expert"`` or None for the task's scripted controller, or a trained
            policy as for :meth:`Policy.load`.
        seed: seed of starts and goals.
        keep_all: whether to write all played episodes, even if they fail; then only ``episodes`` are played.
        force: whether to replace an existing file.

    Raises:
        ValueError: there is no such task or policy, the policy does not fit the task, the file exists, or too
            few episodes achieve their goal.
        OSError: the file cannot be written.
    """
    if episodes < 1:
        raise ValueError(f"episodes must be at least 1, got {episodes}")
    check_free(out, force=force)
    envs = TaskEnvs.of(make_recipe(task=task, seed=seed))
    most = _OF_GYM_AT_ONCE if task.startswith(GYM) else _AT_ONCE
    with closing(envs.make(min(episodes, most), [seed], scaled=False)) as env:
        player, who = _find_policy(task, env, policy)
        facts = {"policy": who, "seed": seed, "torchrl_her": __version__}
        recorded = _play(env, player, task, episodes, keep_all=keep_all, facts=facts)
    recorded.demonstrations.save(out, force=force)
    return recorded


def _find_policy(task: str, env: EnvBase, policy: str | Path | None) -> tuple[Player, str]:
    """Returns a policy that acts in the given environments, and its name."""
    if policy is None or str(policy) == EXPERT:
        try:
            return make_controller(env), "the scripted controller"
        except TypeError:
            raise ValueError(
                f"{task} has no scripted controller: give another --policy (policy=...), which is a file "
                "that `torchrl-her export` wrote or the name of a trained policy"
            ) from None
    trained = Policy.load(policy)
    trained.info.check_plays(env, task)
    return trained, f"{policy}, a policy of {trained.info.task}"


def _play(
    env: EnvBase, player: Player, name: str, episodes: int, *, keep_all: bool, facts: dict[str, Any]
) -> Recorded:
    """Plays episodes in rounds, one per environment and round, until there are enough to write."""
    reward, parts = reward_range(goal_env(env))[1], []
    kept = played = achieved = 0
    while kept < episodes and played < _MOST * episodes:
        batch = demonstrate(env, player, max_steps=goal_env(env).max_steps, achieved_reward=reward)
        batch = batch.select(range(min(len(batch), (episodes if keep_all else _MOST * episodes) - played)))
        good = batch.achieved.nonzero().flatten()
        if not keep_all and len(good) >= episodes - kept:  # episodes after the last one needed are dropped
            good = good[: episodes - kept]
            batch = batch.select(range(int(good[-1]) + 1))
        played, achieved = played + len(batch), achieved + len(good)
        kept += len(batch) if keep_all else len(good)
        if keep_all or len(good):
            parts.append(batch if keep_all else batch.select(good))
    if kept < episodes:
        raise ValueError(
            f"only {achieved} of {played} episodes of {name} by {facts['policy']} achieved their goal: "
            "choose another policy, fewer --episodes, or --all, which also writes episodes that fail"
        )
    made_by = {**facts, "played": played, "achieved": achieved}
    return Recorded(replace(Demonstrations.join(parts), task=name, made_by=made_by), played, achieved)
