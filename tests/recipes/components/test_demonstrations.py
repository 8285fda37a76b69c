"""The demonstrations of a recipe: in batches, in stages, as starts, and over a stop."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict.nn import TensorDictModule

from torchrl_her.demonstrations import Demonstrations, MixedReplay, demonstrate
from torchrl_her.replay_buffers import rows_of_run, sizes_of
from torchrl_her.trainers import FusedLearner, LossLearner
from torchrl_her_envs import make_env
from torchrl_her_recipes import Components, build, record_demonstrations, run

from ..small import small


@pytest.fixture(scope="module", name="file")
def _file(tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("demonstrations") / "hand_v1.pt"
    record_demonstrations("hand_v1", path, episodes=6)
    return str(path)


def asked(file: str, **options: Any) -> dict[str, Any]:
    """Options of a recipe with four demonstrations."""
    own = {"file": file, "episodes": 4} | options
    return {"task": "hand_v1", **{f"demonstrations.{name}": value for name, value in own.items()}}


# Batches


def test_each_batch_has_its_share_of_them(file: str) -> None:
    components = build(small(**asked(file, share=0.25)))
    trainer = components.trainer()
    trainer.run(400)
    assert isinstance(trainer.buffer, MixedReplay)
    rows = trainer.buffer.sample(32 * 3).view(3, 32)
    assert rows["demonstration"].sum((1, 2)).tolist() == [8, 8, 8]
    recorded = Demonstrations.load(file).first(4)
    assert sizes_of(components.demonstrations.buffer) == [
        components.demonstrations.buffer.writer.counts.real
        + components.demonstrations.buffer.writer.counts.virtual
    ]
    assert components.demonstrations.buffer.writer.counts.real == len(recorded.rows)
    assert components.demonstrations.buffer.writer.filter_achieved  # as the run's own


@pytest.mark.parametrize(
    ("options", "learner"),
    [
        ({}, LossLearner),
        ({"learner": "td3"}, LossLearner),
        ({"learner": "sac"}, LossLearner),
        ({"learner": "tqc"}, LossLearner),
        ({"demonstrations.bc_weight": 0.0}, FusedLearner),
        ({"demonstrations.share": 0.0, "demonstrations.starts_share": 0.5}, FusedLearner),
    ],
)
def test_cloning_is_learned_without_compiled_steps(options: dict[str, Any], learner: type, file: str) -> None:
    components = build(small(**{**asked(file), **options}))
    assert (components.loss.terms.cloning is not None) is (learner is LossLearner)
    assert type(components.trainer().learner) is learner  # and nothing warns


def test_compiled_steps_cannot_be_asked_for(file: str) -> None:
    components = build(small(**asked(file), compile="always"))
    with pytest.raises(ValueError, match="compile=always is not supported here: behavior cloning"):
        components.trainer()


def test_they_are_normalized_with_all_other_rows(file: str) -> None:
    components = build(small(**asked(file), normalize=True))
    counted = components.norm.moments_of("observation").n
    assert counted.unique().tolist() == [len(components.demonstrations.buffer)]
    components.trainer().epoch()


def test_numbers_of_another_type(file: str) -> None:
    components = build(small(**asked(file), dtype="float64"))
    assert components.demonstrations.buffer.storage[:]["observation"].dtype == torch.float64
    components.trainer().epoch()


def test_another_threshold_rewards_them_anew(file: str) -> None:
    loose, usual = (
        build(small(**asked(file), **options)).demonstrations for options in ({"threshold": 0.6}, {})
    )
    assert int(loose.shown(0).lengths.sum()) < int(usual.shown(0).lengths.sum())
    assert loose.shown(0).achieved.all()


# Curricula


@pytest.mark.parametrize("every_stage", [False, True])
def test_where_stages_are_learned_at_once_they_are_written_for_the_task_or_for_all(
    file: str, every_stage: bool
) -> None:
    options = {"algo": "cher", "order": "all_at_once", "order.every_stage": every_stage, "k": 1}
    components = build(small(**{**asked(file), **options}, normalize=True))
    recorded = components.demonstrations.recorded
    rows, curriculum = rows_of_run(components.demonstrations.buffer, 0), components.curriculum.curriculum
    real, last = rows[~rows["virtual"].flatten()], len(curriculum) - 1
    state = torch.cat((recorded.rows["observation"], recorded.rows["desired_goal"]), -1)
    for stage in range(len(curriculum)):
        written = real[(real["stage"] == stage).flatten()]
        if every_stage or stage == last:
            assert (written["observation"] == curriculum.show(state, stage)[0]).all()
        else:
            assert len(written) == 0
    components.trainer().epoch()


def test_a_run_that_changes_its_stage_sees_them_in_the_new_one(file: str) -> None:
    components = build(small(**asked(file, starts_share=0.5), algo="cher", num_runs=2, normalize=True))
    shown, state = components.demonstrations, components.curriculum
    before = [rows_of_run(shown.buffer, own).clone() for own in range(2)]
    assert (before[0]["observation"][:, 5:] == 0).all()  # the ball is hidden
    state.progress.set_stage(1, 1)
    shown.enter_stage(1)
    after = [rows_of_run(shown.buffer, own) for own in range(2)]
    assert (after[0] == before[0]).all()
    assert (after[1]["observation"][:, 5:] != 0).any()
    real = after[1][~after[1]["virtual"].flatten()]
    recorded = Demonstrations.load(file).first(4).rows
    assert torch.equal(real["observation"], recorded["observation"])
    assert torch.equal(real["next", "reward"], recorded["next", "reward"])
    lengths = [own.lengths.tolist() for own in shown.starts._shown]
    assert lengths == [shown.shown(own).lengths.tolist() for own in range(2)]
    assert lengths[0] != lengths[1]


def test_a_curriculum_is_trained_with_them(file: str) -> None:
    components = build(
        small(
            **asked(file, starts_share=0.5), algo="cher", window=4, success_threshold=0.01, epochs=3, seed=5
        )
    )
    result = run(components, progress=False)
    assert {row["stage"] for row in result.rows} == {0, 1}
    assert (components.demonstrations.buffer.storage[:]["observation"][:, 5:] != 0).any()


# Starts


def test_episodes_start_at_them(file: str) -> None:
    components = build(small(**asked(file, starts_share=1.0, share=0.0)))
    components.collector.next()
    assert components.demonstrations.buffer is None
    starts = components.demonstrations.starts
    assert sum(len(own) for own in starts.walk.state_dict()["outcomes"]) > 0
    assert starts.walk.state_dict()["longest"] == [int(components.demonstrations.recorded.lengths.max())]
    rollout = components.eval_env.rollout(3)
    assert (rollout["observation"][:, 0, 7:9] == 0).all()  # evaluation starts as ever, with a ball at rest


# Runs side by side


def weights(components: Components, own: int) -> torch.Tensor:
    state = components.actor.state_dict().values()
    return torch.cat([value.chunk(components.recipe.run.num_runs)[own].flatten() for value in state])


@pytest.mark.parametrize(
    "options",
    [
        {"algo": "cher", "window": 4, "success_threshold": 0.01, "demonstrations.starts_share": 0.5},
        {"learner": "td3", "sampler": "uniform", "algo": "filtered_her_ibs"},
    ],
)
def test_each_run_follows_the_single_run_with_its_seed(options: dict[str, Any], file: str) -> None:
    own = {**asked(file), "dtype": "float64", **options}
    together = build(small(**own, num_runs=2, seed=5))
    run(together, progress=False)
    for number in range(2):
        alone = build(small(**own, seed=5 + number))
        run(alone, progress=False)
        torch.testing.assert_close(weights(together, number), weights(alone, 0), rtol=1e-4, atol=1e-6)
        rows, single = (
            rows_of_run(each.buffer, place)
            for each, place in ((together.demonstrations, number), (alone.demonstrations, 0))
        )
        torch.testing.assert_close(rows["desired_goal"], single["desired_goal"])


# Other tasks and other ways to collect


def test_discrete_actions_are_learned_from_without_cloning(tmp_path: Path) -> None:
    """DQN has rows and starts; the toy tasks can be started anywhere, too."""
    env = make_env("chain", num_envs=4, length=6)
    forward = TensorDictModule(
        lambda place: torch.ones(len(place), dtype=torch.int64), ["observation"], ["action"]
    )
    demonstrate(env, forward, max_steps=6, task="chain").save(tmp_path / "chain.pt")
    options = asked(str(tmp_path / "chain.pt"), starts_share=1.0) | {"task": "chain"}
    components = build(small(**options, **{"task.options.length": 6}))
    shown = components.demonstrations
    components.trainer().run(800)
    assert shown.recorded.achieved.all()
    assert shown.starts.walk.back == [6]  # all the way


@pytest.mark.full
def test_rows_are_learned_from_while_other_processes_collect(file: str) -> None:
    components = build(small(**asked(file), processes=2))
    trainer = components.trainer()
    try:
        trainer.run(800)
    finally:
        components.close()
    assert trainer.updates > 0


# What is refused


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"task": "hand_v0"}, r"hand_v1.pt holds demonstrations of hand_v1, not of hand_v0"),
        ({"demonstrations.episodes": 7}, "there are 6 demonstrations of hand_v1, 7 were asked for"),
        (
            {"demonstrations.file": "none.pt"},
            r"demonstrations.file=none.pt cannot be read \(no such file or directory\): `torchrl-her record "
            "hand_v1 --out none.pt` writes it",
        ),
    ],
)
def test_demonstrations_that_cannot_be_used(options: dict[str, Any], message: str, file: str) -> None:
    with pytest.raises(ValueError, match=message):
        build(small(**{**asked(file), **options}))


def test_demonstrations_of_a_task_with_other_options_are_refused(file: str, tmp_path: Path) -> None:
    own = Demonstrations.load(file)
    rows = own.rows.copy()
    wider = torch.cat((rows["observation"], rows["observation"]), -1)
    rows["observation"] = wider
    replace(own, rows=rows).save(tmp_path / "wide.pt")
    with pytest.raises(ValueError, match="with other options: 'observation' of width 18, not 9"):
        build(small(**asked(str(tmp_path / "wide.pt"))))


def test_demonstrations_lack_the_info_that_rewards_may_read(file: str, tmp_path: Path) -> None:
    task = "gym:tests.envs.gym.costly:tests/InfoCost-v0"
    replace(Demonstrations.load(file), task=task).save(tmp_path / "costly.pt")
    options = {"task": task, "task.options": {"info_keys": ["cost"], "achieved_reward": -0.5}}
    with pytest.raises(ValueError, match=r"read info \(task.options.info_keys\), which demonstrations"):
        build(small(**asked(str(tmp_path / "costly.pt")) | options))


def test_environments_that_cannot_be_started_anywhere_are_refused_by_name(tmp_path: Path) -> None:
    task, path = "gym:torchrl_her/HandThrow-v1", tmp_path / "gym.pt"
    record_demonstrations(task, path, episodes=2, policy="hand_v1", keep_all=True)
    options = asked(str(path), starts_share=0.5, episodes=2) | {"task": task}
    with pytest.raises(
        ValueError, match=r"starts_share=0.5 cannot be used with gym:torchrl_her/HandThrow-v1"
    ):
        build(small(**options))


# Learning


def test_a_few_demonstrations_teach_what_no_reward_has_taught_yet(tmp_path: Path) -> None:
    """320 gradient steps without hindsight, in three runs: the goal is hardly ever achieved by chance."""
    path = tmp_path / "hand_reach.pt"
    record_demonstrations("hand_reach", path, episodes=20)
    short: dict[str, Any] = {"task": "hand_reach", "algo": "no_hindsight", "num_runs": 3, "epochs": 1}
    short |= {"frames_per_update": 5.0, "batch_size": 64, "hidden": 32, "depth": 2, "episodes": 50}
    shown = asked(str(path), episodes=20, share=0.5, q_filter=False) | short
    successes = []
    for options in (short, shown):
        result = run(build(small(**options, ema_decay=0.0, compile="never")), progress=False)
        successes.append(sum(result.successes) / 3)
    without, with_demonstrations = successes
    assert without < 0.25
    assert with_demonstrations > 0.4


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"algo": "cher", "order": "all_at_once", "demonstrations.starts_share": 0.5},
            "starts_share=0.5 cannot be used where each episode has a stage of its own: .* order=threshold",
        ),
        (
            {"behavior": "mega", "demonstrations.starts_share": 0.5},
            "starts_share=0.5 has no effect with behavior=mega: leave it out",
        ),
    ],
)
def test_what_cannot_be_beside_them(file: str, options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        build(small(**{**asked(file), **options}))


def test_goals_are_proposed_beside_them(file: str) -> None:
    components = build(small(**asked(file), algo="her", behavior="uniform_achieved"))
    components.trainer().run(800)
    assert components.behavior.memory.sizes[0] > 0
