"""What a release is checked for, and for which machines wheels are; nothing is built."""

from __future__ import annotations

import re
import tomllib
from importlib import metadata
from pathlib import Path
from types import ModuleType

import pytest
import yaml

from torchrl_her.native import library

from .pages import ROOT, script

VERSION = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
CITATION = "title: torchrl-her\nversion: 1.2.0\n"
CHANGELOG = "# Changelog\n\n## 1.2.0 (2026-12-01)\n\n- New: a thing.\n\n## 1.1.0 (2026-11-01)\n\n- Old.\n"


@pytest.fixture
def release(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(ROOT / ".ci")
    return script(".ci/release.py")


@pytest.fixture(scope="module")
def build() -> ModuleType:
    return script("hatch_build.py")


def test_the_version_is_the_same_everywhere(release: ModuleType) -> None:
    texts = [(ROOT / name).read_text() for name in ("CITATION.cff", "CHANGELOG.md")]
    assert release.disagreements(VERSION, metadata.version("torchrl-her"), *texts) == []


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({}, None),
        ({"tag": "v1.2.0"}, None),
        ({"changelog": CHANGELOG.replace("2026-12-01", "unreleased")}, None),
        (
            {"changelog": CHANGELOG.replace("2026-12-01", "unreleased"), "tag": "v1.2.0"},
            "CHANGELOG.md has 'unreleased' in place of a date",
        ),
        ({"tag": "v1.2.1"}, "the tag has version 1.2.1"),
        ({"installed": "1.1.0"}, "the installed package has version 1.1.0"),
        ({"citation": CITATION.replace("1.2.0", "1.1.0")}, "CITATION.cff has version 1.1.0"),
        ({"citation": "title: torchrl-her\n"}, "CITATION.cff has version none"),
        (
            {"changelog": CHANGELOG.replace("1.2.0", "1.3.0")},
            "the first part of CHANGELOG.md has version 1.3.0",
        ),
        (
            {"changelog": CHANGELOG.replace("- New: a thing.\n\n", "")},
            "the first part of CHANGELOG.md has version 1.1.0",
        ),
    ],
)
def test_what_disagrees_about_the_version_is_named(
    release: ModuleType, changes: dict[str, str], complaint: str | None
) -> None:
    arguments = {"installed": "1.2.0", "citation": CITATION, "changelog": CHANGELOG, **changes}
    expected = ["pyproject.toml has version 1.2.0", complaint] if complaint else []
    assert release.disagreements("1.2.0", **arguments) == expected


def test_a_step_that_fails_ends_a_release_with_one_line(
    release: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    called: list[str] = []
    monkeypatch.setattr(release, "call", lambda name, *_command, **_options: called.append(name))
    assert release.main("v9.9.9") == 1
    assert called == []  # nothing is built
    error = capsys.readouterr().err
    assert re.fullmatch(r"release: FAILED after \d+ s: .*the tag has version 9\.9\.9.*\n", error)


def test_a_command_that_fails_shows_its_output(
    release: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    release.call("hello", "sh", "-c", "echo first; echo last", folder=tmp_path)
    assert re.fullmatch(r"-- hello\n   \d+ s: last\n", capsys.readouterr().out)
    with pytest.raises(release.Failed, match="hello: exit code 3, output above"):
        release.call("hello", "sh", "-c", "echo first; exit 3", folder=tmp_path)
    assert "first" in capsys.readouterr().out


def test_options_of_the_compiler_are_those_of_the_processor_and_the_system(build: ModuleType) -> None:
    linked = ("-static-libstdc++", "-Wl,--gc-sections", "-Wl,--exclude-libs,ALL")
    assert build.options("Linux", "x86-64-v4") == (
        "-march=x86-64-v4",
        "-mprefer-vector-width=512",
        "-fopenmp",
        *linked,
    )
    assert build.options("Linux", "armv8-a") == ("-march=armv8-a", "-fopenmp", *linked)
    assert build.options("Darwin", "armv8-a") == (
        "-march=armv8-a",
        "-fopenmp-simd",
        "-mmacosx-version-min=11.0",
    )


@pytest.mark.parametrize(
    ("system", "machine", "libraries", "expected"),
    [
        ("Linux", "x86_64", [b"\0GLIBC_2.2.5\0GLIBC_2.32\0", b"\0GLIBC_2.14\0"], "manylinux_2_32_x86_64"),
        ("Linux", "aarch64", [b"\0GLIBC_2.17\0", b"\0GLIBC_2.17\0GLIBC_2.38\0"], "manylinux_2_38_aarch64"),
        ("Darwin", "arm64", [b""], "macosx_11_0_arm64"),
    ],
)
def test_a_wheel_is_for_systems_that_can_load_all_its_libraries(
    build: ModuleType, system: str, machine: str, libraries: list[bytes], expected: str
) -> None:
    assert build.platform_tag(system, machine, libraries) == expected


def test_machines_that_wheels_are_built_on_load_a_level_without_asking_for_another(build: ModuleType) -> None:
    for _, machine in build.PLATFORMS:
        flags = set().union(*library.LEVELS[machine].values())
        assert library.levels(machine, flags) == list(library.LEVELS[machine]) != []


def test_other_machines_are_refused(build: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(build.platform, "system", lambda: "Windows")
    monkeypatch.setattr(build.platform, "machine", lambda: "AMD64")
    hook = build.CompiledSteps.__new__(build.CompiledSteps)
    with pytest.raises(RuntimeError, match="no compiled code for Windows on AMD64: `pip install .`"):
        hook.initialize("standard", {})


def test_the_workflow_builds_on_each_machine_that_wheels_are_for(build: ModuleType) -> None:
    workflow = yaml.safe_load((ROOT / ".github" / "workflows" / "release.yml").read_text())
    runners = workflow["jobs"]["build"]["strategy"]["matrix"]["os"]
    machines = {"ubuntu-22.04": "x86_64", "ubuntu-22.04-arm": "aarch64", "macos-latest": "arm64"}
    assert sorted(machines[runner] for runner in runners) == sorted(machine for _, machine in build.PLATFORMS)


def test_each_step_of_the_workflows_is_a_target(build: ModuleType) -> None:
    targets = set(re.findall(r"^([\w-]+):.*  ## ", (ROOT / "Makefile").read_text(), re.MULTILINE))
    for path in (ROOT / ".github" / "workflows").glob("*.yml"):
        for job in yaml.safe_load(path.read_text())["jobs"].values():
            for command in (step["run"] for step in job["steps"] if "run" in step):
                program, *words = command.split()
                assert program == "make", command
                assert {word for word in words if "=" not in word} <= targets, command
