"""Where the command line starts: versions are checked before what depends on them is imported."""

from __future__ import annotations

import sys

from torchrl_her_recipes.versions import check_versions


def main() -> int:
    """Runs the command line; see :mod:`torchrl_her_recipes.cli`."""
    try:
        check_versions()
        from torchrl_her_recipes import cli  # noqa: PLC0415  (a pair that does not fit may fail to import)

        return cli.main()
    except ImportError as error:
        print(f"torchrl-her: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("torchrl-her: interrupted", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
