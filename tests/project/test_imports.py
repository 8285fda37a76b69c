"""Who imports whom: the contracts in pyproject.toml notice what breaks them, and there is no circle."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tomllib
from graphlib import TopologicalSorter
from itertools import chain
from pathlib import Path

import grimp

ROOT = Path(__file__).parents[2]
PACKAGES = {"torchrl_her": ROOT, "torchrl_her_envs": ROOT / "envs", "torchrl_her_recipes": ROOT / "recipes"}
CONTRACTS = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]


def test_no_modules_import_in_a_circle() -> None:
    """Counts a module that imports the front of its own package, too, which the contracts leave out."""
    graph = grimp.build_graph(*PACKAGES, cache_dir=None)
    imports = {module: graph.find_modules_directly_imported_by(module) for module in graph.modules}
    assert sum(map(len, imports.values())) > 100
    TopologicalSorter(imports).prepare()  # names the circle if there is one


def test_configurations_are_read_without_torch() -> None:
    """The contract knows no imports by name and no fronts of packages; here all of config is imported."""
    check = (
        "import importlib, pkgutil, sys\n"
        "import torchrl_her_recipes.config as config\n"
        "names = [module.name for module in pkgutil.walk_packages(config.__path__, config.__name__ + '.')]\n"
        "for name in names: importlib.import_module(name)\n"
        "print(len(names), *({'torch', 'torchrl', 'tensordict', 'pymunk'} & set(sys.modules)))\n"
    )
    done = subprocess.run([sys.executable, "-c", check], capture_output=True, text=True, check=True)
    count, *loaded = done.stdout.split()
    assert int(count) > 5
    assert not loaded


def lint_imports(folder: Path) -> str:
    """The report on the packages in a folder, in one line."""
    command = [Path(sys.executable).parent / "lint-imports", "--no-cache"]
    paths = [str(folder), os.environ.get("PYTHONPATH", "")]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, paths))}
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    return " ".join(done.stdout.split())


# For each contract: a module, what it is made to import, and what the report then says.
BREACHES = {
    "The library needs neither environments nor recipes": [
        ("torchrl_her.goals.rewards", "torchrl_her_envs", "torchrl_her.goals.rewards -> torchrl_her_envs ("),
        ("torchrl_her.goals.grid", "gymnasium", "torchrl_her.goals.grid -> gymnasium ("),
    ],
    "The environments need neither library nor recipes": [
        ("torchrl_her_envs.common.seeding", "torchrl_her", "envs.common.seeding -> torchrl_her (")
    ],
    "Only throwing.physics knows pymunk": [
        ("torchrl_her_envs.throwing.hand", "pymunk", "torchrl_her_envs.throwing.hand -> pymunk (")
    ],
    "Configurations are read without torch": [
        ("torchrl_her_recipes.config.versions", "torch", "torchrl_her_recipes.config.versions -> torch (")
    ],
    "Layers of the library": [
        (
            "torchrl_her.goals.rewards",
            "torchrl_her.trainers.trainer",
            "rewards -> torchrl_her.trainers.trainer (",
        ),
        ("torchrl_her.modules.networks", "torchrl_her.goals.grid", "networks -> torchrl_her.goals.grid ("),
    ],
    "Layers of the environments": [
        ("torchrl_her_envs.common.seeding", "torchrl_her_envs.toy.chain", "-> torchrl_her_envs.toy.chain (")
    ],
    "Layers of the throwing tasks": [
        (
            "torchrl_her_envs.throwing.tasks",
            "torchrl_her_envs.throwing.env",
            "tasks -> torchrl_her_envs.throwing.env (",
        )
    ],
    "Layers of the recipes": [
        (
            "torchrl_her_recipes.runs.folder",
            "torchrl_her_recipes.cli",
            "runs.folder -> torchrl_her_recipes.cli (",
        )
    ],
    "No circles": [
        (
            "torchrl_her_envs.toy.base",
            "torchrl_her_envs.toy.chain",
            "No cycles are allowed in torchrl_her_envs.toy.",
        )
    ],
}


def test_each_contract_notices_an_import_that_breaks_it(tmp_path: Path) -> None:
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    only_python = shutil.ignore_patterns("*.safetensors", "*.png", "*.yaml", "__pycache__")
    for package, parent in PACKAGES.items():
        shutil.copytree(parent / package, tmp_path / package, ignore=only_python)
    for module, imported, _ in chain.from_iterable(BREACHES.values()):
        path = tmp_path.joinpath(*module.split(".")).with_suffix(".py")
        path.write_text(f"{path.read_text()}\nif TYPE_CHECKING:\n    import {imported}\n")
    summary, details = lint_imports(tmp_path).split("Broken contracts")
    assert re.findall(r"Contracts: .* kept", summary) == ["Contracts: 0 kept"]
    names = [contract["name"] for contract in CONTRACTS]
    assert list(BREACHES) == names
    sections = re.split("|".join(f"{name} -+" for name in names), details)[1:]
    for name, section in zip(names, sections, strict=True):
        for _, _, said in BREACHES[name]:
            assert said in section, name


def test_make_lint_asks_for_the_contracts_and_they_are_kept() -> None:
    commands = subprocess.run(["make", "-n", "lint"], cwd=ROOT, capture_output=True, text=True, check=True)
    assert "bin/lint-imports\n" in commands.stdout
    assert f"Contracts: {len(CONTRACTS)} kept, 0 broken." in lint_imports(ROOT)
