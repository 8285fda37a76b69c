"""Writes ``docs/compatibility.md`` from the tables that the tests hold."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from .tables import BUFFERS, COLLECTORS, REFUSALS, WORKS, Cell

PAGE = Path(__file__).parents[3] / "docs" / "compatibility.md"

_PARTS = ("`HERWriter`", '`HERWriter(per="episode")`', "`HERSampleUnit`, flat", "`HERSampleUnit`, [T, N]")
_ROLES = ("`HERWriter`", '`HERWriter(per="episode")`', "`HERSampleUnit`")

_TOP = """# Which parts of TorchRL go together

Combined with another part of TorchRL, `HERWriter` and `HERSampleUnit` either work, or raise an error that
names the reason. The tests try each cell of the two tables below. Observations of the test environment
contain the run, environment, episode and step, so that each transition of a buffer, or of a sampled batch,
can be compared with the collected one.

- **yes**: all transitions were right. Each virtual goal was achieved in the same episode, and not before the
  transition; rewards and ends fit it; no real transition is lost or stored twice. Sequences drawn by samplers
  of slices are consecutive steps with one goal.
- **a number**: an error, which is explained [below](#errors).

{counts} `make test` tries some of the cells, and `make test-full` all of them.

## Collectors

A learner extends its buffer with what a collector yields. Environments with a batch dimension are called
batched. The writer takes batches [N, T] as they are. `HERSampleUnit` needs `batch.reshape(-1)`, or a storage
with `ndim=2`, called [T, N] here. With `replay_buffer=` the collector itself writes.

Each cell was tried in three ways: with trajectory ids, which collectors write by default; with the ids of the
transform [`EnvIds`](replay_buffers.md), too; and without ids. A cell that does not mention ids is the same in
all three. Worker processes that write into the buffer themselves are refused in all three.

"""

_MIDDLE = """
## Samplers and storages

Buffers of this process were tried twice: with room for all transitions, and so small that new transitions
take the places of old ones. Buffers of other processes had room for all; they were reached by
`torch.distributed.rpc` (`RemoteTensorDictReplayBuffer`) and by Ray (`RayReplayBuffer`).

"""

_VERSIONS = """
## Versions

These versions passed the tests in November 2026; `make test-versions` repeats them for the oldest and newest.

| Python | torch | tensordict | torchrl |
| --- | --- | --- | --- |
| 3.11.7 | 2.14.0 | 0.14.2 | 0.14.0 |
| 3.11.7 | 2.14.1 | 0.14.3 | 0.14.0 |
| 3.11.7 | 2.14.0 | 0.14.3 | 0.14.1 |
| 3.11.7, 3.12.1, 3.13.0 | 2.14.1 | 0.14.3 | 0.14.1 |
| 3.11.7 | 2.15.0 | 0.14.3 | 0.14.1 |
| 3.11.7 | 2.15.0 | 0.15.3 | nightly |

TorchRL requires tensordict of its own minor release, from 0.14.2 on, and allows any torch. "nightly" is
`torchrl-nightly` 2026.10.27, which stands in for TorchRL 0.15 until that is released.
"""

_THEIRS = " This error is TorchRL's own."


def page() -> str:
    """The whole page."""
    numbers = _number(COLLECTORS, BUFFERS)
    collectors = [(name, *(_cell(cell, numbers) for cell in row)) for name, row in COLLECTORS.items()]
    buffers = [
        (storage, sampler, *(_cell(cell, numbers) for cell in row))
        for storage, rows in BUFFERS.items()
        for sampler, row in rows.items()
    ]
    reasons = [
        f"{number}. {REFUSALS[name].says}{'' if REFUSALS[name].ours else _THEIRS}"
        for name, number in numbers.items()
    ]
    return "".join(
        [
            _TOP.replace("{counts}", _counts()),
            _table(("collector", *_PARTS), collectors),
            _MIDDLE,
            _table(("storage", "sampler", *_ROLES), buffers),
            "\n## Errors\n\n",
            "\n".join(reasons),
            "\n",
            _VERSIONS,
        ]
    )


def _number(*tables: dict) -> dict[str, int]:
    """The refusals in use, numbered in the order in which they first appear."""
    names = dict.fromkeys(name for table in tables for name in _names(table.values()))
    return {name: number for number, name in enumerate((name for name in names if name != WORKS), start=1)}


def _counts() -> str:
    outcomes = [name for row in COLLECTORS.values() for cell in row for name in _each(cell)]
    outcomes += _names(BUFFERS.values())
    works = outcomes.count(WORKS)
    return f"Of {len(outcomes)} cells, {works} work and {len(outcomes) - works} are refused."


def _each(cell: Cell) -> tuple[str, ...]:
    if cell == "sharing":  # whatever the ids
        return (cell,)
    return (cell,) * 3 if isinstance(cell, str) else cell


def _names(cells: Iterable) -> Iterable[str]:
    for cell in cells:
        if isinstance(cell, str):
            yield cell
        else:
            yield from _names(cell.values() if isinstance(cell, dict) else cell)


def _cell(cell: Cell, numbers: dict[str, int]) -> str:
    if isinstance(cell, str):
        return "yes" if cell == WORKS else str(numbers[cell])
    trajectory, env, bare = ("yes" if name == WORKS else str(numbers[name]) for name in cell)
    if trajectory == env:
        return f"{trajectory}; without ids: {bare}"
    assert trajectory == bare, cell
    return f"with `EnvIds`; else: {bare}" if env == "yes" else f"{bare}; with `EnvIds`: {env}"


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


if __name__ == "__main__":
    PAGE.write_text(page())
