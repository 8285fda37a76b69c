"""Rules for relabeling episodes by the stage of a curriculum that each was played in."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from torchrl_her.goals.rewards import RewardFunction
from torchrl_her.randomness import Generators, RunDraws
from torchrl_her.replay_buffers.episodes import Episodes


class StageRule(NamedTuple):
    """Rule by which :class:`~torchrl_her.HERWriter` relabels the episodes of one stage.

    Attributes:
        reward_fn: maps (achieved, desired) goals to (reward, terminated).
        weighted: whether the weights of goals apply, and are updated with the goals that were written.
        view: converts transitions [n] of any stage to this one (:class:`~torchrl_her.curriculum.StageView`):
            episodes of other stages are then written for this stage, too. None to write only its own.
        share: share of the episodes of other stages that are written for this one, if it has a view.
    """

    reward_fn: RewardFunction
    weighted: bool = True
    view: Callable[[TensorDictBase], TensorDictBase] | None = None
    share: float = 1.0


def split_stages(
    rows: TensorDictBase,
    episodes: Episodes,
    run: Tensor | None,
    key: NestedKey,
    stages: Sequence[StageRule],
    generators: Generators,
) -> Iterator[tuple[int, TensorDictBase, Episodes, Tensor | None]]:
    """Yields for each stage its index, the transitions in its view, the episodes to write, and their runs.

    Args:
        rows: [n], transitions.
        episodes: positions of the episodes in ``rows``.
        run: [E] int64, the run of each episode; None if there is only one.
        key: key of the stage [n, 1].
        stages: rules of the stages; empty if episodes have none.
        generators: sources of the random numbers, one for each run, by which shares of episodes are drawn.

    Raises:
        KeyError: rows lack the key of their stage.
        ValueError: an episode's stage has no rule.
    """
    if not stages:
        yield 0, rows, episodes, run
        return
    if len(episodes.lengths) == 0:
        return
    stage = rows.get(key, None)
    if stage is None:
        raise KeyError(f"episodes of several stages need the entry {key!r}, got {list(rows.keys())}")
    episode_stages = stage.reshape(-1)[episodes.rows[:, 0]]
    least, most = int(episode_stages.min()), int(episode_stages.max())
    if least < 0 or most >= len(stages):
        raise ValueError(f"{key!r} must be in [0, {len(stages) - 1}], got {least if least < 0 else most}")
    for number, rule in enumerate(stages):
        which = episode_stages == number
        if rule.view is not None and rule.share == 1.0:
            which = torch.ones_like(which)
        elif rule.view is not None:
            draws = RunDraws(generators, run)((len(which), 1), torch.float32, which.device)
            which |= draws.squeeze(-1) < rule.share
        if bool(which.any()):
            part = Episodes(episodes.rows[which], episodes.lengths[which])
            shown = rows if rule.view is None else rule.view(rows)
            yield number, shown, part, None if run is None else run[which]
