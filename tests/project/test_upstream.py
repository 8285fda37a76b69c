"""The reports in ``docs/upstream``: TorchRL fails as they say, and no longer with their patches."""

from __future__ import annotations

import re
import runpy
import subprocess
from pathlib import Path

import pytest
import torchrl
from torchrl import data

UPSTREAM = Path(__file__).parents[2] / "docs" / "upstream"
SCRIPTS = sorted(UPSTREAM.glob("*.py"))

pytestmark = pytest.mark.skipif(
    not hasattr(data, "HERReplayBuffer"), reason="this TorchRL has no HERReplayBuffer"
)


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_torchrl_fails_as_reported_and_the_patch_repairs_it(
    script: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (line,) = re.findall(r"```text\n(.*?)\n```", script.with_suffix(".md").read_text())
    with pytest.raises(AssertionError) as error:
        runpy.run_path(str(script))
    assert f"AssertionError: {error.value}" == line

    module = Path("torchrl/data/replay_buffers/her.py")
    (tmp_path / module).parent.mkdir(parents=True)
    (tmp_path / module).write_text((Path(torchrl.__file__).parents[1] / module).read_text())
    patch = ["git", "apply", "--include=torchrl/*", str(script.with_suffix(".patch"))]
    subprocess.run(patch, cwd=tmp_path, check=True)
    patched = runpy.run_path(str(tmp_path / module))["HERReplayBuffer"]
    monkeypatch.setattr(data, "HERReplayBuffer", patched)
    runpy.run_path(str(script))


def test_each_report_has_a_script_and_a_patch_with_tests() -> None:
    reports = {path.stem for path in UPSTREAM.glob("*.md")} - {"sample_units"}
    assert reports == {path.stem for path in SCRIPTS} == {path.stem for path in UPSTREAM.glob("*.patch")}
    for name in reports:
        assert "+++ b/test/rb/test_her.py" in (UPSTREAM / f"{name}.patch").read_text()
