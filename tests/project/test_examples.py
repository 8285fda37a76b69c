"""The guide to curricula: its Python runs, the messages it quotes are real, its example works."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from types import ModuleType

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.data import LazyTensorStorage, ReplayBuffer, TensorDictReplayBuffer
from torchrl.envs import SerialEnv, TransformedEnv

from torchrl_her import Curriculum, CurriculumProgress, CurriculumStage, StateToObs, ZeroPad, make_actor
from torchrl_her.replay_buffers import rows_of_run, sizes_of

from .pages import DOCS, ROOT, blocks, run_page, script

GUIDE = (DOCS / "curriculum.md").read_text()


@pytest.fixture(scope="module")
def example() -> ModuleType:
    return script("docs/examples/own_curriculum.py")


def test_the_one_file_moves_from_reaching_to_throwing() -> None:
    path = "recipes/one_file_cher.py"
    assert len((ROOT / path).read_text().splitlines()) <= 250
    cher = script(path)
    results = list(cher.train(cher.Options(epochs=2, episodes=20)))
    assert [result.frames for result in results] == [10_240, 20_480]
    assert (results[0].stage, results[-1].stage) == ("reach", "throw")
    assert results[0].success >= 0.9


def test_the_guide_s_python_runs_from_top_to_bottom() -> None:
    run_page("curriculum.md", 7)


def test_the_guide_s_stages_are_the_example_s(example: ModuleType) -> None:
    names: dict[str, object] = {}
    exec(blocks("curriculum.md")[0], names)
    assert (names["drive"], names["deliver"]) == (example.DRIVE, example.DELIVER)
    assert names["names"] == example.NAMES


def test_the_example_s_episodes_end_at_the_stage_s_goal_and_at_the_time_limit_only(
    example: ModuleType,
) -> None:
    progress = CurriculumProgress(Curriculum([example.DRIVE, example.DELIVER], 4, names=example.NAMES))
    env = example.make_env(2, progress, seed=0)

    # Without acceleration the car rolls back and forth in the valley, where there is no parcel.
    roll = TensorDictModule(lambda state: torch.zeros(len(state), 1), in_keys=["state"], out_keys=["action"])
    rolled = env.rollout(example.STEPS, roll)["next"]
    assert rolled["truncated"][:, -1].all()
    assert rolled["truncated"].sum() == 2
    assert not rolled["terminated"].any()
    assert torch.equal(rolled["desired_goal"], rolled["state"][..., 2:3])

    swing = TensorDictModule(  # accelerate in the direction of motion
        lambda state: torch.where(state[:, 1:2] > 0, 1.0, -1.0), in_keys=["state"], out_keys=["action"]
    )
    there = env.rollout(example.STEPS, swing, break_when_any_done=False)["next"]
    first = there["terminated"].int().argmax(1).flatten()
    for lane, step in enumerate(first.tolist()):
        assert there["terminated"][lane, step]
        assert not there["truncated"][lane, step]
        assert there["reward"][lane, : step + 1].flatten().tolist() == [-1.0] * step + [0.0]
    progress.set_stage(0, 1)
    carried = env.rollout(example.STEPS, swing)["next"]
    assert torch.equal(carried["desired_goal"], carried["state"][..., 3:4])
    assert torch.equal(carried["achieved_goal"], carried["state"][..., 2:3])
    assert carried["terminated"][:, -1].any()  # the car carried the parcel to its place


def test_the_example_trains_each_run_in_its_stage_and_moves_on(
    example: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    ended: list[tuple[TensorDict, CurriculumStage]] = []  # stored transitions, and the next stage
    moved: list[tuple[ReplayBuffer, int]] = []  # the buffer of all runs, and a run that began a stage
    enter_stage = example.enter_stage

    def spy(buffer: ReplayBuffer, stage: CurriculumStage, *args: object, run: int) -> None:
        ended.append((rows_of_run(buffer, run).clone(), stage))
        enter_stage(buffer, stage, *args, run=run)
        assert sizes_of(buffer)[run] == 0
        moved.append((buffer, run))

    monkeypatch.setattr(example, "enter_stage", spy)
    easy = replace(example.DRIVE, threshold=0.6)  # the parcel is 0.27 to 0.84 away
    small = {"epochs": 3, "epoch_frames": 300, "num_envs": 2, "runs": 2, "window": 2}
    rows = list(example.train([easy, example.DELIVER], success_threshold=0.5, **small))
    assert [frames for frames, _, _ in rows] == [300, 600, 900]
    assert all(0.0 <= share <= 1.0 for _, _, shares in rows for share in shares)
    first = {run: [names[run] for _, names, _ in rows] for run in range(2)}
    assert [names[0] for names in first.values()] == ["drive", "drive"]
    assert "deliver" in [names[-1] for names in first.values()]
    assert len(ended) == len(moved) >= 1
    for stored, stage in ended:
        assert stage.name == "deliver"
        check_rows(stored, easy.threshold, low=-0.95, high=-0.6)
    # The others changed stage after the last epoch.
    begun = [rows_of_run(buffer, run) for buffer, run in moved if sizes_of(buffer)[run] > 0]
    assert begun
    for rows_of_stage in begun:
        check_rows(rows_of_stage, example.DELIVER.threshold, low=0.4, high=0.8)


def check_rows(rows: TensorDict, threshold: float, *, low: float, high: float) -> None:
    """Real rows want the stage's goals, virtual ones what was achieved; rewards fit its threshold."""
    assert "state" not in rows.keys()
    virtual = rows["virtual"].squeeze(-1)
    wanted, got = rows["next", "desired_goal"], rows["next", "achieved_goal"]
    assert torch.equal(wanted, rows["desired_goal"])
    assert wanted[~virtual].numel() > 0
    assert wanted[~virtual].min() >= low - 1e-6
    assert wanted[~virtual].max() <= high + 1e-6
    near: Tensor = (wanted - got).square() < threshold**2
    assert torch.equal(rows["next", "reward"], near.float() - 1.0)
    assert torch.equal(rows["next", "terminated"], near)
    assert torch.isin(wanted[virtual], got).all()


def stored_without_input() -> ReplayBuffer:
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(8), batch_size=5)
    rows = {"observation": torch.zeros(5, 3), "desired_goal": torch.zeros(5, 1)}
    buffer.extend(TensorDict(rows, [5]))
    return buffer


MISTAKES: dict[str, tuple[type[Exception], Callable[[ModuleType, Curriculum], object]]] = {
    "desired_goal must share no index": (
        ValueError,
        lambda own, _: CurriculumStage(
            name="drive", observation=[0, 1, 2], achieved_goal=[0], desired_goal=[2], threshold=0.1
        ),
    ),
    "achieved_goal has 2 entries": (
        ValueError,
        lambda own, _: Curriculum(
            [replace(own.DRIVE, achieved_goal=[0, 1], desired_goal=[2, 3]), own.DELIVER], 4, names=own.NAMES
        ),
    ),
    "StateToObs needs the observation": (
        KeyError,
        lambda own, curriculum: (
            TransformedEnv(
                SerialEnv(2, own.make_single_env), StateToObs(curriculum, CurriculumProgress(curriculum))
            ).specs
        ),
    ),
    "the first dimension of a batch": (
        ValueError,
        lambda own, curriculum: (
            stored_without_input()
            .append_transform(ZeroPad(curriculum, CurriculumProgress(curriculum, runs=2)))
            .sample()
        ),
    ),
    "StateToObs is for environments": (
        RuntimeError,
        lambda own, curriculum: (
            stored_without_input()
            .append_transform(StateToObs(curriculum, CurriculumProgress(curriculum)))
            .sample()
        ),
    ),
    "the following inputs are None": (
        KeyError,
        lambda own, _: make_actor([4], 1, in_keys=["input"])(stored_without_input().sample()),
    ),
}


@pytest.mark.parametrize("start", MISTAKES)
def test_the_guide_quotes_messages_as_they_are(example: ModuleType, start: str) -> None:
    quoted = [message for message in re.findall(r"^\| `(.*?)` ", GUIDE, re.MULTILINE) if start in message]
    assert len(quoted) == 1
    error, mistake = MISTAKES[start]
    curriculum = Curriculum([example.DRIVE, example.DELIVER], 4, names=example.NAMES)
    with pytest.raises(error, match=re.escape(quoted[0])):
        mistake(example, curriculum)
