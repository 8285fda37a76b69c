"""What happens to the buffer, weights and exploration of a run when it begins a layer."""

from __future__ import annotations

from torchrl.data import ReplayBuffer, Writer

from torchrl_her.curriculum.layers import CurriculumLayer
from torchrl_her.goals.ibs import Instructiveness
from torchrl_her.goals.rewards import GoalReward
from torchrl_her.modules.exploration import DecayingEpsilon
from torchrl_her.replay_buffers.writer import HERWriter


def set_layer_goals(writer: Writer, layer: CurriculumLayer) -> None:
    """Lets a writer relabel with a layer's reward, and use its IBS weights only if the layer says so.

    Raises:
        TypeError: the writer does not relabel.
    """
    if not isinstance(writer, HERWriter):
        raise TypeError(f"a curriculum needs a buffer with a HERWriter, got a {type(writer).__name__}")
    writer.reward_fn = GoalReward(layer.threshold)
    if isinstance(writer.weights, Instructiveness):
        writer.weights.alike = not layer.instructive


def enter_layer(
    buffer: ReplayBuffer,
    layer: CurriculumLayer,
    exploration: DecayingEpsilon | None = None,
    *,
    epsilon: float | None = None,
    run: int = 0,
) -> None:
    """Begins a layer: the buffer, its priorities and q are emptied, exploration and sigma start anew.

    Networks and optimizer are not touched, since the next layer builds on what was learned.

    Args:
        buffer: of the run, with a :class:`~torchrl_her.HERWriter`. It must not prefetch, since it would then
            still return old transitions.
        layer: the layer that begins.
        exploration: of all runs; None to leave exploration as it is.

    Keyword Args:
        epsilon: where exploration starts again; None for where it started first.
        run: which run the buffer is of.
    """
    buffer.empty()
    writer = buffer.writer
    set_layer_goals(writer, layer)
    if isinstance(writer.weights, Instructiveness):
        writer.weights.restart()
    if exploration is not None:
        exploration.restart(epsilon, run=run)
