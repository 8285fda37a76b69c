"""Values in toy environments, measured and drawn, against networks whose values are known."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from matplotlib.figure import Figure
from PIL import Image
from torch import Tensor, nn
from torchrl.data import Categorical
from torchrl.modules import QValueActor

from torchrl_her_envs import BitFlip, TreasureHunt
from torchrl_her_recipes import Study, build, run
from torchrl_her_recipes.studies.seed_batches import Batches

from ..recipes.small import small
from .pages import script

figures = script("docs/make_toy_values.py")
KEYS = ["observation", "desired_goal"]


class KnowsBits(nn.Module):
    """1 for a needed flip, -1 for a needless one, and the number of wrong bits for the last action."""

    def forward(self, place: Tensor, goal: Tensor) -> Tensor:
        differs = place != goal
        return torch.cat((differs * 2.0 - 1.0, differs.sum(-1, keepdim=True)), -1)


class KnowsTheWay(nn.Module):
    """How far the treasure is to the left, and to the right."""

    def forward(self, place: Tensor, goal: Tensor) -> Tensor:
        return torch.cat((place - goal, goal - place), -1)


class TwoOpinions(nn.Module):
    """Of two runs: the first as above, the second thinks nothing of the last action."""

    def forward(self, place: Tensor, goal: Tensor) -> Tensor:
        values = KnowsBits()(place, goal)
        values[len(values) // 2 :, -1] = -1.0
        return values


class AlwaysLeft(nn.Module):
    def forward(self, place: Tensor, goal: Tensor) -> Tensor:
        return torch.cat((place * 0 + 1, place * 0), -1)


def test_what_two_runs_make_of_the_useless_action() -> None:
    env = BitFlip(4, useless_action=True)
    actor = QValueActor(TwoOpinions(), spec=Categorical(5), in_keys=KEYS, action_space="categorical")
    measured = figures.measure_values(env, actor, 2)
    # One value more than a needed flip for each wrong bit beyond the first, over 1 to 4; then never.
    assert measured["useless_margin"].tolist() == [1.5, -2.0]
    assert measured["useless_share"].tolist() == [0.75, 0.0]


def test_the_right_way_is_towards_the_treasure() -> None:
    actor = QValueActor(KnowsTheWay(), spec=Categorical(2), in_keys=KEYS, action_space="categorical")
    assert figures.measure_values(TreasureHunt(20), actor, 1)["right_way"].tolist() == [1.0]
    always_left = QValueActor(AlwaysLeft(), spec=Categorical(2), in_keys=KEYS, action_space="categorical")
    assert figures.measure_values(TreasureHunt(20), always_left, 1)["right_way"].tolist() == [0.5]


def test_kinds_of_flips_are_told_apart() -> None:
    actor = QValueActor(KnowsBits(), spec=Categorical(5), in_keys=KEYS, action_space="categorical")
    values = figures.values_by_wrong_bits(actor, 4, states=16)
    assert values["needed"].isnan().tolist() == [True, False, False, False, False]
    assert values["needed"][1:].tolist() == [1.0] * 4
    assert values["needless"][:4].tolist() == [-1.0] * 4
    assert values["needless"].isnan().tolist() == [False, False, False, False, True]
    assert values["useless"].tolist() == [0.0, 1.0, 2.0, 3.0, 4.0]


def test_true_values_by_hand() -> None:
    assert figures.true_values(torch.tensor([1, 2, 3]), 0.5).tolist() == [0.0, -1.0, -1.5]


def test_all_places_and_treasures_of_the_line() -> None:
    actor = QValueActor(KnowsTheWay(), spec=Categorical(2), in_keys=KEYS, action_space="categorical")
    values = figures.values_on_the_line(actor, TreasureHunt(50))
    assert values[0, 2].tolist() == [-2.0, 2.0]  # the pirate at 0, the treasure at 100
    assert values[1, 0].tolist() == [1.0, -1.0]


@pytest.mark.parametrize(
    ("task", "options"), [("bit_flip", {"bits": 3, "useless_action": True}), ("treasure_hunt", {"step": 25})]
)
def test_runs_are_drawn_beside_each_other(task: str, options: dict[str, object], tmp_path: Path) -> None:
    runs = []
    for algo in ("her", "filtered_her"):
        recipe = small(task=task, options=options, algo=algo, epochs=1, num_runs=2)
        run(build(recipe), tmp_path / algo, progress=False)
        runs.append(Batches(tmp_path / algo))
    figures.plot_values(runs, tmp_path / "values.png")
    with Image.open(tmp_path / "values.png") as picture:
        assert picture.size[0] > 2 * picture.size[1]


@pytest.mark.parametrize(
    ("task", "options", "columns"),
    [
        ("bit_flip", {"bits": 3, "useless_action": True}, ["useless_share", "useless_margin"]),
        ("treasure_hunt", {"step": 25}, ["right_way"]),
    ],
)
def test_a_study_is_trained_with_columns_of_values(
    task: str, options: dict[str, object], columns: list[str], tmp_path: Path
) -> None:
    recipe = small(task=task, options=options, epochs=2, num_runs=2).to_dict()
    study = Study(name="values", recipe=recipe, vary={"algo": ["her"]})
    figures.train(study, tmp_path)
    rows = Batches(tmp_path / "her").rows()
    assert len(rows) == 4
    assert all(isinstance(row[name], float) for row in rows for name in columns)
    figures.plot_training(study, tmp_path, tmp_path / "values.png")
    with Image.open(tmp_path / "values.png") as picture:
        assert picture.size[0] > (1 + len(columns)) * picture.size[1]


def test_values_are_drawn_over_their_own_places() -> None:
    env, axes = TreasureHunt(25), Figure().subplots()
    actor = QValueActor(KnowsTheWay(), spec=Categorical(2), in_keys=KEYS, action_space="categorical")
    figures._draw(env, axes, [actor], 0.98)
    (picture,) = axes.images
    left, right, bottom, top = picture.get_extent()
    cells = picture.get_size()[0]
    middles = [left + (right - left) * (cell + 0.5) / cells for cell in range(cells)]
    assert middles == pytest.approx([0.0, 25.0, 50.0, 75.0, 100.0])
    assert (bottom, top) == (left, right)
    assert picture.get_array()[0, 3] == pytest.approx(1.5)  # the treasure at 0, the pirate at 75


def test_runs_of_other_tasks_are_refused(tmp_path: Path) -> None:
    run(build(small(epochs=1)), tmp_path / "run", progress=False)
    with pytest.raises(ValueError, match=r"of runs of bit_flip or of treasure_hunt, got \['hand_v0'\]"):
        figures.plot_values([Batches(tmp_path / "run")], tmp_path / "values.png")
