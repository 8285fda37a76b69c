"""Curricula whose stages are trained at the same time: each episode is played in a stage of its own."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from torchrl_her.curriculum.stages import Curriculum, CurriculumProgress
from torchrl_her.modules.noise import generator_states, set_generator_states
from torchrl_her.randomness import Generators, check_generators, uniform


class EpisodeStages(CurriculumProgress):
    """Draws the stage of each episode when it begins, so that all stages are trained at once.

    Stages belong to episodes here; the runs themselves are always in the last stage, the full task.
    :class:`~torchrl_her.StateToObs` draws the stages and writes the stage of each row, so that one buffer
    holds rows of all stages and :class:`~torchrl_her.ZeroPad` pads each row by its stage.
    :class:`~torchrl_her.curriculum.StageOutcomes` counts how episodes ended. Random numbers are drawn on the
    CPU. After Luo et al., Relay Hindsight Experience Replay, 2022 (arXiv 2208.00843).

    Args:
        curriculum: the stages.

    Keyword Args:
        runs: R, the number of independent runs.
        generators: generators, one for each run; None for torch's own, with one run only.
        task_share: share of the episodes that are played in the last stage, the full task; the others are
            drawn evenly from the stages below. None gives all stages the same probability.

    Raises:
        ValueError: ``runs`` is below 1, several runs have no generators, or the share is outside of [0, 1].

    Example:
        >>> from torchrl_her import CurriculumStage
        >>> stage = CurriculumStage(
        ...     name="any", observation=[0], achieved_goal=[0], desired_goal=[1], threshold=0.1
        ... )
        >>> stages = EpisodeStages(Curriculum([stage, stage], 2))
        >>> stages.shares.tolist()
        [[0.5, 0.5]]
        >>> set(stages.draw([100]).tolist())
        {0, 1}
    """

    by_episode = True
    # Whether the drawn stages depend on earlier outcomes. If so, one process must play all episodes.
    adapts = False

    def __init__(
        self,
        curriculum: Curriculum,
        *,
        runs: int = 1,
        generators: Sequence[torch.Generator] | None = None,
        task_share: float | None = None,
    ) -> None:
        super().__init__(curriculum, runs=runs)
        below = len(curriculum) - 1
        share = 1 / (below + 1) if task_share is None else task_share
        if not 0 <= share <= 1:
            raise ValueError(f"task_share must be in [0, 1], got {task_share}")
        self.stages = (below,) * runs
        self.generators: Generators = check_generators(runs, generators) or [None]
        lower_shares = [(1 - share) / below] * below if below else []
        self._shares = torch.tensor([[*lower_shares, share if below else 1.0]] * runs, dtype=torch.float64)

    @property
    def shares(self) -> Tensor:
        """The probability of each of L stages for the next episode of each run, [R, L] float64."""
        return self._shares

    def mean_stage(self, run: int) -> float:
        return float(self.shares[self._check_run(run)] @ torch.arange(len(self.curriculum)).double())

    def draw(self, counts: Sequence[int]) -> Tensor:
        """Draws the stages of episodes that begin.

        Args:
            counts: number of new episodes of each run.

        Returns:
            Index of each episode's stage, [sum of counts] int64, sorted by run.
        """
        numbers = uniform(counts, 1, self.generators, dtype=torch.float64)
        below = self.shares.cumsum(1).repeat_interleave(torch.tensor(list(counts)), 0)
        return (numbers >= below[:, :-1]).sum(1)

    def record_episodes(self, ended: Tensor, achieved: Tensor) -> None:
        """Records how many episodes of each run and stage have ended, and in how many the goal was achieved.

        Args:
            ended: [R, L] int64, number of ended episodes.
            achieved: [R, L] int64, number of these in which the goal was achieved.
        """

    def set_stage(self, run: int, stage: int) -> None:
        """Raises a ValueError: episodes have stages here, not runs."""
        raise ValueError(f"run {run} cannot be moved to stage {stage}: each episode has a stage of its own")

    def state_dict(self) -> dict[str, Any]:
        return {**super().state_dict(), "generators": generator_states(self.generators)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        super().load_state_dict(state)
        set_generator_states(self.generators, state["generators"])


class TeacherStudent(EpisodeStages):
    """Prefers stages whose success rate changes, in proportion to the absolute change.

    A stage's progress is the distance between two averages of its success: over its recent episodes, and over
    the newer half of them. A share of the episodes draws all stages with equal probability, so that a stage
    without progress is noticed when its success changes. After Matiisen et al., Teacher-Student Curriculum
    Learning, 2017 (arXiv 1707.00183), here with exponential moving averages in place of windows.

    Args:
        curriculum, runs, generators: as in :class:`~torchrl_her.curriculum.EpisodeStages`.
        memory: number of later episodes of a stage after which an episode's weight has fallen to 1 / e.
        uniform_share: share of the episodes for which all stages have the same probability.
        still: constant that is added to the progress of each stage, so that random changes of the success
            rate have little effect.

    Attributes:
        long, short: [R, L] float64, success rates over recent episodes, and over the newest of these.

    Raises:
        ValueError: an option is out of its range.

    Example:
        >>> from torchrl_her import CurriculumStage
        >>> stage = CurriculumStage(
        ...     name="any", observation=[0], achieved_goal=[0], desired_goal=[1], threshold=0.1
        ... )
        >>> teacher = TeacherStudent(Curriculum([stage, stage], 2), uniform_share=0.2)
        >>> teacher.record_episodes(torch.tensor([[50, 50]]), torch.tensor([[40, 0]]))
        >>> [round(share, 2) for share in teacher.shares[0].tolist()]  # only the first stage makes progress
        [0.81, 0.19]
    """

    adapts = True

    def __init__(
        self,
        curriculum: Curriculum,
        *,
        runs: int = 1,
        generators: Sequence[torch.Generator] | None = None,
        memory: float = 200.0,
        uniform_share: float = 0.2,
        still: float = 0.02,
    ) -> None:
        if not 0 < memory < torch.inf:
            raise ValueError(f"memory must be positive and finite, got {memory}")
        if not 0 < uniform_share <= 1:
            raise ValueError(f"uniform_share must be in (0, 1], got {uniform_share}")
        super().__init__(curriculum, runs=runs, generators=generators)
        if not 0 < still < torch.inf:
            raise ValueError(f"still must be positive and finite, got {still}")
        self.memory, self.uniform_share, self.still = memory, uniform_share, still
        self.long = torch.zeros(runs, len(curriculum), dtype=torch.float64)
        self.short = torch.zeros_like(self.long)

    @property
    def shares(self) -> Tensor:
        progress = (self.short - self.long).abs() + self.still
        preferred = progress / progress.sum(1, keepdim=True)
        return self.uniform_share * super().shares + (1 - self.uniform_share) * preferred

    def record_episodes(self, ended: Tensor, achieved: Tensor) -> None:
        rate = (achieved / ended.clamp(min=1)).to(self.long)
        for average, memory in ((self.long, self.memory), (self.short, self.memory / 2)):
            kept = torch.exp(-ended.to(self.long) / memory)
            average.mul_(kept).add_((1 - kept) * rate)

    def state_dict(self) -> dict[str, Any]:
        return {**super().state_dict(), "long": self.long.clone(), "short": self.short.clone()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        super().load_state_dict(state)
        self.long, self.short = state["long"].clone(), state["short"].clone()
