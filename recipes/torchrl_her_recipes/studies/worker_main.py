"""Worker process: runs the jobs from its standard input, one after the other, until the input ends.

If the input ends in the middle of a job, the process saves the run and ends. So it also stops if the
process that started it is gone.
"""

from __future__ import annotations

import gc
import logging
import os
import pickle
import signal
import sys
from queue import SimpleQueue
from threading import Thread
from types import FrameType
from typing import Any, BinaryIO

from torchrl_her_recipes.studies.jobs import Job, Outcome, run_job


def main() -> None:
    """Runs the process."""
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    logging.getLogger("torch.utils.cpp_extension").setLevel(logging.ERROR)
    try:
        with os.fdopen(os.dup(sys.stdout.fileno()), "wb") as answers:
            os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # keeps other output out of the outcomes
            _serve(answers)
    except BrokenPipeError:
        pass  # the process that started this one is gone


def _serve(answers: BinaryIO) -> None:
    jobs: SimpleQueue[dict[str, Any] | None] = SimpleQueue()
    working = False

    def stop(_number: int, _frame: FrameType | None) -> None:
        # Between jobs there is nothing to stop, and an error in the garbage collection or at exit would only
        # prevent the release of semaphores.
        if working:
            raise KeyboardInterrupt

    signal.signal(signal.SIGINT, stop)
    Thread(target=_listen, args=(jobs,), daemon=True).start()
    for values in iter(jobs.get, None):
        try:
            working = True
            outcome = _run(values)
            working = False
        except KeyboardInterrupt:  # a stop before the job began, or just after it ended
            working = False
            outcome = Outcome(interrupted=True)
        pickle.dump(outcome, answers)
        answers.flush()
        gc.collect()  # the buffers of a run are gigabytes, and its components refer to each other


def _run(values: dict[str, Any]) -> Outcome:
    try:
        job = Job.from_plain(values)
    except Exception as error:  # a user's module may raise any error
        return Outcome(error=" ".join(f"{type(error).__name__}: {error}".split()))
    return run_job(job)


def _listen(jobs: SimpleQueue[dict[str, Any] | None]) -> None:
    try:
        while True:
            jobs.put(pickle.load(sys.stdin.buffer))
    except (EOFError, pickle.UnpicklingError):
        os.kill(os.getpid(), signal.SIGINT)  # a run stops at a good moment by itself
        jobs.put(None)


if __name__ == "__main__":
    main()
