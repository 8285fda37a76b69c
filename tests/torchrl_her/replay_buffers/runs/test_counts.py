"""What was written is counted for each run."""

from __future__ import annotations

import torch
from tensordict import TensorDict

from torchrl_her import GoalReward, HindsightOptions
from torchrl_her.replay_buffers.episodes import Episodes
from torchrl_her.replay_buffers.runs.counts import WriterCounts, count_rows
from torchrl_her.replay_buffers.runs.pieces import Chunk, Piece
from torchrl_her.replay_buffers.runs.written import WrittenRows

# Transitions 0 to 3 are at 0, 1, 2, 3.
ROWS = TensorDict({"achieved_goal": torch.arange(4.0).unsqueeze(-1)}, [4])


def chunk(*, least: float = 0.0, **options: object) -> Chunk:
    own = HindsightOptions().changed(options)
    piece = Piece([0, 1], Episodes(torch.arange(4).unsqueeze(-1), torch.ones(4, dtype=torch.int64)))
    return Chunk(ROWS, None, piece, GoalReward(0.5, achieved_reward=least), own, own.transition_keys())


def written(reward: list[float], counts: list[int], goals: list[float] | None = None) -> WrittenRows:
    root = torch.arange(len(reward))
    changes = {} if goals is None else {"desired_goal": torch.tensor(goals).unsqueeze(-1)}
    return WrittenRows(root, root, dict(changes), torch.tensor(reward), counts)


def test_positive_is_what_has_the_reward_of_an_achieved_goal() -> None:
    real = written([0.0, -1.0, 1.0, -1.0, -0.5], [3, 2])
    for least, positive in ((0.0, [2, 0]), (-0.5, [2, 1])):
        counted = count_rows(chunk(least=least), real, None, [2, 1])
        assert [counts.real_positive for counts in counted] == positive
        assert [(counts.real, counts.relabeled) for counts in counted] == [(3, 2), (2, 1)]
        assert WriterCounts.sum(counted).virtual == 0


def test_useful_is_what_was_not_achieved_before() -> None:
    """The goals of transitions 0 and 2 are achieved where they are."""
    real = written([-1.0] * 4, [1, 3])
    virtual = written([0.0, 0.0, 0.0, -1.0], [1, 3], [0.0, 2.0, 2.0, 9.0])
    for filtered, useful in ((False, [0, 1]), (True, [1, 2])):
        counted = count_rows(chunk(filter_achieved=filtered), real, virtual, [1, 3])
        assert [counts.virtual for counts in counted] == [1, 3]
        assert [counts.virtual_positive for counts in counted] == [1, 2]
        assert [counts.useful_virtual_positive for counts in counted] == useful
