"""Makes ``command_line.md`` out of what the program says about itself: its help, and that of each command.

Run it as ``python docs/make_command_line.py`` whenever a command or an option is new; a test compares them.
"""

from __future__ import annotations

import re
from pathlib import Path

import click

from torchrl_her_recipes.cli.group import group

PAGE = Path(__file__).parent / "command_line.md"
WIDTH = 100  # of the help, in characters
HEAD = """\
# The command line

What `torchrl-her -h` and `torchrl-her COMMAND -h` say. Options of a run are written `name=value`; they are
listed below [`torchrl-her train`](#torchrl-her-train), with their defaults, and are the same in presets,
studies and `make_recipe`.
"""
_GROUP = re.compile(r"(\w+): .*:\n", re.DOTALL)  # "learner: the learner and its networks:"


def help_of(name: str, command: click.Command, above: click.Context | None) -> str:
    """The help of a command as it is shown in a terminal of WIDTH characters."""
    context = command.make_context(name, [], above, resilient_parsing=True, terminal_width=WIDTH)
    return command.get_help(context).rstrip()


def section(title: str, shown_help: str) -> str:
    """A command's help under a heading; groups of a run's options have headings of their own."""
    parts = [f"## {title}"]
    shown: list[str] = []
    for paragraph in shown_help.split("\n\n"):
        named = _GROUP.match(paragraph.splitlines()[0] + "\n")
        if named and "=" in paragraph:
            parts += [_block(shown), f"### Options of `{named[1]}`"]
            shown = []
        shown.append(paragraph)
    return "\n\n".join([*parts, _block(shown)])


def _block(paragraphs: list[str]) -> str:
    return "```text\n" + "\n\n".join(paragraphs) + "\n```"


def page() -> str:
    """All of the page."""
    program = "torchrl-her"
    above = group.make_context(program, [], resilient_parsing=True)
    sections = [section(program, help_of(program, group, None))]
    for name, command in group.commands.items():
        sections.append(section(f"{program} {name}", help_of(name, command, above)))
    return "\n\n".join([HEAD.rstrip(), *sections]) + "\n"


if __name__ == "__main__":
    PAGE.write_text(page())
    print(PAGE)
