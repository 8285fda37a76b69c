"""Videos of what a run has learned."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_her_envs.common.rendering.video import write_video
from torchrl_her_recipes.runs.film import FPS
from torchrl_her_recipes.runs.folder import RunFolder
from torchrl_her_recipes.runs.kept import KeptPolicy
from torchrl_her_recipes.runs.players import Player, actor_of, check_comparable, find_player, labels_of
from torchrl_her_recipes.runs.side_by_side import SideBySide

_HOLD = 25  # times that the last frame is repeated


def load_actor(folder: str | Path, *, run: int = 0, best: bool = False) -> TensorDictModuleBase:
    """The greedy policy that a run ended with, or its best one, as the run's own environments take it.

    Its continuous actions are from -1 to 1, and in a curriculum it reads the padded inputs of a layer.
    :func:`~torchrl_her_recipes.load_policy` gives the policy for the task itself.

    Args:
        folder: of the run, or ``policy.pt`` or ``best.pt`` in it.
        run: which one, if there are several side by side.
        best: whether to take the policy of the evaluation with the best median success.

    Raises:
        ValueError: this is no folder of a run, there is no such run, its policy is damaged, it has no best
            policy, or its task names a module that must not be imported.
        OSError: the run has not saved a policy yet.
    """
    kept = KeptPolicy.of(folder, best=best)
    if kept is None:
        home = RunFolder(folder)
        kept = KeptPolicy(home, home.policy)  # whose recipe says what is missing
    return actor_of(kept, run)


def play(
    source: str | Path,
    out: str | Path,
    *,
    run: int = 0,
    best: bool = False,
    goals: int = 6,
    seed: int = 0,
    size: int = 240,
) -> int:
    """Writes a video of a policy, for several goals side by side.

    Args:
        source: the folder of a run, ``policy.pt`` or ``best.pt`` in it, the .pt or .onnx file of an exported
            policy, or the name of a task whose policy comes with the package.
        out: a .gif or .mp4 file.
        run: which one, if there are several side by side in the folder.
        best: whether to take the best policy of the folder: that of the evaluation with the best median
            success.
        goals: how many.
        seed: of the goals and starts.
        size: pixels of one environment.

    Returns:
        How many of the goals were achieved.

    Raises:
        ValueError: there is neither such a run nor such a policy, ``best`` without the folder of a run,
            nothing of it can be drawn, or its task names a module that must not be imported.
        OSError: the run has not saved a policy yet.
    """
    with shown([source], goals=goals, seed=seed, size=size, run=run, best=best) as episodes:
        write_video(_film(episodes, seed), out, fps=FPS)
        return episodes.achieved[0]


def play_beside(
    sources: Sequence[str | Path],
    out: str | Path,
    *,
    run: int = 0,
    best: bool = False,
    goals: int = 6,
    seed: int = 0,
    size: int = 240,
) -> list[int]:
    """Writes a video of several policies beside each other, each with the same starts and goals.

    Args:
        sources: of the policies, as for :func:`play`; all of the same task.
        out: a .gif or .mp4 file.
        run: which one of the first folder, if there are several side by side in it.
        best: whether to take the best policy of the first folder.
        goals: how many.
        seed: of the goals and starts.
        size: pixels of one environment.

    Returns:
        How many of the goals each of them achieved.

    Raises:
        ValueError: as for :func:`play`, or the policies are not of the same task.
        OSError: a run has not saved a policy yet.
    """
    with shown(
        sources,
        goals=goals,
        seed=seed,
        size=size,
        run=run,
        best=best,
        named=True,
    ) as episodes:
        write_video(_film(episodes, seed), out, fps=FPS)
        return episodes.achieved


@contextmanager
def shown(
    sources: Sequence[str | Path],
    *,
    goals: int,
    seed: int,
    size: int,
    run: int,
    best: bool,
    named: bool = False,
) -> Iterator[SideBySide]:
    """Policies that are to be seen beside each other; their environments are closed in the end.

    Args:
        sources: of the policies.

    Keyword Args:
        goals: how many each of them has at a time.
        seed: of the goals and starts.
        size: pixels of one environment.
        run: which one of the first folder, if there are several side by side in it.
        best: whether to take the best policy of the first folder.
        named: whether names and successes stand below the pictures.

    Raises:
        ValueError: see :func:`play_beside`.
        OSError: a run has not saved a policy yet.
    """
    with ExitStack() as opened:
        players: list[Player] = []
        for source in sources:
            own = (0, False) if players else (run, best)
            player = find_player(source, goals=goals, seed=seed, run=own[0], best=own[1])
            opened.callback(player.close)
            players.append(player)
        check_comparable(players)
        labels = labels_of(players) if named else None
        yield SideBySide([player.episodes(size=size) for player in players], labels)


def _film(episodes: SideBySide, seed: int) -> list[Tensor]:
    """All frames of some episodes, the last one held for a while."""
    episodes.start(seed=seed)
    frames = [episodes.frame()]
    while episodes.running:
        episodes.step()
        frames.append(episodes.frame())
    return frames + frames[-1:] * _HOLD
