"""The folder of a search: its settings, its database, its trials and what came of them."""

from __future__ import annotations

from pathlib import Path

import yaml

from torchrl_her.files.writing import write_text
from torchrl_her_recipes.config.plain_files import read_mapping
from torchrl_her_recipes.config.search import Search


class SearchFolder:
    """Paths of one search.

    Args:
        path: of the folder.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.settings = self.path / "search.yaml"
        self.database = self.path / "search.db"
        self.lock = self.path / ".lock"
        self.best = self.path / "best.yaml"
        self.table = self.path / "trials.csv"
        self.history = self.path / "history.png"
        self.importance = self.path / "importance.png"
        self.options = self.path / "options.png"

    def trial(self, number: int) -> Path:
        """The folder of the run of one trial."""
        return self.path / f"trial_{number:04}"

    def check(self, search: Search) -> None:
        """Makes sure that the folder is that of a search, or of none yet.

        Raises:
            ValueError: it holds another search, or its settings cannot be read.
        """
        if not self.settings.exists():
            return
        values = read_mapping(self.settings)
        try:
            there = Search.from_plain(values)
        except ValueError as error:
            raise ValueError(f"{self.settings} cannot be read: {error}") from error
        if different := there.difference(search):
            raise ValueError(
                f"{self.path} holds a search with {different}: repeat its options, or choose another "
                "folder=DIR"
            )

    def describe(self, search: Search) -> None:
        """Makes the folder and writes the settings, if it has none yet.

        Raises:
            OSError: it cannot be made.
        """
        self.path.mkdir(parents=True, exist_ok=True)
        if not self.settings.exists():
            write_text(self.settings, yaml.safe_dump(search.to_plain(), sort_keys=False))
