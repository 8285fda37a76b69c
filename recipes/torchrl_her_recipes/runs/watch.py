"""Policies at work, live in a window."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np
from torch import Tensor

from torchrl_her_envs.common.rendering.key_window import Command, KeyWindow
from torchrl_her_envs.common.rendering.pictures import underlined
from torchrl_her_recipes.runs.film import FPS
from torchrl_her_recipes.runs.play import shown
from torchrl_her_recipes.runs.side_by_side import SideBySide

_RATES = (1, 2, 4, 8, FPS, 25, 50, 100, 200)  # steps a second
_LOOKS = 30  # times a second that keys are looked for, at least
_MOST_NUMBERS = 3  # of a goal that are written out
_KEYS = "space: pause    n: one step    r: next goals    + -: speed    q: quit"


class Seen(NamedTuple):
    """What somebody has seen of a policy: goals that it achieved, of those that it had."""

    achieved: int
    goals: int


class Window(Protocol):
    """What pictures are shown in."""

    def show(self, picture: np.ndarray) -> None: ...
    def commands(self) -> list[Command]: ...
    def wait(self, rate: float) -> None: ...
    def close(self) -> None: ...


def watch(
    sources: Sequence[str | Path],
    *,
    run: int = 0,
    best: bool = False,
    goals: int = 1,
    seed: int = 0,
    size: int = 480,
) -> list[Seen]:
    """Shows policies in a window, with the same starts and goals, until somebody closes it.

    Keys: space pauses, n or the right arrow takes one step, r goes on to the next goals, plus and minus
    change the speed, q or escape quits.

    Args:
        sources: of one policy or several, as for :func:`~torchrl_her_recipes.play`; all of the same task.
        run: which one of the first folder, if there are several side by side in it.
        best: whether to take the best policy of the first folder.
        goals: how many at a time.
        seed: of the first goals and starts; the next ones have the next seed.
        size: pixels of one environment.

    Returns:
        What was seen of each policy.

    Raises:
        ValueError: as for :func:`~torchrl_her_recipes.play`, the policies are not of the same task, or there
            is no display.
        ImportError: the package pygame-ce is missing.
        OSError: a run has not saved a policy yet.
    """
    window = KeyWindow(f"torchrl-her: {', '.join(map(str, sources))}")
    try:
        with shown(
            sources,
            goals=goals,
            seed=seed,
            size=size,
            run=run,
            best=best,
            named=True,
        ) as episodes:
            show(Viewing(episodes, seed=seed), window)
            return [Seen(*pair) for pair in zip(episodes.achieved, episodes.ended, strict=True)]
    finally:
        window.close()


def show(viewing: Viewing, window: Window) -> None:
    """Shows episodes in a window until it is closed."""
    due = 0.0  # steps; each look at the keys adds its share of one
    while not viewing.over:
        window.show(viewing.frame().numpy())
        rate, looks = viewing.rate, max(_LOOKS, viewing.rate)
        window.wait(looks)
        for command in window.commands():
            viewing.handle(command)
        due += rate / looks
        while due >= 1.0:
            due -= 1.0
            viewing.tick()


class Viewing:
    """What somebody looks at: episodes, how fast they go, and whether they are paused.

    Args:
        episodes: of the policies.
        seed: of the first goals; the next ones have the next seed.

    Attributes:
        paused: whether no steps are taken unless they are asked for.
        over: whether somebody has had enough.
    """

    def __init__(self, episodes: SideBySide, *, seed: int) -> None:
        self.paused = self.over = False
        self._episodes, self._seed = episodes, seed
        self._rate = _RATES.index(FPS)
        self._round = 0
        self._begin()

    @property
    def rate(self) -> int:
        """Steps a second."""
        return _RATES[self._rate]

    def handle(self, command: Command) -> None:
        """Does what somebody asks for."""
        if command is Command.QUIT:
            self.over = True
        elif command is Command.PAUSE:
            self.paused = not self.paused
        elif command is Command.STEP:
            self.paused = True
            self._go_on(hold=0)
        elif command is Command.RESET:
            self._next()
        elif command is Command.FASTER:
            self._rate = min(self._rate + 1, len(_RATES) - 1)
        elif command is Command.SLOWER:
            self._rate = max(self._rate - 1, 0)

    def tick(self) -> None:
        """Takes a step if it is not paused; about a second after the last one, the next goals begin."""
        if not self.paused and not self.over:
            self._go_on(hold=self.rate)

    def frame(self) -> Tensor:
        """The present picture [height, width, 3] of uint8, with what there is to know below it."""
        return underlined(self._episodes.frame(), [self.status(), _KEYS])

    def status(self) -> str:
        """Which goals, which step, and how fast."""
        goals, own = self._episodes.goals, self._episodes
        first = self._round * goals + 1
        which = f"goal {first}{self._where()}" if goals == 1 else f"goals {first} to {first + goals - 1}"
        speed = "paused" if self.paused else f"{self.rate} steps a second"
        return f"{which}, step {own.step_count} of {own.max_steps}, {speed}"

    def _where(self) -> str:
        """The coordinates of the goal, if there are few."""
        goal = self._episodes.desired_goal[0].flatten().tolist()
        return f" at ({', '.join(f'{x:.2f}' for x in goal)})" if len(goal) <= _MOST_NUMBERS else ""

    def _go_on(self, *, hold: int) -> None:
        if self._episodes.running:
            self._episodes.step()
        elif self._held < hold:
            self._held += 1
        else:
            self._next()

    def _next(self) -> None:
        self._round += 1
        self._begin()

    def _begin(self) -> None:
        self._held = 0
        self._episodes.start(seed=self._seed + self._round)
