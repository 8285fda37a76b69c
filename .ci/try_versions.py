"""Runs a few tests with the ends of the version ranges in pyproject.toml and with each Python named there.

Each try is a virtual environment in a temporary folder, removed afterwards. Arguments are the tests to run.
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
RANGED = ("torch", "tensordict", "torchrl")
TESTS = ["tests/torchrl_her/replay_buffers", "tests/recipes/config", "tests/recipes/runs/test_run.py"]
UV = Path(sys.executable).parent / "uv"
SHOW = (
    "import sys, importlib.metadata; print('Python', sys.version.split()[0], "
    f"*(f'{{name}} {{importlib.metadata.version(name)}}' for name in {RANGED}))"
)


def main(tests: list[str]) -> int:
    """Tries everything; returns 1 if something failed."""
    if not UV.exists():
        print(f"there is no {UV}; `pip install uv` puts it there", file=sys.stderr)
        return 2
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    ranges = [text for text in project["dependencies"] if re.match(rf"({'|'.join(RANGED)})[<>=]", text)]
    pythons = re.findall(r":: (3\.\d+)", "\n".join(project["classifiers"]))
    tries = [(pythons[0], "lowest"), *((python, "newest") for python in pythons)]
    outcomes = []
    for python, end in tries:
        outcome = attempt(python, ranges, end, tests or TESTS)
        print(f"-- Python {python}, {end} versions: {outcome}", flush=True)
        outcomes.append((python, end, outcome))
    print("\nPython  versions  outcome")
    for python, end, outcome in outcomes:
        print(f"{python:6}  {end:8}  {outcome}")
    return int(any(outcome.startswith("FAILED") for _, _, outcome in outcomes))


def attempt(python: str, ranges: list[str], end: str, tests: list[str]) -> str:
    """Makes one environment and runs the tests in it.

    Args:
        python: a version of Python, such as 3.12.
        ranges: the requirements of which the lowest or newest release is installed.
        end: ``"lowest"`` or ``"newest"``.
        tests: files or folders.

    Returns:
        What came of it, in words.
    """
    with tempfile.TemporaryDirectory() as folder:
        interpreter = Path(folder) / "bin" / "python"
        if uv("venv", "--quiet", "--clear", "--python", python, folder):
            return "skipped: this Python is not here, and uv cannot install it"
        install = ["pip", "install", "--quiet", "--python", str(interpreter)]
        resolution = "lowest-direct" if end == "lowest" else "highest"
        if uv(*install, "--resolution", resolution, *ranges) or uv(*install, "--editable", f"{ROOT}[test]"):
            return "FAILED: cannot be installed"
        one_thread = {**os.environ, "OMP_NUM_THREADS": "1"}
        shown = subprocess.run([interpreter, "-c", SHOW], capture_output=True, text=True, check=False)
        print(f"\n-- {shown.stdout.strip() or shown.stderr}", flush=True)
        command = [interpreter, "-m", "pytest", "-q", "-p", "no:cacheprovider", *tests]
        failed = subprocess.run(command, cwd=ROOT, env=one_thread, check=False).returncode
    return f"{'FAILED' if failed else 'passed'}: {shown.stdout.strip()}"


def uv(*arguments: str) -> int:
    """Runs uv, which also finds the Pythons of pyenv; returns its exit code."""
    pyenv = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv"))
    folders = [os.environ["PATH"], *(str(path) for path in sorted(pyenv.glob("versions/*/bin")))]
    path = {**os.environ, "PATH": os.pathsep.join(folders)}
    return subprocess.run([UV, *arguments], env=path, check=False).returncode


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
