"""Trees of sums: what is drawn is what a plain running sum would draw."""

from __future__ import annotations

from itertools import pairwise

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from torch import Tensor

from torchrl_her.native.trees import load_trees
from torchrl_her.replay_buffers.runs import trees as trees_module
from torchrl_her.replay_buffers.runs.trees import SumTrees


@pytest.fixture(autouse=True, params=[True, False], ids=["compiled", "tensors"])
def both(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every test is run with the compiled functions, if there is a compiler, and without them."""
    if request.param and load_trees() is None:
        pytest.skip("there is no C++ compiler")
    if not request.param:
        monkeypatch.setattr(trees_module, "load_trees", lambda: None)


def filled(values: Tensor, *, native: bool = True) -> SumTrees:
    """Trees with leaves [R, capacity]."""
    trees = SumTrees(values.shape[1], runs=len(values), native=native)
    run = torch.arange(len(values)).repeat_interleave(values.shape[1])
    trees.set(run, torch.arange(values.shape[1]).repeat(len(values)), values.flatten(), sorted=True)
    return trees


def leaves(trees: SumTrees) -> Tensor:
    return torch.stack([trees.get(run, trees.capacity) for run in range(trees.runs)])


def check_sums(trees: SumTrees) -> None:
    """Every node is the sum of its children."""
    for below, level in pairwise(trees._levels):
        torch.testing.assert_close(below.view(trees.runs, -1, 16).sum(-1), level)


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_draws_follow_the_running_sum_of_the_leaves(data: st.DataObject) -> None:
    """At a u that is not near an edge, the leaf is that of a search in the running sum of the leaves."""
    runs, capacity = data.draw(st.integers(1, 4)), data.draw(st.integers(1, 1_500))
    seed = data.draw(st.integers(0, 2**32 - 1))
    generator = torch.Generator().manual_seed(seed)
    values = torch.rand(runs, capacity, generator=generator) ** data.draw(st.integers(0, 6))
    values *= torch.rand(runs, capacity, generator=generator) < data.draw(st.sampled_from([0.05, 0.5, 1.0]))
    values[:, data.draw(st.integers(0, capacity - 1))] = 1.0  # no run is without
    trees = filled(values)
    u = torch.rand(runs, 64, dtype=torch.float64, generator=generator)
    leaf, value = trees.draw(u)
    assert torch.equal(value, values.gather(1, leaf))
    assert (value > 0).all()
    sums = values.double().cumsum(-1)
    mass, slack = u * sums[:, -1:], 1e-5 * sums[:, -1:]
    assert (sums.gather(1, leaf) >= mass - slack).all()
    assert (sums.gather(1, leaf) - value <= mass + slack).all()


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_sums_are_those_of_the_leaves_after_any_updates(data: st.DataObject) -> None:
    runs, capacity = data.draw(st.integers(1, 3)), data.draw(st.integers(1, 1_200))
    trees, expected = SumTrees(capacity, runs=runs), torch.zeros(runs, capacity)
    generator = torch.Generator().manual_seed(data.draw(st.integers(0, 2**32 - 1)))
    for _ in range(data.draw(st.integers(1, 5))):
        n = data.draw(st.integers(1, 500))
        run = torch.randint(runs, (n,), generator=generator)
        leaf, value = torch.randint(capacity, (n,), generator=generator), torch.rand(n, generator=generator)
        trees.set(run, leaf, value)
        for i in range(n):  # of those that are named twice the last
            expected[run[i], leaf[i]] = value[i]
    assert torch.equal(leaves(trees), expected)
    check_sums(trees)
    torch.testing.assert_close(trees.totals, expected.double().sum(-1))


@pytest.mark.parametrize("capacity", [1, 16, 17, 32, 33, 512, 513, 10_000])
def test_the_first_and_the_last_leaf_are_drawn_at_the_edges(capacity: int) -> None:
    trees = filled(torch.ones(2, capacity))
    leaf, _ = trees.draw(torch.tensor([[0.0, 1.0 - 2.0**-53]] * 2, dtype=torch.float64))
    assert leaf.tolist() == [[0, capacity - 1]] * 2


def test_shares_of_a_million_equal_leaves_are_equal() -> None:
    """In single precision throughout, the far end would get shares that are wrong by several percent."""
    trees = filled(torch.full((1, 1_000_000), 0.1))
    u = (torch.arange(999_000, 1_000_000, dtype=torch.float64) + 0.5) / 1e6
    leaf, _ = trees.draw(u.unsqueeze(0))
    assert (leaf - torch.arange(999_000, 1_000_000)).abs().max() <= 1
    assert leaf.unique().numel() > 990


def test_leaves_of_zero_are_never_drawn_whatever_the_rounding() -> None:
    values = torch.zeros(1, 5_000)
    values[0, ::37] = torch.rand(values[0, ::37].shape, generator=torch.Generator().manual_seed(0)) ** 20
    leaf, value = filled(values).draw(torch.linspace(0, 1 - 1e-12, 100_001, dtype=torch.float64).unsqueeze(0))
    assert (value > 0).all()
    assert (leaf % 37 == 0).all()


def test_clearing_a_run_leaves_the_others() -> None:
    values = torch.rand(3, 100, generator=torch.Generator().manual_seed(0))
    trees = filled(values)
    trees.clear(1)
    assert torch.equal(leaves(trees), values * torch.tensor([[1.0], [0.0], [1.0]]))
    check_sums(trees)
    assert trees.totals[1] == 0


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_tensors_and_compiled_functions_give_the_same_numbers(data: st.DataObject) -> None:
    runs, capacity = data.draw(st.integers(1, 3)), data.draw(st.integers(1, 40_000))
    generator = torch.Generator().manual_seed(data.draw(st.integers(0, 2**32 - 1)))
    values = torch.rand(runs, capacity, generator=generator) ** data.draw(st.integers(0, 8))
    one, other = filled(values), filled(values, native=False)
    n = data.draw(st.integers(1, 3_000))
    run, leaf = (
        torch.randint(runs, (n,), generator=generator),
        torch.randint(capacity, (n,), generator=generator),
    )
    update = torch.rand(n, generator=generator)
    one.set(run, leaf, update)
    other.set(run, leaf, update)
    assert all(map(torch.equal, one._levels, other._levels))
    u = torch.rand(runs, data.draw(st.integers(1, 200)), dtype=torch.float64, generator=generator)
    assert all(map(torch.equal, one.draw(u), other.draw(u)))


@pytest.mark.parametrize("capacity", [1, 20, 50, 513])
def test_a_run_of_zeros_gives_a_leaf_that_there_is(capacity: int) -> None:
    values = torch.stack([torch.zeros(capacity), torch.ones(capacity)])
    leaf, value = filled(values).draw(torch.tensor([[0.0, 0.5], [0.0, 0.5]], dtype=torch.float64))
    assert (leaf[0] == capacity - 1).all()
    assert value.tolist() == [[0.0, 0.0], [1.0, 1.0]]
