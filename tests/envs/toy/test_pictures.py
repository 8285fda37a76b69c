"""Pictures of the toy environments: what is where, by its color."""

from __future__ import annotations

import pytest
import torch

from torchrl_her_envs import make_env
from torchrl_her_envs.common.rendering.colors import FAILURE, INK, MARGIN, SUCCESS


def color(picture: torch.Tensor, x: float, y: float) -> tuple[int, ...]:
    """At a place, in parts of the width and of the height."""
    height, width, _ = picture.shape
    return tuple(picture[int(y * height), int(x * width)].tolist())


def test_bits_are_dark_where_they_are_set_and_their_edges_say_whether_they_are_right() -> None:
    env = make_env("bit_flip", bits=2, num_envs=2)
    env.reset()
    env.worlds.place[1], env.worlds.goal[1] = torch.tensor([1, 0]), torch.tensor([1, 1])
    picture = env.render(1, size=300)
    assert picture.shape == (180, 300, 3)
    # Two squares of a fifth of the width, side by side in the middle.
    assert color(picture, 0.4, 0.5) == INK
    assert color(picture, 0.6, 0.5) == (252, 251, 248)
    assert color(picture, 0.32, 0.5) == SUCCESS
    assert color(picture, 0.68, 0.5) == FAILURE
    assert color(picture, 0.1, 0.5) == MARGIN


def test_the_pirate_and_the_treasure_are_where_they_are() -> None:
    env = make_env("treasure_hunt", step=10, num_envs=1)
    env.reset()
    env.worlds.place[0, 0], env.worlds.goal[0, 0] = 0, 10
    picture = env.render(0, size=400)
    hat, gold = (
        (picture == torch.tensor(own, dtype=torch.uint8)).all(-1).nonzero()[:, 1].float().mean() / 400
        for own in ((58, 56, 62), (240, 190, 60))
    )
    assert hat == pytest.approx(0.08, abs=0.01)
    assert gold == pytest.approx(0.92, abs=0.01)


def test_the_links_of_a_chain_are_filled_when_they_are_closed() -> None:
    env = make_env("chain", length=3, num_envs=1)
    env.reset()
    env.worlds.place[0] = torch.tensor([1, 1, 0])
    picture = env.render(0, size=300)
    middles = [(0.3, 0.5), (0.5, 0.5), (0.7, 0.5)]
    assert [color(picture, *place) for place in middles] == [INK, INK, (252, 251, 248)]
    long = make_env("chain", length=1_000, num_envs=1)
    long.reset()
    long.worlds.place[0, :500] = 1
    bar = long.render(0, size=300)
    assert color(bar, 0.45, 0.5) == INK
    assert color(bar, 0.55, 0.5) == (252, 251, 248)


def test_wrong_sizes_and_captions() -> None:
    env = make_env("chain", num_envs=1)
    env.reset()
    with pytest.raises(ValueError, match="a size of at least 1 pixel, got 0"):
        env.render(0, size=0)
    assert not env.render(0, size=80, caption="epoch 3").equal(env.render(0, size=80))
    assert env.render().shape == (1, 180, 300, 3)
