"""Several policies at work on the same goals, in one picture."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from torchrl_her_envs.common.rendering.live import LiveEpisodes
from torchrl_her_envs.common.rendering.pictures import beside, underlined

_GAP = 8  # pixels between policies


class SideBySide:
    """Episodes of several policies, which begin at the same time with the same starts and goals.

    Args:
        episodes: of each policy, all in as many environments of the same task.
        labels: what stands below each of them; nothing for None.

    Attributes:
        achieved: goals that each policy has achieved, since the beginning of all.
        ended: goals that each policy has achieved or missed.
    """

    def __init__(self, episodes: Sequence[LiveEpisodes], labels: Sequence[str] | None) -> None:
        self._episodes, self._labels = list(episodes), labels
        self._before = [(0, 0)] * len(self._episodes)  # achieved and ended, in earlier episodes
        self._begun = False

    @property
    def running(self) -> bool:
        """Whether an episode still goes on."""
        return any(own.running for own in self._episodes)

    @property
    def step_count(self) -> int:
        """Steps since the start of these episodes."""
        return max(own.step_count for own in self._episodes)

    @property
    def max_steps(self) -> int:
        """The steps of an episode, at most."""
        return self._episodes[0].max_steps

    @property
    def goals(self) -> int:
        """How many goals each policy has at a time."""
        return self._episodes[0].worlds

    @property
    def desired_goal(self) -> Tensor:
        """The goals [goals, g], as the first policy sees them."""
        return self._episodes[0].desired_goal

    @property
    def achieved(self) -> list[int]:
        return [before + own.achieved for (before, _), own in zip(self._before, self._episodes, strict=True)]

    @property
    def ended(self) -> list[int]:
        pairs = zip(self._before, self._episodes, strict=True)
        return [before + own.worlds - len(own.running) for (_, before), own in pairs]

    def start(self, *, seed: int) -> None:
        """Begins new episodes; those that go on are given up, and do not count."""
        if self._begun:
            self._before = list(zip(self.achieved, self.ended, strict=True))
        self._begun = True
        for own in self._episodes:
            own.start(seed=seed)

    def step(self) -> None:
        """Takes a step with each policy whose episodes go on."""
        for own in self._episodes:
            own.step()

    def frame(self) -> Tensor:
        """The present picture [height, width, 3] of uint8."""
        if self._labels is None:
            return beside([own.frame for own in self._episodes], gap=_GAP)
        counts = zip(self._episodes, self._labels, self.achieved, self.ended, strict=True)
        return beside(
            [
                underlined(own.frame, [label, f"{achieved} of {ended} achieved"])
                for own, label, achieved, ended in counts
            ],
            gap=_GAP,
        )
