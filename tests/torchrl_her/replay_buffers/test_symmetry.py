"""Augmentation of sampled transitions by mirror images and shifts."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from tensordict import TensorDict

from torchrl_her.replay_buffers import AugmentBatch, Shift, Symmetry

MIRROR = Symmetry(mirror={0: 0.5, 2: 0.5}, mirror_action=[1])
PLACES = {"observation": [0, 1], "desired_goal": [2]}


def rows(n: int, dtype: torch.dtype = torch.float32) -> TensorDict:
    def seen(at: float) -> dict[str, torch.Tensor]:
        return {"observation": torch.tensor([[at, 7.0]] * n), "desired_goal": torch.full((n, 1), 2.0)}

    entries: dict[str, Any] = {**seen(1.0), "action": torch.tensor([[3.0, 4.0]] * n), "next": seen(4.0)}
    return TensorDict(entries, [n]).apply(lambda entry: entry.to(dtype))


def generators(*seeds: int) -> list[torch.Generator]:
    return [torch.Generator().manual_seed(seed) for seed in seeds]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_half_of_the_rows_are_mirror_images(dtype: torch.dtype) -> None:
    out = AugmentBatch(MIRROR, PLACES, 3, actions=2, generators=generators(0))(rows(1000, dtype))
    mirrored = out["action"][:, 1] == -4
    assert 400 < int(mirrored.sum()) < 600
    images = [
        (("observation",), [1.0, 7.0], [0.0, 7.0]),
        (("desired_goal",), [2.0], [-1.0]),
        (("action",), [3.0, 4.0], [3.0, -4.0]),
        (("next", "observation"), [4.0, 7.0], [-3.0, 7.0]),
        (("next", "desired_goal"), [2.0], [-1.0]),
    ]
    for key, same, image in images:
        assert out[key].dtype == dtype
        assert (out[key][~mirrored] == out[key].new_tensor(same)).all()
        assert (out[key][mirrored] == out[key].new_tensor(image)).all()


def test_positions_of_a_group_are_shifted_together_before_and_after_the_action() -> None:
    move = Symmetry(shifts=[Shift([0, 2], 0.1), Shift([1], 1.0)])
    out = AugmentBatch(move, PLACES, 3, actions=2, generators=generators(0))(rows(1000))
    x, y = (out["observation"] - torch.tensor([1.0, 7.0])).unbind(-1)
    assert -0.1 <= float(x.min()) < -0.09
    assert 0.09 < float(x.max()) <= 0.1
    assert float(y.abs().max()) > 0.9
    torch.testing.assert_close(out["next", "observation"], torch.stack((4 + x, 7 + y), -1))
    for key in ("desired_goal", ("next", "desired_goal")):
        torch.testing.assert_close(out[key].squeeze(-1), 2 + x)
    assert (out["action"] == torch.tensor([3.0, 4.0])).all()


def test_each_row_has_the_places_of_its_stage() -> None:
    """The second stage has the goal in place of the other column; columns from 3 on are padding."""
    places = {"observation": torch.tensor([[0, 3], [2, 1]])}
    stage = torch.tensor([0, 1] * 500)
    augment = AugmentBatch(MIRROR, places, 3, actions=2, stage=lambda _: stage, generators=generators(0))
    out = augment(rows(1000))
    mirrored = out["action"][:, 1] == -4
    assert (out["observation"][mirrored] == torch.tensor([0.0, 7.0])).all()  # both stages mirror place 0
    padded = AugmentBatch(
        Symmetry(mirror={1: 0.0}), places, 3, actions=2, stage=lambda _: stage, generators=generators(0)
    )(rows(1000))["observation"]
    assert (padded[stage == 0] == torch.tensor([1.0, 7.0])).all()
    assert sorted(padded[stage == 1][:, 1].unique().tolist()) == [-7.0, 7.0]


def test_a_run_draws_the_same_beside_others() -> None:
    alone = AugmentBatch(MIRROR, PLACES, 3, actions=2, generators=generators(5))(rows(20))
    both = AugmentBatch(MIRROR, PLACES, 3, actions=2, generators=generators(4, 5))(rows(40))
    assert (both[20:] == alone).all()
    assert not (both[:20] == alone).all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "needs columns that are mirrored or shifted, got none"),
        ({"mirror": [0, 1]}, r"mirror of a symmetry must be a value for each column, got \[0, 1\]"),
        ({"mirror": {-1: 0.0}}, "columns of a symmetry must be whole numbers from 0 on, got -1"),
        ({"mirror": {0: float("nan")}}, "mirrored at finite values, got nan"),
        ({"shifts": [Shift([0], 0.0)]}, "most of a shift must be positive and finite, got 0.0"),
        ({"mirror": {3: 0.0}}, "the state has the columns 0 to 2, but the symmetry has 3"),
        ({"mirror": {0: 0.0}, "mirror_action": [2]}, "the action has the columns 0 to 1, .* has 2"),
    ],
)
def test_symmetries_that_cannot_be(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        AugmentBatch(Symmetry(**options), PLACES, 3, actions=2)
