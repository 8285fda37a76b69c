"""Whole episodes of some runs, with the rules by which they are relabeled."""

from __future__ import annotations

from dataclasses import dataclass

from tensordict import TensorDictBase
from torch import Tensor

from torchrl_her.goals.rewards import Outcome, RewardFunction
from torchrl_her.replay_buffers.episodes import Episodes
from torchrl_her.replay_buffers.keys import TransitionKeys, failures
from torchrl_her.replay_buffers.options import HindsightOptions
from torchrl_her.replay_buffers.runs.pieces import Piece


@dataclass(frozen=True)
class Chunk:
    """Episodes that are relabeled and written together.

    Attributes:
        rows: [n], collected transitions; other episodes are among them.
        run: [n] int64, the run of each row; None if there is only one.
        piece: Positions of the episodes in ``rows``, by run.
        reward_fn: Maps (achieved, desired) goals to (reward, terminated).
        options: Number, sources and filter of virtual goals.
        keys: Names of the entries.
    """

    rows: TensorDictBase
    run: Tensor | None
    piece: Piece
    reward_fn: RewardFunction
    options: HindsightOptions
    keys: TransitionKeys

    @property
    def episodes(self) -> Episodes:
        """Positions of the episodes in ``rows``."""
        return self.piece.episodes

    def before(self) -> Outcome:
        """Returns the goals [n, g] that were achieved before the actions."""
        return self.keys.before(self.rows, self.reward_fn)

    def after(self) -> Outcome:
        """Returns the goals [n, g] that the actions achieved."""
        return self.keys.after(self.rows, self.reward_fn)

    def failures(self) -> tuple[Tensor, Tensor]:
        """Returns ``(failed, cost)``, [n, 1] each; see :func:`~torchrl_her.replay_buffers.keys.failures`."""
        return failures(self.rows, self.keys, self.reward_fn, self.options.achieved_reward)
