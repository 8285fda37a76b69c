"""A worker process by itself: when it is told to stop, and what it says at its end."""

from __future__ import annotations

import pickle
import subprocess
import sys
from pathlib import Path

import pytest

from torchrl_her_recipes.studies.jobs import Job, Outcome

from ..small import small


@pytest.mark.long
def test_told_to_stop_between_two_jobs_it_ends_without_a_word(tmp_path: Path) -> None:
    """A Ctrl-C that strikes then would only keep it from giving back its semaphores."""
    recipe = small(task="hand_v0", epochs=1, algo="no_hindsight")
    job = Job(label="one", recipe=recipe, folder=tmp_path / "one")
    command = [sys.executable, "-P", "-m", "torchrl_her_recipes.studies.worker_main"]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as process:
        pickle.dump(job.to_plain(), process.stdin)
        process.stdin.flush()
        assert pickle.load(process.stdout) == Outcome()
        process.stdin.close()
        said = process.stderr.read()  # up to the end of all that it has started, too
    assert said == b""
    assert process.returncode == 0
