"""The policies that a run keeps in its folder: the one that it ended with, and the best one."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torchrl_her.trainers.checkpoint import load_checkpoint
from torchrl_her_recipes.runs.folder import RunFolder


@dataclass(frozen=True)
class KeptPolicy:
    """A policy in the folder of a run.

    Args:
        home: the folder.
        file: of the policy.
    """

    home: RunFolder
    file: Path

    @classmethod
    def of(cls, source: str | Path, *, best: bool = False) -> KeptPolicy | None:
        """The policy that somebody means; None if that is no folder of a run and no file in one.

        Args:
            source: the folder of a run, or ``policy.pt`` or ``best.pt`` in it.
            best: whether the best policy of the folder is meant, not the last.

        Raises:
            ValueError: ``best``, and the source is not the folder of a run.

        Example:
            >>> KeptPolicy.of("runs/nowhere.pt")
        """
        home = RunFolder.of(source)
        if home is not None and home.path == Path(source):
            return cls(home, home.best if best else home.policy)
        if best:
            raise ValueError(f"best goes with the folder of a run, and {source} is none")
        return None if home is None else cls(home, Path(source))

    def load(self) -> dict[str, Any]:
        """The weights of all runs, as ``actor``; of a best policy also its ``epoch`` and ``success``.

        Raises:
            ValueError: the file is damaged, or the run has no best policy.
            OSError: the run has not saved a policy yet.
        """
        if self.file == self.home.best and not self.file.exists():
            raise ValueError(
                f"{self.home.path} has no {self.file.name}: the run has not been evaluated yet, or was "
                "trained by a version that kept the last policy alone"
            )
        return load_checkpoint(self.file)
