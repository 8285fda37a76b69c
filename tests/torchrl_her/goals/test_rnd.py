"""Random network distillation of goals: errors fall for what is told often, exactly repeatable."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from torchrl_her.goals import NetworkNovelty
from torchrl_her.trainers import load_checkpoint, save_checkpoint


def uniform(n: int, g: int = 2, *, low: float = -1.0, high: float = 1.0, seed: int = 0) -> Tensor:
    return low + (high - low) * torch.rand(n, g, generator=torch.Generator().manual_seed(seed))


def taught(weights: NetworkNovelty, goals: Tensor, times: int = 40) -> NetworkNovelty:
    for _ in range(times):
        weights.update(goals)
    return weights


def test_before_the_first_goals_all_weights_are_1() -> None:
    weights = NetworkNovelty()
    weights.update(torch.full((4, 2), math.nan))
    assert weights(uniform(3)).tolist() == [1.0] * 3
    with pytest.raises(RuntimeError, match="no prediction before the first goals"):
        weights.error(uniform(3))
    assert taught(weights, uniform(50), 2)(uniform(3)).tolist() != [1.0] * 3


def test_errors_by_hand() -> None:
    """The mean squared difference of both networks, of goals in standard deviations from their mean."""
    weights = NetworkNovelty(seed=3, features=2)
    goals = torch.tensor([[0.0, 10.0], [2.0, 30.0]])  # mean (1, 20), standard deviations 1 and 10
    weights.update(goals)
    assert weights._learned is not None
    target, predictor = weights._learned.loss.target_network, weights._learned.loss.predictor_network
    normal = torch.tensor([[0.5, -1.0], [5.0, 0.0]])
    asked = torch.tensor([[1.5, 10.0], [100.0, 20.0]])  # the second one is clipped
    expected = (target(normal) - predictor(normal)).square().mean(-1).detach()
    torch.testing.assert_close(weights.error(asked), expected, rtol=1e-3, atol=1e-5)
    first, second = weights(asked).tolist()
    assert max(first, second) == 1.0
    assert first / second == pytest.approx(float(expected[0] / expected[1]), rel=1e-3)
    blunt = NetworkNovelty(seed=3, features=2, sharpness=0.5)
    blunt.update(goals)
    one, other = blunt(asked).tolist()
    assert one / other == pytest.approx(math.sqrt(first / second), rel=1e-5)


@pytest.mark.parametrize("g", [2, 3, 15])
def test_the_error_falls_for_goals_that_are_told_often(g: int) -> None:
    often, seldom = uniform(900, g, high=-0.5), uniform(100, g, low=0.0, seed=1)
    weights = NetworkNovelty(seed=1)
    weights.update(torch.cat([often, seldom]))
    before = weights.error(often).mean()
    taught(weights, torch.cat([often, seldom]), 50)
    after = weights.error(often).median()
    assert float(after) < 0.2 * float(before)
    new = uniform(100, g, high=-0.5, seed=2)  # like those told often, but others
    assert float(weights.error(seldom).median()) > 2.0 * float(weights.error(new).median())
    assert float(weights.error(seldom + 1.0).median()) > 3.0 * float(weights.error(new).median())


def test_a_seed_repeats_everything_whatever_other_random_numbers_are_drawn() -> None:
    found = []
    for other in (0, 1):
        torch.manual_seed(other)
        torch.rand(5 + other)
        state = torch.random.get_rng_state()
        found.append(taught(NetworkNovelty(seed=4), uniform(50), 3)(uniform(20, seed=1)))
        assert torch.equal(torch.random.get_rng_state(), state)
    assert torch.equal(*found)
    assert not torch.equal(found[0], taught(NetworkNovelty(seed=5), uniform(50), 3)(uniform(20, seed=1)))


def test_the_target_stays_and_the_work_of_an_update_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    sizes: list[int] = []
    forward = nn.Sequential.forward

    def counted(self: nn.Sequential, x: Tensor) -> Tensor:
        sizes.append(len(x))
        return forward(self, x)

    weights = taught(NetworkNovelty(steps=3, batch_size=10), uniform(5), 1)
    assert weights._learned is not None
    target = [own.clone() for own in weights._learned.loss.target_network.parameters()]
    monkeypatch.setattr(nn.Sequential, "forward", counted)
    for n, batches in ((10_000, [10, 10, 10]), (25, [9, 8, 8]), (7, [7]), (0, [])):
        sizes.clear()
        weights.update(uniform(n))
        assert sizes == [size for size in batches for _ in range(2)]  # both networks
    for own, was in zip(weights._learned.loss.target_network.parameters(), target, strict=True):
        assert torch.equal(own, was)
        assert own.grad is None


def test_it_learns_where_gradients_are_off() -> None:
    with torch.no_grad():
        weights = taught(NetworkNovelty(), uniform(100), 1)
        before = weights.error(uniform(100)).mean()
        assert taught(weights, uniform(100), 20).error(uniform(100)).mean() < 0.7 * before


def test_emptying_starts_again_and_takes_goals_of_any_width() -> None:
    weights, fresh = taught(NetworkNovelty(), uniform(50), 5), NetworkNovelty()
    with pytest.raises(ValueError, match="goals must have 2 numbers, as earlier ones, got 3"):
        weights.update(uniform(5, 3))
    weights.clear()
    assert weights(uniform(3)).tolist() == [1.0] * 3
    for own in (weights, fresh):
        taught(own, uniform(50, 3), 2)
    assert torch.equal(weights(uniform(9, 3)), fresh(uniform(9, 3)))


def test_it_goes_on_as_it_was_saved(tmp_path: Any) -> None:
    first, second = NetworkNovelty(seed=1), NetworkNovelty(seed=1)
    asked = uniform(30, seed=9)
    second.update(uniform(7, 3))  # is forgotten
    second.load_state_dict(first.state_dict())  # of nothing
    assert second(asked).tolist() == [1.0] * 30
    taught(first, uniform(300), 5)
    state = first.state_dict()
    save_checkpoint({"weights": state}, tmp_path / "state.pt")
    second.load_state_dict(load_checkpoint(tmp_path / "state.pt")["weights"])
    for seed in range(3):
        assert torch.equal(second(asked), first(asked))
        for weights in (first, second):
            weights.update(uniform(170, seed=seed))
    third = NetworkNovelty(seed=1)
    third.load_state_dict(state)  # a copy, that did not learn with the first
    assert not torch.equal(third(asked), first(asked))
    second.clear()
    first.clear()
    assert torch.equal(taught(first, asked, 1)(asked), taught(second, asked, 1)(asked))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"sharpness": 0.0}, "sharpness must be positive and finite, got 0.0"),
        ({"lr": math.inf}, "lr must be positive and finite, got inf"),
        ({"hidden": 0}, "hidden must be at least 1, got 0"),
        ({"features": 0}, "features must be at least 1, got 0"),
        ({"steps": 0}, "steps must be at least 1, got 0"),
        ({"batch_size": 0}, "batch_size must be at least 1, got 0"),
    ],
)
def test_bad_options_are_named(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        NetworkNovelty(**options)
