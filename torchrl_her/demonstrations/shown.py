"""Demonstrations converted for a run: to its reward, and to the view of its stage of a curriculum."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from torchrl_her.curriculum.stages import Curriculum
from torchrl_her.demonstrations.dataset import Demonstrations
from torchrl_her.goals.rewards import RewardFunction, call_reward, outcomes


def with_reward(demonstrations: Demonstrations, reward_fn: RewardFunction) -> Demonstrations:
    """Recomputes the rewards and ends of demonstrations; each is cut at the first step that terminates it.

    A demonstration that no longer terminates is truncated at its end. If it had terminated without achieving
    its goal, such as by a fall, it still terminates at that step.

    Args:
        demonstrations: the recorded demonstrations.
        reward_fn: maps (achieved, desired) goals to (reward, terminated).

    Example:
        >>> from tensordict import TensorDict
        >>> from torchrl_her import GoalReward
        >>> goal, at = torch.full((3, 1), 2.0), torch.arange(3.0).unsqueeze(-1)
        >>> seen = {"observation": at, "achieved_goal": at, "desired_goal": goal}
        >>> last = torch.tensor([[False], [False], [True]])
        >>> ends = {"terminated": last, "truncated": last & False, "done": last}
        >>> after = {**seen, "achieved_goal": at + 1, "reward": last.float() - 1.0, **ends}
        >>> walk = Demonstrations(
        ...     TensorDict({**seen, "action": at, "next": after}, [3]), torch.tensor([3])
        ... )
        >>> near = with_reward(walk, GoalReward(0.5))
        >>> near.lengths.tolist(), near.rows["next", "reward"].flatten().tolist()
        ([2], [-1.0, 0.0])
    """
    after = demonstrations.rows["next"]
    recorded = after["terminated"] & (after["reward"] < demonstrations.achieved_reward)
    reached = outcomes(reward_fn, after["achieved_goal"], after, demonstrations.rows)
    reward, terminated = call_reward(reward_fn, reached, after["desired_goal"])
    terminated = terminated.view_as(recorded) | recorded
    kept, lengths = _until_first(terminated.flatten(), demonstrations)
    last = torch.zeros_like(terminated)
    last[kept[lengths.cumsum(0) - 1]] = True
    changes = {
        "reward": reward.view(recorded.shape).to(after["reward"].dtype),
        "terminated": terminated,
        "truncated": (after["truncated"] | ~terminated) & last,
        "done": last,
    }
    rows = demonstrations.rows.copy().set("next", after.copy().update(changes))
    return demonstrations.take(kept, lengths, rows=rows)


def in_stage(
    demonstrations: Demonstrations,
    curriculum: Curriculum,
    stage: int,
    task_reward: RewardFunction | None = None,
    *,
    by_episode: bool = False,
) -> Demonstrations:
    """Converts demonstrations of the full task to the view of a stage, like :class:`~torchrl_her.StateToObs`.

    In stages below the last, demonstrations end where the stage's goal is achieved. All others are truncated
    at their end, since an end by the environment says nothing about the stage's goal.

    Args:
        demonstrations: recorded in the full task; [observation | desired goal] is the curriculum's state.
        curriculum: the curriculum that has the stage.
        stage: index of the stage, from 0.
        task_reward: reward of the full task, for a last stage without a threshold; None keeps the recorded
            rewards.

    Keyword Args:
        by_episode: whether to add ``state`` and ``stage``, which a writer needs whose episodes each have a
            stage of their own (:class:`~torchrl_her.replay_buffers.StageRule`).

    Raises:
        ValueError: observation and goal are not as wide as the curriculum's state.
    """
    rows = demonstrations.rows.copy()
    after = rows["next"].copy()
    for tensordict in (rows, after):
        state = torch.cat((tensordict["observation"], tensordict["desired_goal"]), -1)
        if state.shape[-1] != curriculum.state_width:
            raise ValueError(
                f"the curriculum needs states of width {curriculum.state_width}, demonstrations of "
                f"{demonstrations.task} have {state.shape[-1]}"
            )
        entries = curriculum.show(state, stage)
        tensordict.update(dict(zip(("observation", "achieved_goal", "desired_goal"), entries, strict=True)))
        if by_episode:
            tensordict.update(
                {"state": state, "stage": torch.full_like(rows["next", "done"], stage, dtype=torch.int64)}
            )
    if stage < len(curriculum) - 1:
        after["terminated"] = torch.zeros_like(after["terminated"])
    rows.set("next", after)
    staged, rule = replace(demonstrations, rows=rows), curriculum.stages[stage].reward_fn or task_reward
    return staged if rule is None else with_reward(staged, rule)


def _until_first(end: Tensor, demonstrations: Demonstrations) -> tuple[Tensor, Tensor]:
    """Cuts each episode after its first row that ``end`` [n] marks.

    Returns the kept rows [m], and the number of rows that each episode keeps [E].
    """
    episode, rows = demonstrations.episode, torch.arange(len(end))
    first = torch.full_like(demonstrations.lengths, len(end))
    first = first.scatter_reduce(0, episode[end], rows[end], "amin")
    kept = rows <= first[episode]
    return rows[kept], episode[kept].bincount(minlength=len(demonstrations))
