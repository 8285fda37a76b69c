"""Which achieved goals are worth asking for."""

from __future__ import annotations

from collections.abc import Sequence

import pytest
import torch
from torch import Tensor

from torchrl_her.behavior import (
    DiscoverScore,
    GoalCandidates,
    GoalFactor,
    InverseDensity,
    Successes,
    ValueCutoff,
)


def nearness(observation: Tensor, goals: Tensor, counts: Sequence[int]) -> Tensor:
    """The value of a goal is minus its distance from where one is; two critics, one sees it farther by 2."""
    observation = observation.unsqueeze(1) if observation.ndim == 2 else observation
    near = -(observation - goals).abs().sum(-1)
    return torch.stack((near, near - 2.0), -1)


def candidates(
    *lines: list[float], start: float = 0.0, target: float = 10.0, counts: Sequence[int] = ()
) -> GoalCandidates:
    goals = torch.tensor(lines).unsqueeze(-1)
    begin = torch.full((len(lines), 1), start)
    return GoalCandidates(goals, goals, begin, torch.full_like(begin, target), counts or [len(lines)])


def test_the_run_of_each_episode() -> None:
    assert candidates([1.0], [2.0], [3.0], counts=[1, 0, 2]).run.tolist() == [0, 2, 2]


def test_all_alike() -> None:
    assert GoalFactor()(candidates([1.0, 2.0])).tolist() == [[1.0, 1.0]]


def test_goals_below_the_cutoff_are_left_out() -> None:
    achievable = ValueCutoff(nearness, cutoff=-4.0)  # the critics' mean is 1 below the nearness
    assert achievable(candidates([1.0, 3.0, 3.5])).tolist() == [[True, True, False]]


def test_of_goals_out_of_reach_the_nearest_is_left() -> None:
    assert ValueCutoff(nearness, cutoff=-4.0)(candidates([9.0, 5.0, 6.0])).tolist() == [[False, True, False]]


def test_each_run_has_a_cutoff() -> None:
    achievable = ValueCutoff(nearness, runs=2, cutoff=-4.0)
    achievable.cutoff = torch.tensor([-4.0, -6.0]).double()
    line = [3.0, 5.0]
    assert achievable(candidates(line, line, counts=[1, 1])).tolist() == [[True, False], [True, True]]


def test_the_cutoff_follows_success() -> None:
    achievable = ValueCutoff(nearness, runs=3, cutoff=-3.0, floor=-3.7, step=1.0, memory=10.0)
    ended = torch.tensor([10, 10, 0])
    for _ in range(2):  # every goal, none, no episode
        achievable.record(ended, torch.tensor([10, 0, 0]))
    rate = 1 - 0.5 * torch.tensor(-2.0).exp().item()  # from 0.5, over two memories
    assert achievable.successes.rate.tolist() == pytest.approx([rate, 1 - rate, 0.5])
    assert achievable.cutoff.tolist() == pytest.approx(
        [-3.7, -3.0, -3.0]
    )  # not below the floor, nor above -3


def test_the_score_of_directed_goals() -> None:
    # alpha 1/4: a quarter of what leads there, three quarters of what leads on. The critics' spread is 1.
    score = DiscoverScore(nearness, alpha=0.25, beta=0.5)(candidates([2.0, 6.0])).log()
    near, far = [-3.0 + 0.5, -7.0 + 0.5], [-9.0 + 0.5, -5.0 + 0.5]
    first, second = (0.25 * one + 0.75 * other for one, other in zip(near, far, strict=True))
    assert score[0].tolist() == pytest.approx([first - second, 0.0])


def test_a_lower_temperature_prefers_more() -> None:
    cold, warm = (
        DiscoverScore(nearness, alpha=0.0, temperature=t)(candidates([2.0, 6.0])) for t in (0.5, 2.0)
    )
    assert cold.log()[0].tolist() == pytest.approx([-8.0, 0.0])
    assert warm.log()[0].tolist() == pytest.approx([-2.0, 0.0])


def test_alpha_falls_with_success() -> None:
    directed = DiscoverScore(nearness, runs=2, alpha=0.5, memory=10.0, target=0.5)
    directed.record(torch.tensor([10, 10]), torch.tensor([10, 0]))
    off = 0.5 * (1 - torch.tensor(-1.0).exp().item())
    assert directed.alpha.tolist() == pytest.approx([0.5 - off, 0.5 + off])
    for _ in range(20):
        directed.record(torch.tensor([10, 10]), torch.tensor([10, 0]))
    assert directed.alpha.tolist() == [0.0, 1.0]


@pytest.mark.parametrize("kind", [ValueCutoff, DiscoverScore])
def test_they_go_on_from_their_state(kind: type[ValueCutoff] | type[DiscoverScore]) -> None:
    first, second = kind(nearness, memory=5.0), kind(nearness, memory=5.0)
    first.record(torch.tensor([7]), torch.tensor([7]))
    second.load_state_dict(first.state_dict())
    for own in (first, second):
        own.record(torch.tensor([2]), torch.tensor([1]))
    assert first.state_dict() == second.state_dict()


def test_success_forgets() -> None:
    successes = Successes(1, memory=1.0, start=1.0)
    successes.record(torch.tensor([30]), torch.tensor([15]))
    assert successes.rate.item() == pytest.approx(0.5)
    successes.record(torch.tensor([0]), torch.tensor([0]))
    assert successes.rate.item() == pytest.approx(0.5)


def test_bad_options() -> None:
    with pytest.raises(ValueError, match="low=0.8, high=0.2"):
        ValueCutoff(nearness, low=0.8, high=0.2)
    with pytest.raises(ValueError, match=r"floor must be at most the cut-off -3.0, got -2.0"):
        ValueCutoff(nearness, cutoff=-3.0, floor=-2.0)
    with pytest.raises(ValueError, match=r"alpha must be in \[0, 1\], got 1.5"):
        DiscoverScore(nearness, alpha=1.5)
    with pytest.raises(ValueError, match=r"target must be in \[0, 1\], got -1"):
        DiscoverScore(nearness, target=-1)
    with pytest.raises(ValueError, match="temperature must be positive and finite, got 0"):
        DiscoverScore(nearness, temperature=0)
    with pytest.raises(ValueError, match="memory must be positive and finite, got 0"):
        Successes(1, memory=0)


@pytest.mark.parametrize("width", [1, 5])
def test_the_rarest_goal_weighs_most_in_each_run(width: int) -> None:
    crowd = torch.linspace(0.0, 1.0, 40).unsqueeze(-1).expand(-1, width)
    known = [torch.cat((crowd, crowd[:1] + 9.0)), torch.cat((crowd + 9.0, crowd[:1]))]
    goals = torch.stack((crowd[20], crowd[20] + 9.0)).expand(2, -1, -1)
    candidates_of_both = GoalCandidates(goals, goals, goals[:, 0], goals[:, 0], [1, 1], known)
    weights = InverseDensity(k=3)(candidates_of_both)
    assert weights.argmax(1).tolist() == [1, 0]
    assert weights.amax(1).tolist() == [1.0, 1.0]
    assert weights.amin() < 0.5


def test_a_coordinate_that_never_changes_makes_no_goal_rare() -> None:
    known = torch.tensor([[0.0, 5.0], [0.1, 5.0], [0.2, 5.0], [1.0, 5.0]])
    goals = known[None, :, :]
    weights = InverseDensity()(GoalCandidates(goals, goals, goals[:, 0], goals[:, 0], [1], [known]))
    assert weights.argmax().item() == 3
    alike = torch.ones(1, 3, 2)
    assert InverseDensity()(
        GoalCandidates(alike, alike, alike[:, 0], alike[:, 0], [1], [alike[0]])
    ).tolist() == [[1.0, 1.0, 1.0]]


def test_a_value_that_is_not_a_number_is_not_proposed() -> None:
    def broken(observation: Tensor, goals: Tensor, counts: Sequence[int]) -> Tensor:
        return torch.where(goals == 2.0, torch.nan, -goals)

    given = candidates([1.0, 2.0, 3.0])
    assert ValueCutoff(broken, cutoff=-9.0)(given).tolist() == [[True, False, True]]
    assert DiscoverScore(broken, alpha=1.0)(given)[0].tolist() == pytest.approx([1.0, 0.0, 0.1353], abs=1e-4)
