"""Makes ``images/gallery/NAME.gif``: each policy that comes with the package, in its task.

Run it as ``python docs/make_gallery.py``; it needs the extra ``robotics`` and panda-gym. The goals are the
first ones of one seed; none is chosen by hand.
"""

from __future__ import annotations

from pathlib import Path

from torchrl_her_envs import TASKS
from torchrl_her_recipes import play
from torchrl_her_recipes.config.shipped import policy_files

GALLERY = Path(__file__).parent / "images" / "gallery"
GOALS, GYM_GOALS = 4, 2  # episodes in a film; fewer of gymnasium's, whose pictures have shades
SIZE, SEED = 150, 0  # pixels of one of them, and of which seed
MOST_KB = 250  # of a film


def make_film(name: str) -> str:
    """Films one policy, and says how many of its goals it achieved."""
    path = GALLERY / f"{name}.gif"
    goals = GOALS if name in TASKS else GYM_GOALS
    ((achieved, _),) = play(name, out=path, goals=goals, size=SIZE, seed=SEED)
    size = path.stat().st_size / 1000
    if size > MOST_KB:
        raise SystemExit(f"{path.name} has {size:.0f} kB; {MOST_KB} are allowed: make it smaller")
    return f"{name}: {achieved} of {goals} goals achieved, {size:.0f} kB"


if __name__ == "__main__":
    for name in policy_files():
        print(make_film(name))
