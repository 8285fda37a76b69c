"""Play workers that do jobs in the process of the tests."""

from __future__ import annotations

from threading import Lock

from torchrl_her_recipes.studies.jobs import Job, Outcome, Progress, run_job


class Here:
    """Does jobs in this process, one after the other: TorchRL's exploration type is that of all threads."""

    at_once = 1

    def __init__(self) -> None:
        self._place = Lock()

    def run(self, job: Job) -> Outcome:
        with self._place:
            return run_job(job)

    def progress(self) -> dict[str, Progress]:
        return {}

    def stop(self) -> None: ...

    def close(self) -> None: ...
