"""Values of goals from the networks of a loss: how well each goal can be achieved from an episode's start."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import LossModule

from torchrl_her.env_keys import EnvKeys
from torchrl_her.objectives.critics import critic_values

Prepare = Callable[[TensorDictBase], TensorDictBase]


class GoalValues:
    """Computes the values that a loss's critics give to candidate goals, from an episode's first observation.

    Values are of greedy actions. With rewards of -1 until the goal is achieved, a goal that takes d
    steps has the value -(1 - gamma^d) / (1 - gamma).

    Args:
        loss: loss of TorchRL, whose critics give the values; see
            :func:`~torchrl_her.objectives.critic_values`.
        actor: the greedy policy.

    Keyword Args:
        runs: R, the number of runs, whose networks are stacked.
        before_actor: function that changes the rows before the actor reads them, for example
            :class:`~torchrl_her.ZeroPad`. The rows are R equal blocks, in the order of the runs.
        before_critic: function that changes these rows before the critics read them, for example
            :class:`~torchrl_her.modules.RunningNorm`.
        keys: keys of observation and desired goal, which the networks see.

    Raises:
        ValueError: it is not known how to call the critics of this loss.

    Example:
        >>> from torchrl.data import Bounded
        >>> from torchrl_her import make_actor, make_critic, make_ddpg_loss
        >>> actor, critic = make_actor((4, 2), 3), make_critic((4, 2), 3)
        >>> loss = make_ddpg_loss(actor, critic)
        >>> values = GoalValues(loss, actor)
        >>> values(torch.zeros(5, 4), torch.zeros(5, 10, 2), [5]).shape
        torch.Size([5, 10, 1])
    """

    def __init__(
        self,
        loss: LossModule,
        actor: TensorDictModuleBase,
        *,
        runs: int = 1,
        before_actor: Prepare | None = None,
        before_critic: Prepare | None = None,
        keys: EnvKeys = EnvKeys(),
    ) -> None:
        self.loss, self.actor, self.runs = loss, actor, runs
        self.before_actor, self.before_critic, self.keys = before_actor, before_critic, keys

    @torch.no_grad()
    def __call__(self, observation: Tensor, goals: Tensor, counts: Sequence[int]) -> Tensor:
        """Returns the values of goals.

        Args:
            observation: [m, o], one for each of m episodes, or [m, c, o], one for each goal; sorted by run.
            goals: [m, c, g], c goals for each episode, or [m, 1, g], one for all observations of an episode.
            counts: number of episodes of each run; the sum is m.

        Returns:
            The values [m, c, E] by E critics, on the goals' device.
        """
        if observation.ndim == 2:
            observation = observation.unsqueeze(1)
        width = max(observation.shape[1], goals.shape[1])
        place = torch.device(next(self.loss.parameters()).device)
        blocks = _blocks(counts, goals.device)
        entries = {
            key: entry.expand(-1, width, -1).index_select(0, blocks).flatten(0, 1).to(place)
            for key, entry in ((self.keys.observation, observation), (self.keys.desired_goal, goals))
        }
        rows: TensorDictBase = TensorDict(entries, [len(blocks) * width], device=place)
        rows = rows if self.before_actor is None else self.before_actor(rows)
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            rows = self.actor(rows)
        rows = rows if self.before_critic is None else self.before_critic(rows)
        values = critic_values(self.loss, rows)
        if values is None:
            raise ValueError(f"{type(self.loss).__name__} has no critics like those of DDPG, SAC or DQN")
        lengths = torch.tensor(counts, device=goals.device).unsqueeze(1)
        is_row = (torch.arange(max(counts), device=goals.device) < lengths).flatten()  # False for padding
        return values.to(goals.device).unflatten(0, (len(blocks), width))[is_row]


def _blocks(counts: Sequence[int], device: torch.device) -> Tensor:
    """Returns positions of rows as R equal blocks [R * n]; shorter blocks are padded with row 0."""
    longest, begin, index = max(counts), 0, []
    for count in counts:
        index += [*range(begin, begin + count), *[0] * (longest - count)]
        begin += count
    return torch.tensor(index, device=device)
