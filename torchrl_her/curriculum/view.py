"""Transitions of one layer of a curriculum, shown as another layer would have shown them."""

from __future__ import annotations

import torch
from tensordict import NestedKey, TensorDictBase

from torchrl_her.curriculum.layers import Curriculum
from torchrl_her.goals.rewards import RewardFunction, ask_reward
from torchrl_her.replay_buffers.keys import entry_of, under_next
from torchrl_her.replay_buffers.options import HindsightOptions


class LayerView:
    """Shows collected transitions as a layer would have: with its observation, goals, reward and ends.

    Given to :class:`~torchrl_her.replay_buffers.LayerRule`, it lets each transition train all layers and not
    only the one that its episode was played in, as in Luo et al., Relay Hindsight Experience Replay, 2022
    (arXiv 2208.00843). Transitions that were played in the layer stay as they are. In the others, reward and
    end are those of the layer; where an episode ended that would have gone on in the layer, it is truncated.

    Args:
        curriculum: the layers.
        layer: index of the layer, from 0.
        reward_fn: of this layer; maps (achieved, desired) goals to (reward, terminated).

    Keyword Args:
        state_key: the state vector, which :class:`~torchrl_her.StateToObs` has read.
        observation_key: key of the observation.
        options: has the keys of all other entries; None for the usual ones.

    Example:
        >>> from tensordict import TensorDict
        >>> from torchrl_her import CurriculumLayer, GoalReward
        >>> near, far = (
        ...     CurriculumLayer(
        ...         name=name, observation=[0, 1], achieved_goal=[place], desired_goal=[2], threshold=0.5
        ...     )
        ...     for place, name in enumerate(("near", "far"))
        ... )
        >>> curriculum, names = Curriculum([near, far], 3), ("observation", "achieved_goal", "desired_goal")
        >>> state, ended = torch.tensor([[3.0, 1.0, 3.0]]), torch.ones(1, 1, dtype=torch.bool)
        >>> near_goal = {"state": state, **dict(zip(names, curriculum.show(state, 0)))}  # is achieved here
        >>> ends = {"reward": torch.zeros(1, 1), "terminated": ended, "truncated": ~ended, "done": ended}
        >>> rows = TensorDict({**near_goal, "layer": ~ended + 0, "next": {**near_goal, **ends}}, [1])
        >>> shown = LayerView(curriculum, 1, GoalReward(0.5))(rows)
        >>> shown["achieved_goal"].item(), shown["next", "reward"].item()
        (1.0, -1.0)
        >>> shown["next", "terminated"].item(), shown["next", "truncated"].item()
        (False, True)
    """

    def __init__(
        self,
        curriculum: Curriculum,
        layer: int,
        reward_fn: RewardFunction,
        *,
        state_key: NestedKey = "state",
        observation_key: NestedKey = "observation",
        options: HindsightOptions | None = None,
    ) -> None:
        if not 0 <= layer < len(curriculum):
            raise ValueError(f"layer must be in [0, {len(curriculum) - 1}], got {layer}")
        self.curriculum, self.layer, self.reward_fn = curriculum, layer, reward_fn
        self.state_key, self.observation_key = state_key, observation_key
        self._keys = (options or HindsightOptions()).transition_keys()

    def __call__(self, rows: TensorDictBase) -> TensorDictBase:
        """Returns transitions [n] of any layers as this layer shows them; the given ones stay as they are.

        Raises:
            KeyError: an entry is missing.
        """
        keys = self._keys
        played = entry_of(rows, keys.layer).reshape(-1, 1) == self.layer
        out = rows.copy()
        out.set("next", rows.get("next").copy())
        here = (self.observation_key, keys.achieved, keys.goals[0])
        there = (under_next(self.observation_key), keys.next_achieved, keys.goals[1])
        for state_key, names in ((self.state_key, here), (under_next(self.state_key), there)):
            shown = self.curriculum.show(entry_of(rows, state_key), self.layer)
            for key, entry in zip(names, shown, strict=True):  # goals that were proposed stay
                out.set(key, torch.where(played, entry_of(rows, key), entry))
        for key in (keys.layer, under_next(keys.layer)):
            if (layers := out.get(key, None)) is not None:
                out.set(key, torch.full_like(layers, self.layer))
        reached = keys.after(out, self.reward_fn)
        reward, ends = ask_reward(self.reward_fn, reached, entry_of(out, keys.goals[1]))
        stored = {
            key: entry_of(rows, key) for key in (keys.reward, keys.terminated, keys.truncated, keys.done)
        }
        flat = {key: entry.view(reward.shape) for key, entry in stored.items()}
        terminated = torch.where(played, flat[keys.terminated], ends)
        done = terminated | flat[keys.done]
        changes = {
            keys.reward: torch.where(played, flat[keys.reward], reward.to(stored[keys.reward].dtype)),
            keys.terminated: terminated,
            keys.truncated: flat[keys.truncated] | (done & ~terminated & ~played),
            keys.done: done,
        }
        for key, entry in changes.items():
            out.set(key, entry.view(stored[key].shape))
        return out
