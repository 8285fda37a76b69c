"""HERReplayBuffer takes goals from the state before an action; fails where it does."""

import torch
from tensordict import TensorDict
from torchrl.data import HERReplayBuffer, LazyTensorStorage

# A walk along 0, 1, 2, 3: its three actions achieve 1, 2 and 3.
before = torch.tensor([[0.0], [1.0], [2.0]])
end = before == 2
episode = TensorDict(
    {
        "achieved_goal": before,
        "desired_goal": torch.full_like(before, 9.0),
        "next": {"achieved_goal": before + 1, "reward": torch.zeros(3, 1), "done": end},
    },
    batch_size=[3],
)
buffer = HERReplayBuffer(
    lambda rows: (rows["next", "achieved_goal"] == rows["desired_goal"]).float() - 1,
    her_ratio=1.0,
    strategy="final",
    storage=LazyTensorStorage(100),
    batch_size=100,
)
buffer.extend(episode)
goals = sorted({int(goal) for goal in buffer.sample()["desired_goal"]})
assert goals == [3], f"the last state is 3; the goals given are {goals}"
