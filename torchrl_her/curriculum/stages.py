"""CHER: the observation and the goal of each stage of a curriculum, and the stage that each run is in.

After chapter 6 (Curriculum HER) of the thesis that the method is from. The transforms that apply
this to environments and to replay buffers are :class:`~torchrl_her.StateToObs` and
:class:`~torchrl_her.ZeroPad`.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import accumulate, pairwise
from typing import Any

import torch
from torch import Tensor

from torchrl_her.checks import check_whole
from torchrl_her.goals.rewards import GoalReward, RewardFunction

Indices = str | Sequence[int | str]
_LISTS = ("observation", "achieved_goal", "desired_goal")


@dataclass(frozen=True, kw_only=True)
class CurriculumStage:
    """Stage of a curriculum: the entries of the state that are its observation and its goals.

    Args:
        name: name of the stage, for messages and reports.
        observation, achieved_goal, desired_goal: indices into the state vector, or names that the argument
            ``names`` of :class:`~torchrl_her.Curriculum` translates to indices.
        constant_goal: entries of the goal that are the same in all episodes, like a gap in a wall or open
            fingers, in the unit of the achieved goal. They follow those of ``desired_goal``, if it has any.
        threshold: the goal is achieved at distances below this, in the unit of the state. The last stage,
            which is the environment's own task, needs no threshold: its goals are relabeled by the reward
            function that the writer was made with.
        rewards: rewards of a missed and of an achieved goal, in stages below the last.
        terminates: whether achieving the goal ends the stage's episode, in stages below the last. If not, the
            goal has to be held: a block that slides through it does not count for more than that step.
        instructive: whether IBS weights apply in this stage.

    Raises:
        ValueError: a list is empty, an index is negative or repeated, the desired goal shares an index with
            another list, the goals differ in width, a constant goal is not finite, the threshold is not
            positive, or a flag is no bool.

    Example:
        >>> CurriculumStage(
        ...     name="reach", observation=[0, 1], achieved_goal=[0], desired_goal=[2], threshold=0.1
        ... ).observation
        (0, 1)
    """

    name: str
    observation: Indices
    achieved_goal: Indices
    desired_goal: Indices = ()
    threshold: float | None = None
    rewards: tuple[float, float] = (-1.0, 0.0)
    terminates: bool = True
    constant_goal: Sequence[float] = ()
    instructive: bool = True

    def __post_init__(self) -> None:
        if self.threshold is not None and not 0 < self.threshold < math.inf:
            raise ValueError(
                f"stage {self.name!r}: threshold must be positive and finite, got {self.threshold}"
            )
        for key in ("terminates", "instructive"):
            if not isinstance(getattr(self, key), bool):
                raise ValueError(
                    f"stage {self.name!r}: {key} must be true or false, got {getattr(self, key)!r}"
                )
        object.__setattr__(self, "constant_goal", tuple(map(float, self.constant_goal)))
        if not all(map(math.isfinite, self.constant_goal)):
            raise ValueError(f"stage {self.name!r}: constant_goal must be finite, got {self.constant_goal}")
        for key in _LISTS:
            value = getattr(self, key)
            entries = [value] if isinstance(value, str) else list(value)
            if not entries and not (key == "desired_goal" and self.constant_goal):
                raise ValueError(f"stage {self.name!r}: {key} must not be empty")
            object.__setattr__(
                self, key, tuple(e if isinstance(e, str) else operator.index(e) for e in entries)
            )
        if not any(isinstance(entry, str) for key in _LISTS for entry in getattr(self, key)):
            self._check_indices()

    @cached_property  # one function for all runs in a stage, so that a writer can relabel them together
    def reward_fn(self) -> RewardFunction | None:
        """Reward function of the stage's goals; None without a threshold."""
        if self.threshold is None:
            return None
        missed, achieved = self.rewards
        return GoalReward(
            self.threshold, missed_reward=missed, achieved_reward=achieved, terminates=self.terminates
        )

    def _check_indices(self) -> None:
        """Checks a stage's indices, except against the width of the state, which :class:`Curriculum` does."""
        for key in _LISTS:
            entries = getattr(self, key)
            if min(entries, default=0) < 0:
                raise ValueError(f"stage {self.name!r}: {key} must have indices of at least 0, got {entries}")
            if len(set(entries)) < len(entries):
                raise ValueError(f"stage {self.name!r}: {key} must not repeat an index, got {entries}")
        for key in ("observation", "achieved_goal"):  # these may share entries, but not with the desired goal
            shared = sorted(set(self.desired_goal) & set(getattr(self, key)))
            if shared:
                raise ValueError(
                    f"stage {self.name!r}: desired_goal must share no index with {key}, got {shared} in both"
                )
        goal = (*self.desired_goal, *self.constant_goal)
        if len(self.achieved_goal) != len(goal):
            raise ValueError(
                f"stage {self.name!r}: achieved_goal and the goal must have the same width, "
                f"got {self.achieved_goal} and {goal}"
            )


class Curriculum:
    """Stages in the order in which they are trained, the last one being the full task.

    The network's input is, in each stage, [its n observation entries | its desired goal | zeros],
    as wide as the last stage's. Goals that have fewer entries than the last stage's are followed by zeros.
    Order the state so that a stage's inputs, its observation and then its desired goal, are the first inputs
    of the next stage. Inputs then keep their meaning, and what was learned carries over: in the hand tasks
    the inputs are [hand | ball] for reaching and [hand | ball | speed | black hole] for throwing.

    Args:
        stages: stages in the order of training, one or more.
        state_width: width of the state vector, the real observation followed by the real goal.

    Keyword Args:
        names: indices into the state, for each name that stages use in place of indices.

    Attributes:
        stages: the stages, with indices in place of names and of constant goals.
        resolved: the stages, with indices in place of names only.
        appended: the zero and the constant goals that :meth:`extend` appends to a state.
        observation_width, goal_width: widths of observations and goals in all stages: the widths of the
            last stage, as shorter ones are followed by zeros.
        input_width: width of the network's input.
        first_inputs: number of inputs that the first stage uses; they are the leading ones.
        state_index: [stages, observation_width + 2 * goal_width], indices of observation, achieved and
            desired goal in the extended state.
        input_index: [stages, input_width], indices of the network's input in the observation with the
            desired goal and a zero appended.
        input_columns: [stages, input_width], the same as columns of ``extend(state)``.

    Raises:
        ValueError: there is no stage, a name is unknown, an index lies outside of the state, the observation
            or the goal of a stage is wider than the last one's, a stage below the last has no threshold, or
            the last one has a constant goal.

    Example:
        >>> parts = {"hand": [0, 1], "ball": [2], "hole": [3]}
        >>> reach = CurriculumStage(
        ...     name="reach", observation="hand", achieved_goal=[0], desired_goal="ball", threshold=0.1
        ... )
        >>> throw = CurriculumStage(
        ...     name="throw",
        ...     observation=["hand", "ball"],
        ...     achieved_goal="ball",
        ...     desired_goal="hole",
        ...     threshold=0.2,
        ... )
        >>> curriculum = Curriculum([reach, throw], 4, names=parts)
        >>> curriculum.observation_width, curriculum.input_width, curriculum.first_inputs
        (3, 4, 3)
    """

    def __init__(
        self,
        stages: Sequence[CurriculumStage],
        state_width: int,
        *,
        names: Mapping[str, Sequence[int]] | None = None,
    ) -> None:
        if not stages:
            raise ValueError("a curriculum needs at least one stage, got none")
        resolved = self.resolved = tuple(_resolve(stage, names or {}) for stage in stages)
        if resolved[-1].constant_goal:
            raise ValueError(
                f"stage {resolved[-1].name!r}: the last stage is the full task, its goal must not be constant"
            )
        self.state_width = state_width
        self.observation_width = len(resolved[-1].observation)
        self.goal_width = len(resolved[-1].desired_goal)
        for stage in resolved:
            self._check(stage, resolved[-1])
            if stage.threshold is None and stage is not resolved[-1]:
                raise ValueError(f"stage {stage.name!r}: all stages but the last need a threshold")
        self.appended = [0.0, *(number for stage in resolved for number in stage.constant_goal)]
        ends = accumulate((len(stage.constant_goal) for stage in resolved), initial=state_width + 1)
        self.stages = tuple(
            replace(stage, desired_goal=(*stage.desired_goal, *range(start, end)), constant_goal=())
            for stage, (start, end) in zip(resolved, pairwise(ends), strict=True)
        )
        self.input_width = self.observation_width + self.goal_width
        self.first_inputs = len(self.stages[0].observation) + len(self.stages[0].desired_goal)
        self.state_index = torch.tensor([self._state_index(stage) for stage in self.stages])
        self.input_index = torch.tensor([self._input_index(stage) for stage in self.stages])
        inputs = ([*stage.observation, *stage.desired_goal] for stage in self.stages)
        self.input_columns = torch.tensor([self.padded(each, self.input_width) for each in inputs])

    def __len__(self) -> int:
        return len(self.stages)

    def extend(self, state: Tensor) -> Tensor:
        """Appends a zero and the constant goals, to which stages refer, to states [..., state_width].

        Example:
            >>> gap = CurriculumStage(
            ...     name="gap", observation=[0], achieved_goal=[0], constant_goal=[5.0], threshold=0.5
            ... )
            >>> cross = CurriculumStage(
            ...     name="cross", observation=[0], achieved_goal=[0], desired_goal=[1], threshold=0.5
            ... )
            >>> curriculum = Curriculum([gap, cross], 2)
            >>> curriculum.extend(torch.tensor([3.0, 9.0])).tolist(), curriculum.stages[0].desired_goal
            ([3.0, 9.0, 0.0, 5.0], (3,))
        """
        extended = torch.nn.functional.pad(state, (0, len(self.appended)))
        if len(self.appended) > 1:
            extended[..., self.state_width :] = extended.new_tensor(self.appended)
        return extended

    def show(self, state: Tensor, stage: int) -> tuple[Tensor, Tensor, Tensor]:
        """Returns the observation, the achieved and the desired goal that a stage selects from states.

        Args:
            state: [..., state_width], state vectors.
            stage: index of the stage, from 0.

        Returns:
            Observation [..., observation_width], achieved and desired goal [..., goal_width], each filled up
            with zeros.
        """
        entries = self.extend(state).index_select(-1, self.state_index[stage].to(state.device))
        observation, achieved, desired = entries.split(
            [self.observation_width, self.goal_width, self.goal_width], -1
        )
        return observation, achieved, desired

    def _check(self, stage: CurriculumStage, last: CurriculumStage) -> None:
        for key in _LISTS:
            highest = max(getattr(stage, key), default=0)
            if highest >= self.state_width:
                raise ValueError(
                    f"stage {stage.name!r}: {key} has index {highest}, "
                    f"but the state has {self.state_width} entries: at most {self.state_width - 1} is allowed"
                )
        for key, widest in (("observation", self.observation_width), ("achieved_goal", self.goal_width)):
            if (width := len(getattr(stage, key))) > widest:
                raise ValueError(
                    f"stage {stage.name!r}: {key} has {width} entries, but may have at most {widest}, "
                    f"as in the last stage, {last.name!r}"
                )

    def _state_index(self, stage: CurriculumStage) -> list[Any]:
        goals = (stage.achieved_goal, stage.desired_goal)
        padded = (index for goal in goals for index in self.padded(goal, self.goal_width))
        return [*self.padded(stage.observation, self.observation_width), *padded]

    def padded(self, indices: Indices, width: int) -> list[Any]:
        """Pads indices into the extended state to a width, with the index of the zero in that state."""
        return [*indices, *[self.state_width] * (width - len(indices))]

    def _input_index(self, stage: CurriculumStage) -> list[int]:
        n, goal = len(stage.observation), range(self.observation_width, self.input_width)
        return [*range(n), *goal, *([self.input_width] * (self.observation_width - n))]


def _resolve(stage: CurriculumStage, names: Mapping[str, Sequence[int]]) -> CurriculumStage:
    """Replaces the names in a stage by indices, which :class:`CurriculumStage` then checks."""

    def indices(key: str) -> list[int]:
        resolved_indices: list[int] = []
        for entry in getattr(stage, key):
            if isinstance(entry, str) and entry not in names:
                raise ValueError(
                    f"stage {stage.name!r}: {key} has the unknown name {entry!r}; "
                    f"known are {', '.join(map(repr, names)) or 'none'}"
                )
            resolved_indices += names[entry] if isinstance(entry, str) else [entry]
        return resolved_indices

    return replace(stage, **{key: indices(key) for key in _LISTS})  # type: ignore[arg-type]


class CurriculumProgress:
    """Progress of R independent runs: the stage that each is in, and its recent successes there.

    A run moves to the next stage when the mean of its last ``window`` samples of success reaches the
    threshold. The window is then cleared, so that samples of earlier stages never count. The last stage
    never ends.

    Args:
        curriculum: the stages.

    Keyword Args:
        runs: R, the number of independent runs.
        window: number of samples that are averaged; with fewer a run stays in its stage.
        success_threshold: the mean at which a stage ends.
        patience: number of evaluations (calls of :meth:`record`) after which a stage ends although the mean
            is lower; None for no limit.

    Attributes:
        stages: R numbers, the stage of each run, from 0.

    Raises:
        ValueError: ``runs`` or ``window`` is below 1, or the threshold is outside of (0, 1].

    Example:
        >>> stage = CurriculumStage(
        ...     name="any", observation=[0], achieved_goal=[0], desired_goal=[1], threshold=0.1
        ... )
        >>> progress = CurriculumProgress(Curriculum([stage, stage], 2), runs=2, window=3)
        >>> progress.record(torch.tensor([[1.0, 1.0, 1.0], [1.0, 0.0, 1.0]])).tolist()
        [True, False]
        >>> progress.stages
        (1, 0)
    """

    # True if each episode has a stage of its own; False if each run has one.
    by_episode = False

    def __init__(
        self,
        curriculum: Curriculum,
        *,
        runs: int = 1,
        window: int = 20,
        success_threshold: float = 0.9,
        patience: int | None = None,
    ) -> None:
        check_whole(runs=runs, window=window, patience=1 if patience is None else patience)
        if not 0.0 < success_threshold <= 1.0:
            raise ValueError(f"success_threshold must be in (0, 1], got {success_threshold}")
        self.curriculum, self.runs = curriculum, runs
        self.window, self.success_threshold, self.patience = window, success_threshold, patience
        # Stages are plain numbers, since transforms read them in every step and must not wait for a device.
        self.stages = (0,) * runs
        self._successes: list[list[float]] = [[] for _ in range(runs)]
        self._evaluations = [0] * runs  # number of evaluations in each run's current stage

    @property
    def stage(self) -> Tensor:
        """The stage of each run, [R] of int64. It is a copy; :meth:`set_stage` moves a run."""
        return torch.tensor(self.stages)

    @property
    def successes(self) -> list[list[float]]:
        """Latest samples of success of each run in its present stage, the newest last; a copy."""
        return [list(samples) for samples in self._successes]

    @property
    def evaluations(self) -> list[int]:
        """Number of evaluations of each run in its present stage."""
        return list(self._evaluations)

    def mean_stage(self, run: int) -> float:
        """Mean index of the stages in which a run's episodes are played."""
        return float(self.stages[self._check_run(run)])

    def stage_of(self, run: int) -> CurriculumStage:
        """Returns the present stage of a run."""
        return self.curriculum.stages[self.stages[self._check_run(run)]]

    def set_stage(self, run: int, stage: int) -> None:
        """Moves a run to a stage, and clears its window of successes.

        Raises:
            ValueError: there is no such run or stage.
        """
        self._check_run(run)
        if not 0 <= stage < len(self.curriculum):
            raise ValueError(f"stage must be in [0, {len(self.curriculum) - 1}], got {stage}")
        self.stages = (*self.stages[:run], stage, *self.stages[run + 1 :])
        self._successes[run], self._evaluations[run] = [], 0

    def record(self, successes: Tensor) -> Tensor:
        """Adds samples of success of all runs; see :meth:`record_run`.

        Args:
            successes: [R, n], each in [0, 1] (or of bool), the earliest first.

        Returns:
            [R] of bool: which runs moved on.
        """
        if successes.ndim != 2 or len(successes) != self.runs:
            raise ValueError(f"successes must be [{self.runs}, n], got {list(successes.shape)}")
        samples = [_samples(row) for row in successes]  # all runs are checked before any sample is counted
        return torch.tensor([self._record(run, run_samples) for run, run_samples in enumerate(samples)])

    def record_run(self, run: int, successes: Tensor) -> bool:
        """Adds samples of success of one run, one after the other.

        A stage ends at the first sample with which the window's mean reaches the threshold. Later samples
        were made in the old stage and are dropped, so a call ends at most one stage.

        Args:
            run: the run's number, from 0.
            successes: [n], each in [0, 1] (or of bool), the earliest first.

        Returns:
            Whether the run moved on to its next stage.

        Raises:
            ValueError: there is no such run, the shape is wrong, or a sample is outside of [0, 1].
        """
        return self._record(self._check_run(run), _samples(successes))

    def state_dict(self) -> dict[str, Any]:
        """Returns stages, samples of success and numbers of evaluations of all runs."""
        return {
            "stage": self.stage,
            "successes": self.successes,
            "evaluations": self.evaluations,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores the state that :meth:`state_dict` returned.

        Raises:
            ValueError: the state has another number of runs, or a stage that does not exist.
        """
        stages = tuple(state["stage"].tolist())
        if len(stages) != self.runs:
            raise ValueError(f"the state must have {self.runs} runs, got {len(stages)}")
        if not all(0 <= stage < len(self.curriculum) for stage in stages):
            raise ValueError(f"stages in the state must be in [0, {len(self.curriculum) - 1}], got {stages}")
        self.stages = stages
        self._successes = [list(samples)[-self.window :] for samples in state["successes"]]
        self._evaluations = list(state["evaluations"])

    def _record(self, run: int, samples: list[float]) -> bool:
        latest, last = self._successes[run], len(self.curriculum) - 1
        for sample in samples:
            latest.append(sample)
            del latest[: -self.window]
            if len(latest) < self.window or sum(latest) / self.window < self.success_threshold:
                continue
            if self.stages[run] < last:
                self.set_stage(run, self.stages[run] + 1)
                return True
        self._evaluations[run] += 1
        if self.stages[run] < last and self._evaluations[run] == self.patience:
            self.set_stage(run, self.stages[run] + 1)
            return True
        return False

    def _check_run(self, run: int) -> int:
        if not 0 <= run < self.runs:
            raise ValueError(f"run must be in [0, {self.runs - 1}], got {run}")
        return run


def _samples(successes: Tensor) -> list[float]:
    if successes.ndim != 1:
        raise ValueError(f"successes of a run must be [n], got {list(successes.shape)}")
    samples = successes.to(torch.float64)
    bad = samples[~((samples >= 0.0) & (samples <= 1.0))]
    if len(bad):
        raise ValueError(f"successes must be in [0, 1], got {bad[0].item()}")
    return samples.tolist()


def zero_unused_inputs(weight: Tensor, used: int, *, alpha: float = 0.0) -> Tensor:
    """Scales down the weights that the first layer of a network gives to inputs that are not used yet.

    Unused inputs are 0, so these weights have gradients of 0 and stay as they are until their stage begins
    (under an optimizer without weight decay). With ``alpha = 0``, the outputs at that moment do not depend
    on the new inputs, so the change of stage does not change what the network does.

    Args:
        weight: [..., inputs, outputs], as :class:`~torchrl_her.modules.StackedLinear` has it
            (``nn.Linear`` has it transposed).
        used: number of leading inputs that are used; see ``Curriculum.first_inputs``.
        alpha: factor for the weights of all other inputs.

    Returns:
        A new tensor like ``weight``.

    Raises:
        ValueError: ``used`` is not in [0, inputs], or ``alpha`` is negative or not finite.

    Example:
        >>> zero_unused_inputs(torch.ones(1, 3, 1), 2).flatten().tolist()
        [1.0, 1.0, 0.0]
    """
    inputs = weight.shape[-2]
    if not 0 <= used <= inputs:
        raise ValueError(f"used must be in [0, {inputs}], got {used}")
    if not 0.0 <= alpha < math.inf:
        raise ValueError(f"alpha must be finite and at least 0, got {alpha}")
    return torch.cat((weight[..., :used, :], weight[..., used:, :] * alpha), -2)
