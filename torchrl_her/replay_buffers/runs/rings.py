"""Ring buffers in one storage: each of R runs writes to its own block of rows."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torchrl_her.replay_buffers.runs.storage import Move


class Rings:
    """Cursors of R ring buffers, one for each run. When a ring is full, its oldest rows are overwritten.

    The capacity of a block is passed with each call, because it is known only once there is a storage.

    Args:
        runs: R, the number of independent runs.

    Attributes:
        cursors: for each run, the place within its block where the next row goes.
        sizes: for each run, the number of filled rows in its block.

    Example:
        >>> rings = Rings(2)
        >>> for move in rings.moves(1, begin=0, count=5, capacity=4):  # one row too many
        ...     print(move.source, "->", move.to)
        slice(1, 4, None) -> slice(5, 8, None)
        slice(4, 5, None) -> slice(4, 5, None)
        >>> rings.cursors, rings.sizes
        ([0, 1], [0, 4])
    """

    def __init__(self, runs: int) -> None:
        self.cursors, self.sizes = [0] * runs, [0] * runs

    def moves(self, run: int, *, begin: int, count: int, capacity: int) -> list[Move]:
        """Returns where a run's new rows are copied to in its block, and advances the run's cursor.

        Args:
            run: index of the run.

        Keyword Args:
            begin: position of the first new row of the run among the new rows of all runs.
            count: number of new rows of the run, which are consecutive. If there are more than
                ``capacity``, only the last ``capacity`` rows are copied.
            capacity: number of rows in a block.

        Returns:
            Pairs of slices, of the new rows and of the storage: one pair, two if the rows continue at the
            block's start, none without rows.
        """
        end, moves = begin + count, []
        cursor = (self.cursors[run] + max(0, count - capacity)) % capacity
        begin = max(begin, end - capacity)
        while begin < end:  # writes up to the block's end, then continues at its start
            number = min(end - begin, capacity - cursor)
            first = run * capacity + cursor
            moves.append(Move(slice(begin, begin + number), slice(first, first + number)))
            begin, cursor = begin + number, (cursor + number) % capacity
            self.sizes[run] = min(capacity, self.sizes[run] + number)
        self.cursors[run] = cursor
        return moves

    def empty(self, run: int) -> None:
        """Forgets the rows of a run."""
        self.cursors[run] = self.sizes[run] = 0


class Places:
    """Finds the storage rows that the rows of a batch were written to.

    Args:
        run: [n] int64, the run of each row; None if there is only one.
        n: number of rows.
        runs: R, the number of independent runs.
        device: device of the result.

    Example:
        >>> rings, places = Rings(1), Places(None, 3, runs=1)
        >>> moves = rings.moves(0, begin=0, count=4, capacity=10)  # rows 2 and 0 are the last of four
        >>> places.note([0], [torch.tensor([2, 0])], [4])
        >>> places.rows(rings.cursors, capacity=10).tolist()
        [3, -1, 2]
    """

    def __init__(self, run: Tensor | None, n: int, *, runs: int, device: torch.device | None = None) -> None:
        self._run = run
        self._place = torch.full((n,), -1, dtype=torch.int64, device=device)
        self._written = [0] * runs

    def note(self, runs: Sequence[int], last: Sequence[Tensor], counts: Sequence[int]) -> None:
        """Records that more rows of some runs were written.

        Args:
            runs: indices of m runs.
            last: m tensors [c] int64, for each of these runs the positions in the batch of the rows that were
                written last, in that order. Rows written before these are virtual, and not looked up.
            counts: number of all rows that were written for each of these runs.
        """
        for run, positions, count in zip(runs, last, counts, strict=True):
            self._written[run] += count
            end = self._written[run]
            self._place[positions] = torch.arange(end - len(positions), end, device=self._place.device)

    def rows(self, cursors: Sequence[int], capacity: int) -> Tensor:
        """Returns the storage row [n] of each row of the batch; -1 if it was not written or is overwritten.

        Args:
            cursors: cursors of :class:`Rings`, after all rows were written.
            capacity: number of rows in a block.
        """
        place, run = self._place, self._run
        begins = [cursor - count for cursor, count in zip(cursors, self._written, strict=True)]
        lost = [max(0, count - capacity) for count in self._written]
        if run is None:
            gone = place < lost[0]  # true also of -1, which marks rows not written
            return place.add(begins[0]).remainder_(capacity).masked_fill_(gone, -1)
        gone = place < place.new_tensor(lost)[run]
        rows = (place.new_tensor(begins)[run] + place).remainder_(capacity)
        return rows.add_(run * capacity).masked_fill_(gone, -1)
