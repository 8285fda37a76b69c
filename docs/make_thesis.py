"""Makes the table of claims in docs/thesis.md from thesis_claims.yaml and the numbers in results/.

    python docs/make_thesis.py    # replaces the table; the rest of the page stays as it is

Numbers and intervals are those of the reports: interquartile means at the end of training and their
differences, with 95 % by stratified bootstrap.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from torchrl_her_recipes.config.study import Order
from torchrl_her_recipes.reports.bootstrap import REPETITIONS, Interval, bootstrap
from torchrl_her_recipes.reports.compare import (
    ALL_TASKS,
    Difference,
    Final,
    Judged,
    Verdict,
    compare,
    judge,
    values_of,
)
from torchrl_her_recipes.reports.formatting import show, show_gap, show_interval
from torchrl_her_recipes.reports.results import Combination
from torchrl_her_recipes.reports.tidy import Results, read_results
from torchrl_her_recipes.runs.scores import at_the_end

HERE = Path(__file__).parent
PAGE, CLAIMS, RESULTS = HERE / "thesis.md", HERE / "thesis_claims.yaml", HERE.parent / "results"
BEGIN, END = "<!-- The claims: python docs/make_thesis.py -->\n\n", "\n<!-- End of the claims. -->\n"

Finding = tuple[str, str]  # numbers of this project, verdict


@cache
def results(study: str) -> Results:
    """Stored results of a study."""
    return read_results(RESULTS / study)


@cache
def compared(study: str, measure: str) -> tuple[list[Final], list[Difference]]:
    """Levels and differences of a study, as in its report."""
    return compare(results(study).cells, measure, results(study).published)


def cell(study: str, task: str, algorithm: str) -> Combination:
    """One combination of a study."""
    return next(one for one in results(study).cells if (one.task, one.algorithm) == (task, algorithm))


def gap(first: Sequence[float], second: Sequence[float]) -> Interval:
    """Interquartile mean of the first runs minus that of the second."""
    return bootstrap([first, second], [[0], [1]], [(0, 1)])[1][0]


def rule(ends: Sequence[tuple[bool, bool]]) -> str:
    """Verdict on a claim, from whether its parts hold and whether they are reversed, by their intervals.

    Example:
        >>> rule([(True, False), (False, False)]), rule([(False, True)] * 2), rule([(False, False)])
        ('in part (1 of 2)', 'contradicted', 'undecided')
    """
    holding, reversed_ = (sum(column) for column in zip(*ends, strict=True))
    if holding == len(ends):
        return "reproduced"
    if reversed_ and holding:
        return f"in part ({holding} of {len(ends)}; {reversed_} contradicted)"
    if holding:
        return f"in part ({holding} of {len(ends)})"
    if reversed_:
        return "contradicted" + (f" ({reversed_} of {len(ends)})" if reversed_ < len(ends) else "")
    return "undecided"


def judged(study: str, measure: str, expected: Sequence[str]) -> list[Judged]:
    """Expected orders on each task, and those of success on all tasks."""
    read = [Order.parse(measure, text) for text in expected]
    return judge(results(study).cells, read, compared(study, measure)[1])


def rule_orders(rows: Sequence[Judged]) -> str:
    """Verdict on orders, each task by itself."""
    verdicts = [row.verdict for row in rows if row.task != ALL_TASKS]
    return rule([(one in (Verdict.APART, Verdict.HOLDS), one is Verdict.REVERSED) for one in verdicts])


def orders(study: str, *, measure: str, expected: Sequence[str]) -> Finding:
    """Difference between the two sides of each order; bold where the interval excludes 0."""
    rows, lines = judged(study, measure, expected), []
    for text in expected:
        found = [row for row in rows if row.order == text]
        shown = [_bold(show_gap(row), row.verdict is not Verdict.UNDECIDED) for row in found]
        tasks = [f"{_name(row.task)} {number}" for row, number in zip(found, shown, strict=True)]
        lines.append(f"`{text}`: {', '.join(tasks)}")
    return "; ".join(lines), rule_orders(rows)


def levels(
    study: str,
    *,
    measure: str,
    tasks: Sequence[str],
    algorithms: Sequence[str],
    least: float = -np.inf,
    most: float = np.inf,
    expected: Sequence[str] = (),
) -> Finding:
    """What each algorithm reached, beside the thesis's numbers; orders or bounds give the verdict."""
    found = {(row.task, row.algorithm): row for row in compared(study, measure)[0]}
    lines, ends = [], []
    for task in tasks:
        rows = [found[task, name] for name in algorithms]
        ends += [(least <= row.low and row.high <= most, row.high < least or row.low > most) for row in rows]
        shown = [f"`{row.algorithm}` {show_interval(row, measure)}{_published(row)}" for row in rows]
        lines.append(f"{_name(task)} {', '.join(shown)}")
    return "; ".join(lines), rule_orders(judged(study, measure, expected)) if expected else rule(ends)


def _published(row: Final) -> str:
    return "" if row.published is None else f" [thesis: {show(row.published, row.measure)}]"


def _name(task: str) -> str:
    return task if task == ALL_TASKS else f"`{task}`"


def _bold(text: str, bold: bool) -> str:
    return f"**{text}**" if bold else text


def _points(one: Interval) -> str:
    row = Difference("success", "", "", "", one.value, one.low, one.high, False)
    return _bold(show_gap(row), one.low > 0 or one.high < 0)


def over_training(study: str, *, tasks: Sequence[str], first: str, second: str) -> Finding:
    """Mean success of all evaluations, one algorithm minus another."""
    gaps = []
    for task in tasks:
        rows = [cell(study, task, name).rows for name in (first, second)]
        gaps.append(gap(*(at_the_end(one, "success", evaluations=len(one)) for one in rows)))
    shown = [f"`{task}` {_points(one)}" for task, one in zip(tasks, gaps, strict=True)]
    return f"`{first}` minus `{second}`: {', '.join(shown)}", rule(
        [(one.low > 0, one.high < 0) for one in gaps]
    )


def widths(study: str, *, tasks: Sequence[str], wide: str, narrow: str) -> Finding:
    """Points of success from the 33rd to the 67th percentile of runs, of two algorithms."""
    draw, lines, ends = np.random.default_rng(0), [], []
    for task in tasks:
        runs = [np.array(values_of(cell(study, task, name), "success")) for name in (wide, narrow)]
        before, after = (_width(drawn) for drawn in runs)
        drawn = [_width(draw.choice(one, (REPETITIONS, len(one)))) for one in runs]
        low, high = np.percentile(drawn[1] - drawn[0], [2.5, 97.5])
        lines.append(f"`{task}` {before:.1f} to {after:.1f} (difference {low:+.1f} to {high:+.1f})")
        ends.append((bool(high < 0), bool(low > 0)))
    return f"33rd to 67th percentile, points, `{wide}` to `{narrow}`: {', '.join(lines)}", rule(ends)


def _width(runs: np.ndarray) -> np.ndarray:
    low, high = np.percentile(runs, [33, 67], axis=-1)
    return 100 * (high - low)


def higher_without_filter(
    study: str, *, measure: str, tasks: Sequence[str], cases: Sequence[str], algorithms: Sequence[str] = ("",)
) -> Finding:
    """Number of evaluations in which the median of runs is higher without the filter.

    The two sides are called ``her`` and ``filtered_her``, with the end of an algorithm and of a case.
    """
    shown, higher, of = [], 0, 0
    for case in cases:
        ends = [f"her{algorithm}{case and '_'}{case}" for algorithm in algorithms]
        pairs = [
            [_medians(study, task, name, measure) for name in (end, f"filtered_{end}")]
            for task in tasks
            for end in ends
        ]
        above = np.concatenate([without > filtered for without, filtered in pairs])
        shown.append(f"{above.sum()} of {above.size}" + (f" (`{case}`)" if case else ""))
        higher, of = higher + int(above.sum()), of + above.size
    verdict = "reproduced" if higher > 0.9 * of else "contradicted" if higher < 0.5 * of else "not"
    return f"median higher without the filter in {', '.join(shown)} evaluations", verdict


def _medians(study: str, task: str, algorithm: str, measure: str) -> np.ndarray:
    values: dict[float, list[float]] = {}
    for row in cell(study, task, algorithm).rows:
        values.setdefault(row["epoch"], []).append(row[measure])
    return np.array([np.median(one) for one in values.values()])


def distances(study: str, *, tasks: Sequence[str], algorithm: str) -> Finding:
    """Median distance to the goal at the first evaluation and at the last."""
    shown, ends = [], []
    for task in tasks:
        medians = _medians(study, task, algorithm, "distance")
        shown.append(f"`{task}` {medians[0]:.2f} at first, {medians[-1]:.2f} at the end")
        ends.append((bool(medians[-1] >= 0.8 * medians[0]), bool(medians[-1] < 0.8 * medians[0])))
    return f"median of `{algorithm}`: {', '.join(shown)}", rule(ends)


def on_the_floor(study: str, *, task: str, cases: Sequence[str]) -> Finding:
    """Fraction of virtual goals in the lowest cells of the map, without the filter and with it."""
    shown, less = [], []
    for case in cases:
        maps = [cell(study, task, f"{name}_{case}").goals for name in ("her", "filtered_her")]
        without, filtered = (float(one.share[:, 0].sum()) for one in maps if one is not None)
        shown.append(f"{show(without, 'share')} to {show(filtered, 'share')} (`{case}`)")
        less.append((filtered < without / 2, filtered > without))
    return f"`{task}`, fraction of virtual goals in the lowest cells: {', '.join(shown)}", rule(less)


def words(_study: str, *, ours: str, verdict: str) -> Finding:
    """A finding that is written by hand."""
    return ours, verdict


FINDINGS: dict[str, Callable[..., Finding]] = {
    find.__name__: find
    for find in (
        orders,
        levels,
        over_training,
        widths,
        higher_without_filter,
        distances,
        on_the_floor,
        words,
    )
}


def made_by(study: str) -> str:
    """Number of runs, command and date of a study's numbers."""
    if not study:
        return ""
    about = yaml.safe_load((RESULTS / study / "about.yaml").read_text())
    runs = max(one.runs for one in results(study).cells)
    return (
        f"{runs} runs, `{about['command']}`, by the code of {about['date']} ([numbers](../results/{study}))"
    )


def line(*, section: str, claim: str, study: str = "", **finding: dict[str, Any]) -> str:
    """One line of the table."""
    ((name, options),) = finding.items()
    ours, verdict = FINDINGS[name](study, **options)
    return f"| {section} | {claim} | {ours} | {made_by(study)} | {verdict} |\n"


def claims() -> list[dict[str, Any]]:
    """Claims of the thesis, in its order; behind each of them the same claim by other agents (``also``)."""
    found = []
    for claim in yaml.safe_load(CLAIMS.read_text()):
        others = claim.pop("also", {})
        found += [
            claim,
            *({**claim, "claim": f"… {agent}", "study": study} for study, agent in others.items()),
        ]
    return found


def page(text: str) -> str:
    """The page with its table made again."""
    before, rest = text.split(BEGIN)
    head = "| section | the thesis | ours (95 % interval) | made by | verdict |\n" + "| --- " * 5 + "|\n"
    table = head + "".join(line(**claim) for claim in claims())
    return before + BEGIN + table + END + rest.split(END)[1]


if __name__ == "__main__":
    PAGE.write_text(page(PAGE.read_text()))
