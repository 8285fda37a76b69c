"""Open episodes are truncated at the end of a batch, and no others."""

from __future__ import annotations

import torch
from tensordict import TensorDict

from torchrl_her.trainers import cut_episodes


def make_batch(*shape: int) -> TensorDict:
    off = torch.zeros(*shape, 1, dtype=torch.bool)
    flags = {"truncated": off.clone(), "terminated": off.clone(), "done": off.clone()}
    return TensorDict({"next": {**flags, "agent": {"done": off.clone()}}}, shape)


def test_the_last_step_of_each_environment_is_truncated() -> None:
    batch = make_batch(2, 3)
    out = cut_episodes(batch)["next"]
    for flags in (out["truncated"], out["done"], out["agent", "done"]):
        assert flags.squeeze(-1).tolist() == [[False, False, True]] * 2
    assert not out["terminated"].any()
    assert not batch["next", "done"].any()  # the collector's own batch stays as it is


def test_the_last_step_of_each_trajectory_of_a_flat_batch_is_truncated() -> None:
    batch = make_batch(6)
    batch["collector", "traj_ids"] = torch.tensor([7, 7, 2, 7, 2, 9])
    expected = [False, False, False, True, True, True]
    assert cut_episodes(batch)["next", "truncated"].flatten().tolist() == expected


def test_ends_that_are_there_stay() -> None:
    batch = make_batch(1, 3)
    batch["next", "done"][0, 1] = True
    assert cut_episodes(batch)["next", "done"].flatten().tolist() == [False, True, True]
    batch["next", "terminated"][0, 2] = True  # what ended by itself was not cut
    batch["next", "done"][0, 2] = True
    assert not cut_episodes(batch)["next", "truncated"].any()


def test_flat_transitions_without_ids_are_one_environment_s() -> None:
    flags = {"truncated": torch.zeros(3, 1).bool(), "done": torch.zeros(3, 1).bool()}
    batch = TensorDict({"next": flags}, [3])
    assert cut_episodes(batch)["next", "truncated"].flatten().tolist() == [False, False, True]
    assert cut_episodes(batch[:0]).shape == (0,)
