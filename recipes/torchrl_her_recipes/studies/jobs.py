"""Jobs of a study: a job trains several runs side by side, on this machine or another, into a folder."""

from __future__ import annotations

import shutil
import traceback
from contextlib import nullcontext, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from torchrl_her_recipes.components.assembly import build
from torchrl_her_recipes.config.imports import foreign_module, import_modules, imported_modules, permit_task
from torchrl_her_recipes.config.plain_files import LARGEST_TABLE, read_text
from torchrl_her_recipes.config.recipe import Recipe
from torchrl_her_recipes.config.values import load_name
from torchrl_her_recipes.runs.folder import RunFolder
from torchrl_her_recipes.runs.run import RunResult, resume, run

_CHECKPOINTS = "checkpoint*.pt"
_ORPHAN = 300.0  # seconds to wait until an earlier worker, whose study was killed, has saved its run


@dataclass(frozen=True, kw_only=True)
class Job:
    """Runs of a study that one worker trains side by side.

    Args:
        label: name of the job within the study.
        recipe: recipe of the runs.
        folder: folder of the runs.
        around: context manager, as ``module:name``, in which the job is run in its process, and which yields
            callbacks for the run; empty for none.
        options: arguments of the context manager, plain values by name.
    """

    label: str
    recipe: Recipe
    folder: Path
    around: str = ""
    options: dict[str, Any] = field(default_factory=dict)

    def to_plain(self) -> dict[str, Any]:
        """Converts the job to plain values for another process.

        They include the names of modules to import first, which may register tasks and learners.
        """
        recipe, modules = self.recipe.to_dict(), imported_modules()
        plain = {"label": self.label, "recipe": recipe, "folder": str(self.folder), "modules": modules}
        return plain | {"around": self.around, "options": self.options}

    @classmethod
    def from_plain(cls, values: dict[str, Any]) -> Job:
        """Makes a job from the values of :meth:`to_plain`, and imports its modules.

        Raises:
            ValueError: a module cannot be imported, the recipe names a task or a choice that is unknown, or
                the task's function is in the program that made the job and in no module.
        """
        import_modules(values["modules"])
        recipe = Recipe.from_dict(values["recipe"])
        if foreign_module(task := recipe.task.name) == "__main__":
            raise ValueError(
                f"task={task} is made in the script or notebook that started the study, which other "
                "processes cannot import: put it in a module of its own"
            )
        permit_task(task)  # the process that started the study has checked the permission
        around = {name: values[name] for name in ("around", "options")}
        return cls(label=values["label"], recipe=recipe, folder=Path(values["folder"]), **around)


class Progress(NamedTuple):
    """Progress of a run: number of finished epochs, and the seconds that they took."""

    epochs: int = 0
    seconds: float = 0.0


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """Outcome of a job.

    Attributes:
        interrupted: whether the job was stopped on request, so that it can be resumed.
        error: reason of a failure, in one line; empty if the job did not fail.
        died: whether the job failed because its process ended.
    """

    interrupted: bool = False
    error: str = ""
    died: bool = False


def can_resume(folder: Path) -> bool:
    """Returns whether a folder has a run with a checkpoint from which it can be resumed."""
    home = RunFolder(folder)
    return home.config.exists() and bool(home.checkpoints)


def read_progress(folder: Path) -> Progress:
    """Reads the progress of a run from the last line of its table of metrics; 0 epochs without a table.

    Example:
        >>> read_progress(Path("nowhere"))
        Progress(epochs=0, seconds=0.0)
    """
    try:
        lines = read_text(RunFolder(folder).metrics, largest=LARGEST_TABLE).splitlines()
    except (OSError, ValueError):  # the table is missing or damaged
        return Progress()
    with suppress(IndexError, ValueError, KeyError):  # after a power failure, the last line may be cut off
        last = dict(zip(lines[0].split(","), lines[-1].split(","), strict=True))
        return Progress(int(last["epoch"]), float(last["seconds"]))
    return Progress()


def kept_progress(job: Job) -> Progress:
    """Returns the progress of a job that is not running, or no progress if it cannot be resumed.

    A job that was killed after its last epoch, but before its last files, counts as one epoch short.
    """
    done, home = read_progress(job.folder), RunFolder(job.folder)
    if done.epochs >= job.recipe.run.epochs and home.is_done:
        return done
    short = done._replace(epochs=min(done.epochs, job.recipe.run.epochs - 1))
    return short if can_resume(job.folder) else Progress()


def run_job(job: Job) -> Outcome:
    """Runs a job, or resumes it from its checkpoint. After Ctrl-C, the job saves its state and ends.

    Errors are not raised but returned in the outcome; their traceback is written to ``error.txt``.
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
        for left in (home.config, home.metrics):  # files of a run that stopped before its first checkpoint
            left.unlink(missing_ok=True)
        return run(build(job.recipe), job.folder, callbacks=callbacks, progress=False)


def pack(folder: Path, *, checkpoints: bool) -> dict[str, bytes]:
    """Reads the files of a run's folder, to be sent to another machine.

    Args:
        folder: folder of the run, which need not exist.
        checkpoints: whether to include checkpoints, which contain replay buffers and may be gigabytes.

    Returns:
        Contents of the files, by their paths relative to the folder.

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
    """Writes files from :func:`pack` to a folder, replacing an existing folder.

    The files are first written to a temporary folder, which is then renamed, so that the folder is never
    incomplete.
    """
    part = folder.with_name(f".{folder.name}.part")
    shutil.rmtree(part, ignore_errors=True)
    for name, content in files.items():
        path = part / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    shutil.rmtree(folder, ignore_errors=True)
    part.replace(folder)
