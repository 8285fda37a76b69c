"""The folder that a run leaves behind: configuration, metrics, events, checkpoint, pictures."""

from __future__ import annotations

import csv
import io
import json
import platform
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path

import yaml
from torch.utils.tensorboard import SummaryWriter

from torchrl_her_recipes.config.recipe import Recipe
from torchrl_her_recipes.config.values import read_mapping

_PACKAGES = ("torchrl-her", "torch", "torchrl", "tensordict", "gymnasium", "pymunk", "numpy")


class RunFolder:
    """Paths and tables of one run.

    Args:
        path: of the folder; :meth:`create` makes it.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.config = self.path / "config.yaml"
        self.checkpoint = self.path / "checkpoint.pt"  # the newest
        self.policy = self.path / "policy.pt"
        self.best = self.path / "best.pt"
        self.about = self.path / "run.json"
        self.metrics = self.path / "metrics.csv"
        self.curves = self.path / "curves.png"
        self.goals = self.path / "virtual_goals.png"
        self.goal_map = self.path / "goal_map.npz"
        self.video = self.path / "policy.gif"
        self._events: SummaryWriter | None = None

    @classmethod
    def of(cls, source: str | Path) -> RunFolder | None:
        """The folder of a run that somebody means; None if that is no folder, and no policy's file in one.

        Args:
            source: the folder, or ``policy.pt`` or ``best.pt`` in it.

        Example:
            >>> RunFolder.of("runs/nowhere.pt")
        """
        path = Path(source)
        home = cls(path if path.is_dir() else path.parent)
        policy_in_it = path in (home.policy, home.best) and path.is_file() and home.config.is_file()
        return home if path.is_dir() or policy_in_it else None

    def create(self) -> None:
        """Makes the folder.

        Raises:
            ValueError: there is a run in it already.
            OSError: it cannot be made.
        """
        if self.config.exists():
            raise ValueError(
                f"{self.path} holds a run already; go on with it by --resume, or choose another folder"
            )
        self.path.mkdir(parents=True, exist_ok=True)

    def describe(self, recipe: Recipe) -> None:
        """Writes the recipe and the versions that run it."""
        about = {
            "seed": recipe.run.seed,
            "python": platform.python_version(),
            "platform": platform.platform(),
            "versions": {name: version(name) for name in _PACKAGES},
        }
        _write_whole(self.about, json.dumps(about, indent=2) + "\n")
        _write_whole(self.config, yaml.safe_dump(recipe.to_dict(), sort_keys=False))

    def describe_best(self, epoch: int, success: float) -> None:
        """Adds to what :meth:`describe` wrote which evaluation the best policy is of.

        Args:
            epoch: of the evaluation.
            success: in it, the median of the runs.
        """
        about = json.loads(self.about.read_text()) | {"best": {"epoch": epoch, "success": success}}
        _write_whole(self.about, json.dumps(about, indent=2) + "\n")

    def recipe(self) -> Recipe:
        """The recipe of the run.

        Raises:
            ValueError: this is no folder of a run, or its configuration cannot be read.
        """
        if not self.config.is_file():
            inside = sorted(config.parent.name for config in self.path.glob("*/config.yaml"))
            hint = f"; choose one of {', '.join(inside)} in it" if inside else ""
            raise ValueError(f"{self.path} is no folder of a run: it has no config.yaml{hint}")
        values = read_mapping(self.config)
        try:
            return Recipe.from_dict(values)
        except ValueError as error:
            raise ValueError(f"{self.config} cannot be read: {error}") from error

    @property
    def is_done(self) -> bool:
        """Whether the run has reached its last epoch and left all behind; its policy comes last."""
        rows = self.rows() if self.config.exists() and self.policy.exists() else []
        return bool(rows) and rows[-1]["epoch"] >= self.recipe().run.epochs

    def log(self, rows: Sequence[dict[str, float]], new: int) -> None:
        """Writes the table, and the last rows of it to the events.

        Args:
            rows: the whole table: columns may join it on the way (losses, at the first update).
            new: how many rows at its end are new.
        """
        columns = list(dict.fromkeys(name for row in rows for name in row))
        table = io.StringIO()
        writer = csv.DictWriter(table, columns, restval="nan")
        writer.writeheader()
        writer.writerows(rows)
        _write_whole(self.metrics, table.getvalue())
        if self._events is None:
            self._events = SummaryWriter(str(self.path / "tensorboard"), purge_step=int(rows[-new]["frames"]))
        for row in rows[-new:]:
            for name, value in row.items():
                self._events.add_scalar(f"{name}/run_{row['run']}", value, int(row["frames"]))
        self._events.flush()  # what is behind a checkpoint must be on the disk when the run goes on from it

    @property
    def parts(self) -> list[Path]:
        """The files that there are only while others are written: a killed run leaves them behind."""
        whole = (self.config, self.about, self.metrics, self.checkpoint, self.policy, self.best)
        return [path.with_name(path.name + ".part") for path in whole] + [
            self.goal_map.with_suffix(".part.npz"),
            self.video.with_suffix(".part.gif"),
        ]

    @property
    def older_checkpoints(self) -> list[Path]:
        """The checkpoints before the newest one."""
        return sorted(self.path.glob(f"{self.checkpoint.stem}.*{self.checkpoint.suffix}"))

    def rows(self, *, going_on: bool = False) -> list[dict[str, float]]:
        """The table so far.

        Args:
            going_on: whether somebody may be writing it: then a line without an end is left out, and with it
                the other rows of its epoch.

        Raises:
            ValueError: it is damaged.
        """
        try:
            text = self.metrics.read_text()
        except FileNotFoundError:
            return []
        if going_on:
            text = text[: text.rfind("\n") + 1]
        try:
            table = csv.DictReader(io.StringIO(text))
            rows = [{name: _number(own) for name, own in row.items()} for row in table]
        except (AttributeError, TypeError, ValueError) as error:  # a line is cut short, or no numbers
            raise ValueError(f"{self.metrics} is damaged: a line is no row of the table") from error
        return _whole_epochs(rows) if going_on else rows

    def close(self) -> None:
        """Writes out what is still in memory."""
        if self._events is not None:
            self._events.close()
            self._events = None


def _write_whole(path: Path, text: str) -> None:
    """Writes a file that is never seen in part."""
    part = path.with_name(path.name + ".part")
    try:
        part.write_text(text, newline="")
        part.replace(path)
    except OSError:
        part.unlink(missing_ok=True)  # what there is of it takes up room
        raise


def _whole_epochs(rows: list[dict[str, float]]) -> list[dict[str, float]]:
    """The rows without those of the last epoch, if it has fewer than the first."""
    if not rows:
        return rows
    first, last = (sum(row["epoch"] == end["epoch"] for row in rows) for end in (rows[0], rows[-1]))
    return rows if last == first else rows[:-last]


def _number(text: str) -> float:
    return int(text) if text.isdigit() else float(text)
