"""The chain environment (thesis, appendix C)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from torchrl_her_envs.toy.base import MOST_STEPS, ToyEnv, check_flag, check_whole
from torchrl_her_envs.toy.goals import LatticeGoals
from torchrl_her_envs.toy.pictures import Sheet, draw_chain


class Chain(ToyEnv):
    """A walk along a chain of n steps, from its first place to its last.

    Thesis, appendix C. The agent starts at the first place, its goal is always the last one, and an
    episode has n steps, which suffice without a mistake (premise 4). Action 1 goes forward with
    probability p (premise 1). If action 1 fails, and always with action 0, the agent goes back: by one place,
    or to the first place in the reset-state form. At the first place it stays.

    Always taking action 1 therefore reaches the goal in one of ``p ** -n`` episodes. With p = 1 an
    untrained policy that goes forward with probability q reaches it in one of ``q ** -n``; with hindsight,
    the policy learns place by place instead.

    The agent sees n links. At place k the first k are closed (1) and the others open (-1); the goal is
    that all are closed. With ``stages`` above 1 the chain consists of equal parts, and only the links of
    the last part are the achieved goal, just as only the ball is in the throwing tasks. Until the agent
    comes to that part, hindsight teaches nothing.

    Args:
        length: n, the number of steps from the start to the goal.
        forward_probability: p, in (0, 1].

    Keyword Args:
        stages: number of equal parts, each of ``n / stages`` steps.
        alternating: whether action 0 goes forward at odd places. Then a policy that always takes the
            same action, as an untrained network does, leads nowhere; otherwise it may solve the chain.
        reset_state: whether going back leads to the first place (the thesis's "reset-state game").
        max_steps: steps of an episode; n if None.
        num_envs: number of environments.
        seed: seed of all transitions; R seeds for R equal blocks of environments, each as if alone.

    Raises:
        ValueError: an option is out of its range, or environments cannot be shared out among the seeds.

    Example:
        >>> from tensordict.nn import TensorDictModule
        >>> ones = torch.ones(2, dtype=torch.int64)
        >>> forward = TensorDictModule(lambda place: ones, ["observation"], ["action"])
        >>> steps = Chain(3, 1.0, num_envs=2).rollout(3, forward)
        >>> steps["next", "observation"][0].tolist()
        [[1.0, -1.0, -1.0], [1.0, 1.0, -1.0], [1.0, 1.0, 1.0]]
        >>> steps["next", "reward"][0].flatten().tolist()
        [-1.0, -1.0, 0.0]
        >>> steps = Chain(4, 1.0, stages=2, num_envs=2).rollout(4, forward)
        >>> steps["next", "achieved_goal"][0].tolist()
        [[-1.0, -1.0], [-1.0, -1.0], [1.0, -1.0], [1.0, 1.0]]
    """

    name = "chain"

    def __init__(
        self,
        length: int,
        forward_probability: float,
        *,
        stages: int = 1,
        alternating: bool = False,
        reset_state: bool = False,
        max_steps: int | None = None,
        num_envs: int = 1,
        seed: int | Sequence[int] = 0,
    ) -> None:
        length = check_whole("length", length, 1, MOST_STEPS)
        stages = check_whole("stages", stages, 1, length)
        if length % stages:
            raise ValueError(f"stages must divide length={length}, got {stages}")
        if not isinstance(forward_probability, int | float) or not 0.0 < forward_probability <= 1.0:
            raise ValueError(f"forward_probability must be in (0, 1], got {forward_probability}")
        goal = [1.0] * (length // stages)
        super().__init__(
            LatticeGoals(goal, goal, count=1),
            places=2,
            low=-1.0,
            high=1.0,
            num_actions=2,
            max_steps=length if max_steps is None else max_steps,
            num_envs=num_envs,
            seed=seed,
            size=length,
        )
        self.length, self.forward_probability = length, forward_probability
        self.reset_state = check_flag("reset_state", reset_state)
        self.alternating = check_flag("alternating", alternating)
        self.num_stages = stages
        self._all = torch.arange(num_envs)

    def stages(self) -> list[dict[str, Any]]:
        """Returns a stage for each part of the chain, whose goal is to close the links of that part."""
        links = self.length // self.num_stages
        return [
            {
                "name": f"part {end // links}",
                "observation": list(range(end)),
                "achieved_goal": list(range(end - links, end)),
                "desired_goal": list(range(self.length, self.length + links)),
                "instructive": True,
                **({"threshold": self.threshold} if end < self.length else {}),
            }
            for end in range(links, self.length + 1, links)
        ]

    def state_names(self) -> dict[str, list[int]]:
        """Returns names for entries of the state: ``observation``, ``desired_goal``, ``part_1``, ..."""
        links = self.length // self.num_stages
        ends = range(links, self.length + 1, links)
        parts = {f"part_{end // links}": list(range(end - links, end)) for end in ends}
        return parts | super().state_names()

    def _draw(self, sheet: Sheet, world: int) -> None:
        draw_chain(sheet, int(self.worlds.place[world].sum()), self.length)

    def _start(self, which: Tensor) -> tuple[Tensor, Tensor]:
        links = torch.zeros(len(which), self.length, dtype=torch.int64)
        return links, links + 1

    def _move(self, action: Tensor) -> tuple[Tensor, Tensor | None]:
        place = self.worlds.place.sum(-1, keepdim=True)
        forward = (action.unsqueeze(-1) + place * self.alternating) % 2 == 1
        if self.forward_probability < 1.0:
            forward = forward & (self._uniform(self._all, 1) < self.forward_probability)
        back = torch.zeros_like(place) if self.reset_state else place - 1
        place = torch.where(forward, place + 1, back)
        return (place > torch.arange(self.length)).to(torch.int64), None

    def _goal_of(self, place: Tensor) -> Tensor:
        return place[:, -(self.length // self.num_stages) :]
