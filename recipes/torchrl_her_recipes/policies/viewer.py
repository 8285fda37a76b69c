"""The class :class:`Viewer`, which plays policies side by side and makes pictures and videos of them."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple, Self

from torch import Tensor

from torchrl_her_envs.common.goal_env import goal_env
from torchrl_her_envs.common.live import LiveEpisodes
from torchrl_her_envs.common.rendering.pictures import beside, underlined
from torchrl_her_envs.common.rendering.video import write_video
from torchrl_her_envs.registry import get_task_spec
from torchrl_her_recipes.policies.policy import Policy
from torchrl_her_recipes.runs.film import FPS

_GAP = 8  # width in pixels of the gap between two policies
_HOLD = 25  # number of times that the last frame of a video is repeated


class Seen(NamedTuple):
    """Number of goals that a policy achieved, and of all goals that it had, in ended episodes."""

    achieved: int
    goals: int


class Viewer:
    """Plays policies side by side on the same starts and goals, and makes pictures of them.

    Use it as a context manager, which closes the environments.

    Args:
        policies: The policies, all of the same task.

    Keyword Args:
        goals: Number of goals, and of episodes of each policy, that are shown side by side.
        seed: Seed of goals and starts.
        size: Width and height of each environment's picture in pixels.
        named: Whether names and successes of the policies are written below the pictures.

    Raises:
        ValueError: The policies are of different tasks, or an environment cannot render pictures.
    """

    def __init__(
        self,
        policies: Sequence[Policy],
        *,
        goals: int = 6,
        seed: int = 0,
        size: int = 240,
        named: bool = False,
    ) -> None:
        _check_comparable(policies)
        self.goals, self.seed = goals, seed
        self._labels = _labels_of(policies) if named else None
        self._episodes: list[LiveEpisodes] = []
        with ExitStack() as opened:
            for policy in policies:
                env = policy.envs(goals, seed=seed, pictures=True)
                opened.callback(env.close, raise_if_closed=False)
                if not goal_env(env).can_render:
                    raise ValueError(f"{policy.source} cannot be filmed: its environment renders no pictures")
                self._episodes.append(LiveEpisodes(env, policy, size=size))
            self._opened = opened.pop_all()
        self._before = [Seen(0, 0)] * len(self._episodes)  # counts of the episodes before the current ones
        self._round = -1

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._opened.close()

    @property
    def running(self) -> bool:
        """Whether an episode has not ended yet."""
        return any(episodes.running for episodes in self._episodes)

    @property
    def step_count(self) -> int:
        """Number of steps since the start of the current episodes."""
        return max(episodes.step_count for episodes in self._episodes)

    @property
    def max_steps(self) -> int:
        """Largest number of steps in an episode."""
        return self._episodes[0].max_steps

    @property
    def first_goal(self) -> int:
        """Number of the first goal that is shown now, counting all goals since the beginning from 1."""
        return self._round * self.goals + 1

    @property
    def desired_goal(self) -> Tensor:
        """The current goals [goals, g], from the environments of the first policy."""
        return self._episodes[0].desired_goal

    @property
    def seen(self) -> list[Seen]:
        """For each policy, numbers of achieved goals and of ended episodes since the beginning."""
        pairs = zip(self._before, self._episodes, strict=True)
        return [
            Seen(before.achieved + episodes.achieved, before.goals + episodes.worlds - len(episodes.running))
            for before, episodes in pairs
        ]

    def start(self) -> None:
        """Begins episodes with the next goals; unfinished episodes are dropped and not counted."""
        if self._round >= 0:
            self._before = self.seen
        self._round += 1
        for episodes in self._episodes:
            episodes.start(seed=self.seed + self._round)

    def step(self) -> None:
        """Takes a step in the unfinished episodes of each policy."""
        for episodes in self._episodes:
            episodes.step()

    def frame(self) -> Tensor:
        """Returns the current picture of all policies, [height, width, 3] of uint8."""
        frames = [episodes.frame for episodes in self._episodes]
        if self._labels is not None:
            counts = [f"{seen.achieved} of {seen.goals} achieved" for seen in self.seen]
            frames = list(map(underlined, frames, zip(self._labels, counts, strict=True)))
        return beside(frames, gap=_GAP)

    def write(self, out: str | Path) -> list[Seen]:
        """Plays one episode for each goal, and writes a film of them.

        Args:
            out: Path of a .gif or .mp4 file.

        Returns:
            For each policy, the number of goals that it achieved, and the number of all goals.
        """
        self.start()
        frames = [self.frame()]
        while self.running:
            self.step()
            frames.append(self.frame())
        write_video(frames + frames[-1:] * _HOLD, out, fps=FPS)
        return self.seen


def _check_comparable(policies: Sequence[Policy]) -> None:
    """Refuses policies of different tasks, which would have different goals in spite of equal seeds."""
    first, *others = policies
    for other in others:
        first_task, other_task = _task_of(first), _task_of(other)
        if first_task != other_task:
            raise ValueError(
                f"only policies of the same task can be compared: {first.source} plays {first_task}, and "
                f"{other.source} plays {other_task}"
            )


def _task_of(policy: Policy) -> str:
    """Returns the name of a policy's task, followed by its options that differ from their defaults."""
    task = policy.recipe.replace(task=policy.info.task).task
    usual: dict[str, Any] = dict(get_task_spec(task.name).options)
    options = {**usual, **(task.options or {})}
    if task.threshold is not None:
        options["threshold"] = task.threshold
    changed = [f"{name}={value}" for name, value in sorted(options.items()) if value != usual.get(name)]
    return " ".join([task.name, *changed])


def _labels_of(policies: Sequence[Policy]) -> list[str]:
    """Returns a short name for each policy: the last part of its path, or the whole path if not unique."""
    sources = [policy.source for policy in policies]
    short = [Path(source).name or source for source in sources]
    return [name if short.count(name) == 1 else source for name, source in zip(short, sources, strict=True)]
