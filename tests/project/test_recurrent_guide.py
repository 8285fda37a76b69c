"""The guide to recurrent policies: its example trains, hides virtual goals as real ones, and remembers."""

from __future__ import annotations

from types import ModuleType

import pytest
import torch
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.modules import set_recurrent_mode

from .pages import script

# The episodes of a batch are of different lengths, and stay so.
pytestmark = pytest.mark.filterwarnings("ignore:SliceSampler returned a short flat batch:UserWarning")


@pytest.fixture(scope="module")
def example() -> ModuleType:
    return script("docs/examples/recurrent.py")


@pytest.fixture(scope="module")
def sampled(example: ModuleType) -> tuple[TensorDict, torch.nn.Module]:
    """Sampled episodes of a recurrent actor, and the actor."""
    torch.manual_seed(0)
    env = example.make_task(4, seed=0)
    actor, _ = example.make_networks(env, recurrent=True)
    for weight in actor.parameters():
        weight.data *= 3.0  # of a new actor nearly all actions are the same
    buffer = example.make_buffer(env)
    for batch in Collector(env, actor, frames_per_batch=4 * 10, total_frames=4 * 60):
        buffer.extend(batch)
    return buffer.sample(), actor


def test_sampled_episodes_are_whole_and_have_one_goal_each(sampled: tuple[TensorDict, object]) -> None:
    rows, _ = sampled
    first = rows["is_init"].squeeze(-1)
    assert first.sum() == 32
    assert torch.equal(first, rows["step_count"].squeeze(-1) == 0)
    for start, end in zip(*boundaries(rows), strict=True):
        episode = rows[start:end]
        assert episode["step_count"].flatten().tolist() == list(range(end - start))
        assert (episode["desired_goal"] == episode["desired_goal"][0]).all()
        assert episode["virtual"].unique().numel() == 1
        assert episode["next", "done"][-1]
        assert not episode["next", "terminated"][:-1].any()
    assert rows["virtual"].any()
    assert not rows["virtual"].all()


def boundaries(rows: TensorDict) -> tuple[list[int], list[int]]:
    starts = rows["is_init"].squeeze(-1).nonzero().flatten().tolist()
    return starts, [*starts[1:], len(rows)]


def test_goals_are_hidden_after_the_third_step_virtual_ones_too(sampled: tuple[TensorDict, object]) -> None:
    rows, _ = sampled
    for step in (rows, rows["next"]):
        shown = step["step_count"].squeeze(-1) < 3
        assert torch.equal(step["seen"][shown, :2], step["desired_goal"][shown])
        assert (step["seen"][~shown] == 0.0).all()
        assert (step["seen"][shown, 2] == 1.0).all()
    assert rows["virtual"][rows["step_count"] >= 3].any()


def test_along_an_episode_the_actor_acts_as_it_did_step_by_step(
    sampled: tuple[TensorDict, torch.nn.Module],
) -> None:
    rows, actor = sampled
    real = ~rows["virtual"].squeeze(-1)
    with set_recurrent_mode(True), torch.no_grad():
        again = actor(rows.exclude("action"))["action"]
    torch.testing.assert_close(again[real], rows["action"][real], atol=1e-5, rtol=0.0)
    assert (again[~real] - rows["action"][~real]).abs().max() > 1e-3  # another goal was wanted


def test_what_follows_a_step_is_valued_with_the_memory_of_all_steps_before(
    example: ModuleType, sampled: tuple[TensorDict, torch.nn.Module]
) -> None:
    rows, actor = sampled
    with set_recurrent_mode(True), torch.no_grad():
        here = actor(rows.exclude("action"))["action"]
        prepared = rows.clone()
        example.remember_first_steps(prepared, actor)
        following = actor(prepared["next"])["action"]
        forgotten = actor(rows["next"].clone().update({"is_init": rows["is_init"]}))["action"]
    for start, end in zip(*boundaries(rows), strict=True):
        torch.testing.assert_close(following[start : end - 1], here[start + 1 : end], atol=1e-5, rtol=0.0)
    assert (following - forgotten).abs().max() > 1e-3


@pytest.mark.parametrize("recurrent", [True, False])
def test_the_example_trains(example: ModuleType, recurrent: bool) -> None:
    rows = list(example.train(recurrent=recurrent, seed=0, frames=2_560, every=1_280))
    assert [(row["epoch"], row["frames"]) for row in rows] == [(1, 1_280), (2, 2_560)]
    assert all(0.0 <= row["success"] <= 1.0 and 1.0 <= row["steps"] <= 20.0 for row in rows)
