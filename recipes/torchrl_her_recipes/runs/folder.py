"""The class :class:`RunFolder`: paths of a run's files, its recipe and its table of metrics."""

from __future__ import annotations

import csv
import hashlib
import json
import os
import platform
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from importlib.metadata import version
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from torchrl_her.files.writing import part_of, write_text, written
from torchrl_her_recipes.config.imports import foreign_module, permit_task
from torchrl_her_recipes.config.plain_files import dump_yaml, naming, read_json, read_mapping, read_table
from torchrl_her_recipes.config.policy_header import POLICY_SUFFIX
from torchrl_her_recipes.config.recipe import Recipe

_COUNTED = ("run", "seed", "epoch", "frames")  # columns with whole numbers
_PACKAGES = ("torchrl-her", "torch", "torchrl", "tensordict", "gymnasium", "pymunk", "numpy")


class RunFolder:
    """The folder of a run: paths of its files, and functions that read and write its recipe and metrics.

    Args:
        path: path of the folder; it need not exist before :meth:`create`.

    Example:
        >>> print(RunFolder("runs/mine"))
        runs/mine
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.config = self.path / "config.yaml"
        self.checkpoint = self.path / "checkpoint.pt"  # the newest checkpoint
        self.policy = self.path / f"policy{POLICY_SUFFIX}"
        self.best = self.path / f"best{POLICY_SUFFIX}"
        self.about = self.path / "run.json"
        self.metrics = self.path / "metrics.csv"
        self.curves = self.path / "curves.png"
        self.goals = self.path / "virtual_goals.png"
        self.goal_map = self.path / "goal_map.npz"
        self.video = self.path / "policy.gif"

    def __repr__(self) -> str:
        return f"RunFolder({str(self.path)!r})"

    def __str__(self) -> str:
        return str(self.path)

    @classmethod
    def of(cls, source: str | Path) -> RunFolder | None:
        """Returns the run folder at a path, or the run folder of the policy's file at this path; else None.

        Args:
            source: path of a folder, or of a policy's file in a run folder.

        Example:
            >>> RunFolder.of("runs/nowhere")
        """
        path = Path(source)
        home = cls(path if path.is_dir() else path.parent)
        policy_in_it = path in (home.policy, home.best) and path.is_file() and home.config.is_file()
        return home if path.is_dir() or policy_in_it else None

    @contextmanager
    def at_work(self, *, wait: float = 0.0) -> Iterator[None]:
        """Locks the folder, so that no other process trains in it, and removes partial files of a killed run.

        The lock is released at the end of the block, or when the process ends, even if it is killed. A
        process can take the lock several times.

        Args:
            wait: seconds to wait for the lock: a worker whose parent was killed needs time to save its run.

        Raises:
            ValueError: another process has the lock.
        """
        lock = FileLock(self.path / ".lock", is_singleton=True)
        try:
            lock.acquire(timeout=wait)
        except Timeout:
            raise ValueError(f"another process is training in {self.path}") from None
        try:
            for part in filter(Path.is_file, self._parts):
                part.unlink()
            yield
        finally:
            lock.release()

    def create(self) -> None:
        """Makes the folder.

        Raises:
            ValueError: the folder has a run already.
            OSError: the folder cannot be made.
        """
        if self.config.exists():
            raise ValueError(
                f"{self.path} holds a run already; continue it with --resume, or choose another folder"
            )
        self.path.mkdir(parents=True, exist_ok=True)

    def describe(self, recipe: Recipe) -> None:
        """Writes the recipe to ``config.yaml``, and the seed and versions of packages to ``run.json``."""
        about = {
            "seed": recipe.run.seed,
            "python": platform.python_version(),
            "platform": platform.platform(),
            "versions": {name: version(name) for name in _PACKAGES},
        }
        write_text(self.about, json.dumps(about, indent=2) + "\n")
        write_text(self.config, dump_yaml(recipe.to_dict()))
        remember(self.config, recipe.task.name)

    def describe_best(self, epoch: int, success: float) -> None:
        """Adds epoch and success of the best policy to ``run.json``, which :meth:`describe` wrote."""
        about = read_json(self.about) | {"best": {"epoch": epoch, "success": success}}
        write_text(self.about, json.dumps(about, indent=2) + "\n")

    def recipe(self) -> Recipe:
        """Reads the recipe. If this user has trained the run, permits importing the module of its task.

        Raises:
            ValueError: this is not the folder of a run, its configuration cannot be read, or a link in the
                folder leads out of it, so that files would be written elsewhere.
        """
        if not self.config.is_file():
            inside = sorted(config.parent.name for config in self.path.glob("*/config.yaml"))
            hint = f"; choose one of {', '.join(inside)} in it" if inside else ""
            raise ValueError(f"{self.path} is no folder of a run: it has no config.yaml{hint}")
        self._check_links()
        values = read_mapping(self.config)
        with naming(self.config):
            recipe = Recipe.from_dict(values)
        if is_own(self.config):
            permit_task(recipe.task.name)
        return recipe

    def _check_links(self) -> None:
        """Raises a ValueError for a link through which files would be written outside of the folder."""
        home = self.path.resolve()
        for path in self.path.rglob("*"):
            top, *below = path.relative_to(self.path).parts
            if top == "wandb" and below and not below[0].startswith("run_id"):
                continue  # wandb links to its logs, but replaces these links instead of writing through them
            if path.is_symlink() and not path.resolve().is_relative_to(home):
                raise ValueError(f"{path} is a link that leads out of the run's folder: replace it by a copy")

    @property
    def is_done(self) -> bool:
        """Whether the run has reached its last epoch and written its policy, which is its last file."""
        rows = self.rows() if self.config.exists() and self.policy.exists() else []
        return bool(rows) and rows[-1]["epoch"] >= self.recipe().run.epochs

    def write_table(self, rows: Sequence[dict[str, float]]) -> None:
        """Writes the table of metrics to ``metrics.csv``.

        Raises:
            ValueError: a value is not a number, as callbacks may have added it.
        """
        columns = list(dict.fromkeys(name for row in rows for name in row))
        numbers = [{name: _number(name, value) for name, value in row.items()} for row in rows]
        with written(self.metrics) as part, open(part, "w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, columns, restval="nan")
            writer.writeheader()
            writer.writerows(numbers)

    @property
    def _parts(self) -> list[Path]:
        """Paths of temporary files, to which the files of the folder are written before they are renamed."""
        return [part_of(path) for path in vars(self).values() if path != self.path]

    @property
    def checkpoints(self) -> list[Path]:
        """Existing checkpoints, the newest first."""
        newest = [self.checkpoint] if self.checkpoint.exists() else []
        return newest + self.older_checkpoints

    @property
    def older_checkpoints(self) -> list[Path]:
        """Existing checkpoints except the newest one."""
        return sorted(self.path.glob(f"{self.checkpoint.stem}.[0-9]*{self.checkpoint.suffix}"))

    def rows(self) -> list[dict[str, float]]:
        """Reads the table of metrics; returns an empty list if it was not written yet.

        Raises:
            ValueError: the table is damaged.
        """
        try:
            return read_table(self.metrics, counts=_COUNTED)
        except FileNotFoundError:
            return []


def _number(column: str, value: Any) -> float:
    """Returns a value of the table as an int or a float, also if it is a number of torch or NumPy."""
    try:
        return value if type(value) is int else float(value)
    except (TypeError, ValueError):
        raise ValueError(f"column {column!r} of the table must hold numbers, got {value!r}") from None


def remember(config: Path, task: str) -> None:
    """Records that this user trained the run of ``config.yaml``: resuming it may import its task's module.

    Does nothing if the run's task names no module, or if the user's state directory cannot be written.
    """
    if not foreign_module(task):
        return
    known = {path: digest for path, digest in _known().items() if Path(path).is_file()}
    known[str(config.resolve())] = _digest(config)
    with suppress(OSError):
        _state_file().parent.mkdir(parents=True, exist_ok=True)
        write_text(_state_file(), json.dumps(known, indent=1) + "\n")


def is_own(config: Path) -> bool:
    """Returns whether :func:`remember` recorded a ``config.yaml`` with this path and this content."""
    return _known().get(str(config.resolve())) == _digest(config)


def _state_file() -> Path:
    home = os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state"
    return Path(home) / "torchrl-her" / "runs.json"


def _known() -> dict[str, str]:
    """Reads the record of :func:`remember`: digests of ``config.yaml`` files by path."""
    try:
        state = json.loads(_state_file().read_text())
    except (OSError, ValueError):
        return {}
    return state if isinstance(state, dict) else {}


def _digest(config: Path) -> str:
    return hashlib.sha256(config.read_bytes()).hexdigest()
