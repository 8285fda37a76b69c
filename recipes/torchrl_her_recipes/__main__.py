"""Entry of the command line: checks versions before it imports anything that depends on them."""

from __future__ import annotations

import sys

from torchrl_her_recipes.cli import main as command_line
from torchrl_her_recipes.config.versions import check_versions


def main() -> int:
    """Runs the command line; see :mod:`torchrl_her_recipes.cli`."""
    try:
        check_versions()
    except ImportError as error:
        print(f"torchrl-her: {error}", file=sys.stderr)
        return 2
    return command_line()


if __name__ == "__main__":
    sys.exit(main())
