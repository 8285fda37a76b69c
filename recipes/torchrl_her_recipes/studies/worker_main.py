"""Program of a worker process: runs the jobs that it reads from its standard input, one after the other.

If the input ends during a job, the process saves the run and ends. So it also stops if the process that
started it was killed.
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
    """Runs jobs from the standard input, and writes their outcomes to the standard output."""
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    logging.getLogger("torch.utils.cpp_extension").setLevel(logging.ERROR)
    try:
        with os.fdopen(os.dup(sys.stdout.fileno()), "wb") as answers:
            os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # prints must not mix with pickled outcomes
            _serve(answers)
    except BrokenPipeError:
        pass  # the process that started this one has ended, so nothing reads the outcomes


def _serve(answers: BinaryIO) -> None:
    jobs: SimpleQueue[dict[str, Any] | None] = SimpleQueue()
    working = False

    def stop(_number: int, _frame: FrameType | None) -> None:
        # Between jobs there is nothing to stop, and an error in garbage collection or at exit would keep
        # semaphores from being released.
        if working:
            raise KeyboardInterrupt

    signal.signal(signal.SIGINT, stop)
    Thread(target=_listen, args=(jobs,), daemon=True).start()
    for values in iter(jobs.get, None):
        try:
            working = True
            outcome = _run(values)
            working = False
        except KeyboardInterrupt:  # a signal just before the job began or just after it ended
            working = False
            outcome = Outcome(interrupted=True)
        pickle.dump(outcome, answers)
        answers.flush()
        gc.collect()  # frees the buffers of the run, gigabytes that are part of reference cycles


def _run(values: dict[str, Any]) -> Outcome:
    try:
        job = Job.from_plain(values)
    except Exception as error:  # modules of users may raise errors of any type when they are imported
        return Outcome(error=" ".join(f"{type(error).__name__}: {error}".split()))
    return run_job(job)


def _listen(jobs: SimpleQueue[dict[str, Any] | None]) -> None:
    try:
        while True:
            jobs.put(pickle.load(sys.stdin.buffer))
    except (EOFError, pickle.UnpicklingError):
        os.kill(os.getpid(), signal.SIGINT)  # after this signal, a running job saves its state and stops
        jobs.put(None)


if __name__ == "__main__":
    main()
