"""Runs a few tests with the ends of the version ranges in pyproject.toml and with each Python named there.

Each try is a virtual environment in a temporary folder, removed afterwards. While the newest TorchRL of the
range is not released, its nightly build stands in for it. Arguments are the tests to run.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
RANGED = ("torch", "tensordict", "torchrl")
TESTS = [  # what another TorchRL breaks first, and what another Python does
    "tests/torchrl_her/test_torchrl_private.py",
    "tests/torchrl_her/compatibility",
    "tests/torchrl_her/replay_buffers",
    "tests/torchrl_her/objectives",
    "tests/torchrl_her/trainers/test_checkpoint.py",
    "tests/recipes/config",
    "tests/recipes/runs/test_run.py",
]
UV = Path(sys.executable).parent / "uv"
SHOW = (
    "import sys, importlib.metadata; print('Python', sys.version.split()[0], "
    f"*(f'{{name}} {{importlib.metadata.version(name)}}' for name in {RANGED}))"
)
# A nightly build has another name and its date as version. This gives it those of the release to come.
ALIAS = """
import importlib.metadata, sys
nightly = importlib.metadata.distribution("torchrl-nightly")
version = sys.argv[1] + ".0.dev" + "".join(f"{int(part):02}" for part in nightly.version.split("."))
folder = nightly.locate_file(f"torchrl-{version}.dist-info")
folder.mkdir()
(folder / "METADATA").write_text(f"Metadata-Version: 2.1\\nName: torchrl\\nVersion: {version}\\n")
"""


class CannotInstall(RuntimeError):
    """The outcome of a try whose environment could not be made."""


def main(tests: list[str]) -> int:
    """Tries everything; returns 1 if something failed."""
    pythons = re.findall(r":: (3\.\d+)", "\n".join(PROJECT["classifiers"]))
    tries = [(pythons[0], "lowest"), (pythons[0], "mixed"), *((python, "newest") for python in pythons)]
    outcomes = []
    for python, which in tries:
        outcome = attempt(python, which, tests or TESTS)
        print(f"-- Python {python}, {which} versions: {outcome}", flush=True)
        outcomes.append((python, which, outcome))
    print("\nPython  versions  outcome")
    for python, which, outcome in outcomes:
        print(f"{python:6}  {which:8}  {outcome}")
    return int(any(outcome.startswith("FAILED") for _, _, outcome in outcomes))


def attempt(python: str, which: str, tests: list[str]) -> str:
    """Makes one environment, runs the tests in it, and returns the outcome in words; see :func:`install`."""
    with tempfile.TemporaryDirectory() as folder:
        try:
            interpreter, versions = install(folder, python, which, "--editable", f"{ROOT}[test]")
        except CannotInstall as error:
            return str(error)
        one_thread = {**os.environ, "OMP_NUM_THREADS": "1"}
        command = [interpreter, "-m", "pytest", "-q", "-p", "no:cacheprovider", *tests]
        failed = subprocess.run(command, cwd=ROOT, env=one_thread, check=False).returncode
    return f"{'FAILED' if failed else 'passed'}: {versions}"


def install(folder: str, python: str, which: str, *project: str) -> tuple[Path, str]:
    """Makes a virtual environment that has the project.

    Args:
        folder: the environment's folder.
        python: a version of Python, such as 3.12.
        which: ``"lowest"``, ``"newest"``, or ``"mixed"``: the newest torch beside the oldest TorchRL.
        project: what pip is told to install: a checkout or a file.

    Returns:
        The interpreter, and the versions of Python and of the packages in ``RANGED``.

    Raises:
        CannotInstall: this Python or the packages are not to be had.
    """
    interpreter = Path(folder) / "bin" / "python"
    if uv("venv", "--quiet", "--clear", "--python", python, folder):
        raise CannotInstall("skipped: this Python is not here, and uv cannot install it")
    ranges = [text for text in PROJECT["dependencies"] if re.match(rf"({'|'.join(RANGED)})[<>=]", text)]
    oldest, newest = _minors(ranges)
    pip = ["pip", "install", "--quiet", "--python", str(interpreter)]
    wanted = ["--resolution", "lowest-direct"] if which == "lowest" else [f"torchrl=={oldest}.*"]
    failed = uv(*pip, *ranges, *wanted) or uv(*pip, *project)
    if which == "newest" and not failed and uv(*pip, "--upgrade", *ranges, f"torchrl=={newest}.*"):
        print(f"-- TorchRL {newest} is not released; its nightly build is tried", flush=True)
        uv("pip", "uninstall", "--quiet", "--python", str(interpreter), "torchrl")
        failed = (
            uv(*pip, "--no-deps", "torchrl-nightly", f"tensordict=={newest}.*")
            or subprocess.run([interpreter, "-c", ALIAS, newest], check=False).returncode
        )
    if failed:
        raise CannotInstall("FAILED: cannot be installed")
    shown = subprocess.run([interpreter, "-c", SHOW], capture_output=True, text=True, check=False)
    print(f"\n-- {shown.stdout.strip() or shown.stderr}", flush=True)
    return interpreter, shown.stdout.strip()


def _minors(ranges: list[str]) -> tuple[str, str]:
    """The oldest and the newest minor release of TorchRL in its range: 0.14 and 0.15 of >=0.14,<0.16."""
    (torchrl,) = (text for text in ranges if text.startswith("torchrl"))
    ((oldest, major, beyond),) = re.findall(r">=([\d.]+),<(\d+)\.(\d+)", torchrl)
    return oldest, f"{major}.{int(beyond) - 1}"


def uv(*arguments: str) -> int:
    """Runs uv, which also finds the Pythons of pyenv; returns its exit code."""
    if not UV.exists():
        sys.exit(f"there is no {UV}; `pip install uv` puts it there")
    pyenv = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv"))
    folders = [os.environ["PATH"], *(str(path) for path in sorted(pyenv.glob("versions/*/bin")))]
    path = {**os.environ, "PATH": os.pathsep.join(folders)}
    return subprocess.run([UV, *arguments], env=path, check=False).returncode


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
