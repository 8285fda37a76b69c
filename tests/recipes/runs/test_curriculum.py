"""Runs that climb a curriculum: what changes with a stage, and what goes on."""

from __future__ import annotations

import re
from pathlib import Path

import pandas as pd
import pytest
import torch
from torch import Tensor
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

from torchrl_her import Instructiveness, enter_stage
from torchrl_her.replay_buffers import sizes_of
from torchrl_her_envs import TASKS, base_env, make_env
from torchrl_her_recipes import Components, Recipe, build, resume, run
from torchrl_her_recipes.cli import main
from torchrl_her_recipes.components.curricula import read_curriculum
from torchrl_her_recipes.runs.curriculum import move_on
from torchrl_her_recipes.runs.folder import RunFolder

from ..small import Refused, overrides, small

THROWS = [name for name, task in TASKS.items() if task.throws]


def climbing(**options: object) -> Recipe:
    return small(**{"task": "hand_v1", "algo": "cher_ibs", "window": 4, "epsilon_start": 1.0, **options})


def move(components: Components, *, run: int) -> list[str]:
    """Lets one run learn its stage."""
    samples = torch.zeros(components.recipe.run.num_runs, components.recipe.order.window)
    samples[run] = 1.0
    return move_on(components, components.curriculum, samples, 1_600)


def weights(components: Components) -> Tensor:
    return torch.cat([value.flatten() for value in components.actor.state_dict().values()])


def test_the_guide_s_file_of_stages_is_trained_with(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, refused: Refused
) -> None:
    guide = (Path(__file__).parents[3] / "docs" / "curriculum.md").read_text()
    (stages,) = re.findall(r"```yaml\n(# near.yaml\n.*?)```", guide, re.DOTALL)
    (command,) = re.findall(r"^torchrl-her (train .*curriculum=near.yaml.*)$", guide, re.MULTILINE)
    monkeypatch.chdir(tmp_path)
    Path("near.yaml").write_text(stages)
    given = {word.partition("=")[0] for word in command.split()}
    shrunk = [word for word in overrides(folder="out", epochs=1) if word.partition("=")[0] not in given]
    assert main([*command.split(), *shrunk]) == 0
    recipe, env = RunFolder("out").recipe(), make_env("hand_v1")
    near, *own = read_curriculum(recipe.curriculum.stages, env).stages
    assert own == list(read_curriculum(env.stages(), env).stages)
    assert (near.name, near.achieved_goal, near.threshold) == ("come near", (0, 1), 0.3)
    Path("near.yaml").unlink()  # the run has its stages
    assert main(["train", "--resume", "out", "epochs=2"]) == 0
    Path("near.yaml").write_text(stages.replace("observation: hand,", "observation: hands,"))
    assert refused("train", "task=hand_v1", "algo=cher", "curriculum=near.yaml") == (
        "torchrl-her: stage 'come near': observation has the unknown name 'hands'; known are 'hand', 'grip', "
        "'ball', 'ball_speed', 'hole', 'observation', 'desired_goal'\n"
    )


def test_stages_with_goals_of_one_and_of_two_numbers_train_together() -> None:
    """First the hand comes below or above the ball, then the ball into the hole; guided at each step."""
    goals = {"achieved_goal": [0], "desired_goal": [5], "threshold": 0.1}
    below = {"name": "below", "observation": "hand", **goals}
    _, throw = make_env("hand_v1").stages()
    order = {"order": "all_at_once", "every_stage": True, "task_share": 1.0}
    guided = {"guided_share": 1.0, "guided_per": "step"}
    components = build(small(task="hand_v1", algo="cher", curriculum=[below, throw], **order, **guided))
    result = run(components, progress=False)
    assert result.rows[-1]["rows_virtual"] > 0
    rows = components.buffer[:]
    first = rows[rows["stage"].squeeze(-1) == 0]
    assert len(first) > 0
    assert first["desired_goal"].any(0).tolist() == [True, False]
    near = (first["next", "observation"][:, 0] - first["desired_goal"][:, 0]).abs() < 0.1
    assert 0 < near.sum() < len(near)
    assert torch.equal(first["next", "reward"].squeeze(-1), near.float() - 1.0)
    components.close()


def test_a_small_share_of_the_episodes_trains_the_stages_below_the_last() -> None:
    order = {"order": "all_at_once", "every_stage": True, "task_share": 1.0, "lower_share": 0.25}
    components = build(small(task="hand_v1", algo="cher", **order))
    run(components, progress=False)
    rows = components.buffer[:]
    reach, throw = rows["stage"][~rows["virtual"]].bincount(minlength=2).tolist()
    assert 0.1 * throw < reach < 0.4 * throw
    components.close()


def test_a_goal_that_must_be_held_counts_at_the_end_of_its_stage_s_episodes() -> None:
    """All positions are near enough, so it is held from the first step on."""
    reach, throw = make_env("hand_v1").stages()
    held = {**reach, "threshold": 100.0, "terminates": False}
    components = build(small(task="hand_v1", algo="cher", curriculum=[held, throw], epochs=1))
    rows = run(components, progress=False).rows
    assert rows[0]["stage_success"] == 1.0
    lasting = components.env.rollout(30, break_when_any_done=False)["next"]
    assert (lasting["reward"] == 0).all()
    assert not lasting["terminated"].any()


def test_a_chain_is_climbed() -> None:
    options = {"length": 4, "stages": 2, "alternating": True}
    recipe = small(
        task="chain", options=options, algo="cher", epoch_frames=800, epochs=8, window=1, frames_per_update=4
    )
    rows = run(build(recipe), progress=False).rows
    assert rows[0]["stage"] == 0
    assert rows[-1]["stage"] == 1


def test_a_run_begins_with_the_reach_and_is_measured_at_the_full_task_too(tmp_path: Path) -> None:
    recipe = climbing(success_threshold=1.0, normalize=False)
    components = build(recipe)
    run(components, tmp_path / "run", progress=False)
    rows = pd.read_csv(tmp_path / "run" / "metrics.csv")
    assert rows["stage"].tolist() == [0, 0]
    assert {"success", "stage_success"} <= set(rows.columns)
    assert rows["kl"].isna().all()  # q* is that of the throw
    stored = components.buffer[:]
    assert (stored["observation"][:, 5:] == 0).all()  # of a reach: no ball is seen
    goals = stored["desired_goal"][~stored["virtual"].squeeze(-1)]
    assert (goals[:, 1] == goals[0, 1]).all()  # balls on the floor
    assert "state" not in stored
    assert torch.equal(
        stored["input"][:, :7], torch.cat((stored["observation"][:, :5], stored["desired_goal"]), -1)
    )


def test_inputs_that_the_reach_does_not_use_keep_their_weights() -> None:
    components = build(climbing(alpha_actor=0.1))
    before = [next(net.parameters()).clone() for net in (components.actor, components.critic)]
    run(components, progress=False)
    after = [next(net.parameters()) for net in (components.actor, components.critic)]
    for was, now in zip(before, after, strict=True):
        assert torch.equal(was[:, 7:], now[:, 7:])
        assert not torch.equal(was[:, :7], now[:, :7])
    assert (before[0][:, 7:] != 0).all()
    assert (before[1][:, 7:] == 0).all()


def test_a_change_of_stage_empties_and_restarts_one_run_alone() -> None:
    components = build(climbing(num_runs=2, success_threshold=1.0, window=30))
    run(components, progress=False)
    networks = weights(components)
    steps = [state["step"].tolist() for state in components.optimizer.state.values()]
    lines = move(components, run=1)
    assert lines == ["seed 1: 'reach' learned after 1,600 frames, 'throw' begins"]
    assert [size > 0 for size in sizes_of(components.buffer)] == [True, False]
    assert components.exploration.epsilon.tolist() == pytest.approx([0.81, 1.0], abs=1e-3)
    writer = components.buffer.writer
    assert writer.counts_of(0).real > 0
    assert writer.counts_of(1).real == 0
    first, second = writer.goal_weights
    assert isinstance(second, Instructiveness)
    assert (first.is_uniform, second.is_uniform) == (True, False)
    assert second.sigma == pytest.approx(3 * 0.4)
    assert first.sigma < second.sigma
    assert writer.reward_of(1) is writer.reward_fn  # the task's own
    assert writer.reward_of(0).threshold == pytest.approx(0.06)
    assert torch.equal(weights(components), networks)
    assert [state["step"].tolist() for state in components.optimizer.state.values()] == steps


def test_training_goes_on_in_two_stages_at_once() -> None:
    components = build(climbing(num_runs=2, success_threshold=1.0, normalize=False))
    trainer = components.trainer()
    trainer.epoch()
    move(components, run=1)
    trainer.epoch()
    reach, throw = components.buffer.sample(2 * 1_000).chunk(2)
    assert (reach["observation"][:, 5:] == 0).all()
    assert (throw["observation"][:, 5:7] != 0).any()
    assert torch.equal(throw["input"], torch.cat((throw["observation"], throw["desired_goal"]), -1))
    assert torch.isfinite(weights(components)).all()


def test_runs_are_guided_by_the_stage_that_they_have_learned() -> None:
    components = build(climbing(num_runs=2, guided_share=1.0, epsilon_start=0.0, epsilon_end=0.0))
    guide = components.guide
    trainer = components.trainer()
    trainer.epoch()
    learned = {name: value.clone() for name, value in components.greedy.state_dict().items()}
    move(components, run=1)
    assert guide.stage.tolist() == [-1, 0]
    for name, value in guide.module.state_dict().items():
        assert torch.equal(value.chunk(2)[1], learned[name].chunk(2)[1])
    rows = next(iter(components.collector))
    assert not {"state", "input", "is_init"} & set(components.buffer.storage[:].keys())
    assert (guide.guided.chunk(2)[0] == -1).all()
    assert (guide.guided.chunk(2)[1] == 0).any()
    greedy = components.actor(rows.select("input").clone())["action"]
    differs = (greedy != rows["action"]).any(-1).flatten(1).any(1).chunk(2)
    assert not differs[0].any()


def test_nobody_is_guided_unless_it_is_asked_for() -> None:
    assert build(climbing()).guide is None
    assert "is_init" not in build(climbing()).env.observation_spec.keys()


def test_environments_for_evaluation_show_the_full_task() -> None:
    components = build(climbing())
    shown = components.eval_env.reset()
    assert torch.equal(shown["desired_goal"], base_env(components.eval_env).worlds.goal.float())
    assert (shown["observation"][:, 5:7] != 0).any()


def test_checkpoints_hold_no_inputs(tmp_path: Path) -> None:
    components = build(climbing(epochs=1))
    run(components, tmp_path / "run", progress=False)
    stored = {str(key) for key in components.buffer.storage[:4].keys(True, True)}
    again = build(climbing(epochs=1))
    resume(tmp_path / "run", components=again, progress=False)
    assert {str(key) for key in again.buffer.storage[:4].keys(True, True)} == stored
    assert not any("input" in key for key in stored)


def test_a_buffer_that_does_not_relabel_is_refused() -> None:
    components = build(climbing())
    with pytest.raises(
        TypeError, match="a curriculum needs a buffer with a HERWriter, got a TensorDictRoundRobinWriter"
    ):
        enter_stage(
            TensorDictReplayBuffer(storage=LazyTensorStorage(4)), components.curriculum.progress.stage_of(0)
        )


def test_nothing_is_said_without_a_progress_bar(capsys: pytest.CaptureFixture[str]) -> None:
    run(build(climbing(success_threshold=0.01, episodes=30, window=30, compile="never")), progress=False)
    assert capsys.readouterr() == ("", "")
