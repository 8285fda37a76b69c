"""``torchrl-her``: the group of all commands, which turns their errors into messages and exit codes."""

from __future__ import annotations

import logging
import os
import sys
import warnings
from collections.abc import Sequence
from difflib import get_close_matches

import click

from torchrl_her_recipes.cli.check import check
from torchrl_her_recipes.cli.listing import listing
from torchrl_her_recipes.cli.play import export, play
from torchrl_her_recipes.cli.plot import plot
from torchrl_her_recipes.cli.record import record
from torchrl_her_recipes.cli.say import BAD_INPUT, INTERRUPTED, fail, one_line, say_line, say_warning
from torchrl_her_recipes.cli.study import report, study
from torchrl_her_recipes.cli.train import train
from torchrl_her_recipes.cli.tune import tune
from torchrl_her_recipes.config.imports import allow_imports, import_modules
from torchrl_her_recipes.config.options import what_there_is
from torchrl_her_recipes.config.versions import own_version

_SETTINGS = {"help_option_names": ["-h", "--help"], "max_content_width": 110}


class _Commands(click.Group):
    """Group that suggests similar names for an unknown command, and reads ``folder=DIR`` as ``--folder``."""

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        if self.get_command(ctx, args[0]) is None and not args[0].startswith("-"):
            known = self.list_commands(ctx)
            raise click.UsageError(f"unknown command {args[0]!r}{what_there_is(args[0], known, 'commands')}")
        name, command, rest = super().resolve_command(ctx, args)
        if command is not None and any(parameter.name == "folder" for parameter in command.params):
            rest = [f"--{argument}" if argument.startswith("folder=") else argument for argument in rest]
        return name, command, rest

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(self.commands)  # in the order in which they are typically used, not alphabetically


def _import(context: click.Context, _parameter: click.Parameter, modules: tuple[str, ...]) -> None:
    try:
        import_modules(modules)
    except ValueError:
        if not context.resilient_parsing:  # errors must not break the shell's completion of a command
            raise


@click.group(cls=_Commands, context_settings=_SETTINGS, invoke_without_command=True)
@click.version_option(own_version(), prog_name="torchrl-her")
@click.option(
    "--import",
    metavar="MODULE",
    multiple=True,
    expose_value=False,
    callback=_import,
    help="first import a module, so that names it registers can be used; may be repeated",
)
@click.pass_context
def group(context: click.Context) -> None:
    """Train, compare and show policies that learn from sparse rewards by hindsight experience replay.

    Shell completion: eval "$(_TORCHRL_HER_COMPLETE=bash_source torchrl-her)" (or zsh_source, fish_source).
    """
    if context.invoked_subcommand is None:
        click.echo(context.get_help())
        context.exit(BAD_INPUT)


def _permit(context: click.Context, _parameter: click.Parameter, given: bool) -> None:
    if given:
        context.with_resource(allow_imports())  # until the command ends, files may name modules to import


_may_import = click.option(
    "--allow-import",
    is_flag=True,
    expose_value=False,
    callback=_permit,
    help="allow the task in a file to import its module, if you trust it (module:function, gym:module:ID)",
)

for _command in (check, train, record, play, export, plot, study, report, tune):
    group.add_command(_may_import(_command))
group.add_command(listing)


class _Notices(logging.Handler):
    """Log handler that prints each message of an environment in one line, like a warning."""

    def emit(self, record: logging.LogRecord) -> None:
        say_line(("warning: " if record.levelno >= logging.WARNING else "") + record.getMessage())


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command and returns the exit code: 0, 2 for bad input, 130 for Ctrl-C."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")  # read by torchrl when it is imported
    environments, notices = logging.getLogger("torchrl_her_envs"), _Notices()
    environments.addHandler(notices)
    environments.setLevel(logging.INFO)
    logging.getLogger("torch.utils.cpp_extension").setLevel(logging.ERROR)  # hides a warning of missing CUDA
    try:
        with warnings.catch_warnings():
            warnings.showwarning = say_warning
            code = group.main(arguments, prog_name="torchrl-her", standalone_mode=False)
            return code if isinstance(code, int) else 0
    except click.exceptions.Exit as error:
        return error.exit_code
    except (click.Abort, KeyboardInterrupt):
        click.echo("torchrl-her: interrupted", err=True)
        return INTERRUPTED
    except click.NoSuchOption as error:
        near = get_close_matches(error.option_name, error.possibilities or (), cutoff=0.75)
        return fail(click.NoSuchOption(error.option_name, possibilities=near).format_message().rstrip("."))
    except click.ClickException as error:
        return fail(error.format_message().rstrip("."))
    except (OSError, ValueError, ImportError, MemoryError) as error:
        return fail(one_line(error))
    except RuntimeError as error:
        # Torch's errors of full memory: known by type on a GPU and by text on a CPU, without importing torch.
        if type(error).__name__ != "OutOfMemoryError" and "Allocator" not in str(error):
            raise
        return fail(f"there is not enough memory: {one_line(error).rpartition('Allocator: ')[2]}")
    finally:
        environments.removeHandler(notices)
