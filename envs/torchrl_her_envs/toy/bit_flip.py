"""Bit flipping, with or without a useless action (thesis, section 5.1)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torchrl_her_envs.toy.base import ToyEnv, check_flag, check_whole
from torchrl_her_envs.toy.goals import LatticeGoals
from torchrl_her_envs.toy.pictures import Sheet, draw_bits

_MOST_BITS = 127  # most bits: a start takes 2 * bits + 1 of the 256 random numbers of a step


class BitFlip(ToyEnv):
    """A row of bits that must become the desired row; each action flips one bit.

    Thesis, section 5.1, after Andrychowicz et al. (2017): the two rows are drawn uniformly (here:
    among those that differ), and each step costs 1. The thesis adds an action that changes nothing
    and ends the episode. In hindsight, the goal of that last step is the state that it started from, so
    its virtual reward is always 0: this is the bias that Filtered-HER removes.

    That end is ``truncated``, not ``terminated``, since it says nothing about the goal. If it were
    terminal, giving up would cost 1 in all, less than three flips, so it would not be useless.

    Args:
        bits: n, the number of bits; the agent sees them as 0 and 1.

    Keyword Args:
        useless_action: whether there is an action n, which does nothing and ends the episode.
        max_steps: steps of an episode; n if None.
        num_envs: number of environments.
        seed: seed of all starts and goals; R seeds for R equal blocks of environments, each as if alone.

    Raises:
        ValueError: an option is out of its range, or environments cannot be shared out among the seeds.

    Example:
        >>> env = BitFlip(4, useless_action=True, num_envs=3, seed=0)
        >>> shown = env.reset().set("action", torch.tensor([4, 4, 4]))
        >>> after = env.step(shown)["next"]
        >>> torch.equal(after["observation"], shown["observation"]), after["truncated"].all().item()
        (True, True)
        >>> after["reward"].flatten().tolist(), after["terminated"].any().item()
        ([-1.0, -1.0, -1.0], False)
    """

    name = "bit_flip"

    def __init__(
        self,
        bits: int,
        *,
        useless_action: bool = False,
        max_steps: int | None = None,
        num_envs: int = 1,
        seed: int | Sequence[int] = 0,
    ) -> None:
        bits = check_whole("bits", bits, 1, _MOST_BITS)
        useless_action = check_flag("useless_action", useless_action)
        super().__init__(
            LatticeGoals([0.0] * bits, [1.0] * bits, count=2),
            places=2,
            low=0.0,
            high=1.0,
            num_actions=bits + useless_action,
            max_steps=bits if max_steps is None else max_steps,
            num_envs=num_envs,
            seed=seed,
        )
        self.bits, self.useless_action = bits, useless_action

    def _draw(self, sheet: Sheet, world: int) -> None:
        draw_bits(sheet, self.worlds.place[world].tolist(), self.worlds.goal[world].tolist())

    def _start(self, which: Tensor) -> tuple[Tensor, Tensor]:
        u = self._uniform(which, 2 * self.bits + 1)
        goal, flips = (u[:, :-1] < 0.5).to(torch.int64).chunk(2, -1)
        # Rows that differ, all with the same probability: the first bit that differs is bit i with
        # probability 2**-(i + 1) / (1 - 2**-n), and each bit after it differs at even odds.
        first = (-(1.0 - u[:, -1:] * (1.0 - 2.0**-self.bits)).log2()).floor().clamp(max=self.bits - 1)
        bit = torch.arange(self.bits)
        flips = torch.where(bit == first, 1, torch.where(bit < first, 0, flips))
        return goal ^ flips, goal

    def _move(self, action: Tensor) -> tuple[Tensor, Tensor | None]:
        flipped = torch.arange(self.bits) == action.unsqueeze(-1)  # the useless action flips none
        return self.worlds.place ^ flipped, (action == self.bits if self.useless_action else None)
