"""Processes that collect: each row is right, a seed repeats a run, runs go on, and nothing stays behind."""

from __future__ import annotations

import multiprocessing
import os
import re
import runpy
import signal
import sys
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_her import load_checkpoint
from torchrl_her_recipes import build, cli
from torchrl_her_recipes.components.collection.processes import ProcessCollector

from ....forks import fork
from ...small import overrides, small
from .collection_program import RUNS, SECONDS, results_of
from .tagged_task import LENGTH, wanted

EPOCHS, FRAMES, ENVS = 2, 180, 4  # of each run; 45 steps of each environment in an epoch
pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def together() -> dict[str, Any]:
    return results_of("sync", "several", "stopped")


@pytest.fixture(scope="module")
def apart() -> dict[str, Any]:
    return results_of("async", "weights", "normalized", "curriculum", "guided")


@pytest.fixture(scope="module")
def failures() -> dict[str, Any]:
    return results_of("breaks", "killed", "cannot start")


def audit(found: dict[str, Any], *, resets: int = EPOCHS) -> list[list[Tensor]]:
    """Looks at each row of each run; returns the tags [n, 4] of the real ones."""
    assert len(found["blocks"]) == resets
    every = [block for reset in found["blocks"] for run in reset for block in run]
    assert len(set(every)) == resets * RUNS * 2, "blocks cannot be told apart"
    real = []
    for run, rows in enumerate(found["rows"]):
        own = torch.tensor([block for reset in found["blocks"] for block in reset[run]])
        assert torch.isin(rows["observation"][:, 0].long(), own).all(), "of another run"
        real.append(audit_run(rows))
    return real


def audit_run(rows: TensorDictBase) -> Tensor:
    """Looks at each row of a run; returns the tags [n, 4] of the real ones."""
    now, after = rows["observation"], rows["next", "observation"]
    assert torch.equal(after[:, :3], now[:, :3])  # the same environment and episode, one step later
    assert torch.equal(after[:, 3], now[:, 3] + 1)
    assert torch.equal(after[:, 4:], rows["action"])
    block, place, episode, step = now[:, :4].unbind(-1)
    assert ((place >= 0) & (place < ENVS // 2)).all()
    assert ((step >= 0) & (step < LENGTH)).all()
    goal = rows["desired_goal"]
    assert torch.equal(rows["next", "desired_goal"], goal)
    real = (goal == wanted(block, place, episode)).all(-1)
    drawn = goal[~real]
    assert torch.equal(drawn[:, :3], now[~real, :3])  # virtual goals are of the same episode, and not past
    assert ((drawn[:, 3] > step[~real]) & (drawn[:, 3] <= LENGTH)).all()
    reached = (after[:, :4] - goal).abs().amax(-1) < 0.4
    assert torch.equal(rows["next", "reward"].flatten(), reached.float() - 1)
    assert torch.equal(rows["next", "terminated"].flatten(), reached)
    last = (step + 1 == LENGTH) & ~reached
    assert torch.equal(last | rows["next", "truncated"].flatten(), rows["next", "truncated"].flatten())
    return now[real, :4]


def each_once(tags: Tensor) -> dict[int, int]:
    """Transitions of each block of environments, none of which is there twice or missing in its episode."""
    assert len(tags.unique(dim=0)) == len(tags)
    steps = Counter(tuple(tag[:3]) for tag in tags.tolist())
    ends: dict[tuple[float, ...], float] = {}
    for *episode, step in tags.tolist():
        ends[tuple(episode)] = max(step, ends.get(tuple(episode), 0.0))
    assert all(steps[episode] == last + 1 for episode, last in ends.items())
    return dict(Counter(tags[:, 0].long().tolist()))


def test_all_rows_are_right_where_processes_collect_together(together: dict[str, Any]) -> None:
    for run, tags in enumerate(audit(together["sync"])):
        blocks = [block for reset in together["sync"]["blocks"] for block in reset[run]]
        assert together["sync"]["held"][run] == 0
        assert each_once(tags) == dict.fromkeys(blocks, FRAMES // 2)  # each process has half of the run's


def test_all_rows_are_right_where_each_process_goes_its_way(apart: dict[str, Any]) -> None:
    for run, tags in enumerate(audit(apart["async"])):
        shares = each_once(tags)
        # Episodes of the process whose batch was not the last one wait for the next epoch.
        waiting = apart["async"]["held"][run]
        assert waiting < ENVS // 2 * LENGTH
        assert sum(shares.values()) == EPOCHS * FRAMES - waiting
        begun, _ = apart["async"]["blocks"]
        assert sum(shares.get(block, 0) for block in begun[run]) == FRAMES


def test_several_gradient_steps_for_each_frame(together: dict[str, Any], apart: dict[str, Any]) -> None:
    for table, frames, loss in (
        (together["several"]["table"], [60], "loss_value"),
        (apart["async"]["table"], [FRAMES, 2 * FRAMES], "loss_qvalue"),
    ):
        assert [row["updates"] for row in table] == [2 * count for count in frames for _ in range(RUNS)]
        assert all(row[loss] > 0 for row in table)


def test_a_seed_repeats_a_run_also_if_it_stops_between_epochs(together: dict[str, Any]) -> None:
    resumed, _ = together["stopped"]
    assert together["sync"]["table"] == resumed["table"]
    assert together["sync"]["table"][-1]["updates"] == EPOCHS * FRAMES // 5
    for one, other in zip(together["sync"]["rows"], resumed["rows"], strict=True):
        assert (one == other).all()


def test_a_run_that_stopped_within_an_epoch_goes_on_with_new_episodes(together: dict[str, Any]) -> None:
    _, stopped = together["stopped"]
    assert stopped["table"][: EPOCHS * RUNS - RUNS] == together["sync"]["table"][:RUNS]  # its first epoch
    for run, tags in enumerate(audit(stopped, resets=EPOCHS + 1)):
        first, second, third = [reset[run] for reset in stopped["blocks"]]
        # 13 batches of 5 steps: 9 in the first epoch, 4 before the stop, 5 after it.
        steps = dict.fromkeys(first, 45) | dict.fromkeys(second, 20) | dict.fromkeys(third, 25)
        assert each_once(tags) == {block: ENVS // 2 * count for block, count in steps.items()}


def test_the_policy_is_one_batch_old(apart: dict[str, Any]) -> None:
    first, ahead, then, exploring = apart["weights"]["actions"]
    assert (first < -0.9).all()
    assert (ahead < -0.9).all()  # it was begun before the policy changed
    assert (then > 0.9).all()
    share = (exploring < 0.9).float().mean()  # epsilon 1: six tenths are uniform, a few noises are large
    assert 0.4 < share < 0.9


def test_statistics_of_normalized_inputs_reach_the_processes(apart: dict[str, Any]) -> None:
    for action, expected, before in apart["normalized"]["actions"]:
        torch.testing.assert_close(action, expected)
        assert not torch.allclose(action, before, atol=1e-3)


def test_stages_reach_the_processes(apart: dict[str, Any]) -> None:
    reach, throw = apart["curriculum"]["batches"]
    assert apart["curriculum"]["stages"] == [1, 1, 1, 1]
    assert (reach["observation"][..., 5:] == 0).all()  # the ball is not seen there, but wanted
    assert (throw["observation"][..., 5:] != 0).any()
    assert (reach["desired_goal"][..., 0] < 0).any()  # the ball lies in the left half
    assert (throw["desired_goal"][..., 0] > 0).all()


def test_processes_are_guided_by_what_a_run_has_learned(apart: dict[str, Any]) -> None:
    other, own = apart["guided"]["moved"]
    assert own.all()
    assert not other.any()


@pytest.mark.parametrize(
    ("name", "error"),
    [
        ("breaks", "a process that collects has failed, and all others were ended; the error of the process"),
        ("killed", "a process that collects has failed, and all others were ended; the error of the process"),
        ("cannot start", "RuntimeError('a process that collects cannot start: there is no display')"),
    ],
)
def test_where_one_fails_all_end(failures: dict[str, Any], name: str, error: str) -> None:
    assert error in failures[name]["error"]
    assert failures[name]["children"] == 0


def test_nothing_stays_behind(together: dict[str, Any]) -> None:
    assert all(found["children"] == 0 for found in (together["sync"], *together["stopped"]))


@pytest.mark.skipif(sys.platform != "linux", reason="/proc tells which processes there are")
def test_ctrl_c_ends_all_processes(tmp_path: Path) -> None:
    """The signal is for all of them, as a terminal sends it; they share no handlers, as for users."""
    folder = tmp_path / "run"
    program = fork(_train, tmp_path, overrides(processes=2, epochs=1_000, folder=str(folder)))
    try:
        _wait_for(lambda: (folder / "metrics.csv").exists())
        assert _running(program.pid) >= 3
        os.killpg(program.pid or 0, signal.SIGINT)
        program.join(SECONDS)
        assert program.exitcode == 130
    finally:
        program.kill()
    # The last one is Python's tracker of resources.
    _wait_for(lambda: _running(program.pid) == 0, seconds=20.0)
    saved = load_checkpoint(folder / "checkpoint.pt")
    assert saved["trainer"]["frames"] > 0


def _train(folder: Path, options: list[str]) -> None:
    os.chdir(folder)
    os.setsid()
    multiprocessing.set_start_method("forkserver", force=True)  # in this session, and imports torch once
    multiprocessing.set_forkserver_preload(["torchrl_her_recipes.components.collection.processes"])
    sys.exit(cli.main(["train", *options]))


def _running(session: int | None) -> int:
    """Number of processes of a session."""
    count = 0
    for path in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):  # it has ended meanwhile
            state, _, _, leader, *_ = path.read_text().rpartition(")")[2].split()
            count += state != "Z" and int(leader) == session
    return count


def _wait_for(condition: Callable[[], bool], *, seconds: float = SECONDS) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.1)


def test_nothing_starts_before_it_is_needed() -> None:
    components = build(small(processes=2))
    assert isinstance(components.collector, ProcessCollector)
    assert components.env.batch_size == torch.Size([1])
    assert components.collector._workers is None
    components.close()
    with pytest.raises(NotImplementedError, match="processes take their seeds from the recipe"):
        components.collector.set_seed(3)


def test_a_script_that_its_processes_would_run_again_is_refused(tmp_path: Path) -> None:
    script = tmp_path / "train.py"
    sizes = "processes=2, epochs=1, epoch_frames=80, num_envs=4, hidden=8, pictures=False"
    script.write_text(
        "from torchrl_her_recipes import build, make_recipe, run\n"
        f"run(build(make_recipe(task='hand_v0', {sizes})), progress=False)\n"
    )
    advice = "put the code that trains under `if __name__ == '__main__':`"
    message = f"processes=2 starts processes that import {script}: {advice}"
    with pytest.raises(RuntimeError, match=f"^{re.escape(message)}$"):
        runpy.run_path(str(script), run_name="__main__")
