"""Films of a policy at work in several worlds at once."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_her_envs import palette
from torchrl_her_envs.goal_env import first_below
from torchrl_her_envs.palette import Colour
from torchrl_her_envs.rendering import choose_worlds, render
from torchrl_her_envs.throwing import ThrowingEnv

Policy = Callable[[TensorDictBase], TensorDictBase]

_BORDER = 1 / 60  # of a picture's side: how wide the border of a finished world is


def base_env(env: EnvBase) -> ThrowingEnv:
    """The throwing environment below any transforms.

    Raises:
        TypeError: there is none.

    Example:
        >>> from torchrl.envs import StepCounter, TransformedEnv
        >>> from torchrl_her_envs import make_env
        >>> base_env(TransformedEnv(make_env("hand_v1"), StepCounter())).task.name
        'hand_v1'
    """
    inner = first_below(env, lambda inner: isinstance(inner, ThrowingEnv))
    if not isinstance(inner, ThrowingEnv):
        raise TypeError(f"expected a ThrowingEnv, transformed or not, got {type(env).__name__}")
    return inner


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
    """Plays one greedy episode in each of several worlds and films them side by side.

    A world whose episode is over stays as it was at its end, with a green border if it achieved its
    goal (was ``terminated``) and a red one if not. The environment is reset before, and stands
    where the longest of these episodes ended afterwards.

    Args:
        env: a :class:`~torchrl_her_envs.ThrowingEnv`, transformed or not.
        policy: takes a tensordict and writes the action into it; called for all worlds, without
            gradients and with the exploration type ``DETERMINISTIC``.
        worlds: indices of the worlds to film; None for all.
        size: side of the picture of one world in pixels.
        columns: worlds beside each other; None for a grid that is at least as wide as high.
        trail: whether to draw where the balls were.
        hold: how many times the last frame is repeated: one second's worth at 25 frames a second.
        caption: a line of text in each picture.

    Returns:
        One frame [height, width, 3] of uint8 for the start, one for each step, and the last repeated.

    Raises:
        TypeError: ``env`` has no ThrowingEnv below it.
        ValueError: a world that does not exist, a size that is too small, or ``columns`` below 1.

    Example:
        >>> from torchrl_her_envs import make_env
        >>> env = make_env("hand_v0", num_envs=3)
        >>> frames = record_episodes(env, env.rand_action, size=32, hold=0)
        >>> frames[0].shape  # a grid of 2 by 2, of which three are used
        torch.Size([64, 64, 3])
    """
    base = base_env(env)
    film = _Film(base, choose_worlds(base, worlds), size=size, columns=columns, trail=trail, caption=caption)
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        tensordict = env.reset()
        film.shoot(done=tensordict["done"], success=tensordict["terminated"])
        while film.running:
            tensordict = env.step(policy(tensordict))
            after = tensordict["next"]
            out_of_time = (base.worlds.step >= base.world.max_steps).unsqueeze(-1)  # whatever transforms say
            film.shoot(done=after["done"] | out_of_time, success=after["terminated"])
            tensordict = env.step_mdp(tensordict)
    return film.frames + film.frames[-1:] * hold


class _Film:
    """The frames so far, the latest picture of each world, and which worlds still run."""

    def __init__(
        self,
        env: ThrowingEnv,
        worlds: list[int],
        *,
        size: int,
        columns: int | None,
        trail: bool,
        caption: str,
    ) -> None:
        self.frames: list[Tensor] = []
        self.running = worlds
        self._env, self._size, self._caption = env, size, caption
        self._columns = math.ceil(math.sqrt(len(worlds))) if columns is None else columns
        self._pictures: dict[int, Tensor] = {}
        self._trail: list[Tensor] = []
        self._keeps_trail = trail

    def shoot(self, *, done: Tensor, success: Tensor) -> None:
        """Adds a frame, and stops the worlds that are ``done`` [N, 1] with their ``success`` [N, 1]."""
        drawn = render(self._env, self.running, size=self._size, trail=self._trail, caption=self._caption)
        for world, picture in zip(self.running, drawn, strict=True):
            self._pictures[world] = _bordered(picture, bool(success[world])) if done[world] else picture
        self.running = [world for world in self.running if not done[world]]
        if self._keeps_trail:
            self._trail.append(self._env.worlds.ball.clone())
        self.frames.append(tile(list(self._pictures.values()), columns=self._columns))


def tile(pictures: Sequence[Tensor], *, columns: int) -> Tensor:
    """Pictures of one size in a grid, filled row by row; places left over have the colour of the margins.

    Args:
        pictures: [height, width, 3] of uint8 each.
        columns: pictures in a row.

    Returns:
        [rows * height, columns * width, 3].

    Raises:
        ValueError: ``columns`` is below 1.

    Example:
        >>> tile([torch.zeros(2, 2, 3, dtype=torch.uint8)] * 3, columns=2).shape
        torch.Size([4, 4, 3])
    """
    if columns < 1:
        raise ValueError(f"columns must be at least 1, got {columns}")
    empty = torch.tensor(palette.OUTSIDE, dtype=torch.uint8).expand_as(pictures[0])
    missing = -len(pictures) % columns
    grid = torch.stack([*pictures, *[empty] * missing])
    return torch.cat([torch.cat(list(row), 1) for row in grid.split(columns)], 0)


def _bordered(picture: Tensor, success: bool) -> Tensor:
    """The picture of a finished world."""
    colour: Colour = palette.SUCCESS if success else palette.FAILURE
    width = max(1, round(picture.shape[0] * _BORDER))
    framed = torch.tensor(colour, dtype=torch.uint8).expand_as(picture).clone()
    framed[width:-width, width:-width] = picture[width:-width, width:-width]
    return framed
