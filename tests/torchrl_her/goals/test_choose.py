"""Choosing goals from lines: only goals that may be drawn, as often as the product of the factors says."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from torchrl_her.goals import choose
from torchrl_her.goals.choose import Candidates, Index, choose_goals
from torchrl_her.randomness import RunDraws

# Two lines of four goals, the second one padded: goals 0 to 3, and 4 to 6.
GOALS = torch.arange(7.0).unsqueeze(-1)
TABLE = torch.tensor([[0, 1, 2, 3], [4, 5, 6, 6]])


def seeded(seed: int = 0) -> RunDraws:
    return RunDraws([torch.Generator().manual_seed(seed)])


def shares(position: Tensor) -> dict[int, float]:
    """How often each goal was drawn by one transition."""
    values, counts = position.unique(return_counts=True)
    return dict(zip(values.tolist(), (counts / position.numel()).tolist(), strict=True))


@pytest.mark.parametrize("tries", [0, 1, 8])
@pytest.mark.parametrize("weighted", [False, True])
def test_frequencies_are_the_product_of_the_factors(tries: int, weighted: bool) -> None:
    """One transition may take all of the first line, the others the end of the second. 2, 5 are refused."""
    k = 6_000
    candidates = Candidates(
        GOALS, TABLE, torch.tensor([0, 1, 1]), torch.tensor([0, 1, 1]), torch.tensor([4, 3, 3])
    )

    def keep(which: Index, goals: Tensor) -> Tensor:
        return ~torch.isin(goals.squeeze(-1), torch.tensor([2.0, 5.0]))

    def weights(goals: Tensor) -> Tensor:
        assert goals.shape == (2, 4, 1)
        return goals.squeeze(-1)  # that of goal 0 is 0

    position, valid = choose_goals(
        candidates, k, weights=weights if weighted else None, keep=keep, draws=seeded(), tries=tries
    )
    assert valid.all()
    expected = {1: 0.25, 3: 0.75} if weighted else {0: 1 / 3, 1: 1 / 3, 3: 1 / 3}
    assert shares(position[0]) == pytest.approx(expected, abs=0.03)  # about five deviations
    assert shares(position[1]) == shares(position[2]) == {6: 1.0}


@pytest.mark.parametrize("tries", [0, 3])
def test_draws_that_were_accepted_stay_independent_of_those_that_were_not(tries: int) -> None:
    """Pairs of draws are as often as the product of their shares: no draw knows of the other."""
    n = 30_000
    line = torch.zeros(n, dtype=torch.int64)
    candidates = Candidates(GOALS, TABLE, line, line, line + 4)

    def keep(which: Index, goals: Tensor) -> Tensor:
        return goals.squeeze(-1) != 1.0

    position, _ = choose_goals(candidates, 2, weights=None, keep=keep, draws=seeded(), tries=tries)
    for one in (0, 2, 3):
        for other in (0, 2, 3):
            share = ((position[:, 0] == one) & (position[:, 1] == other)).float().mean().item()
            assert share == pytest.approx(1 / 9, abs=0.01)  # five deviations


@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_only_goals_that_may_be_drawn_are_drawn(data: st.DataObject) -> None:
    lengths = data.draw(st.lists(st.integers(1, 7), min_size=1, max_size=4))
    width, begin = max(lengths), torch.tensor([0, *lengths]).cumsum(0)[:-1]
    step = torch.arange(width).minimum(torch.tensor(lengths).unsqueeze(-1) - 1)
    numbers = sum(lengths)
    weight = torch.tensor(
        data.draw(st.lists(st.sampled_from([0.0, 1e-6, 1.0]), min_size=numbers, max_size=numbers))
    )
    line, first, end = [], [], []
    for number, length in enumerate(lengths):
        for _ in range(data.draw(st.integers(0, 5))):
            low = data.draw(st.integers(0, length - 1))
            line.append(number)
            first.append(low)
            end.append(data.draw(st.integers(low + 1, length)))
    if not line:
        return
    candidates = Candidates(
        torch.arange(float(numbers)).unsqueeze(-1),
        begin.unsqueeze(-1) + step,
        *(torch.tensor(own) for own in (line, first, end)),
    )
    modulus = data.draw(st.integers(1, 4))

    def keep(which: Index, goals: Tensor) -> Tensor:
        own = torch.arange(len(line))[which]
        return (goals.squeeze(-1).long() + own.unsqueeze(-1)) % modulus == 0

    weighted, filtered = data.draw(st.booleans()), data.draw(st.booleans())
    position, valid = choose_goals(
        candidates,
        3,
        weights=(lambda goals: weight[goals.squeeze(-1).long()]) if weighted else None,
        keep=keep if filtered else None,
        draws=seeded(data.draw(st.integers(0, 99))),
        tries=data.draw(st.integers(0, 2)),
    )
    for i, own in enumerate(position.tolist()):
        allowed = [
            goal
            for goal in range(int(begin[line[i]]) + first[i], int(begin[line[i]]) + end[i])
            if (not weighted or weight[goal] > 0) and (not filtered or (goal + i) % modulus == 0)
        ]
        assert valid[i].tolist() == [bool(allowed)] * 3
        assert not allowed or set(own) <= set(allowed)


def test_many_refused_transitions_are_looked_at_part_by_part(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(choose, "LIKELIHOODS", 12)  # three transitions
    line = torch.zeros(10, dtype=torch.int64)
    asked: list[int] = []

    def keep(which: Index, goals: Tensor) -> Tensor:
        asked.append(len(goals))
        return goals.squeeze(-1) == 3.0

    candidates = Candidates(GOALS, TABLE, line, line, line + torch.tensor([4] * 9 + [2]))
    position, valid = choose_goals(candidates, 5, weights=None, keep=keep, draws=seeded())
    assert position[:9].unique().tolist() == [3]
    assert valid.tolist() == [[True] * 5] * 9 + [[False] * 5]
    assert asked == [10, 3, 3, 3, 1]


class Given:
    """Random numbers that are given, one row for each transition."""

    def __init__(self, *rows: list[float]) -> None:
        self.rows = torch.tensor(rows)

    def of(self, some: Tensor) -> Given:
        raise AssertionError("nothing is drawn again")

    def __call__(self, shape: tuple[int, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
        assert shape == tuple(self.rows.shape)
        return self.rows.to(dtype)


@pytest.mark.parametrize(
    ("weights", "expected", "taken"),
    [
        # a quarter for each goal, then for each of the last two
        (None, [[0, 2, 3, 1], [2, 3, 3, 2]], [[1, 0, 1, 1], [0, 1, 1, 0]]),
        # weights of 0, 1, 1 and 4 add up to 1/6, 1/3 and 1; those of the last two to 1/5 and 1
        ([0.0, 1.0, 1.0, 4.0], [[1, 3, 3, 2], [2, 3, 3, 3]], [[1, 1, 1, 0], [0, 1, 1, 1]]),
        ([0.0, 0.0, 1.0, 0.0], [[2, 2, 2, 2], [2, 2, 2, 2]], [[0, 0, 0, 0], [0, 0, 0, 0]]),
    ],
)
def test_a_refused_goal_is_left_out_and_no_other_is_drawn(
    weights: list[float] | None, expected: list[list[int]], taken: list[list[int]]
) -> None:
    """The filter refuses goal 2, whoever takes it. Two transitions draw four goals each, by given numbers."""
    line = torch.tensor([0, 0])
    candidates = Candidates(GOALS[:4], TABLE[:1], line, torch.tensor([0, 2]), torch.tensor([4, 4]))
    position, valid = choose_goals(
        candidates,
        4,
        weights=None if weights is None else lambda goals: torch.tensor([weights]),
        keep=lambda which, goals: goals.squeeze(-1) != 2.0,
        draws=Given([0.1, 0.6, 0.9, 0.3], [0.1, 0.6, 0.9, 0.3]),
        redraw=False,
    )
    assert position.tolist() == expected
    assert valid.int().tolist() == taken


def test_goals_without_weight_are_left_out_without_a_filter() -> None:
    line = torch.tensor([0, 0])
    candidates = Candidates(GOALS[:4], TABLE[:1], line, torch.tensor([0, 3]), torch.tensor([3, 4]))
    _, valid = choose_goals(
        candidates,
        2,
        weights=lambda goals: torch.tensor([[0.0, 0.0, 0.0, 1.0]]),
        keep=None,
        draws=Given([0.1, 0.6], [0.1, 0.6]),
        redraw=False,
    )
    assert valid.tolist() == [[False, False], [True, True]]


def test_what_a_run_draws_does_not_depend_on_other_runs_or_their_refusals() -> None:
    def choose_for(lines: list[int], refuse: float) -> Tensor:
        counts = [3, 4]
        line = torch.tensor([own for own in lines for _ in range(counts[own])])
        own = torch.arange(len(lines)).repeat_interleave(torch.tensor([counts[each] for each in lines]))
        generators = [torch.Generator().manual_seed(each) for each in lines]
        table = TABLE[lines]
        end = torch.tensor([4, 3])[line]
        candidates = Candidates(GOALS, table, own, torch.zeros_like(own), end)
        position, _ = choose_goals(
            candidates,
            2,
            weights=lambda goals: goals.squeeze(-1) + 1.0,
            keep=lambda which, goals: (goals.squeeze(-1) != refuse) & (goals.squeeze(-1) != 5.0),
            draws=RunDraws(generators, own),
            tries=3,
        )
        return position[line == 1]

    alone = choose_for([1], 3.0)
    assert torch.equal(choose_for([0, 1], 3.0), alone)
    assert torch.equal(choose_for([0, 1], -1.0), alone)  # the first run is refused nothing
