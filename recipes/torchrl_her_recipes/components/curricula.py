"""Makes a recipe's curriculum, the progress of runs through it, and transforms that apply a run's stage."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from torchrl.data import Writer
from torchrl.envs import CatTensors, Compose, EnvBase, InitTracker, Transform, TransformedEnv

from torchrl_her.behavior import BehaviorGoals
from torchrl_her.curriculum.orders import EpisodeStages, TeacherStudent
from torchrl_her.curriculum.stages import Curriculum, CurriculumProgress, CurriculumStage
from torchrl_her.curriculum.switch import set_stage_goals
from torchrl_her.curriculum.transforms import StageOutcomes, StateToObs, ZeroPad
from torchrl_her.demonstrations.starts import DemonstrationStarts
from torchrl_her.goals.rewards import EnvReward
from torchrl_her_envs.common.goal_env import GoalEnv, goal_env, reward_range
from torchrl_her_recipes.components.envs import TaskEnvs
from torchrl_her_recipes.components.streams import Stream, generators_of
from torchrl_her_recipes.config.choices.order import AllAtOnce, Order, Teacher, Threshold
from torchrl_her_recipes.config.choices.weights import Equal, Weights
from torchrl_her_recipes.config.groups import CurriculumConfig
from torchrl_her_recipes.config.values import load_name

_STATE = ["observation", "desired_goal"]  # entries whose concatenation is the state


@dataclass
class CurriculumState:
    """The curriculum of some runs, and the stage that each of them is in.

    Attributes:
        progress: the stage of each run.
        stage_env: environments that evaluate each run at the goals of its stage; None if each episode has a
            stage of its own.
        stored_shares: share of the episodes that are stored for each stage, besides those that were played in
            it; None if no others are.
    """

    progress: CurriculumProgress
    stage_env: EnvBase | None
    stored_shares: list[float] | None

    @property
    def curriculum(self) -> Curriculum:
        """The list of stages, which is the same for all runs."""
        return self.progress.curriculum

    def at_the_top(self, run: int) -> bool:
        """Returns whether a run is in the last stage, which is the full task."""
        return self.progress.stages[run] == len(self.curriculum) - 1

    def set_goals(self, writer: Writer) -> None:
        """Sets the reward function and weights of a writer to those of each run's stage.

        If each episode has a stage of its own, the writer has rules for all stages, and nothing is set.
        """
        for run in range(0 if self.progress.by_episode else self.progress.runs):
            set_stage_goals(writer, self.progress.stage_of(run), run=run)


def make_curriculum(options: CurriculumConfig | None, env: EnvBase) -> Curriculum | None:
    """Makes the curriculum, with the stages in ``options`` or the task's own; None without ``options``."""
    if options is None:
        return None
    task = goal_env(env)
    return read_curriculum(task.stages() if options.stages is None else options.stages, task)


def read_curriculum(stages: object, env: GoalEnv) -> Curriculum:
    """Makes a curriculum from plain values, which refer to entries of an environment's state.

    The state is the observation followed by the desired goal. Its entries are given by index, or by the names
    that the environment has for them (``env.state_names()``). The last stage is the environment's own task.
    Earlier stages have the task's two rewards, of a missed and of an achieved goal.

    Args:
        stages: list of mappings, each with the options of a :class:`~torchrl_her.CurriculumStage`.
        env: environment that defines the rewards and the width of the state.

    Example:
        >>> from torchrl_her_envs import make_env
        >>> env = make_env("hand_v1")
        >>> [stage.name for stage in read_curriculum(env.stages(), env).stages]
        ['reach', 'throw']
    """
    if not isinstance(stages, Sequence) or isinstance(stages, str):
        raise ValueError(f"curriculum must be a list of stages, got {type(stages).__name__}")
    width = sum(env.observation_spec[key].shape[-1] for key in _STATE)
    parsed = [_read_stage(stage, env, is_last=stage is stages[-1]) for stage in stages]
    curriculum, goal = Curriculum(parsed, width, names=env.state_names()), env.state_names()["desired_goal"]
    if list(last := curriculum.stages[-1].desired_goal) != goal:
        raise ValueError(
            f"stage {parsed[-1].name!r}: the last stage is the task itself, so its desired_goal must be "
            f"{goal}, got {list(last)}"
        )
    return curriculum


def _read_stage(options: Any, env: GoalEnv, *, is_last: bool) -> CurriculumStage:
    try:
        for option in ("threshold", "terminates"):
            if is_last and option in options:
                raise ValueError(
                    f"stage {options.get('name')!r}: {option} has no effect in the last stage, where the "
                    "environment decides if goals are achieved; leave it out"
                )
        return CurriculumStage(**options, rewards=reward_range(env))
    except TypeError as error:  # options are missing or unknown, or ``options`` is not a mapping
        raise ValueError(f"{options!r} is no stage of a curriculum: {error}") from error


def make_curriculum_state(
    order: Order, progress: CurriculumProgress | None, envs: TaskEnvs, num_envs: int, seeds: Sequence[int]
) -> CurriculumState | None:
    """Makes the state of runs from their progress, with ``num_envs`` environments for each run, or None."""
    if progress is None:
        return None
    by_run = not isinstance(progress, EpisodeStages)
    stage_env = in_stages(envs.make(num_envs, seeds), progress) if by_run else None
    shares = None
    if getattr(order, "every_stage", False):
        shares = [getattr(order, "lower_share", 1.0)] * (len(progress.curriculum) - 1) + [1.0]
    return CurriculumState(progress, stage_env, shares)


def check_order(order: Order, progress: CurriculumProgress | None, weights: Weights, processes: int) -> None:
    """Refuses options that cannot be used if each episode has a stage of its own.

    Raises:
        ValueError: weights of goals are chosen, which would count goals of different stages together, or
            several processes collect although each needs the results of all episodes.
    """
    if not isinstance(progress, EpisodeStages):
        return
    if not isinstance(weights, Equal):
        raise ValueError(
            f"weights={weights.name} cannot be used with order={order.name}: goals of different "
            "stages would be counted together; choose order=threshold"
        )
    if progress.adapts and processes > 0:
        raise ValueError(
            f"order={order.name} draws stages by the results of all episodes: it needs processes=0, "
            f"got processes={processes}"
        )


def make_progress(
    order: Order, options: CurriculumConfig | None, env: EnvBase, seeds: Sequence[int]
) -> CurriculumProgress | None:
    """Makes the record of the runs' stages at the beginning of training; None without a curriculum."""
    if (curriculum := make_curriculum(options, env)) is None:
        return None
    progress: CurriculumProgress = load_name(order.maker)(
        order, curriculum, runs=len(seeds), generators=generators_of(seeds, Stream.STAGES)
    )
    return progress


def make_threshold(options: Threshold, curriculum: Curriculum, *, runs: int, **_: Any) -> CurriculumProgress:
    """Makes the order ``threshold``: runs learn one stage after the other."""
    return CurriculumProgress(
        curriculum,
        runs=runs,
        window=options.window,
        success_threshold=options.success_threshold,
        patience=options.stage_epochs or None,
    )


def make_all_at_once(options: AllAtOnce, curriculum: Curriculum, **runs: Any) -> EpisodeStages:
    """Makes the order ``all_at_once``: each episode's stage is drawn with constant probabilities."""
    return EpisodeStages(curriculum, **runs, task_share=options.task_share)


def make_teacher(options: Teacher, curriculum: Curriculum, **runs: Any) -> TeacherStudent:
    """Makes the order ``teacher_student``: stages whose success changes are drawn more often."""
    return TeacherStudent(
        curriculum,
        **runs,
        memory=options.progress_memory,
        uniform_share=options.even_share,
        still=options.least_progress,
    )


def make_played_env(
    envs: TaskEnvs,
    num_envs: int,
    seeds: Sequence[int],
    *,
    pictures: bool = False,
    behavior: BehaviorGoals | None = None,
) -> EnvBase:
    """Makes environments for playing a trained policy; with a curriculum, all are in its last stage."""
    env = envs.make(num_envs, seeds, pictures=pictures)
    curriculum = make_curriculum(envs.curriculum, env)
    progress = None if curriculum is None else at_the_top(curriculum, len(seeds))
    return in_stages(env, progress, behavior=behavior)


def is_guided(options: CurriculumConfig | None, progress: CurriculumProgress | None) -> bool:
    """Returns whether an earlier stage's policy acts first in some episodes (``guided_share``)."""
    if options is None or progress is None:
        return False
    return options.guided_share > 0 and len(progress.curriculum) > 1


def in_stages(
    env: EnvBase,
    progress: CurriculumProgress | None,
    *,
    begins: bool = False,
    behavior: BehaviorGoals | None = None,
    starts: DemonstrationStarts | None = None,
) -> EnvBase:
    """Adds transforms for stages, network inputs, proposed goals and demonstrated starts to an environment.

    Args:
        env: environment of the full task.
        progress: stages of the runs; None without a curriculum.

    Keyword Args:
        begins: whether to add the entry ``is_init``, which is true in an episode's first step.
        behavior: transform that proposes goals, or None.
        starts: transform that starts episodes at states of demonstrations, or None.
    """
    if progress is None:
        chooses_goals = behavior if starts is None else starts  # a recipe must not have both
        return env if chooses_goals is None else TransformedEnv(env, chooses_goals, auto_unwrap=True)
    curriculum = progress.curriculum
    state_to_obs = StateToObs(
        curriculum, progress, continues_after_termination=goal_env(env).continues_after_termination
    )
    proposes = [] if behavior is None else [behavior]
    transforms: list[Transform] = [state_to_obs, *proposes, ZeroPad(curriculum, progress)]
    if "state" not in env.observation_spec:
        transforms.insert(0, CatTensors(_STATE, "state", del_keys=False, sort=False))
    if begins:
        transforms.append(InitTracker())
    if isinstance(progress, EpisodeStages):
        transforms.append(StageOutcomes(progress, reward_fn=EnvReward.of(env)))
    if starts is not None:
        transforms = [starts, *transforms, starts.outcomes()]
    return TransformedEnv(env, Compose(*transforms), auto_unwrap=True)


def at_the_top(curriculum: Curriculum, runs: int) -> CurriculumProgress:
    """Returns the progress of runs that are all in the last stage, which is the full task."""
    progress = CurriculumProgress(curriculum, runs=runs)
    for run in range(runs):
        progress.set_stage(run, len(curriculum) - 1)
    return progress
