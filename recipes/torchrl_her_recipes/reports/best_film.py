"""The film of the best policy of a run that goes on."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path

from torchrl_her_recipes.runs.play import play
from torchrl_her_recipes.studies.seed_batches import Batches

_GOALS, _SIZE = 6, 200


def film_best(folders: Sequence[Path], out: Path) -> tuple[Path, str] | None:
    """Films the best policy of the run that has found a better one last, if that is not filmed yet.

    Args:
        folders: of runs, some of which go on.
        out: the film.

    Returns:
        The film and what it shows; None if no run that goes on has a policy yet, or nothing can be drawn.
    """
    homes = [home for folder in folders for home in Batches(folder).homes if not home.policy.exists()]
    times = {home: home.best.stat().st_mtime for home in homes if home.best.exists()}
    if not times:
        return None
    newest = max(times, key=times.__getitem__)
    if not out.exists() or out.stat().st_mtime < times[newest]:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                play(newest.path, out, best=True, goals=_GOALS, size=_SIZE)
        except Exception:  # whatever a renderer raises: the page has its curves
            return None
    return out, f"The best policy of {newest.path.resolve().name} so far"
