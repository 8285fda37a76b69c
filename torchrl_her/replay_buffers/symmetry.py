"""Augments sampled transitions by the symmetries of a task: mirror images and shifts of the whole scene."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.envs import Transform

from torchrl_her.randomness import Generators, uniform


class Shift(NamedTuple):
    """Positions along one axis that can be moved together.

    Attributes:
        columns: columns of the state to which the same number is added.
        most: the number is drawn from ``-most`` to ``most``, in the unit of the columns.
    """

    columns: Sequence[int]
    most: float


@dataclass(frozen=True, kw_only=True)
class Symmetry:
    """How the state of a task can be changed so that the same actions still do the same.

    The state is the observation, followed by the desired goal.

    Args:
        mirror: the value at which each column is mirrored that differs in a mirror image: x becomes
            ``2 * value - x``.
        mirror_action: columns of the action whose sign differs in a mirror image.
        shifts: groups of columns that can be moved.

    Raises:
        ValueError: there is no symmetry, ``mirror`` is no mapping, a column is negative, or a number is not
            finite or not positive.

    Example:
        >>> Symmetry(mirror={0: 0.5}, mirror_action=[0]).mirror
        {0: 0.5}
    """

    mirror: Mapping[int, float] = field(default_factory=dict)
    mirror_action: Sequence[int] = ()
    shifts: Sequence[Shift] = ()

    def __post_init__(self) -> None:
        if not isinstance(self.mirror, Mapping):
            raise ValueError(f"mirror of a symmetry must be a value for each column, got {self.mirror!r}")
        if not self.mirror and not self.shifts:
            raise ValueError("a symmetry needs columns that are mirrored or shifted, got none")
        for each in (*self.columns, *self.mirror_action):
            if not isinstance(each, int) or each < 0:
                raise ValueError(f"columns of a symmetry must be whole numbers from 0 on, got {each!r}")
        for value in self.mirror.values():
            if not math.isfinite(value):
                raise ValueError(f"columns must be mirrored at finite values, got {value}")
        for shift in self.shifts:
            if not 0 < shift.most < math.inf:
                raise ValueError(f"most of a shift must be positive and finite, got {shift.most}")

    @property
    def columns(self) -> list[int]:
        """All columns of the state that are mirrored or shifted."""
        return [*self.mirror, *(each for shift in self.shifts for each in shift.columns)]

    def check(self, *, state: int, action: int) -> None:
        """Raises a ValueError if a column is not one of a state or an action of the given widths."""
        for name, columns, width in (("state", self.columns, state), ("action", self.mirror_action, action)):
            if columns and max(columns) >= width:
                raise ValueError(
                    f"the {name} has the columns 0 to {width - 1}, but the symmetry has {max(columns)}"
                )


class AugmentBatch(Transform):
    """Replaces the transitions that a replay buffer samples by equivalent ones, drawn anew each time.

    Half of the transitions are mirrored, and all are shifted. Rewards, ends and priorities stay as they are.
    Add it with ``buffer.append_transform`` before normalization. After Lin et al., Invariant Transform
    Experience Replay, 2020 (arXiv 1909.10707), who mirror whole episodes when they are stored.

    Args:
        symmetry: what can be changed.
        columns: for each entry that is changed, in the root and under ``next``, the column of the state that
            is in each of its places: [w], or [L, w] for L stages. Places of other columns, such as padding,
            have numbers from ``width`` on.
        width: width of the state.

    Keyword Args:
        actions: width of the action.
        stage: maps the transitions [n] to the stage of each, [n] int64; None if there is only one.
        generators: generators of R runs, whose transitions are R equal blocks; None for torch's own.
        action_key: key of the action.

    Raises:
        ValueError: the symmetry has columns that state or action do not have.

    Example:
        >>> from tensordict import TensorDict
        >>> cart = Symmetry(mirror={0: 0.0, 1: 0.0}, mirror_action=[0])  # position and goal on a line
        >>> augment = AugmentBatch(cart, {"observation": [0], "desired_goal": [1]}, 2, actions=1)
        >>> seen = {"observation": torch.ones(100, 1), "desired_goal": torch.full((100, 1), 2.0)}
        >>> rows = TensorDict({**seen, "action": torch.full((100, 1), 3.0), "next": {**seen}}, [100])
        >>> drawn = augment(rows)
        >>> sorted(drawn["observation"].unique().tolist())
        [-1.0, 1.0]
        >>> bool((drawn["action"] == 3 * drawn["observation"]).all())
        True
    """

    def __init__(
        self,
        symmetry: Symmetry,
        columns: Mapping[NestedKey, Sequence[int] | Tensor],
        width: int,
        *,
        actions: int,
        stage: Callable[[TensorDictBase], Tensor] | None = None,
        generators: Generators = (None,),
        action_key: NestedKey = "action",
    ) -> None:
        symmetry.check(state=width, action=actions)
        super().__init__(in_keys=[*columns, action_key], out_keys=[*columns, action_key])
        self.symmetry, self.stage, self.generators = symmetry, stage, list(generators)
        self.action_key, self.keys = action_key, list(columns)
        places = [torch.as_tensor(each) for each in columns.values()]
        # What is added to each column, by the mirror image and by each shift, and which columns are mirrored.
        added = torch.zeros(1 + len(symmetry.shifts), 1 + max(width - 1, *(int(p.max()) for p in places)))
        mirrored = torch.zeros(added.shape[1])
        for column, value in symmetry.mirror.items():
            mirrored[column], added[0, column] = 1, 2 * value
        for number, (shifted, most) in enumerate(symmetry.shifts, 1):
            added[number, list(shifted)] = most
        self._mirrored = [mirrored[each] for each in places]  # [w] or [L, w]
        self._added = [added[:, each].movedim(0, -2) for each in places]  # [1 + S, w] or [L, 1 + S, w]
        self._turned = torch.zeros(actions)
        self._turned[list(symmetry.mirror_action)] = 1

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Changes sampled transitions."""
        n, runs = tensordict.numel(), len(self.generators)
        place = None if self.generators[0] is None else self.generators[0].device
        draws = uniform([n // runs] * runs, self._added[0].shape[-2], self.generators, device=place)
        action = tensordict.get(self.action_key)
        draws = draws.to(action.device).view(*tensordict.shape, -1)
        mirror = (draws[..., :1] < (0.5 if self.symmetry.mirror else 0)).to(draws.dtype)
        drawn = torch.cat((mirror, 2 * draws[..., 1:] - 1), -1)
        stage = None if self.stage is None else self.stage(tensordict)
        for key, mirrored, added in zip(self.keys, self._mirrored, self._added, strict=True):
            mirrored, added = (each.to(action.device) for each in (mirrored, added))
            if stage is not None:
                mirrored, added = mirrored[stage], added[stage]
            sign, plus = 1 - 2 * mirror * mirrored, (drawn.unsqueeze(-2) @ added).squeeze(-2)
            for part in (tensordict, tensordict.get("next")):
                entry = part.get(key)
                part.set(key, (entry * sign + plus).to(entry.dtype))
        turned = self._turned.to(action.device, action.dtype)
        return tensordict.set(self.action_key, action * (1 - 2 * mirror.to(action.dtype) * turned))
