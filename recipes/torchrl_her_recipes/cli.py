"""The command line: ``torchrl-her train | play | plot | study | report | list``."""

from __future__ import annotations

import argparse
import logging
import os
import sys
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import hydra
from hydra.core.config_store import ConfigStore
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import MISSING, DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from tqdm import tqdm

from torchrl_her_envs import SMALL_WORLDS, TASKS, make_env
from torchrl_her_recipes.algorithms import ALGORITHMS
from torchrl_her_recipes.batches import Batches
from torchrl_her_recipes.chain_times import plot_times
from torchrl_her_recipes.planning import Plan, duration
from torchrl_her_recipes.playing import play
from torchrl_her_recipes.plots import plot_goals
from torchrl_her_recipes.policies import export_policy, load_trained, policy_names
from torchrl_her_recipes.recipe import Recipe
from torchrl_her_recipes.run_folder import RunFolder
from torchrl_her_recipes.running import RunResult, resume
from torchrl_her_recipes.small_world_plots import plot_values
from torchrl_her_recipes.studies import StudyResult, load_study, plan_study, run_study, study_names
from torchrl_her_recipes.workers import LocalWorkers, Workers
from torchrl_her_recipes.worlds import GYM

_FAILED = 1
_BAD_INPUT = 2
_INTERRUPTED = 130
_USAGE = """usage: torchrl-her COMMAND ...

commands:
  train [NAME=VALUE ...]   train; for instance: torchrl-her train task=hand_v0 algo=filtered_her seed=0
                           -m sweeps: torchrl-her train -m algo=her,filtered_her seed=0,1,2
                           preset=demo takes the values of a preset; --cfg job shows all values
  train --resume RUN       go on with a run from its checkpoint
  play RUN|TASK            a GIF of a run's policy, or of the trained one of a task, for several goals
  export RUN               a run's policy as a small file of its own
  plot goals RUN           a heat map of a run's virtual goals beside the target q*
  plot values RUN ...      what agents make of a small world: bit_flip or treasure_hunt
  plot times RUN ...       how long chains took to be solved, beside the times of ideal learners
  study NAME               runs a whole comparison on all cores and draws its figure; --quick for a size of
                           minutes, --plan says how long it takes, --ray ADDRESS runs it on a cluster
  report NAME              a page about a study: figures, intervals, the thesis's numbers beside ours
  list                     tasks, algorithms and presets
"""
_PICTURES = {"goals": "virtual_goals.png", "values": "values.png", "times": "times.png"}
_CONF = Path(__file__).parent / "conf"
_HINTS = (
    "full_key",
    "object_type",
    "reference_type",
    "To append",
    "Set the environment",
)  # Hydra's, for its users
_BAD = (HydraException, OmegaConfBaseException, OSError, ValueError, ImportError, MemoryError)


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command and returns the exit code: 0, 2 for bad input, 130 for Ctrl-C."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    logging.getLogger("torch.utils.cpp_extension").setLevel(logging.ERROR)  # compiling on a CPU is no mistake
    commands = {
        "train": _train,
        "play": _play,
        "export": _export,
        "plot": _plot,
        "study": _study,
        "report": _report,
        "list": _list,
    }
    if not arguments or arguments[0] in ("-h", "--help"):
        print(_USAGE, end="")
        return 0 if arguments else _BAD_INPUT
    if arguments[0] not in commands:
        return _fail(f"unknown command {arguments[0]!r}; the commands are {', '.join(commands)}")
    try:
        with warnings.catch_warnings():
            warnings.showwarning = _say_warning
            return commands[arguments[0]](arguments[1:])
    except KeyboardInterrupt:
        print("torchrl-her: interrupted", file=sys.stderr)
        return _INTERRUPTED
    except _BAD as error:
        return _fail(_one_line(error))


def _say_warning(message: Warning | str, *_where: Any, **_more: Any) -> None:
    """In one line, above a progress bar if there is one."""
    tqdm.write(f"torchrl-her: warning: {' '.join(str(message).split())}", file=sys.stderr)


def _fail(message: str, code: int = _BAD_INPUT) -> int:
    print(f"torchrl-her: {message}", file=sys.stderr)
    return code


def _one_line(error: BaseException) -> str:
    """The message of an error, without the hints that other libraries put below it."""
    if isinstance(error, OSError) and error.strerror is not None:
        return f"cannot use {error.filename}: {error.strerror.lower()}"
    if isinstance(error, MemoryError):
        return "there is not enough memory: buffer_size, hidden or batch_size may be too large"
    cause = str(error.__cause__ or "") if isinstance(error, HydraException) else ""
    message = f"{error}\n{cause}".split("Config search path")[0].replace("In 'train': ", "")
    lines = [line.strip() for line in message.splitlines()]
    kept = [line.rstrip(".") for line in lines if line and not line.startswith(_HINTS)]
    if "Could not override" in message:
        kept.append(f"what may be set is {', '.join(field.name for field in fields(_Arguments))}")
    return "; ".join(kept) or type(error).__name__


# train


def _train(arguments: list[str]) -> int:
    if any(argument.split("=")[0] == "--resume" for argument in arguments):
        parser = argparse.ArgumentParser(prog="torchrl-her train --resume")
        parser.add_argument("--resume", metavar="RUN", type=Path, required=True, help="folder of a run")
        folder = parser.parse_args(arguments).resume
        _say_start(folder)
        return _say_end(resume(folder))
    sweep = any(argument in ("-m", "--multirun") for argument in arguments)
    if sweep and any(argument.lstrip("+").startswith("folder=") for argument in arguments):
        return _fail("folder= is for a single run; a sweep's folder is hydra.sweep.dir=DIR")
    _store_recipe()
    os.environ["HYDRA_FULL_ERROR"] = "1"  # errors come to main() as they are
    codes: list[int] = []

    def job(config: DictConfig) -> None:
        try:
            codes.append(_train_one(config))
        except _BAD as error:  # reported here, so that the other jobs of a sweep go on
            codes.append(_fail(_one_line(error)))
        if codes[-1] == _INTERRUPTED:
            raise KeyboardInterrupt  # which ends a sweep, too

    before, sys.argv = sys.argv, ["torchrl-her train", *arguments]
    try:
        hydra.main(version_base="1.3", config_path=str(_CONF), config_name="train")(job)()
    finally:
        sys.argv = before
    return max(codes, default=0)


def _train_one(config: DictConfig) -> int:
    values = OmegaConf.to_container(config, resolve=True)
    assert isinstance(values, dict)
    chosen = str(values.pop("folder"))
    if not chosen:
        raise ValueError("folder must name a folder, got nothing")
    folder = Path(chosen)
    recipe = Recipe.from_dict({str(key): value for key, value in values.items()})
    if HydraConfig.get().mode == RunMode.MULTIRUN:
        folder = Path(HydraConfig.get().runtime.output_dir)
    parts = recipe.build()
    _say_start(folder)
    return _say_end(parts.run(folder))


@dataclass(frozen=True, kw_only=True)
class _Arguments(Recipe):
    """What the command line of `train` takes: a recipe, and where to put the run."""

    folder: str = MISSING


def _store_recipe() -> None:
    """Makes the recipe's fields and their types known to Hydra."""
    node = OmegaConf.structured(_Arguments)
    OmegaConf.set_readonly(node, False)  # the dataclass is frozen; its configuration is not
    ConfigStore.instance().store(name="recipe", node=node)


def _say_start(folder: Path) -> None:
    print(f"run: {folder}", flush=True)


def _say_end(result: RunResult) -> int:
    if result.interrupted:
        print(f"interrupted: all there is was saved in {result.folder}")
        print(f"go on with: torchrl-her train --resume {result.folder}")
        return _INTERRUPTED
    print(f"success {result.success:.0%} in the last evaluation")
    print(f"run: {result.folder} (curves.png, policy.gif, metrics.csv, checkpoint.pt)")
    return 0


# play, plot and list


def _play(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(prog="torchrl-her play", description="Make a GIF of a policy.")
    parser.add_argument("run", metavar="RUN", help="folder of a run, or a task for its trained policy")
    parser.add_argument("--out", type=Path, help="the .gif or .mp4 (default: RUN/play.gif, or TASK.gif)")
    parser.add_argument("--run", type=int, default=0, dest="index", help="which, of several side by side")
    parser.add_argument("--goals", type=int, default=6, help="how many goals, side by side (default: 6)")
    parser.add_argument("--seed", type=int, default=0, help="of the goals and starts (default: 0)")
    parser.add_argument("--size", type=int, default=240, help="pixels of one world (default: 240)")
    options = parser.parse_args(arguments)
    folder = Path(options.run)
    out = options.out or (folder / "play.gif" if folder.is_dir() else Path(f"{options.run}.gif"))
    achieved = play(
        options.run, out, run=options.index, goals=options.goals, seed=options.seed, size=options.size
    )
    print(f"{achieved} of {options.goals} goals achieved: {out}")
    return 0


def _export(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(prog="torchrl-her export", description="Write a run's policy as a file.")
    parser.add_argument("run", type=Path, metavar="RUN", help="folder of a run")
    parser.add_argument("--out", type=Path, help="the .pt file (default: RUN/TASK.pt)")
    parser.add_argument("--run", type=int, dest="index", help="which, of several (default: the median)")
    parser.add_argument("--task", help="that it is for, if not the run's own")
    options = parser.parse_args(arguments)
    out = options.out or options.run / f"{options.task or RunFolder(options.run).recipe().task}.pt"
    policy = export_policy(options.run, out, run=options.index, task=options.task)
    print(f"seed {policy.recipe.seed}, success {policy.success:.0%} on {policy.task}: {out}")
    return 0


def _plot(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(prog="torchrl-her plot", description="Draw a picture of runs.")
    parser.add_argument(
        "what",
        choices=list(_PICTURES),
        help="virtual goals beside q*, values in a small world, or times to solve chains",
    )
    folders = "folder of a run, or of the batches of a study's combination"
    parser.add_argument("runs", type=Path, metavar="RUN", nargs="+", help=folders)
    parser.add_argument("--out", type=Path, help="the picture (default: in the folder of the first run)")
    options = parser.parse_args(arguments)
    runs = [Batches(folder) for folder in options.runs]
    for own in runs:
        if not own.homes:
            raise ValueError(f"{own.path} is no folder of a run")
    out = options.out or options.runs[0] / _PICTURES[options.what]
    if options.what == "values":
        plot_values(runs, out)
    elif options.what == "times":
        plot_times([(own.homes[0].recipe(), own.rows()) for own in runs], out)
    else:
        if len(runs) > 1:
            raise ValueError(f"goals are drawn of one folder, got {len(runs)}")
        _plot_goals(runs[0], out)
    print(out)
    return 0


def _plot_goals(runs: Batches, out: Path) -> None:
    recipe, goals = runs.homes[0].recipe(), runs.goal_map()
    if recipe.task not in TASKS:
        raise ValueError(f"goals are drawn on the screen of a throwing or reaching task, got {recipe.task}")
    if goals is None:
        raise ValueError(f"{runs.path} has no map of goals: its runs have written no virtual goals")
    plot_goals(goals, make_env(recipe.task), out, title=f"virtual goals: {recipe.task}, {recipe.algo}")


def _study(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(prog="torchrl-her study", description="Run a whole comparison.")
    parser.add_argument("name", help=f"{', '.join(study_names())}, or a .yaml file of your own")
    parser.add_argument("--seeds", type=int, help="runs of each combination")
    parser.add_argument("--frames", type=int, help="environment steps of each run")
    parser.add_argument("--quick", action="store_true", help="a size that ends in minutes")
    parser.add_argument("--folder", type=Path, help="where it goes (default: runs/NAME)")
    parser.add_argument("--plan", action="store_true", help="only say what is to do, and how long it takes")
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--jobs", type=int, help="batched runs at once (default: one for each core)")
    where.add_argument("--ray", metavar="ADDRESS", help="over a Ray cluster: auto, or HOST:PORT")
    options = parser.parse_args(arguments)
    study = load_study(options.name, seeds=options.seeds, frames=options.frames, quick=options.quick)
    folder = options.folder or Path("runs") / (study.name + ("_quick" if options.quick else ""))
    plan = plan_study(study, folder)
    workers = _ray_workers(options.ray) if options.ray else LocalWorkers(options.jobs)
    _say_plan(study.name, folder, plan, workers.at_once)
    if options.plan:
        workers.close()
        return 0
    return _say_study(run_study(study, folder, workers=workers))


def _ray_workers(address: str) -> Workers:
    try:
        from torchrl_her_recipes.ray_workers import RayWorkers  # noqa: PLC0415  (an extra)
    except ModuleNotFoundError as error:
        raise ImportError("--ray needs Ray: pip install '.[cluster]'") from error
    return RayWorkers(address)


def _say_plan(name: str, folder: Path, plan: Plan, at_once: int) -> None:
    to_go = plan.to_go
    steps = f"{plan.steps_to_go(to_go):,} environment steps in all"
    print(f"{name}: {len(to_go)} batched runs to go, {steps}: {folder}")
    print("\n".join(plan.table()))
    if to_go:
        together = min(at_once, len(to_go))
        print(f"about {duration(plan.wall_clock(to_go, at_once))}, {together} at once", flush=True)


def _say_study(result: StudyResult) -> int:
    for label, reason in result.failed.items():
        print(f"torchrl-her: {label} failed: {reason}", file=sys.stderr)
    if result.figure is not None:
        print(result.figure)
        return 0
    print("interrupted: " * result.interrupted + "the same command goes on with it")
    return _INTERRUPTED if result.interrupted else _FAILED


def _report(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(
        prog="torchrl-her report", description="Write a page about what there is of a study; trains nothing."
    )
    parser.add_argument("name", help=f"{', '.join(study_names())}, or a .yaml file of your own")
    parser.add_argument("--folder", type=Path, help="where its runs are (default: runs/NAME)")
    parser.add_argument("--out", type=Path, help="where the page goes (default: FOLDER/report)")
    options = parser.parse_args(arguments)
    from torchrl_her_recipes.report import write_report  # noqa: PLC0415  (an extra, and slow to import)

    study = load_study(options.name)
    folder = options.folder or Path("runs") / study.name
    print(write_report(study, folder, options.out or folder / "report"))
    return 0


def _list(arguments: list[str]) -> int:
    argparse.ArgumentParser(prog="torchrl-her list", description="List what there is.").parse_args(arguments)
    presets = sorted((_CONF / "preset").glob("*.yaml"))
    sections = {
        "tasks": {name: task.summary for name, task in (TASKS | SMALL_WORLDS).items()}
        | {f"{GYM}ID": "any environment of gymnasium with goals, by its id"},
        "algorithms": {algorithm.name: algorithm.summary for algorithm in ALGORITHMS.values()},
        "studies": {name: load_study(name).summary for name in study_names()},
        "trained policies": {name: f"{load_trained(name).success:.0%} success" for name in policy_names()},
        "presets": {path.stem: path.read_text().splitlines()[1].lstrip("# ") for path in presets},
    }
    for title, entries in sections.items():
        print(f"{title}:")
        for name, summary in entries.items():
            print(f"  {name:<20} {summary}")
    return 0
