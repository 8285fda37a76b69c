"""Collectors that write to a replay buffer by themselves (``replay_buffer=``)."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.collectors import Collector, MultiAsyncCollector, MultiSyncCollector
from torchrl.envs import TransformedEnv

import torchrl_her

from .audit import Log
from .collect import BATCHES, COMMON, ENVS, STEPS, Batches, make_env
from .parts import GRID, audit, make_buffer
from .tagged import TaggedEnv, make_policy

_ROOT, _MINUTE = ("observation", "achieved_goal", "desired_goal", "action"), 60.0


class _RecordedEnv(TaggedEnv):
    """Keeps all its transitions, beside what the collector makes of them."""

    def __init__(self, num_envs: int | None) -> None:
        super().__init__(0, num_envs)
        self.record: Batches = []

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        after = super()._step(tensordict)
        self.record.append(tensordict.select(*_ROOT).clone().set("next", after.clone()))
        return after


def fill(
    buffer: Any,
    *,
    num_envs: int | None,
    env_ids: bool,
    track_traj_ids: bool,
    thread: bool = False,
    **options: Any,
) -> Batches:
    """Lets a single collector write to a buffer.

    Args:
        thread: whether it does so in a thread, while this one samples.

    Returns:
        What the environment did.
    """
    recorded = _RecordedEnv(num_envs)
    env = TransformedEnv(recorded, torchrl_her.EnvIds()) if env_ids else recorded
    frames = STEPS * (num_envs or 1)
    collector = Collector(
        env,
        make_policy(),
        frames_per_batch=frames,
        total_frames=BATCHES * frames,
        replay_buffer=buffer,
        track_traj_ids=track_traj_ids,
        **COMMON,
        **options,
    )
    try:
        if thread:
            _in_a_thread(collector, buffer)
        else:
            for _ in collector:
                pass
    finally:
        collector.shutdown()
    return [whole_episodes(recorded.record)] if "trajs_per_batch" in options else recorded.record


def _in_a_thread(collector: Collector, buffer: Any) -> None:
    errors: list[BaseException | None] = []
    before, threading.excepthook = threading.excepthook, lambda error: errors.append(error.exc_value)
    try:
        collector.start()
        deadline = time.monotonic() + _MINUTE
        while collector.is_running() and time.monotonic() < deadline:
            if len(buffer) > 0:
                buffer.sample()
            time.sleep(0.01)
        collector.async_shutdown()
    finally:
        threading.excepthook = before
    if errors and errors[0] is not None:
        raise errors[0]


def whole_episodes(record: Batches) -> TensorDictBase:
    """Of what the environment did, the episodes that are over: all that ``trajs_per_batch`` gives."""
    rows = torch.cat([step.reshape(-1) for step in record])
    episode = rows["observation"][:, :3]
    over = episode[rows["next", "done"].view(-1)]
    return rows[(episode.unsqueeze(1) == over).all(-1).any(-1)]


def share(kind: str, part: str) -> bool:
    """Lets worker processes write to a buffer, and audits what they wrote.

    Args:
        kind: "sync" or "async".
        part: one of PARTS.
    """
    buffer, num_envs = make_buffer(part, shared=True), ENVS if part == GRID else None
    # TorchRL shares no storage that is still without shape.
    fill(buffer, num_envs=num_envs, env_ids=False, track_traj_ids=True)
    written = len(buffer)
    collector = {"sync": MultiSyncCollector, "async": MultiAsyncCollector}[kind](
        [partial(make_env, 100 * worker, num_envs) for worker in range(1, 3)],
        make_policy(),
        frames_per_batch=2 * STEPS * (num_envs or 1),
        total_frames=20 * STEPS * (num_envs or 1),
        replay_buffer=buffer,
        **COMMON,
    )
    for _ in collector:
        pass
    assert len(buffer) > written, "the workers wrote nothing"
    buffer.sample()
    audit(part, buffer, Log([buffer.storage[:]]))
    return True


_COLLECTORS: dict[str, dict[str, Any]] = {
    "`Collector(replay_buffer=...)`": {},
    "`Collector(replay_buffer=..., extend_buffer=False)`": {"extend_buffer": False},
    "`Collector(replay_buffer=..., trajs_per_batch=4)`": {"trajs_per_batch": 4},
    "`Collector(replay_buffer=...)` in a thread (`start()`)": {"thread": True},
}
FILLERS: dict[str, Callable[..., Batches]] = {
    f"{name}, {kind}": partial(fill, num_envs=num_envs, **options)
    for name, options in _COLLECTORS.items()
    for kind, num_envs in (("batched", ENVS), ("unbatched", None))
}
