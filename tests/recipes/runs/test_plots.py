"""Points that are drawn over a picture of an environment lie where the picture shows them."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from torchrl_her_envs import TASKS, ThrowingEnv, make_env
from torchrl_her_recipes.runs.plots import COLORS, colors, draw_curve, draw_goals, plot_comparison

GOALS = [(0.627, 0.021), (-0.35, 0.4), (0.9, -0.7), (0.1, 0.85)]  # the first is the one of the bug report


def put(env: ThrowingEnv, goal: tuple[float, float]) -> None:
    """Moves what is at the goal: the black hole, or the ball where that is the goal."""
    state = env.world_state_dict()
    state["goal"][:] = torch.tensor(goal)
    if not env.task.throws:
        state["ball"][:] = (torch.tensor(goal) + 1) / 2 * env.world.size
    env.load_world_state_dict(state)


def drawn(env: ThrowingEnv, share: np.ndarray) -> tuple[Axes, np.ndarray]:
    """The axes, and all that they show [height, width, 3], the first row at the top."""
    figure = Figure(figsize=(6, 6), dpi=100)
    axes = figure.subplots()
    draw_goals(axes, share, env, limit=1.0)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return axes, np.asarray(canvas.buffer_rgba())[..., :3].astype(int)


def middle(axes: Axes, changed: np.ndarray) -> list[float]:
    """The middle of some pixels [height, width], in the coordinates of the axes."""
    rows, columns = changed.nonzero()
    height = changed.shape[0]
    pixel = (columns.min() + columns.max() + 1) / 2, height - (rows.min() + rows.max() + 1) / 2
    return axes.transData.inverted().transform(pixel).tolist()


@pytest.mark.parametrize("task", TASKS)
def test_what_is_at_the_goal_is_drawn_at_the_goal(task: str) -> None:
    env = make_env(task)
    env.reset()
    put(env, (-0.6, -0.6))
    axes, before = drawn(env, np.zeros((20, 20)))
    left, right = axes.get_xlim()
    for goal in GOALS:
        put(env, goal)
        _, after = drawn(env, np.zeros((20, 20)))
        changed = np.abs(after - before).sum(-1) > 120
        lower_left = axes.transData.transform((-0.2, -0.2))
        changed[-int(lower_left[1]) :, : int(lower_left[0])] = False  # where it was
        assert middle(axes, changed) == pytest.approx(goal, abs=0.01), goal
    assert (left, right) == (-1.0, 1.0)


def test_cells_of_the_heat_map_lie_over_the_picture_s_own_places() -> None:
    env = make_env("hand_v0")
    env.reset()
    share = np.zeros((20, 20))
    _, before = drawn(env, share)
    share[17, 4] = 1.0  # x from 0.7 to 0.8, y from -0.6 to -0.5
    axes, after = drawn(env, share)
    changed = np.abs(after - before).sum(-1) > 60
    assert middle(axes, changed) == pytest.approx((0.75, -0.55), abs=0.01)


def test_an_environment_without_a_scale_has_goals_on_white() -> None:
    class Blank(ThrowingEnv):
        def picture_box(self) -> None:  # type: ignore[override]
            return None

        def regions(self) -> dict:
            return {}

    axes, shown = drawn(Blank(TASKS["hand_v0"]), np.zeros((20, 20)))
    assert len(axes.images) == 1
    corner, other = (axes.transData.transform(point).astype(int) for point in ((-0.9, -0.9), (0.9, 0.9)))
    inside = shown[600 - other[1] : 600 - corner[1], corner[0] : other[0]]
    assert (inside == 255).all()


def test_goals_on_a_line_or_without_a_box_are_refused() -> None:
    with pytest.raises(
        ValueError, match="goals of chain cannot be drawn: goal_box.. must return a box of two"
    ):
        draw_goals(Figure().subplots(), np.zeros((20, 20)), make_env("chain"), limit=1.0)


@pytest.mark.parametrize("task", TASKS)
def test_the_edges_of_a_picture_are_those_that_the_environment_states(task: str) -> None:
    env = make_env(task)
    (left, bottom), (_, top) = env.picture_box()
    assert all(low < inner for low, inner in zip((left, bottom), env.goal_box()[0], strict=True))
    env.reset()
    picture = env.render(0, size=216)
    # The floor's upper edge, at -1, is a dark line; rows are counted from the top.
    dark = (picture[:, 3].int().sum(-1) < 400).nonzero().flatten().tolist()
    assert all(b - a == 1 for a, b in pairwise(dark))
    assert top - (top - bottom) * dark[0] / 216 == pytest.approx(-1.0, abs=0.01)


def test_no_two_lines_of_a_picture_have_one_color() -> None:
    """Up to as many lines as there are colors, with and without algorithms that have their own."""
    others = [f"case {number}" for number in range(6)]
    for labels in ([f"case {number}" for number in range(10)], [*others, "her_ibs"], ["cher", *others]):
        palette = colors(labels)
        assert list(palette) == labels
        assert len(set(palette.values())) == len(labels)
    assert colors([*COLORS, "case"])["case"] in COLORS.values()  # none is left: they begin again


def rows(runs: int) -> list[dict[str, float]]:
    return [
        {"run": run, "frames": 100.0 * epoch, "success": 0.1 * run % 1}
        for epoch in (1, 2, 3)
        for run in range(runs)
    ]


@pytest.mark.parametrize(("runs", "lines"), [(1, 1), (3, 4), (15, 16), (16, 1)])
def test_up_to_fifteen_runs_have_a_line_each_beneath_their_median(runs: int, lines: int) -> None:
    axes = Figure().subplots()
    draw_curve(axes, rows(runs), "success")
    assert len(axes.lines) == lines
    assert axes.lines[-1].get_linewidth() > 1 or runs == 1


def test_many_panels_are_in_several_rows(tmp_path: Path) -> None:
    plot_comparison({f"task {number}": {"her": rows(2)} for number in range(8)}, tmp_path / "many.png")
    with Image.open(tmp_path / "many.png") as picture:
        assert picture.width < 3 * picture.height
