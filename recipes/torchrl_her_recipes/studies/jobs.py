"""Jobs of a study. A job trains runs side by side into a folder, on this machine or another."""

from __future__ import annotations

import shutil
import traceback
from contextlib import nullcontext, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from torchrl_her_recipes.components.assembly import build
from torchrl_her_recipes.config.imports import import_modules, imported_modules, permit_task
from torchrl_her_recipes.config.plain_files import LARGEST_TABLE, read_text
from torchrl_her_recipes.config.recipe import Recipe
from torchrl_her_recipes.config.values import load_name
from torchrl_her_recipes.runs.folder import RunFolder
from torchrl_her_recipes.runs.run import RunResult, resume, run

_CHECKPOINTS = "checkpoint*.pt"
_ORPHAN = 300.0  # seconds that a worker whose study was killed has to save its run


@dataclass(frozen=True, kw_only=True)
class Job:
    """Runs of a study that one worker trains side by side.

    Args:
        label: name of the job within the study.
        recipe: recipe of the runs.
        folder: folder of the runs.
        around: context manager around the job in its process, as ``module:name``, which yields callbacks;
            empty for no context manager.
        options: arguments of the context manager, plain values by name.
    """

    label: str
    recipe: Recipe
    folder: Path
    around: str = ""
    options: dict[str, Any] = field(default_factory=dict)

    def to_plain(self) -> dict[str, Any]:
        """Converts the job to plain values for another process, with the modules that it must import first.

        These modules register the tasks and learners that the recipe may name.
        """
        recipe, modules = self.recipe.to_dict(), imported_modules()
        plain = {"label": self.label, "recipe": recipe, "folder": str(self.folder), "modules": modules}
        return plain | {"around": self.around, "options": self.options}

    @classmethod
    def from_plain(cls, values: dict[str, Any]) -> Job:
        """Makes a job from the values of :meth:`to_plain`, and imports its modules.

        Raises:
            ValueError: a module cannot be imported here, or the recipe names something that is not known.
        """
        import_modules(values["modules"])
        recipe = Recipe.from_dict(values["recipe"])
        permit_task(recipe.task.name)  # was checked in the process that started the study
        around = {name: values[name] for name in ("around", "options")}
        return cls(label=values["label"], recipe=recipe, folder=Path(values["folder"]), **around)


class Progress(NamedTuple):
    """Progress of a run: epochs, and the seconds that they took."""

    epochs: int = 0
    seconds: float = 0.0


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """Outcome of a job.

    Attributes:
        interrupted: whether the job was stopped; it can be resumed.
        error: reason of a failure, in one line; empty if the job did not fail.
        died: whether the process of the job ended without an outcome.
    """

    interrupted: bool = False
    error: str = ""
    died: bool = False


def can_resume(folder: Path) -> bool:
    """Returns whether a folder has a checkpoint to resume from."""
    home = RunFolder(folder)
    return home.config.exists() and bool(home.checkpoints)


def read_progress(folder: Path) -> Progress:
    """Reads the progress of a run from the last line of its table, without reading the rest.

    Example:
        >>> read_progress(Path("nowhere"))
        Progress(epochs=0, seconds=0.0)
    """
    try:
        lines = read_text(RunFolder(folder).metrics, largest=LARGEST_TABLE).splitlines()
    except (OSError, ValueError):  # the table is missing or damaged
        return Progress()
    with suppress(IndexError, ValueError, KeyError):  # a power failure can cut the last line
        last = dict(zip(lines[0].split(","), lines[-1].split(","), strict=True))
        return Progress(int(last["epoch"]), float(last["seconds"]))
    return Progress()


def kept_progress(job: Job) -> Progress:
    """Returns the progress of a job that is not running, up to its last checkpoint.

    A job that was killed between its last epoch and its pictures counts as one epoch short of its end.
    """
    done, home = read_progress(job.folder), RunFolder(job.folder)
    if done.epochs >= job.recipe.run.epochs and home.is_done:
        return done
    short = done._replace(epochs=min(done.epochs, job.recipe.run.epochs - 1))
    return short if can_resume(job.folder) else Progress()


def run_job(job: Job) -> Outcome:
    """Runs a job, or resumes it from its checkpoint. Ctrl-C ends it at the next good moment.

    Raises no errors: an error is part of the outcome, and its traceback is in ``error.txt``.
    """
    story = job.folder / "error.txt"
    try:
        story.unlink(missing_ok=True)
        job.folder.mkdir(parents=True, exist_ok=True)
        with RunFolder(job.folder).at_work(wait=_ORPHAN):
            return Outcome(interrupted=_train(job).interrupted)
    except KeyboardInterrupt:
        return Outcome(interrupted=True)
    except Exception as error:
        with suppress(OSError):  # the folder may be missing, or the disk full
            story.write_text(traceback.format_exc())
        return Outcome(error=" ".join(f"{type(error).__name__}: {error}".split()))


def _train(job: Job) -> RunResult:
    with load_name(job.around)(**job.options) if job.around else nullcontext(()) as callbacks:
        if can_resume(job.folder):
            return resume(job.folder, callbacks=callbacks, progress=False)
        home = RunFolder(job.folder)
        for left in (home.config, home.metrics):  # left by a stop before the first checkpoint
            left.unlink(missing_ok=True)
        return run(build(job.recipe), job.folder, callbacks=callbacks, progress=False)


def pack(folder: Path, *, checkpoints: bool) -> dict[str, bytes]:
    """Reads the files of a run's folder, to be sent to another machine.

    Args:
        folder: folder of the run; it may not exist yet.
        checkpoints: whether to include checkpoints. They hold replay buffers, gigabytes for many runs.

    Returns:
        Contents by path within the folder.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     for name in ("config.yaml", "checkpoint.pt"):
        ...         _ = (Path(folder) / name).write_text("...")
        ...     pack(Path(folder), checkpoints=False)
        {'config.yaml': b'...'}
    """
    paths = sorted(path for path in folder.rglob("*") if path.is_file())
    files = [path for path in paths if path.name != ".lock" and (checkpoints or not path.match(_CHECKPOINTS))]
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}


def unpack(files: dict[str, bytes], folder: Path) -> None:
    """Writes the files from :func:`pack` into a folder, and replaces an existing one.

    The folder never is incomplete: files are written into another one, which is then renamed.
    """
    part = folder.with_name(f".{folder.name}.part")
    shutil.rmtree(part, ignore_errors=True)
    for name, content in files.items():
        path = part / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    shutil.rmtree(folder, ignore_errors=True)
    part.replace(folder)
