"""Applies running normalization to sampled transitions and to the inputs of a policy."""

from __future__ import annotations

import math

from tensordict import TensorDictBase, unravel_key
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import Transform

from torchrl_her.checks import entry_of
from torchrl_her.env_keys import EnvKeys
from torchrl_her.modules.normalization import RunningNorm


class NormalizeBatch(Transform):
    """Normalizes the transitions that a replay buffer samples: add it with ``buffer.append_transform``.

    Relabeling comes before: a :class:`~torchrl_her.HERWriter` stores transitions with their virtual goals,
    and a :class:`~torchrl_her.HERSampleUnit` inserts virtual goals before all transforms. So losses see
    normalized virtual goals, in the root and under ``next``. Stored transitions stay raw: read them from
    ``buffer.storage[...]``, since ``buffer[...]`` applies this transform, too.

    TorchRL's own transforms do not fit. ``VecNormV2`` works in environments only, before relabeling: goals
    that were normalized at different times cannot be compared, and virtual goals are not counted. The
    statistics of ``ObservationNorm`` are fixed.

    Args:
        norm: the statistics, shared with the policy (:class:`~torchrl_her.modules.NormalizedPolicy`).

    Keyword Args:
        counted_k: None if another part counts written transitions, as ``HERWriter(on_write=norm.update)``
            does. In a buffer with a plain writer and a :class:`~torchrl_her.HERSampleUnit`, the k of that
            unit: this transform then counts all that is written, and each achieved goal under ``next`` as k
            desired goals.
        keys: keys of the goals, for ``counted_k``.

    Raises:
        ValueError: ``counted_k`` is negative or infinite, or the desired goal is not normalized; when
            writing, an entry to be counted is not finite or has another width.
        KeyError: when writing, an entry to be counted is missing.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
        >>> from torchrl_her.modules import RunningNorm
        >>> norm = RunningNorm({"observation": 1})
        >>> buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(9), batch_size=4)
        >>> _ = buffer.append_transform(NormalizeBatch(norm))
        >>> rows = TensorDict({"observation": torch.tensor([[1.0], [5.0]])}, [2])
        >>> _ = buffer.extend(rows)
        >>> _ = norm.update(rows)
        >>> buffer.sample()["observation"].abs().unique().tolist()
        [1.0]
        >>> buffer.storage[:]["observation"].tolist()
        [[1.0], [5.0]]
    """

    def __init__(
        self,
        norm: RunningNorm,
        *,
        counted_k: float | None = None,
        keys: EnvKeys = EnvKeys(),
    ) -> None:
        if counted_k is not None and not 0 <= counted_k < math.inf:
            raise ValueError(f"counted_k must be None or a finite number of at least 0, got {counted_k}")
        if counted_k is not None and unravel_key(keys.desired_goal) not in norm.widths:
            raise ValueError(f"counted_k needs {keys.desired_goal!r} to be normalized, got {norm}")
        super().__init__(in_keys=norm.keys, out_keys=norm.keys)
        self.norm, self.counted_k, self.keys = norm, counted_k, keys

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Normalizes sampled transitions."""
        return self.norm(tensordict)

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Counts transitions that are written, and leaves them unchanged."""
        if self.counted_k is not None and not self.norm.frozen:
            # Checked first, so that rows which cannot be counted leave the statistics as they were.
            key = unravel_key(("next", self.keys.achieved_goal))
            achieved = entry_of(tensordict, key, by="counted_k")
            width = self.norm.widths[unravel_key(self.keys.desired_goal)]
            if achieved.shape[-1] > width:
                raise ValueError(f"{key!r} must have a width of at most {width}, got {achieved.shape[-1]}")
            if not bool(achieved.isfinite().all()):
                raise ValueError(f"{key!r} must be finite to be counted, got NaN or infinity in it")
            self.norm.update(tensordict)
            goals_by_run = achieved.reshape(-1, achieved.shape[-1]).chunk(self.norm.runs)
            for run, goals in enumerate(goals_by_run):
                self.norm.count(self.keys.desired_goal, goals, run=run, weight=self.counted_k)
        return tensordict


class NormalizedPolicy(TensorDictModuleBase):
    """Runs a policy on normalized inputs, and leaves the observations and goals in the tensordict unchanged.

    Only the actor's outputs are put into the tensordict, so collectors yield raw observations and goals, as
    buffers must store them. Exploration belongs after this module, or within the actor. The statistics are
    part of this module's ``state_dict``, so checkpoints have them, and collectors in other processes get them
    with the weights.

    Args:
        actor: policy that reads normalized entries. Losses take the actor and not this module, since they get
            batches from :class:`~torchrl_her.modules.NormalizeBatch`.
        norm: running statistics, which other modules may share.

    Raises:
        ValueError: the actor reads no normalized entry, or writes one.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_her import make_actor
        >>> from torchrl_her.modules import RunningNorm
        >>> norm = RunningNorm({"observation": 9, "desired_goal": 2})
        >>> policy = NormalizedPolicy(make_actor((9, 2), 3), norm)
        >>> seen = TensorDict({"observation": torch.ones(4, 9), "desired_goal": torch.ones(4, 2)}, [4])
        >>> played = policy(seen)
        >>> played["action"].shape, bool((played["observation"] == 1).all())
        (torch.Size([4, 3]), True)
    """

    def __init__(self, actor: TensorDictModuleBase, norm: RunningNorm) -> None:
        super().__init__()
        reads, writes = ({unravel_key(key) for key in keys} for keys in (actor.in_keys, actor.out_keys))
        self._normalized = [key for key in norm.keys if key in reads]
        if not self._normalized:
            raise ValueError(f"the actor must read a normalized entry, {norm.keys}, got {actor.in_keys}")
        if both := [key for key in norm.keys if key in writes]:
            raise ValueError(f"the actor must not write normalized entries, got {both}")
        self.in_keys, self.out_keys = actor.in_keys, actor.out_keys
        self.actor, self.norm = actor, norm

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Runs the actor on normalized entries, and copies its outputs.

        Raises:
            KeyError: an entry that the actor reads normalized is missing.
        """
        normalized = tensordict.copy()
        for key in self._normalized:
            entry = entry_of(tensordict, key, by="normalization")
            normalized.set(key, self.norm.normalize(key, entry))
        return tensordict.update(self.actor(normalized).select(*self.out_keys, strict=False))
