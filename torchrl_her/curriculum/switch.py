"""Start of a stage: resets the buffer, the weights of goals and the exploration of a run."""

from __future__ import annotations

from torchrl.data import ReplayBuffer, Writer

from torchrl_her.curriculum.stages import CurriculumStage
from torchrl_her.goals.instructive import InstructiveWeights
from torchrl_her.modules.exploration import DecayingEpsilon
from torchrl_her.replay_buffers.runs.buffer import empty_run, runs_of
from torchrl_her.replay_buffers.writer import HERWriter


def set_stage_goals(writer: Writer, stage: CurriculumStage, *, run: int = 0) -> None:
    """Sets a writer's reward function for a run, and whether IBS weights apply, to those of a stage.

    Args:
        writer: writer of one run or several.
        stage: the stage that the run is in.

    Keyword Args:
        run: index of the run in the writer.

    Raises:
        TypeError: the writer does not relabel.
    """
    if not isinstance(writer, HERWriter):
        raise TypeError(f"a curriculum needs a buffer with a HERWriter, got a {type(writer).__name__}")
    writer.set_reward(stage.reward_fn, run=run)
    weights = writer.goal_weights[run] if writer.goal_weights else None
    if isinstance(weights, InstructiveWeights):
        weights.is_uniform = not stage.instructive


def enter_stage(
    buffer: ReplayBuffer,
    stage: CurriculumStage,
    exploration: DecayingEpsilon | None = None,
    *,
    epsilon: float | None = None,
    run: int = 0,
) -> None:
    """Begins a run's stage: empties its buffer and restarts its goal weights and its exploration.

    Networks and optimizer are not touched, since the next stage builds on what was learned.

    Args:
        buffer: buffer of the run, or of all runs, with a :class:`~torchrl_her.HERWriter`. It must not
            prefetch, since it would then still return old transitions.
        stage: the stage that begins.
        exploration: exploration of all runs; None to leave exploration as it is.

    Keyword Args:
        epsilon: epsilon with which exploration starts again; None for its first value.
        run: index of the run that begins the stage, in the exploration and in a buffer of several runs.
    """
    place = run if runs_of(buffer) > 1 else 0
    empty_run(buffer, place)
    writer = buffer.writer
    set_stage_goals(writer, stage, run=place)
    if writer.goal_weights and isinstance(weights := writer.goal_weights[place], InstructiveWeights):
        weights.restart()
    if exploration is not None:
        exploration.restart(epsilon, run=run)
