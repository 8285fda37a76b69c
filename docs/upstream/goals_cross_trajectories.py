"""HERReplayBuffer gives transitions goals of another environment; fails where it does."""

import torch
from tensordict import TensorDict
from torchrl.data import HERReplayBuffer, LazyTensorStorage

# What a collector yields of two environments in the middle of their episodes, [2, 3]. The goals that are
# achieved in an environment are its number.
env = torch.tensor([0, 1]).unsqueeze(-1).expand(2, 3)
goal = env.unsqueeze(-1).float()
no = torch.zeros(2, 3, 1, dtype=torch.bool)
batch = TensorDict(
    {
        "achieved_goal": goal,
        "desired_goal": torch.full_like(goal, 9.0),
        "collector": {"traj_ids": env},
        "next": {"achieved_goal": goal, "reward": torch.zeros(2, 3, 1), "terminated": no, "done": no},
    },
    batch_size=[2, 3],
)
buffer = HERReplayBuffer(
    lambda rows: torch.zeros(len(rows), 1),
    her_ratio=1.0,
    strategy="final",
    storage=LazyTensorStorage(100),
    batch_size=200,
)
buffer.extend(batch.reshape(-1))
rows = buffer.sample()
pairs = sorted({(int(a), int(d)) for a, d in zip(rows["achieved_goal"], rows["desired_goal"], strict=True)})
assert pairs == [(0, 0), (1, 1)], f"(environment, environment of the goal): {pairs}"
