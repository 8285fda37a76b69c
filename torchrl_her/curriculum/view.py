"""Converts transitions to the observations, goals, rewards and ends of another curriculum stage."""

from __future__ import annotations

import torch
from tensordict import NestedKey, TensorDictBase

from torchrl_her.checks import entry_of
from torchrl_her.curriculum.stages import Curriculum
from torchrl_her.goals.rewards import RewardFunction, ask_reward
from torchrl_her.replay_buffers.keys import under_next
from torchrl_her.replay_buffers.options import HindsightOptions


class StageView:
    """Converts transitions of any stage to another stage: its observation, goals, reward and ends.

    With it, a :class:`~torchrl_her.replay_buffers.StageRule` trains a stage on the transitions of all stages.
    Transitions that were played in the stage stay as they are. The others get the reward of the stage and
    terminate by its rule. One that ended its episode, but ends none in this stage, is marked as truncated.
    After Luo et al., Relay Hindsight Experience Replay, 2022 (arXiv 2208.00843).

    Args:
        curriculum: the stages.
        stage: index of the stage, from 0.
        reward_fn: reward of this stage; maps (achieved, desired) goals to (reward, terminated).

    Keyword Args:
        state_key: the state vector, which :class:`~torchrl_her.StateToObs` has read.
        options: the writer's options, for the keys of all other entries; None for the default keys.

    Example:
        >>> from tensordict import TensorDict
        >>> from torchrl_her import CurriculumStage, GoalReward
        >>> stages = [
        ...     CurriculumStage(name=n, observation=[0, 1], achieved_goal=[i], desired_goal=[2], threshold=1)
        ...     for i, n in enumerate(("near", "far"))
        ... ]
        >>> curriculum, names = Curriculum(stages, 3), ("observation", "achieved_goal", "desired_goal")
        >>> state, ended = torch.tensor([[3.0, 1.0, 3.0]]), torch.ones(1, 1, dtype=torch.bool)
        >>> near_goal = {"state": state, **dict(zip(names, curriculum.show(state, 0)))}  # is achieved here
        >>> ends = {"reward": torch.zeros(1, 1), "terminated": ended, "truncated": ~ended, "done": ended}
        >>> rows = TensorDict({**near_goal, "stage": ~ended + 0, "next": {**near_goal, **ends}}, [1])
        >>> shown = StageView(curriculum, 1, GoalReward(0.5))(rows)
        >>> shown["achieved_goal"].item(), shown["next", "reward"].item()
        (1.0, -1.0)
        >>> shown["next", "terminated"].item(), shown["next", "truncated"].item()
        (False, True)
    """

    def __init__(
        self,
        curriculum: Curriculum,
        stage: int,
        reward_fn: RewardFunction,
        *,
        state_key: NestedKey = "state",
        options: HindsightOptions | None = None,
    ) -> None:
        if not 0 <= stage < len(curriculum):
            raise ValueError(f"stage must be in [0, {len(curriculum) - 1}], got {stage}")
        self.curriculum, self.stage, self.reward_fn = curriculum, stage, reward_fn
        options = options or HindsightOptions()
        self.state_key, self.observation_key = state_key, options.keys.observation
        self._keys = options.transition_keys()

    def __call__(self, rows: TensorDictBase) -> TensorDictBase:
        """Returns copies of transitions [n] of any stages, as this stage shows them.

        Raises:
            KeyError: an entry is missing.
        """
        keys = self._keys
        played = entry_of(rows, keys.stage).reshape(-1, 1) == self.stage
        out = rows.copy()
        out.set("next", rows.get("next").copy())
        current_keys = (self.observation_key, keys.achieved, keys.goals[0])
        next_keys = (under_next(self.observation_key), keys.next_achieved, keys.goals[1])
        for state_key, names in ((self.state_key, current_keys), (under_next(self.state_key), next_keys)):
            entries = self.curriculum.show(entry_of(rows, state_key), self.stage)
            for key, entry in zip(names, entries, strict=True):  # rows of this stage keep their goals
                out.set(key, torch.where(played, entry_of(rows, key), entry))
        for key in (keys.stage, under_next(keys.stage)):
            if (stages := out.get(key, None)) is not None:
                out.set(key, torch.full_like(stages, self.stage))
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
