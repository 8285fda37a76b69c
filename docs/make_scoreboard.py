"""Makes the tables and the figure of docs/scoreboard.md from the numbers in results/ and scoreboard.yaml.

python docs/make_scoreboard.py    # replaces the tables; the rest of the page stays as it is

It also draws the figure of FetchPush by the default agent, evaluation by evaluation.
"""

from __future__ import annotations

import csv
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import yaml

from torchrl_her_recipes.runs.plots import plot_comparison

HERE = Path(__file__).parent
PAGE, RESULTS = HERE / "scoreboard.md", HERE.parent / "results"
FIGURE, STAYING = HERE / "images" / "scoreboard.png", HERE / "images" / "staying.png"
BEGIN, END = "<!-- The {}: python docs/make_scoreboard.py -->\n\n", "\n<!-- End of the {}. -->\n"
LEVELS = (0.8, 0.9, 0.95)
FIRST_LOOK = 3_200  # random actions that find the curriculum before training: 64 episodes of 50 steps

Rows = list[dict[str, float]]


class Curves(NamedTuple):
    """Success of one method on one task, over environment steps.

    Attributes:
        method: name in the table.
        rows: evaluations of all runs, each the mean of the last ``window`` ones.
        episodes: number of episodes in such a mean.
    """

    method: str
    rows: Rows
    episodes: int


def read_curves(study: str, chosen: dict[str, str], method: str, window: int, episodes: int) -> Curves:
    """Curves of the rows of a table whose columns have the ``chosen`` entries."""
    runs: dict[int, list[tuple[float, float]]] = {}
    with open(RESULTS / study / "runs.csv") as file:
        for row in csv.DictReader(file):
            if all(row[name] == value for name, value in chosen.items()):
                runs.setdefault(int(row["seed"]), []).append((float(row["frames"]), float(row["success"])))
    rows = [
        {
            "run": run,
            "epoch": end,
            "frames": evaluations[end - 1][0],
            "success": sum(value for _, value in evaluations[end - window : end]) / window,
        }
        for run, evaluations in runs.items()
        for end in range(window, len(evaluations) + 1)
    ]
    # One of the published runs lacks an evaluation; only steps at which each run has one are drawn.
    number = Counter(row["frames"] for row in rows)
    return Curves(method, [row for row in rows if number[row["frames"]] == len(runs)], episodes * window)


def ours(case: str, method: str) -> Curves:
    """Curves of this project: evaluations of 100 episodes, in means of two.

    Steps count the random actions that find the curriculum, which a run's own frames leave out.
    """
    curves = read_curves("staying", {"case": case}, method, window=2, episodes=100)
    return curves._replace(rows=[{**row, "frames": row["frames"] + FIRST_LOOK} for row in curves.rows])


def theirs(method: str, task: str, name: str) -> Curves:
    """Curves that Relay-HER's authors published: evaluations of 10 episodes, in means of four."""
    return read_curves("relay_her", {"method": method, "task": task}, name, window=4, episodes=10)


def mirrored(task: str) -> Curves:
    """Runs that know the symmetries of a task."""
    return ours(f"symmetries of {task}", "default agent with symmetries")


def defaults(task: str) -> list[Curves]:
    """Runs of the default agent on a task: as it is now, and with its earlier decay of epsilon."""
    return [
        ours(f"default agent on {task}", "default agent"),
        ours(f"epsilon decays by 0.99 on {task}", "the same, `epsilon_decay=0.99`"),
    ]


def boards() -> dict[str, list[Curves]]:
    """Methods whose runs are known, by task."""
    return {
        "FetchPush": [
            *defaults("FetchPush"),
            ours("default agent, one stage after the other", "the same, one stage after the other"),
            mirrored("FetchPush"),
            theirs("RHER", "FetchPush", "Relay-HER"),
            theirs("DDPG+HER", "FetchPush", "DDPG and HER, by Relay-HER's authors"),
        ],
        "FetchPickAndPlace": [
            *defaults("FetchPickAndPlace"),
            ours(
                "default agent, one stage after the other, on FetchPickAndPlace",
                "one stage after the other, seeds 0 to 2",
            ),
            mirrored("FetchPickAndPlace"),
            theirs("RHER", "FetchPickAndPlace", "Relay-HER"),
            theirs("DDPG+HER", "FetchPickAndPlace", "DDPG and HER, by Relay-HER's authors"),
        ],
        "FetchSlide": [
            ours("TD3 of FetchSlide's stages and symmetries", "`preset=fetch_slide`, seeds 0, 100 and 101"),
            ours(
                "FetchSlide to 500,000 steps on an AMD EPYC",
                "`preset=fetch_slide epochs=100`, seed 100 on another machine",
            ),
            ours("default agent on FetchSlide", "default agent, `epsilon_decay=0.99`"),
        ],
        "PandaPush": defaults("PandaPush"),
        "PandaPickAndPlace": defaults("PandaPickAndPlace"),
        "PandaStack": [
            ours("two blocks on PandaStack in six stages", "`preset=panda_stack`, seeds 100 and 101")
        ],
    }


def steps_to(rows: Rows, level: float) -> list[float]:
    """Environment steps of each run until its mean is at a level; infinite if it never is."""
    runs = {row["run"]: [own for own in rows if own["run"] == row["run"]] for row in rows}.values()
    return [
        min((row["frames"] for row in run if row["success"] >= level - 1e-6), default=np.inf) for run in runs
    ]


def show_steps(steps: list[float], last: float) -> str:
    """Median and worst of steps to a level."""

    def show(number: float) -> str:
        return f"{number:,.0f}" if np.isfinite(number) else f"not by {last:,.0f}"

    return f"{show(float(np.median(steps)))} ({show(max(steps))})"


def steps_table() -> Iterator[str]:
    """Lines of the table of steps to a level."""
    yield "| task | method | runs | episodes in a mean | " + " | ".join(
        f"steps to {level:.0%}" for level in LEVELS
    )
    for task, board in boards().items():
        for curves in board:
            last = max(row["frames"] for row in curves.rows)
            levels = [show_steps(steps_to(curves.rows, level), last) for level in LEVELS]
            runs = len({row["run"] for row in curves.rows})
            yield f"| {task} | {curves.method} | {runs} | {curves.episodes} | " + " | ".join(levels)


def published_table() -> Iterator[str]:
    """Lines of the table of published figures."""
    yield "| task | method | steps | success, % | achieved at | source"
    for row in yaml.safe_load((HERE / "scoreboard.yaml").read_text()):
        yield "| " + " | ".join(
            row[name] for name in ("task", "method", "steps", "success", "rule", "source")
        )


def page(text: str) -> str:
    """The page with its tables made again."""
    for name, table in (("steps to a level", steps_table()), ("published figures", published_table())):
        head, *lines = table
        made = [head, "| --- " * (head.count("|") - 1) + "| ---", *lines]
        before, rest = text.split(BEGIN.format(name))
        text = before + BEGIN.format(name) + "".join(f"{line} |\n" for line in made)
        text += END.format(name) + rest.split(END.format(name))[1]
    return text


if __name__ == "__main__":
    PAGE.write_text(page(PAGE.read_text()))
    plot_comparison(
        {
            task: {curves.method.replace("`", ""): curves.rows for curves in board}
            for task, board in boards().items()
            if len(board) > 1  # a curve beside others
        },
        FIGURE,
    )
    cases = [
        read_curves("staying", {"case": case}, case, window=1, episodes=100)
        for case in ("default agent on FetchPush", "default agent, one stage after the other")
    ]
    plot_comparison(
        {"FetchPush, at the last step": {curves.method: curves.rows for curves in cases}}, STAYING
    )
