"""Rules for relabeling episodes that carry the layer of a curriculum in which they were played."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from torchrl_her.goals.rewards import RewardFunction
from torchrl_her.replay_buffers.episodes import Episodes


class LayerRule(NamedTuple):
    """Rule by which :class:`~torchrl_her.HERWriter` relabels the episodes of one layer.

    Attributes:
        reward_fn: maps (achieved, desired) goals to (reward, terminated).
        weighted: whether the weights of goals apply, and are updated with the goals that were written.
        view: shows transitions [n] of any layer as this one would have
            (:class:`~torchrl_her.curriculum.LayerView`): those of all episodes are then written for this
            layer. None for episodes that were played in it alone.
    """

    reward_fn: RewardFunction
    weighted: bool = True
    view: Callable[[TensorDictBase], TensorDictBase] | None = None


def split_layers(
    rows: TensorDictBase, episodes: Episodes, run: Tensor | None, key: NestedKey, layers: Sequence[LayerRule]
) -> Iterator[tuple[int, TensorDictBase, Episodes, Tensor | None]]:
    """Yields the transitions as each layer shows them, and its episodes, in the order in which they came.

    Args:
        rows: [n], transitions.
        episodes: positions among them.
        run: [E] int64, the run of each episode; None if there is only one.
        key: key of the layer [n, 1].
        layers: rules of the layers.

    Raises:
        KeyError: rows do not carry their layer.
        ValueError: there is no such layer.
    """
    if len(episodes.lengths) == 0:
        return
    layer = rows.get(key, None)
    if layer is None:
        raise KeyError(f"episodes of several layers need the entry {key!r}, got {list(rows.keys())}")
    episode_layers = layer.reshape(-1)[episodes.rows[:, 0]]
    least, most = int(episode_layers.min()), int(episode_layers.max())
    if least < 0 or most >= len(layers):
        raise ValueError(f"{key!r} must be in [0, {len(layers) - 1}], got {least if least < 0 else most}")
    for number, rule in enumerate(layers):
        which = episode_layers == number
        if rule.view is not None:
            yield number, rule.view(rows), episodes, run
        elif bool(which.any()):
            part = Episodes(episodes.rows[which], episodes.lengths[which])
            yield number, rows, part, None if run is None else run[which]


def check_layers(layers: Sequence[LayerRule] | None) -> list[LayerRule]:
    """Returns the rules of layers as a list; empty without layers.

    Raises:
        TypeError: one of them is no rule.
    """
    for rule in layers or ():
        if not isinstance(rule, LayerRule):
            raise TypeError(f"layers must be a list of LayerRule, got {rule!r} in it")
    return list(layers or ())
