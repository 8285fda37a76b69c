"""Shows the progress of a run: as a bar on a terminal, and as lines in a file."""

from __future__ import annotations

import statistics
import sys
from collections.abc import Sequence

from tqdm import tqdm

from torchrl_her.trainers.trainer import Trainer


class Progress:
    """Shows the progress of a run on the standard error stream.

    On a terminal, this is a bar. If the stream goes to a file or another program, it is a line per epoch.
    """

    def __init__(self, trainer: Trainer, *, epochs: int, frames: int, show: bool) -> None:
        self.trainer, self.epochs = trainer, epochs
        self.show, self.lines = show, show and not sys.stderr.isatty()
        self.bar = tqdm(
            total=frames,
            initial=trainer.frames,
            unit="frames",
            disable=not show or self.lines,
        )

    def batch(self) -> None:
        """Updates the display after a batch and its gradient steps."""
        self.bar.set_description_str(f"{self.trainer.updates} updates", refresh=False)
        self.bar.update(self.trainer.frames - self.bar.n)

    def epoch(self, rows: Sequence[dict[str, float]]) -> None:
        """Shows the results of an epoch's evaluation."""
        success = statistics.median(row["success"] for row in rows)
        self.bar.set_postfix(success=f"{success:.2f}")
        if self.lines:
            line = (
                f"epoch {rows[0]['epoch']:.0f} of {self.epochs}: {rows[0]['frames']:,.0f} frames, "
                f"{rows[0]['updates']:,.0f} updates, {rows[0]['seconds']:.0f} s, success {success:.0%}"
            )
            tqdm.write(line, file=sys.stderr)

    def say(self, line: str) -> None:
        """Writes a message to the standard output, above the bar if there is one."""
        if self.show:
            tqdm.write(line)

    def close(self) -> None:
        """Closes the bar, which stays on the screen."""
        self.bar.close()
