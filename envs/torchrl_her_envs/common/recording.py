"""Videos of a policy that acts in several environments at once."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor
from torchrl.envs import EnvBase

from torchrl_her_envs.common.live import LiveEpisodes, Policy


def record_episodes(
    env: EnvBase,
    policy: Policy,
    *,
    worlds: Sequence[int] | None = None,
    size: int = 240,
    columns: int | None = None,
    trail: bool = True,
    hold: int = 25,
    caption: str = "",
) -> list[Tensor]:
    """Plays one greedy episode in each of several environments and films them side by side.

    All environments are reset before. The picture of an environment whose episode is over stays as it was,
    with a green border if it achieved its goal in some step and a red one if not. The environment itself
    begins a new episode, which is not filmed, as long as others are.

    Args:
        env: an environment with goals that gives pictures (``can_render``), transformed or not.
        policy: takes a tensordict and writes the action into it; called for all environments, without
            gradients and with the exploration type ``DETERMINISTIC``.
        worlds: indices of the environments to film; None for all.
        size: longer side of the picture of one environment in pixels.
        columns: pictures in a row; None for a grid that is at least as wide as high.
        trail: whether to draw where the balls were, in throwing tasks.
        hold: number of repetitions of the last frame: 25 are one second at 25 frames a second.
        caption: a line of text in each picture.

    Returns:
        Frames [height, width, 3] of uint8: the start, one for each step, and the last one repeated.

    Raises:
        TypeError: ``env`` has no environment with goals below it.
        ValueError: it gives no pictures, an index is out of range, ``size`` is too small, or ``columns`` is
            below 1.

    Example:
        >>> from torchrl_her_envs import make_env
        >>> env = make_env("hand_v0", num_envs=3)
        >>> frames = record_episodes(env, env.rand_action, size=32, hold=0)
        >>> frames[0].shape  # a grid of 2 by 2, of which three are used
        torch.Size([64, 64, 3])
    """
    live = LiveEpisodes(
        env,
        policy,
        worlds=worlds,
        size=size,
        columns=columns,
        trail=trail,
        caption=caption,
    )
    live.start()
    frames = [live.frame]
    while live.running:
        live.step()
        frames.append(live.frame)
    return frames + frames[-1:] * hold
