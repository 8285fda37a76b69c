"""Truncates open episodes before environments are reset, so that their transitions are stored."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_her.replay_buffers.keys import device_of

_TRAJECTORY = ("collector", "traj_ids")


def cut_episodes(batch: TensorDictBase) -> TensorDictBase:
    """Truncates all episodes that are open at the end of a batch.

    Call it if you reset a collector before its episodes have ended: a replay buffer that waits for whole
    episodes would otherwise never see their end.

    Args:
        batch: [N, T] with time last; or flat [n], with ``("collector", "traj_ids")``. Without these ids, all
            rows are of one environment.

    Returns:
        The same transitions; ``truncated`` and ``done`` under ``next`` are set in the last one of each
        environment, or of each trajectory in a flat batch. Only these flags are copied.

    Example:
        >>> from tensordict import TensorDict
        >>> open_ = {"truncated": torch.zeros(3, 1).bool(), "done": torch.zeros(3, 1).bool()}
        >>> batch = TensorDict({"collector": {"traj_ids": torch.tensor([4, 4, 5])}, "next": open_}, [3])
        >>> cut_episodes(batch)["next", "done"].flatten().tolist()
        [False, True, True]
    """
    out = batch.clone(False)
    after = out.get("next")
    last = _last(batch)
    if (done := after.get("done", None)) is not None:
        last &= ~done.reshape(batch.shape)  # episodes that ended by themselves are not truncated
    for key in list(after.keys(True, True)):
        if (key if isinstance(key, str) else key[-1]) in ("truncated", "done"):
            flag = after.get(key)
            after.set(key, flag | last.view(*last.shape, *[1] * (flag.ndim - last.ndim)))
    return out


def _last(batch: TensorDictBase) -> Tensor:
    """Returns which transitions are the last ones, in the shape of the batch."""
    last = torch.zeros(batch.shape, dtype=torch.bool, device=device_of(batch))
    ids = batch.get(_TRAJECTORY, None)
    if batch.ndim > 1 or ids is None:
        last[..., -1:] = True
        return last
    ids = ids.reshape(-1)
    order = ids.argsort(stable=True)
    ends = torch.ones_like(last)
    ends[:-1] = ids[order][1:] != ids[order][:-1]
    last[order[ends]] = True
    return last
