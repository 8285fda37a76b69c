"""What is expected of each cell, as plain data: it works, or it is refused for a reason.

``docs/compatibility.md`` shows these tables, as ``python -m tests.torchrl_her.compatibility.page`` writes it.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass

WORKS = "works"


@dataclass(frozen=True)
class Refusal:
    """Why a cell is refused.

    Args:
        match: a pattern that is found in the error.
        says: the same for readers.
        ours: whether it is this library that refuses, and not TorchRL.
    """

    match: str
    says: str
    ours: bool = True


REFUSALS: dict[str, Refusal] = {
    "EnvIds": Refusal(
        r"torchrl_her\.EnvIds\(\)",
        "The batch does not show which environment a transition is from, or whether its episode continues. "
        "The message names the remedy, `EnvIds`.",
    ),
    "padded": Refusal(
        "not split and padded",
        'Padding would become transitions. Use `split_trajs=False`, or `traj_format="cat"`.',
    ),
    "n_steps": Refusal(
        r"span several steps .* n_steps",
        "Goals that are passed on the way would be missed. Use the option `n_steps` in place of `MultiStep`.",
    ),
    "compact": Refusal(
        r"relabeling needs the entry \('next', 'achieved_goal'\)",
        "The goals achieved by the actions are not in the batch.",
    ),
    "single": Refusal(
        "needs single transitions",
        "A flat storage takes [N, T] batches as items. Give it `ndim=2`, or extend with `batch.reshape(-1)`.",
    ),
    "sharing": Refusal(
        "workers send episodes and the learner extends",
        "Workers send episodes and the learner extends: leave `replay_buffer=` out.",
    ),
    "slices": Refusal(
        r"needs per='episode'",
        'A slice would hold copies of one transition under several goals. Use `per="episode"`.',
    ),
    "consuming": Refusal(
        "consumes its transitions",
        "New transitions take the places of sampled ones, so rows are not in order of time.",
    ),
    "one dimension": Refusal(
        "HERWriter needs a storage of 1 dimension", "The writer needs a storage of one dimension."
    ),
    "no list": Refusal(
        "HERSampleUnit needs a storage of tensordicts",
        "`HERSampleUnit` reads the whole storage as one tensordict to find goals.",
    ),
    "list storage": Refusal(
        "slices.*LazyTensorStorage",
        "TorchRL's samplers of slices write their marks into this storage. Use `LazyTensorStorage`.",
    ),
    "2-D slices": Refusal(
        "PrioritizedSliceSampler.*dimension",
        "In a full storage, TorchRL's prioritized slices are not consecutive steps.",
    ),
    "ensemble": Refusal(
        "in a ReplayBufferEnsemble, relabel while writing",
        "An ensemble does not use the sample units of its members. Use `HERWriter`.",
    ),
    "2-D writes": Refusal(
        "dim0 and dim1 must be within the range",
        "A storage of two dimensions takes [N, T] batches.",
        ours=False,
    ),
    "2-D add": Refusal(
        "meshgrid expects|expand_as_right requires",
        "A storage of two dimensions takes [N, T] batches, not single steps.",
        ours=False,
    ),
    "needs ids": Refusal("trajs_per_batch requires", "`trajs_per_batch` needs trajectory ids.", ours=False),
    "list slices": Refusal(
        "Could not get a tensordict out of the storage",
        "Samplers of slices need a storage of tensordicts.",
        ours=False,
    ),
    "stack priorities": Refusal(
        "Wrong shapes / arange configuration",
        "Prioritized slices do not work with this storage.",
        ours=False,
    ),
    "2-D consuming": Refusal(
        "ConsumingSampler only supports 1-dimensional storages",
        "A consuming sampler needs a storage of one dimension.",
        ours=False,
    ),
    "ensemble weights": Refusal(
        "the Tensor priority_weight has shape",
        "Prioritized slices do not work in an ensemble.",
        ours=False,
    ),
    "ensemble sizes": Refusal(
        "The shapes of the tensors to stack is incompatible",
        "Members of an ensemble must give slices of the same number of steps.",
        ours=False,
    ),
}


def outcome_of(call: Callable[[], object]) -> str:
    """``WORKS``, the name of a refusal, or what is wrong."""
    try:
        call()
    except AssertionError as error:
        return f"WRONG: {error}"
    except Exception as error:
        return name_of(f"{type(error).__name__}: {error}")
    return WORKS


def name_of(error: str) -> str:
    """The name of the refusal that an error is, or the error if it is none of them."""
    names = [name for name, refusal in REFUSALS.items() if re.search(refusal.match, error, re.DOTALL)]
    return names[0] if names else f"WRONG: unknown refusal: {error}"


Cell = (
    str | tuple[str, str, str]
)  # one outcome; or one with ids of trajectories, one with EnvIds, one without
_LOST: Cell = ("EnvIds", WORKS, "EnvIds")  # environments, or their episodes, are known by EnvIds alone
_BARE: Cell = (WORKS, WORKS, "EnvIds")  # any ids will do
_ALL = (WORKS,) * 4

# For each collector: the writer, the writer of whole episodes, the unit over a flat and a [T, N] storage.
COLLECTORS: dict[str, tuple[Cell, Cell, Cell, Cell]] = {
    "`Collector`, batched environment": _ALL,
    "`Collector`, unbatched environment": _ALL,
    "`Collector`, `SerialEnv`": _ALL,
    "`Collector(reset_at_each_iter=True)`, batched": (_LOST, _LOST, WORKS, WORKS),
    "`Collector(reset_at_each_iter=True)`, unbatched": (_BARE, _BARE, WORKS, WORKS),
    "`Collector(set_truncated=True)`, batched": _ALL,
    "`collector.reset()` in mid-episode, batched": (_LOST, _LOST, WORKS, WORKS),
    "`collector.reset()` in mid-episode, unbatched": (_BARE, _BARE, WORKS, WORKS),
    "a second `Collector` that uses ids again, batched": (_LOST, _LOST, WORKS, WORKS),
    "a second `Collector` that uses ids again, unbatched": (_BARE, _BARE, WORKS, WORKS),
    "`Collector(split_trajs=True)`": ("padded",) * 4,
    '`Collector(trajs_per_batch=4, traj_format="padded")`': ("padded",) * 4,
    '`Collector(trajs_per_batch=4, traj_format="cat")`': _ALL,
    "`Collector(compact_obs=True)`": ("compact",) * 4,
    "`Collector(postproc=MultiStep(...))`": ("n_steps",) * 4,
    "`AsyncBatchedCollector`, environments in threads": (_LOST, _LOST, WORKS, WORKS),
    '`MultiSyncCollector(cat_results="stack")`, unbatched': _ALL,
    '`MultiSyncCollector(cat_results="stack")`, batched': _ALL,
    "`MultiSyncCollector(cat_results=0)`, unbatched": (_BARE, _BARE, WORKS, WORKS),
    "`MultiSyncCollector(cat_results=0)`, batched": _ALL,
    "`MultiSyncCollector(cat_results=-1)`, unbatched": (_BARE, _BARE, WORKS, WORKS),
    "`MultiSyncCollector(cat_results=-1)`, batched": (_LOST, _LOST, WORKS, WORKS),
    "`MultiAsyncCollector`, unbatched": (_BARE, _BARE, WORKS, WORKS),
    "`MultiAsyncCollector`, batched": (_LOST, _LOST, WORKS, WORKS),
    "`Collector(replay_buffer=...)`, batched": (WORKS, WORKS, "single", WORKS),
    "`Collector(replay_buffer=...)`, unbatched": (WORKS, WORKS, WORKS, "2-D writes"),
    "`Collector(replay_buffer=..., extend_buffer=False)`, batched": (WORKS, WORKS, "single", "2-D add"),
    "`Collector(replay_buffer=..., extend_buffer=False)`, unbatched": (WORKS, WORKS, WORKS, "2-D add"),
    "`Collector(replay_buffer=..., trajs_per_batch=4)`, batched": (
        *[(WORKS, WORKS, "needs ids")] * 3,
        ("2-D writes", "2-D writes", "needs ids"),
    ),
    "`Collector(replay_buffer=..., trajs_per_batch=4)`, unbatched": (
        *[(WORKS, WORKS, "needs ids")] * 3,
        ("2-D writes", "2-D writes", "needs ids"),
    ),
    "`Collector(replay_buffer=...)` in a thread (`start()`), batched": (WORKS, WORKS, "single", WORKS),
    "`Collector(replay_buffer=...)` in a thread (`start()`), unbatched": (WORKS, WORKS, WORKS, "2-D writes"),
    "`MultiSyncCollector(replay_buffer=...)`": ("sharing",) * 4,
    "`MultiAsyncCollector(replay_buffer=...)`": ("sharing",) * 4,
}

_FLAT: dict[str, tuple[str, str, str]] = {
    "`RandomSampler`": (WORKS, WORKS, WORKS),
    "`PrioritizedSampler`": (WORKS, WORKS, WORKS),
    "`SamplerWithoutReplacement`": (WORKS, WORKS, WORKS),
    "`SliceSampler`": ("slices", WORKS, WORKS),
    "`PrioritizedSliceSampler`": ("slices", WORKS, WORKS),
    "`SliceSamplerWithoutReplacement`": ("slices", WORKS, WORKS),
    "`consume_after_n_samples`": ("consuming",) * 3,
}

# For each storage and sampler: the writer, the writer of whole episodes, the unit.
BUFFERS: dict[str, dict[str, tuple[str, str, str]]] = {
    "`LazyTensorStorage`": _FLAT,
    "`LazyMemmapStorage`": _FLAT,
    "`ListStorage`": {
        **dict.fromkeys(list(_FLAT)[:3], (WORKS, WORKS, "no list")),
        **dict.fromkeys(list(_FLAT)[3:6], ("list storage", "list storage", "list slices")),
        "`consume_after_n_samples`": ("consuming",) * 3,
    },
    "`LazyStackStorage`": {
        **_FLAT,
        "`SliceSampler`": ("list storage", "list storage", WORKS),
        "`PrioritizedSliceSampler`": ("list storage", "list storage", "stack priorities"),
        "`SliceSamplerWithoutReplacement`": ("list storage", "list storage", WORKS),
    },
    "`LazyTensorStorage(ndim=2)`": {
        **dict.fromkeys(_FLAT, ("one dimension", "one dimension", WORKS)),
        "`PrioritizedSliceSampler`": ("one dimension", "one dimension", "2-D slices"),
        "`consume_after_n_samples`": ("2-D consuming",) * 3,
    },
    "`ReplayBufferEnsemble`": {
        **dict.fromkeys(list(_FLAT)[:3], (WORKS, WORKS, "ensemble")),
        "`SliceSampler`": ("slices", WORKS, "ensemble"),
        "`PrioritizedSliceSampler`": ("slices", "ensemble weights", "ensemble"),
        "`SliceSamplerWithoutReplacement`": ("slices", "ensemble sizes", "ensemble sizes"),
        "`consume_after_n_samples`": ("consuming", "consuming", "ensemble"),
    },
    "`RemoteTensorDictReplayBuffer`": _FLAT,
    "`RayReplayBuffer`": _FLAT,
}
