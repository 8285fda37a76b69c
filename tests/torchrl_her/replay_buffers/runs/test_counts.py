"""What was written is counted for each run."""

from __future__ import annotations

import torch
from tensordict import TensorDict

from torchrl_her import GoalReward, HindsightOptions
from torchrl_her.replay_buffers.episodes import Episodes
from torchrl_her.replay_buffers.runs.chunk import Chunk
from torchrl_her.replay_buffers.runs.counts import real_positives, virtual_positives
from torchrl_her.replay_buffers.runs.pieces import Piece
from torchrl_her.replay_buffers.runs.written import WrittenRows

# Transitions 0 to 3 are at 0, 1, 2, 3.
ROWS = TensorDict({"achieved_goal": torch.arange(4.0).unsqueeze(-1)}, [4])


def chunk(**options: object) -> Chunk:
    own = HindsightOptions().changed(options)
    piece = Piece([0, 1], Episodes(torch.arange(4).unsqueeze(-1), torch.ones(4, dtype=torch.int64)))
    return Chunk(ROWS, None, piece, GoalReward(0.5), own, own.transition_keys())


def written(reward: list[float], counts: list[int], goals: list[float] | None = None) -> WrittenRows:
    root = torch.arange(len(reward))
    changes = {} if goals is None else {"desired_goal": torch.tensor(goals).unsqueeze(-1)}
    return WrittenRows(root, root, dict(changes), torch.tensor(reward), counts)


def test_positive_is_what_has_the_reward_of_an_achieved_goal() -> None:
    real = written([0.0, -1.0, 1.0, -1.0, -0.5], [3, 0, 2])
    assert real_positives(chunk(), real) == {"real_positive": [2, 0, 0]}
    assert real_positives(chunk(achieved_reward=-0.5), real) == {"real_positive": [2, 0, 1]}


def test_useful_is_what_was_not_achieved_before() -> None:
    """The goals of transitions 0 and 2 are achieved where they are."""
    virtual = written([0.0, 0.0, 0.0, -1.0], [1, 3], [0.0, 2.0, 2.0, 9.0])
    positives = {"virtual_positive": [1, 2], "useful_virtual_positive": [0, 1]}
    assert virtual_positives(chunk(), virtual) == positives
    filtered = virtual_positives(chunk(filter_achieved=True), virtual)
    assert filtered == {"virtual_positive": [1, 2], "useful_virtual_positive": [1, 2]}
