"""A page that is written again whenever there is something new, while training goes on."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from torchrl_her.files.writing import write_text
from torchrl_her_recipes.config.study import Study
from torchrl_her_recipes.reports.best_film import film_best
from torchrl_her_recipes.reports.page import Live, describe, render
from torchrl_her_recipes.reports.runs import read_runs, read_study_so_far, runs_in, signature
from torchrl_her_recipes.reports.tidy import Results

_SHARE = 0.25  # of the time that drawing may take: training has a better use for the machine
_PAGE = "index.html"
_TRIES = 5  # in a row that may fail, as files are replaced while they are read


@dataclass(frozen=True)
class Followed:
    """Training that is followed.

    Args:
        folders: of its runs; asked again each time, as they appear one by one.
        read: what there is of it so far.
    """

    folders: Callable[[], Sequence[Path]]
    read: Callable[[], Results]

    @classmethod
    def runs(cls, folders: Sequence[Path]) -> Followed:
        """Some runs, or folders of them."""
        return cls(
            lambda: [path for folder in folders for path in runs_in(folder)], lambda: read_runs(folders)
        )

    @classmethod
    def study(cls, study: Study, folder: Path) -> Followed:
        """A study."""
        return cls(
            lambda: [folder / label for label, _ in study.cells()], lambda: read_study_so_far(study, folder)
        )


def follow(
    training: Followed,
    out: Path,
    *,
    every: float = 5.0,
    film: bool = True,
    say: Callable[[str], object] = str,
) -> Path:
    """Keeps a page up to date until the training is over, or somebody presses Ctrl-C.

    Args:
        training: that is followed; it may not have begun.
        out: where the page goes.

    Keyword Args:
        every: seconds between two looks at the files.
        film: whether to film the best policy of an unfinished run whenever there is a better one.
        say: called with the place of the page when there is one.

    Returns:
        The page, which does not renew itself any more.

    Raises:
        ValueError: ``every`` is not above 0, or there is something that cannot be read.
        OSError: the page cannot be written.
    """
    if not every > 0:
        raise ValueError(f"every must be above 0, got {every}")
    (out / "figures").mkdir(parents=True, exist_ok=True)
    described: dict[str, Any] | None = None
    seen, failed, version = None, 0, 0
    try:
        while True:
            began = time.monotonic()
            try:
                now = signature(training.folders())
                if now != seen:
                    results = training.read()
                    if film and not results.over:
                        best = film_best(training.folders(), out / "figures" / "best.gif")
                        results = replace(results, film=best or results.film)
                    described = describe(results, out)
                    version += 1
                    _write(described, out, Live(version=version, every=every, going=not results.over))
                    if seen is None:
                        say(str(out / _PAGE))
                    if results.over:
                        return out / _PAGE
                    seen, failed = now, 0
                _tell(out, version)
            except (OSError, ValueError):
                failed += 1
                if failed >= _TRIES or seen is None:
                    raise
            time.sleep(max(every, (time.monotonic() - began) * (1 / _SHARE - 1)))
    except KeyboardInterrupt:
        if described is not None:
            _write(described, out, Live(version=version + 1, every=every, going=False))
        return out / _PAGE


def _write(described: dict[str, Any], out: Path, live: Live) -> None:
    """Writes the page, and then says that it is there to those who look at an older one."""
    render(described, out, live=live)
    _tell(out, live.version)


def _tell(out: Path, version: int) -> None:
    """Says beside the page which version is the newest, and that somebody still looks."""
    newest = json.dumps({"version": version, "looked": int(time.time())})
    write_text(out / "live.js", f"window.torchrlHer({newest});\n")
