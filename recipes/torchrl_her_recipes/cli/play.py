"""``torchrl-her play`` shows a policy in a video or a window; ``torchrl-her export`` writes it to a file."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import click
from click.shell_completion import CompletionItem

import torchrl_her_recipes as recipes  # imports torch only when one of its names is used
from torchrl_her_recipes.cli.say import file_name
from torchrl_her_recipes.config.shipped import find_policy, policy_files

_SUFFIXES = (".gif", ".mp4")
_RUN = click.Path(path_type=Path)
_best = click.option(
    "--best", is_flag=True, help="use the policy of the evaluation with the best success, not the last one"
)


def _complete(_context: click.Context, _parameter: click.Parameter, incomplete: str) -> list[CompletionItem]:
    names = [CompletionItem(name) for name in policy_files() if name.startswith(incomplete)]
    return [*names, CompletionItem(incomplete, type="file")]


@click.command(short_help="show the policy of a run, of a file or of the package, in a film or a window")
@click.argument("source", metavar="RUN|FILE|TASK", shell_complete=_complete)
@click.option("--window", is_flag=True, help="show it live in a window, with keys, instead of writing a film")
@click.option(
    "--compare",
    "others",
    metavar="RUN|FILE|TASK",
    multiple=True,
    shell_complete=_complete,
    help="show another policy of the same task beside it, with the same starts and goals; may be repeated",
)
@click.option("--out", type=_RUN, help=".gif or .mp4 file (default: RUN/play.gif, FILE.gif or TASK.gif)")
@click.option("--run", type=click.IntRange(0), help="index of the run in RUN (default: the median)")
@_best
@click.option("--goals", type=click.IntRange(1), help="episodes side by side (default: 6, in a window 1)")
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True, help="seed of goals and starts")
@click.option(
    "--size", type=click.IntRange(32), help="pixels of each environment (default: 240, in a window 480)"
)
def play(
    source: str,
    window: bool,
    others: tuple[str, ...],
    out: Path | None,
    run: int | None,
    best: bool,
    goals: int | None,
    seed: int,
    size: int | None,
) -> int:
    """Show a policy: as a GIF or MP4, or live in a window.

    RUN is the folder of a run or a policy's file in this folder, FILE is a .safetensors file written by
    `torchrl-her export`, and TASK is one of the trained policies of the package.

    Keys in the window: space pauses, n or the right arrow takes one step, r skips to the next goals, + and
    - change the speed, q or escape quits.
    """
    sources = (source, *others)
    for name in sources:
        if not Path(name).is_dir():
            find_policy(name)  # raises for an unknown policy, before torch is imported
    if window and out is not None:
        raise click.UsageError("--window and --out cannot be given together")
    film = None if window else out or _film_of(Path(source), compared=bool(others))
    if film is not None and film.suffix.lower() not in _SUFFIXES:
        raise ValueError(f"cannot write {film.name!r}: its suffix must be one of {', '.join(_SUFFIXES)}")
    view = {"goals": goals or (1 if window else 6), "size": size or (480 if window else 240), "seed": seed}
    counts = recipes.play(*sources, out=film, run=run, best=best, **view)
    alone = film is not None and not others
    for name, (achieved, ended) in zip([str(film)] if alone else sources, counts, strict=True):
        click.echo(f"{achieved} of {ended} goals achieved: {name}")
    if film is not None and others:
        click.echo(film)
    return 0


def _film_of(source: Path, *, compared: bool) -> Path:
    """Returns the default path of a policy's video: in the folder of its run, or beside its file."""
    name = "compare.gif" if compared else "play.gif"
    if source.is_dir():
        return source / name
    if source == recipes.RunFolder(source.parent).policy and source.is_file():
        return source.with_name(name)  # never policy.gif, which is the video made at the end of the run
    stem = source.stem if source.is_file() else file_name(str(source))
    return source.with_name(f"{stem}{'_compare' * compared}.gif")


@click.command(short_help="write a run's policy to a small file, for load_policy or as ONNX")
@click.argument("source", metavar="RUN|FILE|TASK", shell_complete=_complete)
@click.option(
    "--out", type=_RUN, help="file to write (default: RUN/TASK.safetensors, FILE.onnx or TASK.safetensors)"
)
@click.option(
    "--format",
    "form",
    type=click.Choice(["safetensors", "onnx"]),
    help="safetensors, for load_policy; onnx, for onnxruntime (default: suffix of --out, or safetensors)",
)
@click.option("--run", "index", type=click.IntRange(0), help="index of the run in RUN (default: the median)")
@click.option("--task", help="task for which the policy is exported (default: the task of its run)")
@click.option(
    "--card/--no-card",
    default=True,
    show_default=True,
    help="also write a model card, a page FILE.md about the policy",
)
@_best
def export(
    source: str,
    out: Path | None,
    form: Literal["safetensors", "onnx"] | None,
    index: int | None,
    task: str | None,
    card: bool,
    best: bool,
) -> int:
    """Write a policy as a file: .safetensors for `torchrl-her play` and load_policy, .onnx for onnxruntime.

    RUN is the folder of a run or a policy's file in this folder. FILE, an exported policy, and TASK, one of
    the trained policies of the package, can be written in another format.
    """
    file = out or _file_of(source, task, f".{form or 'safetensors'}")
    if form is not None and file.suffix != f".{form}":
        raise ValueError(f"a file of format={form} must have the suffix .{form}, got {file.name!r}")
    info = recipes.export_policy(source, file, run=index, task=task, best=best, card=card).info
    touched = f" (reached at some step {info.reached:.0%})" if info.reached > info.success else ""
    click.echo(f"seed {info.seed}, success {info.success:.0%}{touched} on {info.task}: {file}")
    return 0


def _file_of(source: str, task: str | None, suffix: str) -> Path:
    """Returns the default path of an exported policy: in the folder of its run, or beside its file."""
    path = Path(source)
    home = recipes.RunFolder.of(path)
    if home is not None:
        return home.path / f"{file_name(task or home.recipe().task.name)}{suffix}"
    find_policy(source)
    file = path.with_suffix(suffix) if path.is_file() else Path(f"{file_name(source)}{suffix}")
    if file == path:
        raise ValueError(f"{source} would be replaced by itself: give --out or --format onnx")
    return file
