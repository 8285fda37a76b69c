"""Studies: the same recipe over tasks, algorithms and options, each as batched runs, with one figure."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from itertools import product
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from torchrl_her_recipes.batches import Batches, plan_batches
from torchrl_her_recipes.chain_times import plot_times
from torchrl_her_recipes.plain import read_mapping
from torchrl_her_recipes.planning import Plan
from torchrl_her_recipes.plots import metric_names, plot_comparison
from torchrl_her_recipes.recipe import Recipe
from torchrl_her_recipes.scheduling import run_jobs
from torchrl_her_recipes.workers import LocalWorkers, Workers

_CONF = Path(__file__).parent / "conf" / "study"
_QUICK: dict[str, Any] = {
    "num_runs": 2,
    "epochs": 2,
    "epoch_frames": 3_200,
    "num_envs": 16,
    "eval_episodes": 20,
}


@dataclass(frozen=True, kw_only=True)
class Study:
    """What is compared with what.

    Args:
        name: of the study.
        summary: one line for people.
        recipe: what all of it has in common; ``num_runs`` is the number of seeds.
        vary: option of a recipe to the values that are compared. All combinations are run. The panels of
            the figure are the tasks, its curves the rest.
        figure: metrics that are drawn over environment steps, or "times" until the chain is solved.

    Raises:
        ValueError: nothing to compare, values that are no lists, or a figure that there is not.
    """

    name: str
    summary: str = ""
    recipe: dict[str, Any] = field(default_factory=dict)
    vary: dict[str, Sequence[Any]] = field(default_factory=dict)
    figure: str | Sequence[str] = ("success",)

    def __post_init__(self) -> None:
        if not isinstance(self.recipe, Mapping):
            raise ValueError(f"recipe of {self.name} must hold names and values, got {self.recipe!r}")
        wrong = not isinstance(self.vary, Mapping) or not self.vary
        if wrong or not all(isinstance(values, list | tuple) and values for values in self.vary.values()):
            raise ValueError(f"vary of {self.name} must hold lists of values by option, got {self.vary!r}")
        if strange := [name for name in (*self.recipe, *self.vary) if not isinstance(name, str)]:
            raise ValueError(f"options of {self.name} must be names, got {strange[0]!r}")
        drawn = [self.figure] if isinstance(self.figure, str) else list(self.figure)
        if drawn != ["times"] and (not drawn or not set(drawn) <= set(metric_names())):
            known = ", ".join(metric_names())
            raise ValueError(f"figure of {self.name} must be times, or some of {known}; got {self.figure!r}")
        object.__setattr__(self, "figure", "times" if drawn == ["times"] else drawn)

    def cells(self) -> Iterator[tuple[str, Recipe]]:
        """The combinations by name, each with all of its seeds.

        Raises:
            ValueError: a recipe that cannot work, or two combinations of the same name.
        """
        labels = set()
        for values in product(*self.vary.values()):
            own = dict(zip(self.vary, values, strict=True))
            words = (_word(name, value, self.vary[name]) for name, value in own.items())
            label = "_".join(word for word in words if word).replace("/", "_") or self.name
            if label in labels:
                raise ValueError(f"the study {self.name} has two combinations that are called {label}")
            labels.add(label)
            recipe = Recipe.from_dict({**self.recipe, **own})
            if self.figure == "times" and recipe.task != "chain":
                raise ValueError(f"the figure times of {self.name} is for the task chain, not {recipe.task}")
            yield label, recipe


def curve_label(label: str, recipe: Recipe) -> str:
    """What sets a combination apart from others on the same task.

    Example:
        >>> curve_label("hand_v1_her", Recipe(task="hand_v1", algo="her"))
        'her'
    """
    return f"_{label}_".replace(f"_{recipe.task.replace('/', '_')}_", "_").strip("_") or recipe.algo


def _word(name: str, value: Any, values: Sequence[Any]) -> str:
    """What sets a value apart from the other ``values`` of its option; of a mapping, the entries that do."""
    if all(isinstance(each, Mapping) for each in values):
        entries = {key: [each.get(key) for each in values] for key in value}
        differing = {key: own for key, own in entries.items() if any(other != own[0] for other in own)}
        return "_".join(_word(key, value[key], own) for key, own in differing.items())
    return str(value) if name in ("task", "algo") else f"{name}={value}"


def study_names() -> list[str]:
    """All studies that come with the package."""
    return sorted(path.stem for path in _CONF.glob("*.yaml"))


def load_study(
    name: str, *, seeds: int | None = None, frames: int | None = None, quick: bool = False
) -> Study:
    """A study by name, or from a YAML file of one's own.

    Args:
        name: one of :func:`study_names`, or the path of a .yaml file.
        seeds: runs of each combination, in place of the study's own number.
        frames: environment steps of each run, rounded up to whole epochs.
        quick: shrinks it to minutes.

    Raises:
        ValueError: there is no such study, or a number below 1.
    """
    path = Path(name) if name.endswith((".yaml", ".yml")) else _CONF / f"{name}.yaml"
    if not path.is_file():
        raise ValueError(f"there is no study {name!r}; the studies are {', '.join(study_names())}")
    for option, value in (("seeds", seeds), ("frames", frames)):
        if value is not None and value < 1:
            raise ValueError(f"{option} must be at least 1, got {value}")
    values = read_mapping(path)
    preset = values.pop("preset", None)
    known = [field.name for field in fields(Study) if field.name != "name"]
    if unknown := [key for key in values if key not in known]:
        raise ValueError(f"{path}: a study has no {', '.join(unknown)}; it has preset, {', '.join(known)}")
    study = Study(name=path.stem, **values)
    recipe = {**(load_preset(preset) if preset else {}), **study.recipe, **(_QUICK if quick else {})}
    if seeds is not None:
        recipe["num_runs"] = seeds
    if frames is not None:
        recipe["epochs"] = -(-frames // Recipe.from_dict({**recipe, **_first(study)}).epoch_frames)
    return replace(study, recipe=recipe)


def load_preset(name: str) -> dict[str, Any]:
    """The values of a preset.

    Raises:
        ValueError: there is no such preset.
    """
    path = _CONF.parent / "preset" / f"{name}.yaml"
    if not path.is_file():
        known = ", ".join(sorted(preset.stem for preset in path.parent.glob("*.yaml")))
        raise ValueError(f"there is no preset {name!r}; the presets are {known}")
    return read_mapping(path)


def _first(study: Study) -> dict[str, Any]:
    return {name: values[0] for name, values in study.vary.items()}


@dataclass(frozen=True, kw_only=True)
class StudyResult:
    """What came of a study.

    Attributes:
        figure: the picture, if all runs are done.
        interrupted: whether somebody stopped it. It goes on if it is run again.
        failed: why, by the name of the batched run. The others are not held back by it.
    """

    figure: Path | None
    interrupted: bool = False
    failed: dict[str, str] = field(default_factory=dict)


def plan_study(study: Study, folder: Path) -> Plan:
    """What there is to do, and about how long it takes.

    Args:
        study: what to run.
        folder: a folder of each combination goes into it, or is there already. Seeds that it lacks are
            added to those that it has.

    Raises:
        ValueError: the folder has a run of other options under the same name.
    """
    return Plan(job for label, recipe in study.cells() for job in plan_batches(label, recipe, folder))


def run_study(
    study: Study, folder: Path, *, workers: Workers | None = None, progress: bool = True
) -> StudyResult:
    """Runs what is not done yet, several at once, and draws the figure.

    A combination that was interrupted goes on from its checkpoint.

    Args:
        study: what to run.
        folder: a folder of each combination goes into it.
        workers: who does it; by default a process for each core. They are closed in the end.
        progress: whether to show a progress bar over all of it.

    Raises:
        ValueError: the folder has a run of other options under the same name, or somebody is at work
            in it.
        KeyboardInterrupt: by a second Ctrl-C.
    """
    workers = workers or LocalWorkers()
    folder.mkdir(parents=True, exist_ok=True)
    try:
        with FileLock(folder / ".lock", timeout=0):
            plan = plan_study(study, folder)
            outcomes = run_jobs(plan, workers, progress=progress)
    except Timeout as error:
        raise ValueError(f"another process is running a study in {folder}") from error
    finally:
        workers.close()
    return StudyResult(
        figure=None if plan.to_go else draw_study(study, folder),
        interrupted=any(outcome.interrupted for outcome in outcomes.values()),
        failed={label: outcome.error for label, outcome in outcomes.items() if outcome.error},
    )


def draw_study(study: Study, folder: Path) -> Path:
    """Metrics over environment steps: a panel for each task, a curve for each combination of the rest.

    Of a study whose figure is "times": how long chains took.
    """
    path = folder / f"{study.name}.png"
    if study.figure == "times":
        plot_times([(recipe, Batches(folder / label).rows()) for label, recipe in study.cells()], path)
        return path
    panels: dict[str, dict[str, list[dict[str, float]]]] = {}
    for label, recipe in study.cells():
        panels.setdefault(recipe.task, {})[curve_label(label, recipe)] = Batches(folder / label).rows()
    plot_comparison(panels, path, metrics=study.figure)
    return path
