"""Running normalization of the networks' input in a curriculum, whose layers see different things."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import zip_longest

import torch
from tensordict import NestedKey, TensorDictBase

from torchrl_her.checks import check_finite
from torchrl_her.curriculum.layers import CurriculumLayer, CurriculumProgress
from torchrl_her.modules.normalization import RunningNorm


def count_inputs(
    norm: RunningNorm,
    progress: CurriculumProgress,
    rows: TensorDictBase,
    runs: Sequence[int],
    counts: Sequence[int],
    *,
    observation_key: NestedKey = "observation",
    desired_goal_key: NestedKey = "desired_goal",
    input_key: NestedKey = "input",
    layer_key: NestedKey = "layer",
) -> Callable[[], None]:
    """Counts the networks' input of transitions that are written, as :class:`~torchrl_her.ZeroPad` makes it.

    Hand it to the writer as ``HERWriter(on_write=functools.partial(count_inputs, norm, progress))``. Inputs
    that a layer does not use are left out. In the buffer, :class:`~torchrl_her.modules.NormalizeBatch` comes
    behind ``ZeroPad``.

    Args:
        norm: normalization of the input.
        progress: tells the layer of each run.
        rows: [n], run after run, as the layers show them.
        runs: indices of the runs that the rows belong to.
        counts: number of rows of each of these runs.

    Keyword Args:
        observation_key, desired_goal_key: read.
        input_key: key of the input, in ``norm``.
        layer_key: key of the layer that each row carries, if episodes have layers of their own.

    Returns:
        What undoes it.

    Raises:
        ValueError: an input is not finite; then nothing is counted.
    """
    check_finite({f"{key!r}": rows.get(key) for key in (observation_key, desired_goal_key)})
    undo, layers = norm.snapshot(), progress.curriculum.layers
    for run, run_rows in zip(runs, rows.split(list(counts)), strict=True):
        parts = [(progress.layer_of(run), run_rows)]
        if progress.by_episode:
            which = run_rows.get(layer_key).squeeze(-1)
            parts = [(layer, run_rows[which == place]) for place, layer in enumerate(layers)]
        for layer, part in parts:
            shown = len(layer.observation)
            seen = (part.get(observation_key)[..., :shown], part.get(desired_goal_key))
            if len(part) > 0:
                norm.count(input_key, torch.cat(seen, -1), run=run)
    return undo


def restart_inputs(
    norm: RunningNorm,
    before: CurriculumLayer,
    after: CurriculumLayer,
    *,
    run: int = 0,
    input_key: NestedKey = "input",
) -> None:
    """Resets the statistics of the inputs that mean something else in the new layer of a run.

    The others go on, so that at first the networks do in the new layer what they did in the old one.

    Args:
        norm: normalization of the input.
        before: the layer that the run was in.
        after: the one that it enters.

    Keyword Args:
        run: index of the run.
        input_key: key of the input, in ``norm``.

    Example:
        >>> near = CurriculumLayer(
        ...     name="near", observation=[0], achieved_goal=[0], desired_goal=[1], threshold=1.0
        ... )
        >>> far = CurriculumLayer(
        ...     name="far", observation=[0, 1], achieved_goal=[1], desired_goal=[2], threshold=1.0
        ... )
        >>> norm = RunningNorm({"input": 3})
        >>> norm.count("input", torch.tensor([[4.0, 5.0], [6.0, 7.0]]))
        >>> restart_inputs(norm, near, far)  # the second input was the goal and is an observation: both of 1
        >>> norm.moments_of("input").n.tolist()
        [2.0, 2.0, 0.0]
    """
    columns = ([*layer.observation, *layer.desired_goal] for layer in (before, after))
    places = [place for place, (old, new) in enumerate(zip_longest(*columns)) if old != new]
    norm.restart(run, key=input_key, places=places)
