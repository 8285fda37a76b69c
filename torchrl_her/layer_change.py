"""What happens to a run's parts when it begins a layer of a curriculum."""

from __future__ import annotations

from torchrl.data import ReplayBuffer, Writer

from torchrl_her.curriculum import CurriculumLayer
from torchrl_her.exploration import DecayingEpsilon
from torchrl_her.goals import GoalReward
from torchrl_her.instructiveness import Instructiveness
from torchrl_her.writer import HERWriter


def set_layer_goals(writer: Writer, layer: CurriculumLayer) -> None:
    """Lets a writer relabel with the reward of a layer, and prefer goals if the layer says so.

    Raises:
        TypeError: the writer does not relabel.
    """
    if not isinstance(writer, HERWriter):
        raise TypeError(f"a curriculum needs a buffer with a HERWriter, got a {type(writer).__name__}")
    writer.reward = GoalReward(layer.threshold)
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
    """Begins a layer: rows, priorities and q are forgotten, exploration and sigma start anew.

    Networks and optimiser go on as they are: what was learnt is what the next layer builds on.

    Args:
        buffer: of the run, with a :class:`~torchrl_her.HERWriter` and without prefetching, which would
            go on handing out old rows.
        layer: the one that begins.
        exploration: of all runs; None leaves it.

    Keyword Args:
        epsilon: where exploration starts again; None for its own start.
        run: which run the buffer is of.
    """
    buffer.empty()
    writer = buffer.writer
    set_layer_goals(writer, layer)
    if isinstance(writer.weights, Instructiveness):
        writer.weights.restart()
    if exploration is not None:
        exploration.restart(epsilon, run=run)
