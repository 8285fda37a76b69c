"""Episodes whose goals tell where they come from."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

from torchrl_her import EnvReward, GoalReward, GoalWeights, HERWriter

# The goal of state t of episode e of environment n is (1000 n + 100 e + t, 0): never equal to another.
WANTED = -7.0


def tag(env: int, episode: int, state: int) -> float:
    """The achieved goal of a state."""
    return 1000.0 * env + 100.0 * episode + state


def make_batch(
    lengths: list[list[int]],
    *,
    steps: int | None = None,
    terminated: bool = False,
    first: list[tuple[int, int]] | None = None,
) -> TensorDict:
    """A batch [N, T] as a collector gives it, with time last.

    Args:
        lengths: of the episodes of each environment.
        steps: T; by default as many as the longest environment has. The last episode may be cut by it.
        terminated: whether episodes end by termination, their goals achieved; otherwise by truncation.
        first: for each environment, the episode and state to begin with.
    """
    horizon = steps or max(sum(own) for own in lengths)
    rows = []
    for env, own in enumerate(lengths):
        episode, state = first[env] if first else (0, 0)
        for _ in range(horizon):
            last = state + 1 >= own[episode]
            rows.append((env, episode, state, last))
            episode, state = (episode + 1, 0) if last else (episode, state + 1)
            if episode >= len(own):
                own = [*own, 10**6]
    env, episode, state = (torch.tensor([row[i] for row in rows]) for i in range(3))
    last = torch.tensor([row[3] for row in rows]).unsqueeze(-1)
    batch = TensorDict(
        {
            "observation": _point(tag_of(env, episode, state)),
            "achieved_goal": _point(tag_of(env, episode, state)),
            "desired_goal": _point(torch.full((len(rows),), WANTED)),
            "state": torch.full((len(rows), 3), WANTED),
            "action": torch.zeros(len(rows), 1),
            "collector": {"traj_ids": 50 * env + episode},
            "next": {
                "observation": _point(tag_of(env, episode, state + 1)),
                "achieved_goal": _point(tag_of(env, episode, state + 1)),
                "desired_goal": _point(torch.full((len(rows),), WANTED)),
                "state": torch.full((len(rows), 3), WANTED),
                "reward": (last & terminated).float() - 1.0,
                "terminated": last & terminated,
                "truncated": last & (not terminated),
                "done": last,
            },
        },
        batch_size=[len(rows)],
    )
    return batch.reshape(len(lengths), horizon)


def tag_of(env: Tensor, episode: Tensor, state: Tensor) -> Tensor:
    """:func:`tag` of tensors."""
    return (1000 * env + 100 * episode + state).float()


def _point(x: Tensor) -> Tensor:
    return torch.stack((x, torch.zeros_like(x)), -1)


def along(path: list[float], episodes: int = 1) -> TensorDict:
    """A batch [N, T] of episodes whose achieved goals are those of a path; the observation is the step."""
    batch, states = make_batch([[len(path) - 1]] * episodes), torch.tensor(path)
    batch["achieved_goal"][..., 0], batch["next", "achieved_goal"][..., 0] = states[:-1], states[1:]
    batch["observation"][..., 0] = torch.arange(len(path) - 1.0)
    return batch


def tags(x: Tensor) -> list[float]:
    return x[..., 0].tolist()


def same(one: TensorDict, other: TensorDict) -> bool:
    """Whether two tensordicts have the same entries, bit for bit."""
    keys = set(one.keys(True, True))
    return keys == set(other.keys(True, True)) and all(torch.equal(one[key], other[key]) for key in keys)


def make_buffer(weights: GoalWeights | None, *, seed: int = 0, **options: Any) -> TensorDictReplayBuffer:
    """A large buffer whose writer has weights of goals; goals are achieved within 0.01."""
    writer = HERWriter(GoalReward(0.01), weights=weights, **options)
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(100_000), writer=writer, batch_size=4)
    buffer.set_rng(torch.Generator().manual_seed(seed))
    return buffer


def virtual_goals(rows: TensorDict) -> Tensor:
    return rows["desired_goal"][rows["virtual"].squeeze(-1)]


def pairs(rows: TensorDict) -> set[tuple[float, float]]:
    """Observations and the goals that they were given; real goals are left out."""
    found = zip(tags(rows["observation"]), tags(rows["desired_goal"]), strict=True)
    return {pair for pair in found if pair[1] != WANTED}


def costly(lengths: list[list[int]]) -> tuple[EnvReward, TensorDict]:
    """A reward that costs a quarter for each step that an episode has lasted, and a batch with that cost."""
    batch, near = make_batch(lengths), GoalReward(0.5)
    for part in (batch, batch["next"]):
        part["info"] = TensorDict({"cost": part["achieved_goal"][..., :1] % 100 / 4}, batch.batch_size)
    rule = EnvReward(
        lambda a, d, info: near(a, d)[0] - info["info", "cost"],
        lambda a, d, info: near(a, d)[1] & (info["info", "cost"] > 0),
        info_keys=[("info", "cost")],
        achieved_reward=-0.9,
    )
    after = batch["next"]
    after["reward"] = rule(after["achieved_goal"], after["desired_goal"], after)[0]
    return rule, batch


class PreferFar(GoalWeights):
    """A goal is as useful as it is far away; counts the goals that were chosen."""

    def __init__(self) -> None:
        self.chosen = 0

    def __call__(self, goals: Tensor) -> Tensor:
        return goals[..., 0]

    def update(self, goals: Tensor) -> None:
        self.chosen += len(goals)
