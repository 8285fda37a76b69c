"""Makes ``images/gallery/TASK.gif``: each of the eleven tasks, played by the policy that comes with it.

Run it as ``python docs/make_gallery.py``; it needs nothing but the library. The goals are the first ones of
one seed; none is chosen by hand.
"""

from __future__ import annotations

from pathlib import Path

from torchrl_her_recipes import play
from torchrl_her_recipes.config.shipped import policy_names

GALLERY = Path(__file__).parent / "images" / "gallery"
GOALS, SIZE, SEED = 4, 150, 0  # episodes in a film, pixels of one of them, and of which seed
MOST_KB = 250  # of a film


def make_film(task: str) -> str:
    """Films one policy, and says how many of its goals it achieved."""
    path = GALLERY / f"{task}.gif"
    ((achieved, _),) = play(task, out=path, goals=GOALS, size=SIZE, seed=SEED)
    size = path.stat().st_size / 1000
    if size > MOST_KB:
        raise SystemExit(f"{path.name} has {size:.0f} kB; {MOST_KB} are allowed: make it smaller")
    return f"{task}: {achieved} of {GOALS} goals achieved, {size:.0f} kB"


if __name__ == "__main__":
    for name in policy_names():
        print(make_film(name))
