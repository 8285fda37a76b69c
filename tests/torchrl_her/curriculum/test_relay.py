"""Stages in a relay: in which stage each row is seen, and what of it."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor

from torchrl_her import Curriculum, CurriculumStage
from torchrl_her.curriculum import Relay, RelayPolicy

# The state is [gripper, block, higher block, wanted place, wanted place of the higher block].
STAGES = [
    CurriculumStage(name="reach", observation=[0], achieved_goal=[0], desired_goal=[1], threshold=0.5),
    CurriculumStage(name="rise", observation=[0], achieved_goal=[0], constant_goal=[9.0], threshold=2),
    CurriculumStage(
        name="stack", observation=[0, 1, 2], achieved_goal=[1, 2], desired_goal=[3, 4], threshold=0.5
    ),
]
CURRICULUM = Curriculum(STAGES, 5)
FAR, NEAR, HIGH, LOST = ([gripper, 4.0, 6.0, 1.0, 2.0] for gripper in (3.5, 4.25, 10.5, 7.0))


@pytest.mark.parametrize(
    ("state", "stage", "inputs"),
    [
        (FAR, 0, [3.5, 4, 0, 0, 0]),  # at a distance of the threshold the goal is not achieved
        (NEAR, 1, [4.25, 9, 0, 0, 0]),
        (HIGH, 2, [10.5, 4, 6, 1, 2]),  # the last achieved goal counts, though the first is not achieved
        (LOST, 0, [7, 4, 0, 0, 0]),
    ],
)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_each_row_is_seen_in_the_stage_after_the_last_achieved(
    state: list[float], stage: int, inputs: list[float], dtype: torch.dtype
) -> None:
    relay, row = Relay(CURRICULUM), torch.tensor(state, dtype=dtype)
    assert relay.stage(row).item() == stage
    assert relay(row).tolist() == inputs
    assert relay(row).dtype is dtype


def test_batches_may_have_any_shape_and_states_come_in_parts() -> None:
    relay, rows = Relay(CURRICULUM), torch.tensor([FAR, NEAR, HIGH, LOST])
    expected = torch.stack([relay(row) for row in rows])
    assert torch.equal(relay(rows), expected)
    blocks: Tensor = rows.view(2, 1, 2, 5)
    assert torch.equal(relay(blocks[..., :3], blocks[..., 3:]), expected.view(2, 1, 2, 5))


def test_its_input_replaces_none_of_the_environment() -> None:
    actor = TensorDictModule(lambda seen: seen.sum(-1, keepdim=True), ["input"], ["action"])
    rows = TensorDict({"state": torch.tensor([FAR]), "input": torch.ones(1, 5)}, [1])
    assert RelayPolicy(actor, CURRICULUM)(rows)["action"].tolist() == [[7.5]]
    assert torch.equal(rows["input"], torch.ones(1, 5))  # which the critics value


def test_it_has_no_weights_that_a_checkpoint_would_need() -> None:
    assert not Relay(CURRICULUM).state_dict()
