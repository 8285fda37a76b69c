"""Running normalization of the networks' input in a curriculum, whose stages have different inputs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import zip_longest

import torch
from tensordict import NestedKey, TensorDictBase

from torchrl_her.checks import check_finite
from torchrl_her.curriculum.stages import CurriculumProgress, CurriculumStage
from torchrl_her.env_keys import EnvKeys
from torchrl_her.modules.normalization import RunningNorm


def count_inputs(
    norm: RunningNorm,
    progress: CurriculumProgress,
    rows: TensorDictBase,
    runs: Sequence[int],
    counts: Sequence[int],
    *,
    keys: EnvKeys = EnvKeys(),
    input_key: NestedKey = "input",
    stage_key: NestedKey = "stage",
) -> Callable[[], None]:
    """Adds the networks' inputs in written transitions to the statistics; see :class:`~torchrl_her.ZeroPad`.

    Pass it to the writer as ``HERWriter(on_write=functools.partial(count_inputs, norm, progress))``. Inputs
    that a stage does not use are left out. In the buffer, :class:`~torchrl_her.modules.NormalizeBatch` comes
    after ``ZeroPad``.

    Args:
        norm: normalization of the input.
        progress: the stage of each run.
        rows: [n] transitions, run after run, with the observations and goals of their stages.
        runs: indices of the runs that the rows belong to.
        counts: number of rows of each of these runs.

    Keyword Args:
        keys: keys of observation and desired goal, which are read.
        input_key: key of the input, in ``norm``.
        stage_key: key of the stage of each row, if episodes have stages of their own.

    Returns:
        A function that undoes the call.

    Raises:
        ValueError: an input is not finite; then nothing is counted.
    """
    check_finite({f"{key!r}": rows.get(key) for key in (keys.observation, keys.desired_goal)})
    undo, stages = norm.snapshot(), progress.curriculum.stages
    for run, run_rows in zip(runs, rows.split(list(counts)), strict=True):
        parts = [(progress.stage_of(run), run_rows)]
        if progress.by_episode:
            which = run_rows.get(stage_key).squeeze(-1)
            parts = [(stage, run_rows[which == place]) for place, stage in enumerate(stages)]
        for stage, part in parts:
            inputs = (
                part.get(keys.observation)[..., : len(stage.observation)],
                part.get(keys.desired_goal)[..., : len(stage.desired_goal)],
            )
            if len(part) > 0:
                norm.count(input_key, torch.cat(inputs, -1), run=run)
    return undo


def restart_inputs(
    norm: RunningNorm,
    before: CurriculumStage,
    after: CurriculumStage,
    *,
    run: int = 0,
    input_key: NestedKey = "input",
) -> None:
    """Resets the statistics of the inputs that mean something else in the new stage of a run.

    All other statistics stay, so that at first the networks do in the new stage what they did in the old one.

    Args:
        norm: normalization of the input.
        before: the stage that the run was in.
        after: the stage that the run enters.

    Keyword Args:
        run: index of the run.
        input_key: key of the input, in ``norm``.

    Example:
        >>> near = CurriculumStage(
        ...     name="near", observation=[0], achieved_goal=[0], desired_goal=[1], threshold=1.0
        ... )
        >>> far = CurriculumStage(
        ...     name="far", observation=[0, 1], achieved_goal=[1], desired_goal=[2], threshold=1.0
        ... )
        >>> norm = RunningNorm({"input": 3})
        >>> norm.count("input", torch.tensor([[4.0, 5.0], [6.0, 7.0]]))
        >>> restart_inputs(norm, near, far)  # both stages have entry 1 as the second input
        >>> norm.moments_of("input").n.tolist()
        [2.0, 2.0, 0.0]
    """
    columns = ([*stage.observation, *stage.desired_goal] for stage in (before, after))
    places = [place for place, (old, new) in enumerate(zip_longest(*columns)) if old != new]
    norm.restart(run, key=input_key, places=places)
