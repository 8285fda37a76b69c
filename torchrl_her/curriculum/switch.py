"""The beginning of a layer: buffer, weights of goals and exploration of a run start anew."""

from __future__ import annotations

from torchrl.data import ReplayBuffer, Writer

from torchrl_her.curriculum.layers import CurriculumLayer
from torchrl_her.goals.instructive import InstructiveWeights
from torchrl_her.modules.exploration import DecayingEpsilon
from torchrl_her.replay_buffers.runs.buffer import empty_run, runs_of
from torchrl_her.replay_buffers.writer import HERWriter


def set_layer_goals(writer: Writer, layer: CurriculumLayer, *, run: int = 0) -> None:
    """Lets a writer relabel a run with a layer's reward, and use its IBS weights only if the layer says so.

    Args:
        writer: of one run or several.
        layer: the layer that the run is in.

    Keyword Args:
        run: which of the writer's runs.

    Raises:
        TypeError: the writer does not relabel.
    """
    if not isinstance(writer, HERWriter):
        raise TypeError(f"a curriculum needs a buffer with a HERWriter, got a {type(writer).__name__}")
    writer.set_reward(layer.reward_fn, run=run)
    weights = writer.goal_weights[run] if writer.goal_weights else None
    if isinstance(weights, InstructiveWeights):
        weights.alike = not layer.instructive


def enter_layer(
    buffer: ReplayBuffer,
    layer: CurriculumLayer,
    exploration: DecayingEpsilon | None = None,
    *,
    epsilon: float | None = None,
    run: int = 0,
) -> None:
    """Begins a run's layer: its rows, priorities and q are emptied, its exploration and sigma start anew.

    Networks and optimizer are not touched, since the next layer builds on what was learned.

    Args:
        buffer: of the run, or of all runs, with a :class:`~torchrl_her.HERWriter`. It must not prefetch,
            since it would then still return old transitions.
        layer: the layer that begins.
        exploration: of all runs; None to leave exploration as it is.

    Keyword Args:
        epsilon: where exploration starts again; None for where it started first.
        run: which run begins the layer, for exploration and in a buffer of several runs.
    """
    place = run if runs_of(buffer) > 1 else 0
    empty_run(buffer, place)
    writer = buffer.writer
    set_layer_goals(writer, layer, run=place)
    if writer.goal_weights and isinstance(weights := writer.goal_weights[place], InstructiveWeights):
        weights.restart()
    if exploration is not None:
        exploration.restart(epsilon, run=run)
