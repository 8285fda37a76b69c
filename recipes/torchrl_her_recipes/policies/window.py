"""Shows policies live in a window that reacts to keys, or writes a video of them."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import Any

from torch import Tensor

from torchrl_her_envs.common.rendering.key_window import Command, KeyWindow
from torchrl_her_envs.common.rendering.pictures import underlined
from torchrl_her_recipes.policies.policy import Policy
from torchrl_her_recipes.policies.viewer import Seen, Viewer
from torchrl_her_recipes.runs.film import FPS

_RATES = (1, 2, 4, 8, FPS, 25, 50, 100, 200)  # speeds that a user can choose, in steps per second
_LOOKS = 30  # least number of times per second that keys are read
_MOST_NUMBERS = 3  # largest number of coordinates with which a goal is written below the picture
_KEYS = "space: pause    n: one step    r: next goals    + -: speed    q: quit"


def play(
    *sources: str | Path,
    out: str | Path | None = None,
    run: int | None = None,
    best: bool = False,
    **view: Any,
) -> list[Seen]:
    """Shows policies on the same starts and goals: in a video, or in a window until the user closes it.

    Keys in the window: space pauses, n or the right arrow takes one step, r skips to the next goals, plus
    and minus change the speed, q or escape quits.

    Args:
        sources: The policies, see :meth:`Policy.load`; all of the same task.
        out: Path of a .gif or .mp4 file; None opens a window.
        run: Index of the run, if the first source is a folder with several runs side by side; by default, the
            run with the median success.
        best: Whether to load the best policy instead of the last one, if the first source is a folder.
        view: Arguments ``goals``, ``seed``, ``size`` and ``named`` of
            ``torchrl_her_recipes.policies.viewer.Viewer``.

    Returns:
        For each policy, the number of goals that it achieved, and the number of its goals.

    Raises:
        ValueError: There is no such policy, the policies are of different tasks, their environments cannot
            render pictures, or a window is requested without a display.
        ImportError: A window is requested, but the package pygame-ce is not installed.
        OSError: A run has not saved a policy yet.

    Example:
        >>> from tempfile import TemporaryDirectory
        >>> from torchrl_her_recipes import play
        >>> with TemporaryDirectory() as folder:
        ...     play("hand_reach", out=f"{folder}/reach.gif", goals=2)
        [Seen(achieved=2, goals=2)]
    """
    first, *others = sources

    def viewer() -> Viewer:
        policies = [Policy.load(first, run=run, best=best), *map(Policy.load, others)]
        return Viewer(policies, **{"named": out is None or bool(others), **view})

    if out is not None:
        with viewer() as frames:
            return frames.write(out)
    with closing(KeyWindow(f"torchrl-her: {', '.join(map(str, sources))}")) as window, viewer() as frames:
        show(Viewing(frames), window)
        return frames.seen


def show(viewing: Viewing, window: KeyWindow) -> None:
    """Shows episodes in a window and handles keys, until the user closes the window."""
    due = 0.0  # steps to take; a loop may add a fraction, since keys are read more often than steps are taken
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
    """State of a live view: episodes, their speed, and whether they are paused.

    Attributes:
        paused: whether to wait with the next step until the user presses a key.
        over: whether the user has quit.
    """

    def __init__(self, viewer: Viewer) -> None:
        self.paused = self.over = False
        self._viewer = viewer
        self._rate = _RATES.index(FPS)
        self._begin()

    @property
    def rate(self) -> int:
        """Current speed, in steps per second."""
        return _RATES[self._rate]

    def handle(self, command: Command) -> None:
        """Carries out the command of a key: quit, pause, step, reset or a change of speed."""
        if command is Command.QUIT:
            self.over = True
        elif command is Command.PAUSE:
            self.paused = not self.paused
        elif command is Command.STEP:
            self.paused = True
            self._go_on(hold=0)
        elif command is Command.RESET:
            self._begin()
        elif command is Command.FASTER:
            self._rate = min(self._rate + 1, len(_RATES) - 1)
        elif command is Command.SLOWER:
            self._rate = max(self._rate - 1, 0)

    def tick(self) -> None:
        """Takes a step unless paused; starts the next goals about a second after the last step."""
        if not self.paused and not self.over:
            self._go_on(hold=self.rate)

    def frame(self) -> Tensor:
        """Returns the current picture, with status and keys written below it, [height, width, 3] of uint8."""
        return underlined(self._viewer.frame(), [self.status(), _KEYS])

    def status(self) -> str:
        """Describes the current goals, step and speed in one line."""
        viewer, goals, first = self._viewer, self._viewer.goals, self._viewer.first_goal
        which = f"goal {first}{self._where()}" if goals == 1 else f"goals {first} to {first + goals - 1}"
        speed = "paused" if self.paused else f"{self.rate} steps a second"
        return f"{which}, step {viewer.step_count} of {viewer.max_steps}, {speed}"

    def _where(self) -> str:
        """Formats the coordinates of the goal; returns an empty text if they are too many."""
        goal = self._viewer.desired_goal[0].flatten().tolist()
        return f" at ({', '.join(f'{x:.2f}' for x in goal)})" if len(goal) <= _MOST_NUMBERS else ""

    def _go_on(self, *, hold: int) -> None:
        if self._viewer.running:
            self._viewer.step()
        elif self._held < hold:
            self._held += 1
        else:
            self._begin()

    def _begin(self) -> None:
        self._held = 0
        self._viewer.start()
