"""Grids and a target that tests of IBS share."""

from __future__ import annotations

from functools import partial

from torchrl_her import GoalGrid, box_target

LINE = GoalGrid(0.0, 3.0, [3])  # centers at 0.5, 1.5 and 2.5
SCREEN = GoalGrid((0.0, 0.0), (1.0, 1.0), (20, 20))
RIGHT = partial(box_target, SCREEN, (0.55, 0.2), (0.95, 0.8))
