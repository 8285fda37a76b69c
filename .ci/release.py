"""Tries a release: builds it, checks it, and uses it in new environments. Uploads nothing.

With a tag, such as v0.1.0, CHANGELOG.md must have the version's date, too.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
import time
from importlib import metadata
from pathlib import Path

from try_versions import PROJECT, ROOT, CannotInstall, install

PAGES = " ".join(  # those whose texts are made by programs
    f"tests/project/test_{name}.py"
    for name in ("project", "docs", "interface", "results", "teaching", "thesis")
)
SMOKE = """
import os, sys, torch
import torchrl_her, torchrl_her_envs, torchrl_her_recipes
from torchrl_her.native import load_steps
for package in (torchrl_her, torchrl_her_envs, torchrl_her_recipes):
    assert package.__file__.startswith(sys.prefix), package.__file__
assert torchrl_her.__version__ == sys.argv[1], torchrl_her.__version__
load_steps(torch.float32), load_steps(torch.float64)
env = torchrl_her_envs.make_env("hand_v1", num_envs=100, seed=0)
rollout = torchrl_her.evaluate(env, torchrl_her_recipes.load_policy("hand_v1"), max_steps=50)
rate = torchrl_her.success(rollout).float().mean().item()
print(f"the policy of hand_v1 succeeds in {rate:.0%} of 100 episodes")
assert rate > 0.8
"""


class Failed(RuntimeError):
    """A step of the release failed; the message says which."""


def main(tag: str = "") -> int:
    """Takes all steps; returns 1 after the first one that fails."""
    began = time.monotonic()
    version = PROJECT["version"]
    python = f"{sys.version_info.major}.{sys.version_info.minor}"
    try:
        step("the version, in all places that have it")
        texts = [(ROOT / name).read_text(encoding="utf-8") for name in ("CITATION.cff", "CHANGELOG.md")]
        if wrong := disagreements(version, metadata.version("torchrl-her"), *texts, tag):
            raise Failed("; ".join(wrong))
        for target in (["wheel"], ["check-dist"], ["test", f"TESTS={PAGES}"]):
            call(f"make {target[0]}", "make", *target, f"VENV={sys.prefix}", folder=ROOT)
        for built in sorted((ROOT / "dist").glob(f"torchrl_her-{version}*")):
            for which in ("lowest", "mixed", "newest"):
                step(f"{built.name}, installed with the {which} versions")
                with tempfile.TemporaryDirectory() as folder:
                    use(install(f"{folder}/venv", python, which, str(built))[0], built, Path(folder))
    except (Failed, CannotInstall) as error:
        print(f"release: FAILED after {time.monotonic() - began:.0f} s: {error}", file=sys.stderr)
        return 1
    print(f"\nrelease: {version} can be published; tried in {time.monotonic() - began:.0f} s")
    return 0


def disagreements(version: str, installed: str, citation: str, changelog: str, tag: str = "") -> list[str]:
    """Compares the version of pyproject.toml with the other places that have it.

    Args:
        version: Version in pyproject.toml.
        installed: Version of the installed package, which is its ``__version__``.
        citation: Text of CITATION.cff.
        changelog: Text of CHANGELOG.md, whose first part is that of the version.
        tag: Tag of the release; with one, the part of the changelog must have a date.

    Returns:
        A sentence for each place that disagrees.
    """
    cited = re.search(r"^version: (.+)$", citation, re.MULTILINE)
    part = re.search(r"^## (\S+) \((.+)\)\n\s*(?!\s|## |\Z)", changelog, re.MULTILINE)
    have = {
        "the installed package": installed,
        "CITATION.cff": cited[1] if cited else "none",
        "the first part of CHANGELOG.md": part[1] if part else "none that says anything",
        **({"the tag": tag.removeprefix("v")} if tag else {}),
    }
    wrong = [f"{place} has version {found}" for place, found in have.items() if found != version]
    if tag and part and not re.fullmatch(r"\d{4}-\d\d-\d\d", part[2]):
        wrong.append(f"CHANGELOG.md has {part[2]!r} in place of a date")
    return [f"pyproject.toml has version {version}", *wrong] if wrong else []


def use(interpreter: Path, built: Path, folder: Path) -> None:
    """Runs what was installed, away from the checkout; a wheel without a compiler."""
    command = interpreter.with_name("torchrl-her")
    env = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    env |= {"OMP_NUM_THREADS": "1", "TORCHRL_HER_CACHE": f"{folder}/cache"}
    if built.suffix == ".whl":
        env["CXX"] = "none"
    call("import and play", interpreter, "-c", SMOKE, PROJECT["version"], folder=folder, env=env)
    call("torchrl-her list", command, "list", folder=folder, env=env)
    call("the demo, shortened", command, "train", "preset=demo", "epochs=2", folder=folder, env=env)


def call(name: str, *command: str | Path, folder: Path, env: dict[str, str] | None = None) -> None:
    """Runs a command; of its output only the last line is shown, unless it fails."""
    step(name)
    began = time.monotonic()
    done = subprocess.run(command, cwd=folder, env=env, check=False, text=True, capture_output=True)
    if done.returncode:
        print(done.stdout, done.stderr)
        raise Failed(f"{name}: exit code {done.returncode}, output above")
    last = (done.stdout or done.stderr).rstrip().rpartition("\n")[2]
    print(f"   {time.monotonic() - began:.0f} s: {last}", flush=True)


def step(name: str) -> None:
    """Says what is done next."""
    print(f"-- {name}", flush=True)


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
