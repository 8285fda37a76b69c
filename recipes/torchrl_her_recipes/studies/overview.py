"""How far the jobs of a plan are: a bar on a terminal, a few lines where the output goes elsewhere."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from tqdm import tqdm

from torchrl_her_recipes.studies.jobs import Job, Outcome
from torchrl_her_recipes.studies.plan import Plan, duration
from torchrl_her_recipes.studies.workers_local import Workers

_BAR = "{percentage:3.0f}%|{bar}| {n_fmt}/{total_fmt} steps [{elapsed}{postfix}]"
_STOPPING = "{percentage:3.0f}%|{bar}| {n_fmt}/{total_fmt} steps [saving what there is]"
_PART = 0.05  # of all steps: where there is no terminal, as much is worth a line


class Overview:
    """Shows how far the jobs of a plan are, on the standard error stream."""

    def __init__(self, plan: Plan, workers: Workers, *, show: bool) -> None:
        self.plan, self.workers = plan, workers
        self.lines = show and not sys.stderr.isatty()
        self.bar = tqdm(total=plan.steps, unit_scale=True, bar_format=_BAR, disable=not show or self.lines)
        self._said = self._share(self._done())

    def show(self, left: Sequence[Job]) -> None:
        """Brings plan and bar up to date."""
        working = self.workers.progress()
        self.plan.update(working)
        self.bar.n = done = self._done()
        to_go = duration(self.plan.wall_clock(left, self.workers.at_once))
        state = f"{len(working)} running, {len(left) - len(working)} waiting, about {to_go} to go"
        self.bar.set_postfix_str(state)
        share = self._share(done)
        if left and share >= self._said + _PART:
            self._said = share
            self._say(f"{share:.0%} of all steps: {state}")

    def ended(self, job: Job, outcome: Outcome) -> None:
        """Says that a job has ended, and how."""
        how = "failed" if outcome.error else "interrupted" if outcome.interrupted else "done"
        self._say(f"{job.label}: {how}")

    def stopping(self) -> None:
        """Says that all were told to stop."""
        self.bar.bar_format = _STOPPING
        self._say("saving what there is")

    def close(self) -> None:
        """Ends the bar."""
        self.bar.close()

    def _say(self, line: str) -> None:
        if self.lines:
            tqdm.write(line, file=sys.stderr)

    def _done(self) -> int:
        return self.plan.steps - self.plan.steps_to_go(self.plan.jobs)

    def _share(self, done: int) -> float:
        return done / max(self.plan.steps, 1)
