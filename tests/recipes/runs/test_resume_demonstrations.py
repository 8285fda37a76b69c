"""A run with demonstrations that was stopped goes on bit for bit as if it had not been."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from torchrl_her import load_checkpoint
from torchrl_her_recipes import build, record_demonstrations, resume, run

from ..small import assert_same, small, stop_after

ALL: dict[str, Any] = {"task": "hand_v1", "epochs": 2, "episodes": 10, "seed": 5}


@pytest.fixture(scope="module", name="file")
def _file(tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("demonstrations") / "hand_v1.pt"
    record_demonstrations("hand_v1", path, episodes=6)
    return str(path)


def asked(file: str, **options: Any) -> dict[str, Any]:
    return {"demonstrations.file": file, "demonstrations.episodes": 4, **ALL, **options}


@pytest.mark.parametrize(
    "options",
    [
        pytest.param(
            {"algo": "cher_ibs", "window": 10, "success_threshold": 0.01, "normalize": True}
            | {"demonstrations.starts_share": 0.5, "demonstrations.starts_samples": 3},
            id="in a curriculum, with starts",
        ),
        pytest.param(
            {"num_runs": 2, "demonstrations.starts_share": 0.5, "demonstrations.starts_threshold": 0.01}
            | {"demonstrations.starts_samples": 2},
            id="two runs, with starts",
        ),
        pytest.param({"sampler": "uniform", "learner": "sac"}, id="sac"),
        pytest.param({"algo": "cher", "order": "all_at_once", "every_stage": True}, id="all stages at once"),
    ],
)
def test_a_stop_changes_nothing(options: dict[str, Any], file: str, tmp_path: Path) -> None:
    recipe = small(**asked(file, **options))
    run(build(recipe), tmp_path / "whole", progress=False)
    stopped = build(recipe)
    stop_after(stopped, 4)
    assert run(stopped, tmp_path / "part", progress=False).interrupted
    stopped = build(recipe)
    stop_after(stopped, 5)
    assert resume(tmp_path / "part", components=stopped, progress=False).interrupted
    assert not resume(tmp_path / "part", progress=False).interrupted
    whole, part = (load_checkpoint(tmp_path / name / "checkpoint.pt") for name in ("whole", "part"))
    assert whole["demonstrations"]["buffer"]["rows"][0] is not None
    if "demonstrations.starts_share" in options:
        walk = next(
            own["walk"]
            for name, own in whole["collector"]["env_state_dict"].items()
            if name.endswith("_extra_state")
        )
        assert any(walk["outcomes"]) or max(walk["back"]) > 4
    assert_same(whole, part)


def test_a_file_that_was_changed_meanwhile_is_refused(file: str, tmp_path: Path) -> None:
    path = tmp_path / "hand_v1.pt"
    path.write_bytes(Path(file).read_bytes())
    recipe = small(**asked(str(path)))
    components = build(recipe)
    stop_after(components, 3)
    run(components, tmp_path / "part", progress=False)
    record_demonstrations("hand_v1", path, episodes=6, seed=1, force=True)
    with pytest.raises(ValueError, match="the run's demonstrations was 4, .*: give resume"):
        resume(tmp_path / "part", progress=False)
