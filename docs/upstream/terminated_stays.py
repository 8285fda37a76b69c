"""HERReplayBuffer leaves ``terminated`` as it was for the original goal; fails where it does.

Achieving the goal ends an episode here. With the patch, ``terminated_fn`` says so.
"""

import inspect

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import HERReplayBuffer, LazyTensorStorage


def achieved(rows: TensorDictBase) -> Tensor:
    return rows["next", "achieved_goal"] == rows["desired_goal"]


# An episode that achieves the goals 1, 2 and 3 one after the other. 3 was wanted and ended it.
after = torch.tensor([[1.0], [2.0], [3.0]])
end = after == 3
episode = TensorDict(
    {
        "achieved_goal": after - 1,
        "desired_goal": torch.full_like(after, 3.0),
        "next": {"achieved_goal": after, "reward": end.float() - 1, "terminated": end, "done": end},
    },
    batch_size=[3],
)
patched = "terminated_fn" in inspect.signature(HERReplayBuffer.__init__).parameters
buffer = HERReplayBuffer(
    lambda rows: achieved(rows).float() - 1,
    **({"terminated_fn": achieved} if patched else {}),
    her_ratio=1.0,
    strategy="episode",
    storage=LazyTensorStorage(100),
    batch_size=200,
)
buffer.extend(episode)
after = buffer.sample()["next"]
pairs = sorted({(int(r), bool(t)) for r, t in zip(after["reward"], after["terminated"], strict=True)})
assert pairs == [(-1, False), (0, True)], f"(reward, terminated): {pairs}"
