"""The project as a whole: its fronts, the wheel, the README's example."""

from __future__ import annotations

import re
import subprocess
import sys
import zipfile
from pathlib import Path

import hatchling.build
import pytest

ROOT = Path(__file__).parents[2]
PACKAGES = {
    "torchrl_her": ROOT / "torchrl_her",
    "torchrl_her_envs": ROOT / "envs" / "torchrl_her_envs",
    "torchrl_her_recipes": ROOT / "recipes" / "torchrl_her_recipes",
}


@pytest.mark.parametrize("package", PACKAGES)
def test_what_a_package_exports_is_there_and_sorted(package: str) -> None:
    module = __import__(package)
    if (PACKAGES[package] / "__init__.pyi").exists():  # lazy_loader makes the list, and sorts it
        ordered = sorted(module.__all__)
    else:
        ordered = sorted(module.__all__, key=lambda name: (not name.isupper(), name[0].islower(), name))
    assert module.__all__ == ordered
    assert len(module.__all__) == len(set(module.__all__)) > 0
    for name in module.__all__:
        assert getattr(module, name) is not None


def test_the_wheel_holds_three_packages_and_no_module_called_envs_or_recipes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(ROOT)
    with zipfile.ZipFile(tmp_path / hatchling.build.build_wheel(str(tmp_path))) as archive:
        names = [name for name in archive.namelist() if ".dist-info/" not in name]
        archive.extractall(tmp_path / "site")
    # What is installed is, byte for byte, what the tests ran.
    checkout = {
        str(path.relative_to(folder.parent)): path.read_bytes()
        for folder in PACKAGES.values()
        for path in folder.rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert {name: (tmp_path / "site" / name).read_bytes() for name in names} == checkout
    for package in PACKAGES:
        assert f"{package}/py.typed" in names
    assert "torchrl_her_recipes/templates/report.html" in names
    assert any(re.fullmatch(r"torchrl_her_recipes/conf/.+\.yaml", name) for name in names)
    # Python without site-packages, and so without this checkout, finds the three and nothing else of ours.
    check = (
        "import importlib.util, sys\n"
        f"sys.path.insert(0, {str(tmp_path / 'site')!r})\n"
        f"names = {[*PACKAGES, 'envs', 'recipes']!r}\n"
        "print(*(name for name in names if importlib.util.find_spec(name)))\n"
    )
    done = subprocess.run(
        [sys.executable, "-S", "-I", "-c", check], check=True, cwd=ROOT, capture_output=True, text=True
    )
    assert done.stdout.split() == list(PACKAGES)


def test_the_readme_s_example_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    assert blocks
    for block in blocks:
        exec(compile(block, "README.md", "exec"), {})


def test_the_repository_names_no_package_index_and_no_path_of_a_machine() -> None:
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard"]
    listed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    if listed.returncode:
        pytest.skip("not a git checkout")
    index = "|".join("-".join(words) for words in (("index", "url"), ("find", "links")))
    forbidden = re.compile(f"{index}|pythonhosted|/({'|'.join(('root', 'home', 'tmp'))})/")
    for name in listed.stdout.splitlines():
        path = ROOT / name
        binary = path.suffix in {".png", ".gif", ".safetensors", ".npz", ".gz"}
        if (
            path.exists() and not binary and path != Path(__file__)
        ):  # a file may be removed, but not yet in git
            assert not forbidden.search(path.read_text()), name
