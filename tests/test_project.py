"""The project as a whole: imports go one way, the wheel is clean, the README's example runs."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGES = {
    "torchrl_her": ROOT / "torchrl_her",
    "torchrl_her_envs": ROOT / "envs" / "torchrl_her_envs",
    "torchrl_her_recipes": ROOT / "recipes" / "torchrl_her_recipes",
}
FORBIDDEN = {
    "torchrl_her": {"torchrl_her_envs", "torchrl_her_recipes", "pymunk", "hydra", "gymnasium"},
    "torchrl_her_envs": {"torchrl_her", "torchrl_her_recipes", "hydra"},
    "torchrl_her_recipes": {"pymunk"},
}


def imported(path: Path) -> set[str]:
    """Top-level names that a file imports, anywhere in it."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module.split(".")[0])
    return names


@pytest.mark.parametrize("package", PACKAGES)
def test_imports_go_one_way(package: str) -> None:
    files = list(PACKAGES[package].rglob("*.py"))
    assert files
    for path in files:
        assert not imported(path) & FORBIDDEN[package], path


def test_only_one_file_knows_pymunk() -> None:
    knowing = [path.name for path in PACKAGES["torchrl_her_envs"].glob("*.py") if "pymunk" in imported(path)]
    assert knowing == ["physics.py"]


@pytest.mark.parametrize("package", PACKAGES)
def test_what_a_package_exports_is_there_and_sorted(package: str) -> None:
    module = __import__(package)
    assert module.__all__ == sorted(
        module.__all__, key=lambda name: (not name.isupper(), name[0].islower(), name)
    )
    for name in module.__all__:
        assert getattr(module, name) is not None


def test_the_wheel_installs_three_packages_and_no_module_called_envs_or_recipes(tmp_path: Path) -> None:
    build = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(tmp_path), str(ROOT)]
    subprocess.run(build, check=True, capture_output=True)
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        archive.extractall(tmp_path / "site")
    tops = {name.split("/")[0] for name in names}
    assert {top for top in tops if not top.endswith(".dist-info")} == set(PACKAGES)
    for package in PACKAGES:
        assert f"{package}/py.typed" in names
    for data in ("conf/train.yaml", "conf/thesis.yaml", "templates/report.html"):
        assert f"torchrl_her_recipes/{data}" in names
    check = (
        "import importlib.util, torchrl_her, torchrl_her_envs, torchrl_her_recipes\n"
        "packages = torchrl_her, torchrl_her_envs, torchrl_her_recipes\n"
        f"assert all(package.__file__.startswith({str(tmp_path)!r}) for package in packages)\n"
        "assert importlib.util.find_spec('envs') is None\n"
        "assert importlib.util.find_spec('recipes') is None\n"
    )
    # -S -I: neither this checkout's editable installation nor the working directory is on the path.
    site = [path for path in sys.path if path.endswith("site-packages")]
    setup = f"import sys; sys.path[:0] = {[str(tmp_path / 'site'), *site]!r}\n"
    subprocess.run([sys.executable, "-S", "-I", "-c", setup + check], check=True, cwd=tmp_path)


def test_the_readme_s_example_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    assert blocks
    for block in blocks:
        exec(compile(block, "README.md", "exec"), {})


def test_the_repository_names_no_package_index_and_no_path_of_a_machine() -> None:
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=False)
    if listed.returncode:
        pytest.skip("not a git checkout")
    index = "|".join("-".join(words) for words in (("index", "url"), ("find", "links")))
    forbidden = re.compile(f"{index}|pythonhosted|/({'|'.join(('root', 'home', 'tmp'))})/")
    for name in listed.stdout.split():
        path = ROOT / name
        if path.suffix not in {".png", ".gif", ".pt"} and path != Path(__file__):
            assert not forbidden.search(path.read_text()), name
