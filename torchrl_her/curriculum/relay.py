"""Stages in a relay: each row is seen as in the stage after the last one whose goal it achieves."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from torchrl_her.curriculum.stages import Curriculum


class Relay(nn.Module):
    """Selects a network's input from states, in the stage after the last one whose goal is achieved.

    In front of a policy that has learned all stages at once, it makes a policy whose stages act in turn: a
    gripper goes to a block until it is there, and then places it. So the goal of a stage must include all
    that the next stage requires. :class:`~torchrl_her.GuidedExploration` guides in the same way, after Luo et
    al., Relay Hindsight Experience Replay, 2022 (arXiv 2208.00843).

    Args:
        curriculum: the stages.

    Example:
        >>> from tensordict.nn import TensorDictModule, TensorDictSequential
        >>> from torchrl_her import CurriculumStage, make_actor
        >>> reach = CurriculumStage(
        ...     name="reach", observation=[0], achieved_goal=[0], desired_goal=[1], threshold=1
        ... )
        >>> move = CurriculumStage(
        ...     name="move", observation=[0, 1], achieved_goal=[1], desired_goal=[2], threshold=1
        ... )
        >>> relay = Relay(Curriculum([reach, move], 3))
        >>> relay(torch.tensor([[5.0, 8.0, 9.0], [7.5, 8.0, 9.0]])).tolist()  # [gripper, block, goal]
        [[5.0, 8.0, 0.0], [7.5, 8.0, 9.0]]
        >>> actor = make_actor([3], 1, in_keys=["input"])
        >>> in_turn = TensorDictSequential(TensorDictModule(relay, ["state"], ["input"]), actor)
    """

    _inputs: Tensor
    _goals: Tensor
    _squares: Tensor
    _after: Tensor

    def __init__(self, curriculum: Curriculum) -> None:
        super().__init__()
        self.curriculum = curriculum
        # Columns of ``Curriculum.extend(state)``: of each stage's input, and of the goals below the last,
        # whose goal ends the task and may have no threshold.
        inputs = ([*stage.observation, *stage.desired_goal] for stage in curriculum.stages)
        below = curriculum.stages[:-1]
        goals = torch.tensor([index for stage in below for index in curriculum.goal_index(stage)]).long()
        tables = {
            "_inputs": torch.tensor([curriculum.padded(each, curriculum.input_width) for each in inputs]),
            "_goals": goals.view(len(below), 2 * curriculum.goal_width),
            "_squares": torch.tensor([(stage.threshold or 0.0) ** 2 for stage in below]),
            "_after": torch.arange(1, len(curriculum)),
        }
        for name, table in tables.items():
            self.register_buffer(name, table, persistent=False)

    def achieved(self, state: Tensor) -> Tensor:
        """Returns which goals of the stages below the last are achieved, [..., stages - 1]."""
        achieved, desired = self.curriculum.extend(state)[..., self._goals].chunk(2, -1)
        return (achieved - desired).square().sum(-1) < self._squares.to(state.dtype)

    def stage(self, state: Tensor) -> Tensor:
        """Returns the stage after the last one whose goal is achieved, [...]; 0 if none is."""
        return nn.functional.pad(self.achieved(state) * self._after, (1, 0)).amax(-1)

    def inputs(self, state: Tensor, stage: Tensor) -> Tensor:
        """Returns the network's input of each state in the stage given for it, [..., input_width]."""
        return self.curriculum.extend(state).gather(-1, self._inputs[stage])

    def forward(self, *entries: Tensor) -> Tensor:
        """Maps states [..., state_width], whole or in parts to be joined, to inputs [..., input_width]."""
        state = torch.cat(entries, -1)
        return self.inputs(state, self.stage(state))
