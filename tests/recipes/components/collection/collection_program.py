"""Collecting in processes, which are forked instead of spawned, in a process of its own."""

from __future__ import annotations

import os
import signal
import tempfile
from collections.abc import Sequence
from copy import deepcopy
from multiprocessing import active_children
from pathlib import Path
from shutil import copytree
from typing import Any

import torch
from torch import multiprocessing

from torchrl_her_recipes import Components, Recipe, RunResult, build, resume, run
from torchrl_her_recipes.components.collection.processes import ProcessCollector

from ....forks import call_in_session
from ...small import small, stop_after
from .tagged_task import TASK, block_of

SECONDS = 300  # until it is ended
RUNS = 2
_FRAMES = 180  # of each run in an epoch: the last episodes are cut
_TAGGED: dict[str, Any] = {
    "task": TASK,
    "task.options.termination": "reward",
    "num_runs": RUNS,
    "processes": 2,
    "num_envs": 4,
    "steps_per_batch": 5,
    "epoch_frames": _FRAMES,
    "warmup_frames": 40,
    "frames_per_update": 5,
    "goal_sources": None,  # of the same episode alone
    "checkpoint_interval": 100,
}
_TABLE = ("seconds",)  # columns that differ


def main(out: Path, names: Sequence[str]) -> None:
    torch.set_num_threads(1)
    multiprocessing.set_start_method("fork", force=True)
    torch.save({name: JOBS[name]() for name in names}, out)


def tagged(**options: Any) -> Recipe:
    return small(**{**_TAGGED, **options})


def _sync() -> dict[str, Any]:
    return _run(tagged())


def _several() -> dict[str, Any]:
    """Two gradient steps for each frame, in turn with collecting."""
    return _run(tagged(epochs=1, epoch_frames=60, frames_per_update=0.5))


def _async() -> dict[str, Any]:
    """Two gradient steps for each frame, of another learner, with options of exploration."""
    td3 = {"learner": "td3", "critics": 3, "target_critics": 2, "action_noise": 0.1}
    return _run(tagged(sync=False, frames_per_update=0.5, **td3))


def _run(recipe: Recipe) -> dict[str, Any]:
    components = build(recipe)
    return shown(components, run(components, progress=False))


def shown(components: Components, result: RunResult) -> dict[str, Any]:
    """The table of a run, its rows, and the numbers of each run's blocks of environments, for each reset."""
    collector, buffer = components.collector, components.buffer
    assert isinstance(collector, ProcessCollector)
    blocks, resets = [], collector.resets
    for collector.resets in range(1, resets + 1):
        made = [collector._beginning(process).env_seeds for process in range(2)]
        blocks.append([[block_of(own[number]) for own in made] for number in range(RUNS)])
    sizes = buffer.writer.sizes
    starts = [number * buffer.writer.capacity for number in range(RUNS)]
    rows = [buffer.storage[start : start + size].clone() for start, size in zip(starts, sizes, strict=True)]
    return {
        "table": [{key: value for key, value in own.items() if key not in _TABLE} for own in result.rows],
        "rows": rows,
        "held": buffer.writer._held.run.bincount(minlength=RUNS).tolist(),
        "blocks": blocks,
        "children": len(active_children()),
    }


def _stopped() -> list[dict[str, Any]]:
    """A run that resumes between its two epochs, and where it was stopped in the middle of the second one."""
    with tempfile.TemporaryDirectory() as folder:
        between, middle = Path(folder, "between"), Path(folder, "middle")
        components = build(tagged(checkpoint_interval=1))
        stop_after(components, 13)
        assert run(components, middle, progress=False).interrupted
        copytree(middle, between)
        (between / "checkpoint.1.pt").replace(between / "checkpoint.pt")
        return [_resumed(path) for path in (between, middle)]


def _resumed(folder: Path) -> dict[str, Any]:
    components = build(tagged(checkpoint_interval=1))
    return shown(components, resume(folder, components=components, progress=False))


def _weights() -> dict[str, Any]:
    """Which of two policies played: they want -1 and 1."""
    components = build(tagged(num_runs=1, epsilon_start=0.0, epsilon_end=0.0))
    collector, (*_, bias) = components.collector, components.actor.parameters()
    assert isinstance(collector, ProcessCollector)

    def set_policy(action: float) -> None:
        for parameter in components.actor.parameters():
            parameter.data.zero_()
        bias.data.fill_(10 * action)

    set_policy(-1.0)
    collector.reset()
    first = collector.next()
    collector.collect_ahead()
    set_policy(1.0)
    batches = [first, *(collector.next() for _ in range(2))]
    components.exploration.epsilon.fill_(1.0)
    batches.append(collector.next())
    components.close()
    return {"actions": [batch["action"].clone() for batch in batches]}


def _normalized() -> dict[str, Any]:
    """What processes play after statistics changed; what this one would play, and would have before."""
    components = build(tagged(epsilon_start=0.0, epsilon_end=0.0, normalize=True))
    collector, norm, found = components.collector, components.norm, []
    for parameter in components.actor.parameters():
        parameter.data.mul_(3.0)  # so that inputs matter
    collector.reset()
    for scale in (1.0, 30.0):
        before = deepcopy(components.actor)
        for key, width in norm.widths.items():
            values = torch.linspace(-scale, scale, 7).unsqueeze(-1).expand(7, width)
            for number in range(RUNS):
                norm.count(key, values + number, run=number)
        batch, actors = collector.next(), (components.actor, before)
        seen = batch.select(*norm.keys)
        found.append([batch["action"].clone(), *(own(seen.clone())["action"].detach() for own in actors)])
    components.close()
    return {"actions": found}


def _curriculum() -> dict[str, Any]:
    """The desired goals before and after all runs came to the last stage."""
    components = build(
        small(
            task="hand_v1", algo="cher", num_runs=RUNS, processes=2, success_threshold=0.01, guided_share=0.5
        )
    )
    collector, shown = components.collector, []
    for stage in range(2):
        for number in range(RUNS):
            components.curriculum.progress.set_stage(number, stage)  # type: ignore[union-attr]
        collector.reset()
        shown.append(collector.next().clone())
    trained = run(components, progress=False)
    return {"batches": shown, "stages": [row["stage"] for row in trained.rows]}


def _guided() -> dict[str, Any]:
    """What processes do where one of the runs is guided, and its policy would not move."""
    recipe = small(
        task="hand_v1",
        algo="cher",
        num_runs=RUNS,
        processes=2,
        guided_share=1.0,
        epsilon_start=0.0,
        epsilon_end=0.0,
    )
    components = build(recipe)
    components.collector.reset()
    components.collector.next()  # the processes are there, and nothing guides them
    for number in range(RUNS):
        components.curriculum.progress.set_stage(number, 1)  # type: ignore[union-attr]
    components.guide.follow(components.actor, 0, run=1)  # type: ignore[union-attr]
    for weight in components.actor.parameters():
        weight.data.zero_()
    components.collector.reset()
    batch = components.collector.next()
    components.close()
    return {"moved": (batch["action"] != 0).flatten(1).any(1).chunk(RUNS)}


def _failure(**options: Any) -> dict[str, Any]:
    """What is raised when an environment fails, and how many processes are left."""
    try:
        run(build(tagged(**options)), progress=False)
    except Exception as error:
        return {"error": repr(error), "children": len(active_children())}
    return {}


def _breaks() -> dict[str, Any]:
    return _failure(
        algo="filtered_her", epoch_frames=600, warmup_frames=600, **{"task.options.fails_at": 130}
    )


def _cannot_start() -> dict[str, Any]:
    return _failure(**{"task.options.only_in": os.getpid()})


def _killed() -> dict[str, Any]:
    components = build(tagged())
    components.collector.reset()
    os.kill(components.collector._workers.procs[0].pid, signal.SIGKILL)  # type: ignore[attr-defined]
    try:
        while True:
            components.collector.next()
    except RuntimeError as error:
        return {"error": repr(error), "children": len(active_children())}


JOBS = {
    "sync": _sync,
    "several": _several,
    "stopped": _stopped,
    "async": _async,
    "weights": _weights,
    "normalized": _normalized,
    "curriculum": _curriculum,
    "guided": _guided,
    "breaks": _breaks,
    "cannot start": _cannot_start,
    "killed": _killed,
}


def results_of(*names: str) -> dict[str, Any]:
    """What some of the jobs find out, in a process of its own."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "results.pt"
        call_in_session(main, out, names, seconds=SECONDS)
        return torch.load(out, weights_only=False)
