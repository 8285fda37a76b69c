"""The treasure hunt on a line (thesis, section 5.2)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torchrl_her_envs.toy.base import ToyEnv, check_whole
from torchrl_her_envs.toy.goals import LatticeGoals
from torchrl_her_envs.toy.pictures import Sheet, draw_treasure

_LINE = 100  # length of the line


class TreasureHunt(ToyEnv):
    """A pirate on a line from 0 to 100 goes left (action 0) or right (1) until it is at the treasure.

    Thesis, section 5.2: pirate and treasure are at random places (here: at different ones). The best
    policy walks towards the treasure, and no action matters at the treasure. HER nevertheless stores
    transitions that start at their virtual goal: those of a pirate who walks against an end of the line.

    Args:
        step: distance that an action moves the pirate: a divisor of 100. Treasures lie at multiples of it.
            The pirate cannot leave the line.

    Keyword Args:
        max_steps: steps of an episode; 100 / ``step``, which is enough from anywhere, if None.
        num_envs: number of environments.
        seed: seed of all starts and goals; R seeds for R equal blocks of environments, each as if alone.

    The agent sees a place x as ``x / 50 - 1``.

    Raises:
        ValueError: an option is out of its range, or environments cannot be shared out among the seeds.

    Example:
        >>> from tensordict.nn import TensorDictModule
        >>> env = TreasureHunt(10, num_envs=2, seed=0)
        >>> walk = lambda place, goal: (goal > place).squeeze(-1).long()
        >>> policy = TensorDictModule(walk, ["observation", "desired_goal"], ["action"])
        >>> steps = env.rollout(10, policy)
        >>> steps["next", "terminated"][:, -1].any().item()
        True
    """

    name = "treasure_hunt"

    def __init__(
        self,
        step: int = 1,
        *,
        max_steps: int | None = None,
        num_envs: int = 1,
        seed: int | Sequence[int] = 0,
    ) -> None:
        step = check_whole("step", step, 1, _LINE)
        if _LINE % step:
            divisors = ", ".join(str(d) for d in range(1, _LINE + 1) if _LINE % d == 0)
            raise ValueError(f"step must divide {_LINE}, so be one of {divisors}; got {step}")
        last = _LINE // step
        super().__init__(
            LatticeGoals([-1.0], [1.0], count=last + 1),
            places=last + 1,
            low=-1.0,
            high=1.0,
            num_actions=2,
            max_steps=last if max_steps is None else max_steps,
            num_envs=num_envs,
            seed=seed,
        )

    def _draw(self, sheet: Sheet, world: int) -> None:
        pirate, treasure = (int(cells[world, 0]) for cells in (self.worlds.place, self.worlds.goal))
        draw_treasure(sheet, pirate / self._last, treasure / self._last)

    def _start(self, which: Tensor) -> tuple[Tensor, Tensor]:
        u = self._uniform(which, 2)
        goal = (u[:, :1] * (self._last + 1)).to(torch.int64)
        start = (u[:, 1:] * self._last).to(torch.int64)
        return start + (start >= goal), goal

    def _move(self, action: Tensor) -> tuple[Tensor, Tensor | None]:
        return (self.worlds.place + 2 * action.unsqueeze(-1) - 1).clamp(0, self._last), None
