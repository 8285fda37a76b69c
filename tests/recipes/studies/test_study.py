"""Studies and sweeps: what they run, that they go on where they stopped, and what they refuse."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
import yaml
from filelock import FileLock
from PIL import Image

from torchrl_her_recipes.cli import main
from torchrl_her_recipes.config.recipe import Recipe
from torchrl_her_recipes.config.study import Study, study_names
from torchrl_her_recipes.runs.folder import RunFolder
from torchrl_her_recipes.studies.jobs import Job, Outcome
from torchrl_her_recipes.studies.seed_batches import Batches
from torchrl_her_recipes.studies.study import StudyResult, draw_study, plan_study, run_study, unfinished_sweep

from ..small import SMALL, Refused, overrides, small
from .forked_worker import fork_workers
from .here import Here
from .test_schedule import Actors


class Writers(Actors):
    """Play workers that leave finished runs behind, of a success that is their seed divided by ten."""

    def __init__(self, *broken: str) -> None:
        super().__init__()
        self.broken, self.did = broken, []  # type: tuple[str, ...], list[str]

    def run(self, job: Job) -> Outcome:
        self.did.append(job.label)
        if job.label in self.broken:
            return Outcome(error="why")
        home = RunFolder(job.folder)
        home.create()
        home.describe(job.recipe)
        seed, epoch = job.recipe.run.seed, job.recipe.run.epochs
        counters = {"run": 0, "seed": seed, "epoch": epoch, "frames": 9, "seconds": 1.0}
        home.write_table([{**counters, "success": seed / 10}])
        home.policy.touch()
        return Outcome()


def runs(*seeds: int) -> dict[str, Recipe]:
    return {f"seed_{seed}": small(seed=seed) for seed in seeds}


def test_a_study_of_ones_own_says_what_is_to_do_goes_on_after_a_failure_and_draws(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path, folder = tmp_path / "mine.yaml", tmp_path / "runs"
    vary = {"algo": ["her", "filtered_her"]}
    path.write_text(yaml.safe_dump({"recipe": {**SMALL, "task": "hand_v0"}, "vary": vary}))
    command = ["study", str(path), f"folder={folder}", "--jobs", "1"]
    assert main([*command, "--plan"]) == 0
    said = capsys.readouterr().out
    assert "2 batched runs to go, 1,920 environment steps in all" in said
    assert "her/seeds_0           to do                        960 steps to go\n" in said
    assert not folder.exists()

    fork_workers(monkeypatch)
    folder.mkdir()
    (folder / "her").write_text("in the way")
    assert main(command) == 1
    said, failed = capsys.readouterr()
    assert "torchrl-her: her/seeds_0 failed: NotADirectoryError: " in failed
    assert "the same command resumes it" in said

    (folder / "her").unlink()
    assert main(command) == 0
    said = capsys.readouterr().out
    assert "1 batched runs to go, 960 environment steps in all" in said
    assert re.search(r"^her: success \d+%$", said, re.MULTILINE)
    with Image.open(folder / "mine.png") as picture:
        assert min(picture.size) > 200

    metrics = [folder / name / "seeds_0" / "metrics.csv" for name in vary["algo"]]
    before = [file.stat().st_mtime_ns for file in metrics]
    assert main(command) == 0
    assert "0 batched runs to go, 0 environment steps" in capsys.readouterr().out
    assert [file.stat().st_mtime_ns for file in metrics] == before


@pytest.mark.full
def test_a_whole_study_ends_without_a_word(tmp_path: Path) -> None:
    values = {"recipe": {**SMALL, "task": "hand_v0", "epochs": 1}, "vary": {"algo": ["her", "no_hindsight"]}}
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump(values))
    command = [sys.executable, "-P", "-m", "torchrl_her_recipes", "study", "mine.yaml", "--jobs", "2"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    said = [line for line in re.split(r"[\r\n]+", done.stderr) if line.strip()]
    progress = r"\w+/seeds_0: done|\d+% of all steps: .*"
    assert [line for line in said if not re.fullmatch(progress, line)] == []


def test_a_study_draws_the_metrics_asked_for(tmp_path: Path) -> None:
    metrics = Study(
        name="metrics",
        recipe={**SMALL, "task": "treasure_hunt", "options": {"step": 25}, "epochs": 1},
        vary={"algo": ["her"]},
        figure=["success", "distance"],
    )
    run_study(metrics, tmp_path / "b", workers=Here(), progress=False)
    with Image.open(tmp_path / "b" / "metrics.png") as picture:
        assert picture.size[0] > 2 * picture.size[1]
    draw_study(replace(metrics, figure="success"), tmp_path / "b")
    with Image.open(tmp_path / "b" / "metrics.png") as picture:
        assert picture.size[0] < 2 * picture.size[1]
    with pytest.raises(ValueError, match="these runs did not measure virtual_success; they have run, seed"):
        draw_study(replace(metrics, figure="virtual_success"), tmp_path / "b")


def test_the_guide_s_study_is_planned_as_it_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    guide = (Path(__file__).parents[3] / "docs" / "studies.md").read_text()
    mine, cases, expected = re.findall(r"```yaml\n(.*?)```", guide, re.DOTALL)
    monkeypatch.chdir(tmp_path)
    Path("mine.yaml").write_text(mine)
    assert main(["study", "mine.yaml", "--plan", "--jobs", "2"]) == 0
    first, *lines, last = capsys.readouterr().out.splitlines()
    assert len(lines) == 6
    for line in (first, lines[0], last):
        assert line in guide
    Path("parts.yaml").write_text(f"vary: {{task: [hand_v1]}}\n{cases}")
    assert main(["study", "parts.yaml", "--plan"]) == 0
    assert "hand_v1_no_filter" in capsys.readouterr().out
    Path("expected.yaml").write_text(f"vary: {{task: [hand_v0, hand_v1], algo: [her, her_ibs]}}\n{expected}")
    assert main(["study", "expected.yaml", "--plan"]) == 0


def test_a_combination_that_was_cut_short_goes_on(tmp_path: Path) -> None:
    short = Study(name="cut", recipe={**SMALL, "epochs": 1}, vary={"algo": ["her"]})
    run_study(short, str(tmp_path), workers=Here(), progress=False)
    (home,) = Batches(tmp_path / "her").homes
    home.config.write_text(home.config.read_text().replace("epochs: 1", "epochs: 2"))
    assert not Batches(tmp_path / "her").is_done
    whole = Study(name="cut", recipe={**SMALL, "epochs": 2}, vary={"algo": ["her"]})
    result = run_study(whole, tmp_path, workers=Here(), progress=False)
    assert result == StudyResult(figure=tmp_path / "cut.png", successes={"her": [home.rows()[-1]["success"]]})
    assert Batches(tmp_path / "her").is_done
    assert [row["epoch"] for row in home.rows()] == [1, 2]


def test_one_process_at_a_time_is_at_work_in_a_folder(tmp_path: Path) -> None:
    study = Study(name="one", recipe=SMALL, vary={"algo": ["her"]})
    with (
        FileLock(tmp_path / ".lock"),
        pytest.raises(ValueError, match=f"another process is running a study in {tmp_path}"),
    ):
        run_study(study, tmp_path, workers=Here(), progress=False)


def test_without_ray_its_name_and_the_remedy_are_given(
    monkeypatch: pytest.MonkeyPatch, refused: Refused
) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    said = refused("study", study_names()[0], "--plan", "--ray", "auto")
    assert said == "torchrl-her: --ray needs Ray: pip install '.[cluster]'\n"


def test_what_is_done_is_skipped_and_what_failed_is_tried_again(tmp_path: Path) -> None:
    folder = tmp_path / "sweep"
    first, second = Writers("seed_2"), Writers()
    result = run_study(runs(1, 2, 3), folder, workers=first, progress=False)
    assert result.successes == {"seed_1": [0.1], "seed_3": [0.3]}
    assert result.failed == {"seed_2": "why"}
    assert sorted(first.did) == ["seed_1", "seed_2", "seed_3"]
    assert unfinished_sweep(runs(1, 2, 3), tmp_path) == folder
    assert unfinished_sweep(runs(1, 2), tmp_path) is None  # that is another sweep
    result = run_study(runs(1, 2, 3), folder, workers=second, progress=False)
    assert result.successes == {"seed_1": [0.1], "seed_2": [0.2], "seed_3": [0.3]}
    assert second.did == ["seed_2"]
    assert unfinished_sweep(runs(1, 2, 3), tmp_path) is None  # all is done


def test_a_folder_with_other_runs_or_in_use_is_refused(tmp_path: Path) -> None:
    run_study(runs(1), tmp_path, workers=Writers(), progress=False)
    with pytest.raises(ValueError, match="seed_1 holds a run with other options; choose another folder"):
        plan_study({"seed_1": small(seed=1, epochs=3)}, tmp_path)
    (tmp_path / "seed_1" / "config.yaml").write_text("epochs: [")  # the power failed
    (tmp_path / "seed_1" / "metrics.csv").unlink()
    plan_study(runs(1), tmp_path)
    with (
        FileLock(tmp_path / ".lock"),
        pytest.raises(ValueError, match="another process is running a sweep in"),
    ):
        run_study(runs(1), tmp_path, workers=Writers(), progress=False)


def test_the_same_command_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    command = ["train", "-m", "task=hand_v0", "algo=her", "seed=1,2", *overrides()]
    made = [Writers("hand_v0_her_s2_1"), Writers(), Writers()]
    workers = iter(made)
    monkeypatch.setattr("torchrl_her_recipes.make_workers", lambda jobs: next(workers), raising=False)
    assert main(command) == 1
    said, errors = capsys.readouterr()
    (folder,) = Path("runs").iterdir()
    assert said.splitlines()[0] == f"sweep: 2 of 2 runs to go: {folder}"
    assert f"torchrl-her: {folder}/hand_v0_her_s2_1 failed: why" in errors.splitlines()
    assert said.splitlines()[-1] == "the whole sweep: success 10%; 1 of 2 did not end"
    assert main(command) == 0
    said = capsys.readouterr().out
    assert said.splitlines()[0] == f"sweep: 1 of 2 runs to go: {folder}"
    assert "  hand_v0_her_s1_0  done" in said.splitlines()
    assert "hand_v0_her_s1_0: success 10%" in said.splitlines()
    assert made[1].did == ["hand_v0_her_s2_1"]
    time.sleep(1.0)  # folders are named by the second
    assert main(command) == 0  # a new one: the other is done
    assert made[2].did == ["hand_v0_her_s1_0", "hand_v0_her_s2_1"]
    assert len(list(Path("runs").iterdir())) == 2


def test_jobs_needs_a_sweep(refused: Refused) -> None:
    assert refused("train", "--jobs", "2") == "torchrl-her: --jobs is for a sweep: give -m as well\n"


@pytest.mark.full
def test_ctrl_c_saves_all_runs_and_ends_all_processes(tmp_path: Path) -> None:
    options = overrides(epochs=100_000, folder="sweep", compile="never")
    program = [sys.executable, "-m", "torchrl_her_recipes"]
    command = [*program, "train", "-m", "--jobs", "2", "seed=1,2", *options]
    before = 0
    for _ in range(2):
        with open(tmp_path / "said", "w") as said:
            process = subprocess.Popen(command, cwd=tmp_path, stdout=said, stderr=said)
            deadline = time.monotonic() + 200
            while epochs(tmp_path) <= before:
                assert process.poll() is None
                assert time.monotonic() < deadline
                time.sleep(0.1)
            workers = children(process.pid)
            process.send_signal(signal.SIGINT)
            assert process.wait(100) == 130
        assert len(workers) == 2
        assert not [pid for pid in workers if Path(f"/proc/{pid}").exists()]
        lines = (tmp_path / "said").read_text().splitlines()
        assert lines[-1] == "interrupted: the same command resumes it"
        assert "hand_v0_s1_0: interrupted" in lines
        assert bool(before) == any(f"at epoch {before} of 100000" in line for line in lines)
        before = epochs(tmp_path)


def epochs(folder: Path) -> int:
    """How many epochs the slower run has done."""
    tables = [RunFolder(path).rows() for path in (folder / "sweep").glob("hand*")]
    return min((len(rows) for rows in tables), default=0) if len(tables) == 2 else 0


def children(pid: int) -> list[int]:
    """Its worker processes."""
    listed = subprocess.run(
        ["pgrep", "-P", str(pid), "-f", "worker_main"], capture_output=True, text=True, check=False
    )
    return [int(line) for line in listed.stdout.split()]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nothing"], "there is no study 'nothing'; the studies are bias, "),
        (["ibs", "--seeds", "0"], "Invalid value for '--seeds': 0 is not in the range x>=1"),
        (["ibs", "--frames", "-5"], "Invalid value for '--frames': -5 is not in the range x>=1"),
        (
            ["recipes: {}"],
            "unknown recipes; a study has preset, summary, recipe, vary, cases, for_task, figure",
        ),
        ([""], "mine.yaml cannot be read: it must hold names and values, got None"),
        (["vary: {algo: ["], "mine.yaml cannot be read: line 1: while parsing"),
        (["vary: {learning_rate: [1e-3, fast]}"], "learning_rate must be a number, got 'fast'"),
        (["vary: {1: [2]}"], "options of mine must be names, got 1"),
        (["vary: {algo: [her]}\nrecipe: {1: 2}"], "options of mine must be names, got 1"),
        (["vary: {task.options: [{a: 1}, 3]}"], "hand_v0 takes no option 'a'"),
        (["vary: {task.options: [3]}"], "task.options must be a mapping of options by name, got 3"),
    ],
)
def test_bad_input_is_one_clear_line(
    arguments: list[str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, refused: Refused
) -> None:
    monkeypatch.chdir(tmp_path)
    if arguments[0] not in ("nothing", "ibs"):  # the text of a study of one's own
        Path("mine.yaml").write_text(arguments[0])
        arguments = ["mine.yaml"]
    assert message in refused("study", *arguments)
