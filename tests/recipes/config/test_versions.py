"""Versions of torch, tensordict and torchrl: refused outside of their ranges, before anything is imported."""

from __future__ import annotations

import os
import subprocess
import sys
import warnings
from pathlib import Path

import pytest

from torchrl_her_recipes.config.versions import TRIED, check_versions

INSTALLED = {"torch": "2.14.1", "tensordict": "0.14.3", "torchrl": "0.14.1"}


@pytest.mark.parametrize(
    "given", [{"torch": "2.13.0+cpu"}, {"torch": "2.16.0"}, {"torch": "2.16.0.dev20260801"}, {"torch": "3.0"}]
)
def test_a_version_outside_of_its_range_is_named_with_the_remedy(given: dict[str, str]) -> None:
    shown = given["torch"].split("+")[0]
    with pytest.raises(ImportError) as error:
        check_versions({**INSTALLED, **given}.__getitem__)
    assert str(error.value) == (
        f"torch {shown} does not fit this version of torchrl-her; "
        "install 'torch<2.16,>=2.14' 'tensordict<0.16,>=0.14' 'torchrl<0.16,>=0.14'"
    )


def test_all_versions_that_do_not_fit_are_named() -> None:
    installed = {"torch": "2.14.1", "tensordict": "0.13.0", "torchrl": "0.16.0"}
    with pytest.raises(ImportError, match=r"^tensordict 0\.13\.0, torchrl 0\.16\.0 do not fit"):
        check_versions(installed.__getitem__)


@pytest.mark.parametrize(("tensordict", "torchrl"), [("0.15.3", "0.14.1"), ("0.14.3", "0.15.0")])
def test_tensordict_is_of_torchrl_s_minor_release(tensordict: str, torchrl: str) -> None:
    with pytest.raises(ImportError) as error:
        check_versions({**INSTALLED, "tensordict": tensordict, "torchrl": torchrl}.__getitem__)
    assert str(error.value) == (
        f"tensordict {tensordict} does not fit torchrl {torchrl}; install 'tensordict~={torchrl[:4]}.0'"
    )


@pytest.mark.parametrize("version", ["2.14.1+cu130", "2.14.0", "2.14.1+cpu"])
def test_a_version_that_was_tried_is_taken_in_silence(version: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_versions({**INSTALLED, "torch": version}.__getitem__)


@pytest.mark.parametrize("version", ["2.14.7", "2.14.2rc1"])
def test_a_patch_release_never_tried_only_warns_in_one_line(version: str) -> None:
    with pytest.warns(UserWarning, match="never tried") as warned:
        check_versions({**INSTALLED, "torch": version}.__getitem__)
    assert [str(warning.message) for warning in warned] == [
        f"torch {version} was never tried with this version of torchrl-her; "
        "the tests were run with 2.14.0, 2.14.1, 2.15.0"
    ]


@pytest.mark.parametrize("torch", TRIED["torch"])
@pytest.mark.parametrize(
    ("tensordict", "torchrl"), list(zip(TRIED["tensordict"], TRIED["torchrl"], strict=True))
)
def test_what_was_tried_lies_in_the_ranges(torch: str, tensordict: str, torchrl: str) -> None:
    check_versions({"torch": torch, "tensordict": tensordict, "torchrl": torchrl}.__getitem__)


def test_versions_are_checked_before_anything_is_imported(tmp_path: Path) -> None:
    """A torchrl that cannot even be imported beside this torch is still named in one line."""
    for name, version in {**INSTALLED, "torch": "2.13.0"}.items():
        (tmp_path / f"{name}.py").write_text("raise RuntimeError('not to be imported')")
        about = tmp_path / f"{name}-{version}.dist-info"
        about.mkdir()
        (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
    paths = [str(tmp_path), os.environ.get("PYTHONPATH", "")]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, paths))}
    command = [sys.executable, "-m", "torchrl_her_recipes", "list"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr.startswith(
        "torchrl-her: torch 2.13.0 does not fit this version of torchrl-her; install "
    )
    assert done.stderr.count("\n") == 1
