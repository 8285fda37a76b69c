"""Videos of a policy that acts in several environments at once."""

from __future__ import annotations

from typing import Any

from torch import Tensor
from torchrl.envs import EnvBase

from torchrl_her_envs.common.live import LiveEpisodes, Policy


def record_episodes(env: EnvBase, policy: Policy, *, hold: int = 25, **options: Any) -> list[Tensor]:
    """Plays one greedy episode in each of several environments and films them side by side.

    Args:
        env: an environment with goals that gives pictures (``can_render``), transformed or not.
        policy: takes a tensordict and writes the action into it.

    Keyword Args:
        hold: number of repetitions of the last frame: 25 are one second at 25 frames a second.
        **options: ``worlds``, ``size``, ``columns``, ``trail`` and ``caption`` of
            :class:`~torchrl_her_envs.LiveEpisodes`.

    Returns:
        Frames [height, width, 3] of uint8: the start, one for each step, and the last one repeated.

    Raises:
        TypeError: ``env`` has no environment with goals below it.
        ValueError: the environment gives no pictures, an index is out of range, ``size`` is too small, or
            ``columns`` is below 1.

    Example:
        >>> from torchrl_her_envs import make_env
        >>> env = make_env("hand_v0", num_envs=3)
        >>> frames = record_episodes(env, env.rand_action, size=32, hold=0)
        >>> frames[0].shape  # a grid of 2 by 2, of which three are used
        torch.Size([64, 64, 3])
    """
    live = LiveEpisodes(env, policy, **options)
    live.start()
    frames = [live.frame]
    while live.running:
        live.step()
        frames.append(live.frame)
    return frames + frames[-1:] * hold
