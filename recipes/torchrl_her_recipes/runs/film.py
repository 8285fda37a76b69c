"""Makes a video of a run's policy at the end of the run."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from torchrl_her_envs.common.goal_env import goal_env
from torchrl_her_envs.common.recording import record_episodes
from torchrl_her_envs.common.rendering.video import write_video
from torchrl_her_envs.registry import get_task_spec
from torchrl_her_recipes.components.curricula import make_played_env
from torchrl_her_recipes.components.envs import TaskEnvs

FPS = 12  # frames per second: half the true speed of the throwing tasks, whose throws take half a second
_FILMED = 6  # largest number of environments in the video


def film_policy(
    envs: TaskEnvs, env: EnvBase, player: TensorDictModuleBase, out: Path, *, seeds: Sequence[int], run: int
) -> None:
    """Makes a video of greedy episodes of one run, if its environment can be rendered.

    Environments that render only if they were made with certain options are made again with these. If
    rendering fails, for instance without a display, there is a warning and no video.
    """
    count = env.numel() // len(seeds)
    filmed = min(_FILMED, count)
    if goal_env(env).can_render:
        _film(player, env, out, run * count, filmed)
    elif get_task_spec(envs.task.name).for_pictures:
        try:
            with closing(make_played_env(envs, filmed, seeds, pictures=True)) as drawn:
                if goal_env(drawn).can_render:
                    _film(player, drawn, out, run * filmed, filmed)
        except Exception as error:  # renderers raise errors of any type; a finished run must not fail by them
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            warnings.warn(f"no {out.name}: the environment could not be drawn: {reason}", stacklevel=2)


def _film(player: TensorDictModuleBase, env: EnvBase, out: Path, first: int, count: int) -> None:
    write_video(record_episodes(env, player, worlds=range(first, first + count)), out, fps=FPS)
