"""Stages in a relay: each row is seen as in the stage after the last one whose goal it achieves."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from torchrl_her.curriculum.stages import Curriculum


class Relay(nn.Module):
    """Selects a network's input from states, in the stage after the last one whose goal is achieved.

    It has no weights: policies use it to act (:class:`RelayPolicy`), and
    :class:`~torchrl_her.GuidedExploration` to guide.

    Args:
        curriculum: the stages.

    Example:
        >>> from torchrl_her import CurriculumStage
        >>> reach = CurriculumStage(
        ...     name="reach", observation=[0], achieved_goal=[0], desired_goal=[1], threshold=1
        ... )
        >>> move = CurriculumStage(
        ...     name="move", observation=[0, 1], achieved_goal=[1], desired_goal=[2], threshold=1
        ... )
        >>> relay = Relay(Curriculum([reach, move], 3))
        >>> relay(torch.tensor([[5.0, 8.0, 9.0], [7.5, 8.0, 9.0]])).tolist()  # [gripper, block, goal]
        [[5.0, 8.0, 0.0], [7.5, 8.0, 9.0]]
    """

    _inputs: Tensor
    _goals: Tensor
    _squares: Tensor
    _after: Tensor

    def __init__(self, curriculum: Curriculum) -> None:
        super().__init__()
        self.curriculum = curriculum
        tables = {
            "_inputs": curriculum.input_columns,
            # of the goals below the last one, which ends the task and may have no threshold
            "_goals": curriculum.state_index[:-1, curriculum.observation_width :],
            "_squares": torch.tensor([(stage.threshold or 0.0) ** 2 for stage in curriculum.stages[:-1]]),
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


class RelayPolicy(TensorDictModuleBase):
    """Policy of all stages of a curriculum, which act in turn.

    In each step it acts as in the stage after the last one whose goal is achieved: a gripper goes to a block
    until it is there, then it places the block, and goes back if it has lost the block. So the goal of a
    stage must include all that the next stage requires. Exploration is guided in this way by Luo et al.,
    Relay Hindsight Experience Replay, 2022 (arXiv 2208.00843).

    Args:
        policy: a policy that has learned all stages. Its only input is the network's input.
        curriculum: the stages.

    Keyword Args:
        in_keys: key of the state vector, or keys of parts that make it if they are joined.
        action_key: key of the action, which is written.

    Example:
        >>> from torchrl_her import CurriculumStage, make_actor
        >>> stages = [
        ...     CurriculumStage(name=n, observation=[0, 1], achieved_goal=[i], desired_goal=[2], threshold=1)
        ...     for i, n in enumerate(("near", "far"))
        ... ]
        >>> policy = RelayPolicy(make_actor([3], 1, in_keys=["input"]), Curriculum(stages, 3))
        >>> policy(TensorDict({"state": torch.zeros(5, 3)}, [5]))["action"].shape
        torch.Size([5, 1])
    """

    def __init__(
        self,
        policy: TensorDictModuleBase,
        curriculum: Curriculum,
        *,
        in_keys: Sequence[NestedKey] = ("state",),
        action_key: NestedKey = "action",
    ) -> None:
        super().__init__()
        self.in_keys, self.out_keys = list(in_keys), [action_key]
        self.module, self.relay = policy, Relay(curriculum)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the action."""
        inputs = self.relay(*(tensordict.get(key) for key in self.in_keys))
        rows = TensorDict({self.module.in_keys[0]: inputs}, tensordict.batch_size)
        (action_key,) = self.out_keys
        return tensordict.set(action_key, self.module(rows).get(action_key))
