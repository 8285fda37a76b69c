"""A run leaves behind what it promises, and comes out the same from the same seed."""

from __future__ import annotations

import json
from pathlib import Path
from shutil import rmtree
from typing import Any

import pandas as pd
import pytest
import torch
import yaml
from PIL import Image

from torchrl_her_recipes import Callback, Components, Recipe, RunView, build, load_policy, resume, run
from torchrl_her_recipes.runs.folder import RunFolder

from ..small import assert_same, small

RECIPE = small(
    algo="filtered_her", seed=3, pictures=True, epsilon_start=1.0, epsilon_decay=0.9, log="tensorboard"
)


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs") / "run"
    run(build(RECIPE), folder, progress=False)
    return folder


def test_configuration_versions_and_seed(finished: Path) -> None:
    assert Recipe.from_dict(yaml.safe_load((finished / "config.yaml").read_text())) == RECIPE
    about = json.loads((finished / "run.json").read_text())
    assert about["seed"] == 3
    assert about["versions"]["torch"].split("+")[0] == torch.__version__.split("+")[0]


def test_pandas_reads_the_metrics_at_once(finished: Path) -> None:
    table = pd.read_csv(finished / "metrics.csv")
    assert table["frames"].tolist() == [480, 960]
    assert table["updates"].tolist() == [24, 48]
    assert table["epsilon"].tolist() == pytest.approx([0.9, 0.81])
    assert {"success", "distance", "return", "q", "q_bias", "loss_actor", "loss_value"} <= set(table.columns)
    assert (table["rows_virtual"] > 0).all()
    assert (table["rows_virtual"] <= 4 * table["rows_real"]).all()


def test_pictures_open(finished: Path) -> None:
    for name in ("curves.png", "virtual_goals.png", "policy.gif"):
        with Image.open(finished / name) as picture:
            assert min(picture.size) > 100, name
            assert picture.convert("L").getextrema()[0] < picture.convert("L").getextrema()[1], name


def test_pictures_that_are_not_wanted_are_not_made_until_they_are(tmp_path: Path) -> None:
    run(build(small(epochs=1)), tmp_path, progress=False)
    assert not list(tmp_path.glob("*.png")) + list(tmp_path.glob("*.gif"))
    resume(tmp_path, options={"pictures": True}, progress=False)
    pictures = sorted(path.name for path in (*tmp_path.glob("*.png"), *tmp_path.glob("*.gif")))
    assert pictures == ["curves.png", "policy.gif", "virtual_goals.png"]


def test_a_folder_that_holds_a_run_is_not_written_over(finished: Path) -> None:
    with pytest.raises(ValueError, match="holds a run already"):
        run(build(small()), finished, progress=False)


def test_what_is_no_run_is_refused(finished: Path, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="is no folder of a run"):
        resume(tmp_path)
    with pytest.raises(ValueError, match="there is no run 4 in"):
        load_policy(finished, run=4)


# The same again


def everything(components: Components) -> dict[str, Any]:
    """Weights, targets and optimizer, as one flat dict."""
    state = dict(components.loss.state_dict())
    for index, own in components.optimizer.state_dict()["state"].items():
        state |= {f"optimizer {index} {name}": value for name, value in own.items()}
    return {name: value for name, value in state.items() if isinstance(value, torch.Tensor)}


def test_the_same_seed_gives_the_same_run() -> None:
    runs = [build(small(epochs=1, seed=seed)) for seed in (1, 1, 2)]
    for components in runs:
        run(components, progress=False)
    first, second, other = (everything(components) for components in runs)
    assert_same(first, second)
    assert not all(torch.equal(first[name], other[name]) for name in first)


def test_a_folder_that_is_deleted_meanwhile_is_written_anew(tmp_path: Path) -> None:
    class Delete(Callback):
        def on_epoch(self, run: RunView) -> bool:
            if run.trainer.epochs == 1:
                rmtree(tmp_path / "run")
            return False

    recipe = small(algo="her", epochs=2, checkpoint_interval=9)
    run(build(recipe), tmp_path / "run", callbacks=[Delete()], progress=False)
    assert RunFolder(tmp_path / "run").recipe() == recipe
    assert [row["epoch"] for row in RunFolder(tmp_path / "run").rows()] == [1, 2]
    assert json.loads((tmp_path / "run" / "run.json").read_text())["best"]["epoch"] >= 1
    load_policy(tmp_path / "run", best=True)
    assert not resume(tmp_path / "run", progress=False).interrupted


def test_a_run_that_stops_when_its_folder_was_deleted_can_be_resumed(tmp_path: Path) -> None:
    class DeleteAndStop(Callback):
        def on_batch(self, run: RunView) -> bool:
            if run.trainer.epochs == 1:
                rmtree(tmp_path / "run")
            return run.trainer.epochs == 1

    recipe = small(algo="her", epochs=2)
    run(build(recipe), tmp_path / "run", callbacks=[DeleteAndStop()], progress=False)
    assert RunFolder(tmp_path / "run").recipe() == recipe
    assert [row["epoch"] for row in resume(tmp_path / "run", progress=False).rows] == [1, 2]


def test_epochs_without_an_update_leave_a_table_that_fits(tmp_path: Path) -> None:
    recipe = small(epochs=3, epoch_frames=400, warmup_frames=900, checkpoint_interval=1, pictures=True)
    run(build(recipe), tmp_path / "run", progress=False)
    table = pd.read_csv(tmp_path / "run" / "metrics.csv")
    assert table["loss_value"].isna().tolist() == [True, True, False]
    assert table["success"].between(0, 1).all()
    assert (tmp_path / "run" / "policy.gif").exists()
