"""Policies as files: exported from runs, and those that come with the package."""

from __future__ import annotations

import copy
import sys
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from tensordict import TensorDict

from torchrl_her import evaluate, success
from torchrl_her_envs import TASKS, make_env
from torchrl_her_recipes import build, export_policy, load_policy, run
from torchrl_her_recipes.cli import main
from torchrl_her_recipes.components.curricula import make_played_env
from torchrl_her_recipes.components.envs import TaskEnvs
from torchrl_her_recipes.config.shipped import policy_files
from torchrl_her_recipes.policies import policy
from torchrl_her_recipes.policies.network import ScaledActions
from torchrl_her_recipes.runs.policy_file import read_policy, write_policy

from ...envs.gym.walk import Walk
from ..small import Refused, small
from .tiny import LEARNERS, needs_onnx, states, tiny_policy

_GYM = ("fetch_push", "fetch_pick_and_place", "fetch_slide", "shadow_hand_reach")
_PANDA = ("panda_push", "panda_pick_and_place", "panda_slide", "panda_stack")
OTHERS = dict.fromkeys(_GYM, "") | dict.fromkeys(_PANDA, "panda_gym")  # and modules that they need


def backwards() -> list[dict[str, Any]]:
    """A stage of hand_v1 that sees its observation from the end, and not all of it."""
    (*_, last) = make_env("hand_v1", num_envs=1).stages()
    observation = last["observation"][:0:-1]
    return [last | {"observation": observation}]


@pytest.mark.parametrize(
    "options",
    [
        {"algo": "filtered_her"},
        {"algo": "cher"},
        {"algo": "her", "normalize": True},
        {"algo": "cher", "normalize": True},
        {"algo": "cher", "curriculum": backwards()},
        {"algo": "cher", "curriculum": backwards(), "normalize": True},
        {"algo": "cher", "order": "all_at_once", "relay": True},
        {"algo": "cher", "order": "all_at_once", "relay": True, "normalize": True},
        {"algo": "cher", "curriculum": backwards(), "order": "all_at_once", "relay": True},
        pytest.param({"algo": "her", "learner": "td3"}, marks=pytest.mark.full),
        {"algo": "filtered_her", "learner": "sac", "normalize": True},
        pytest.param({"algo": "cher", "learner": "tqc"}, marks=pytest.mark.full),
        {"algo": "her", "task": "bit_flip"},
    ],
    ids=lambda options: "_".join(options),
)
def test_an_exported_policy_acts_as_its_run_does(options: dict[str, Any], tmp_path: Path) -> None:
    recipe = small(**{"task": "hand_v1", "num_runs": 2, "epochs": 1, "hidden": 8, **options})
    components = build(recipe)
    run(components, tmp_path / "run", progress=False)
    written = export_policy(tmp_path / "run", tmp_path / "policy.safetensors", run=1)
    assert written.recipe.run.seed == 1
    assert written.info.frames == 480
    seen = make_env(recipe.task.name, num_envs=4, seed=7).reset()
    shown = make_played_env(TaskEnvs.of(recipe), 4, [7]).reset()
    played = components.player(torch.cat((shown, shown)))["action"][4:]  # of the second of two runs
    for own in (load_policy(tmp_path / "run", run=1), load_policy(tmp_path / "policy.safetensors"), written):
        acted = own(seen.clone())
        torch.testing.assert_close(acted["action"], played)
        assert {*acted.keys()} == {*seen.keys(), "action"}


def test_export_takes_the_median_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "run"
    run(build(small(num_runs=3, epochs=1)), folder, progress=False)
    lines = (folder / "metrics.csv").read_text().splitlines()
    place = lines[0].split(",").index("success")
    for index, value in enumerate(("0.5", "0.9", "0.1")):
        cells = lines[index + 1].split(",")
        cells[place] = value
        lines[index + 1] = ",".join(cells)
    (folder / "metrics.csv").write_text("\n".join(lines) + "\n")
    assert main(["export", str(folder)]) == 0
    said = capsys.readouterr().out
    assert said.startswith("seed 0, success ")
    assert said.endswith(f" on hand_v0: {folder / 'hand_v0.safetensors'}\n")


def test_what_cannot_be_exported_is_said(tmp_path: Path) -> None:
    other = tmp_path / "other"
    run(build(small(task="hand_v0", epochs=1)), other, progress=False)
    with pytest.raises(
        ValueError, match="a policy of hand_v0 cannot play robot_v0: the policy has observation"
    ):
        export_policy(other, tmp_path / "policy.safetensors", task="robot_v0")
    with pytest.raises(ValueError, match="unknown task 'nope'"):
        export_policy(other, tmp_path / "policy.safetensors", task="nope")
    with pytest.raises(ValueError, match="there is no run 4 in .*; it has runs 0 to 0"):
        export_policy(other, tmp_path / "policy.safetensors", run=4)
    _, weights = read_policy(other / "policy.safetensors")
    write_policy(other / "policy.safetensors", {"own": weights.popitem()[1]}, {})
    with pytest.raises(
        ValueError, match=r"other/policy.safetensors cannot be read: these are not the weights"
    ):
        export_policy(other, tmp_path / "policy.safetensors")
    assert list(tmp_path.iterdir()) == [other]
    with pytest.raises(ValueError, match=r"hand_v9 is neither .* did you mean hand_v\d\? The trained"):
        load_policy("hand_v9")


def test_every_task_has_a_trained_policy() -> None:
    assert set(policy_files()) == {*TASKS, *OTHERS}


@pytest.mark.parametrize("name", OTHERS)
def test_policies_of_other_packages_tasks_are_found_by_the_task_and_stay_at_its_goals(name: str) -> None:
    """20 other episodes, with five standard deviations of room."""
    policy = load_policy(name)
    assert load_policy(policy.info.task).info == policy.info
    said = policy.info.success
    assert said > {"fetch_slide": 0.75, "shadow_hand_reach": 0.85}.get(name, 0.9)
    if OTHERS[name] and find_spec(OTHERS[name]) is None:
        pytest.skip(f"needs {OTHERS[name]}")
    at_last, at_some = policy.measure(20, seed=99)
    assert said - 5 * (said * (1 - said) / 20) ** 0.5 <= at_last <= at_some


@pytest.mark.parametrize("task", TASKS)
def test_trained_policies_are_as_good_as_they_say(task: str) -> None:
    """300 other episodes; five standard deviations of room."""
    trained = load_policy(task)
    assert (trained.info.task, trained.info.learner) == (task, "ddpg")
    env = make_env(task, num_envs=300, seed=99)
    measured = float(success(evaluate(env, trained, max_steps=env.max_steps)).float().mean())
    assert measured > trained.info.success - 5 * 0.029
    assert measured > 0.3
    assert trained.info.success > 0.5


def test_a_task_is_played_at_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], refused: Refused
) -> None:
    out = tmp_path / "hand_v1.gif"
    assert main(["play", "hand_v1", "--out", str(out), "--goals", "2", "--size", "64"]) == 0
    assert out.stat().st_size > 1_000
    assert "of 2 goals achieved" in capsys.readouterr().out
    assert "nor the file of an exported policy, nor one of the trained policies" in refused("play", "hand_v9")


def test_what_export_wrote_is_played(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], refused: Refused
) -> None:
    monkeypatch.chdir(tmp_path)
    run(build(small(task="hand_v0", epochs=1, pictures=True)), "run", progress=False)
    assert main(["export", "run", "--out", "mine.safetensors"]) == 0
    assert main(["play", "mine.safetensors", "--goals", "2", "--size", "64", "--seed", "3"]) == 0
    alone = capsys.readouterr().out.splitlines()[-1]
    assert alone.endswith(" of 2 goals achieved: mine.gif")
    assert main(["play", "run", "--goals", "2", "--size", "64", "--seed", "3"]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == alone.replace("mine.gif", "run/play.gif")
    assert Path("mine.gif").read_bytes() == Path("run/play.gif").read_bytes()
    filmed = Path("run/policy.gif").read_bytes()
    assert main(["play", "run/policy.safetensors", "--goals", "2", "--size", "64", "--seed", "3"]) == 0
    assert Path("mine.gif").read_bytes() == Path("run/play.gif").read_bytes()
    assert Path("run/policy.gif").read_bytes() == filmed
    Path("moved.safetensors").write_bytes(Path("run/policy.safetensors").read_bytes())
    Path("notes.safetensors").write_text("not a policy")
    for name, why in (
        (
            "run/checkpoint.pt",
            "does not end with .safetensors and cannot be loaded: `torchrl-her export RUN`",
        ),
        ("moved.safetensors", "is not an exported policy: `torchrl-her export RUN` writes one"),
        ("notes.safetensors", "cannot be read: its header must have at most 4,194,304 bytes, got"),
    ):
        assert refused("play", name).startswith(f"torchrl-her: {name} {why}")
    said = "a policy's file must end with .safetensors or .onnx, got 'mine.pt'"
    assert said in refused("export", "run", "--out", "mine.pt")


@needs_onnx
def test_on_the_command_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], refused: Refused
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["export", "hand_reach", "--format", "onnx"]) == 0
    assert capsys.readouterr().out == "seed 1, success 100% on hand_reach: hand_reach.onnx\n"
    assert "`hand_reach`" in Path("hand_reach.md").read_text()
    assert main(["export", "hand_reach", "--out", "other.safetensors", "--no-card"]) == 0
    assert not Path("other.md").exists()
    assert load_policy("other.safetensors").info.success == 1.0
    for wrong, message in (
        (["hand_reach.onnx", "--out", "new.safetensors"], "hand_reach.onnx is for onnxruntime and cannot"),
        (["other.safetensors"], "other.safetensors would be replaced by itself: give --out or --format onnx"),
        (
            ["other.safetensors", "--out", "a.safetensors", "--run", "1"],
            "run=1 has no effect with other.safetensors, which holds a single",
        ),
        (
            ["other.safetensors", "--out", "a.safetensors", "--format", "onnx"],
            "format=onnx must have the suffix .onnx, got 'a.safetensors'",
        ),
        (
            ["other.safetensors", "--out", "a.onnx", "--task", "robot_v0"],
            "observation [5], desired_goal [2] and",
        ),
        (["nowhere"], "nowhere is neither the folder of a run, nor the file of an exported policy"),
    ):
        assert message in refused("export", *wrong)
    Path("a.md").write_text("mine")
    said = refused("export", "other.safetensors", "--out", "a.onnx")
    assert "a.md exists, and export did not write it" in said
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "a.md", "hand_reach.md", "hand_reach.onnx", "other.safetensors"
    ]  # fmt: skip
    for command in (["play", "hand_reach.onnx"], ["record", "hand_reach", "--policy", "hand_reach.onnx"]):
        assert "hand_reach.onnx is for onnxruntime and cannot be loaded" in refused(*command)


@pytest.mark.parametrize("missing", ["onnx", "onnxruntime", "onnxscript"])
def test_without_the_extra_nothing_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, refused: Refused, missing: str
) -> None:
    monkeypatch.setitem(sys.modules, missing, None)
    said = "torchrl-her: ONNX files need onnx, onnxruntime and onnxscript: pip install '.[onnx]'\n"
    assert refused("export", "hand_reach", "--out", str(tmp_path / "a.onnx")) == said
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda own: own["recipe"]["learner"].update(hidden=10_000_000),
            "must be (1, 7, 10000000), got (1, 7, 64)",
        ),
        (
            lambda own: own["weights"]["module.layers.3.bias"].fill_(torch.nan),
            "weights must be finite, got NaN or infinity in module.layers.3.bias",
        ),
        (
            lambda own: own["recipe"]["learner"].update(warp=9),
            "no option 'learner.warp'; the options of learner are",
        ),
        (
            lambda own: own["info"].pop("widths"),
            "its info is damaged: PolicyInfo.__init__() missing 1 required keyword",
        ),
        (
            lambda own: own["recipe"]["learner"].update(name="theirs"),
            "learner must be one of ddpg, td3, sac, redq, tqc, dqn, auto, got 'theirs'",
        ),
        (lambda own: own["weights"].clear(), "these are not the weights of an actor of learner="),
    ],
)
def test_files_that_somebody_made_give_one_line(
    change: Callable[[dict[str, Any]], Any],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    refused: Refused,
) -> None:
    monkeypatch.chdir(tmp_path)
    export_policy("hand_reach", "good.safetensors", card=False)
    description, weights = read_policy(Path("good.safetensors"))
    change({**description, "weights": weights})
    write_policy(Path("bad.safetensors"), weights, description)
    said = refused("play", "bad.safetensors")
    assert said.startswith("torchrl-her: bad.safetensors is not an exported policy: ")
    assert message in said


def test_a_policy_that_no_longer_fits_its_task_is_not_played(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, refused: Refused
) -> None:
    robot = make_env("robot_v0", num_envs=2)
    monkeypatch.setattr(policy.TaskEnvs, "make", lambda *_args, **_options: robot)
    said = refused("play", "hand_reach", "--out", str(tmp_path / "a.gif"))
    assert "a policy of hand_reach cannot play hand_reach: the policy has observation" in said


def test_predict_takes_what_gymnasium_shows() -> None:
    env = gymnasium.make("torchrl_her/HandThrow-v1")
    own = load_policy("hand_v1")
    shown, _ = env.reset(seed=4)
    action, state = own.predict(shown, deterministic=True)
    assert state is None
    assert env.action_space.contains(action)
    several = {key: np.stack([value, value + 0.01]) for key, value in shown.items()}
    both, _ = own.predict(several)
    np.testing.assert_allclose(both[0], action, atol=1e-6)
    seen = TensorDict({key: torch.as_tensor(several[key]) for key in ("observation", "desired_goal")}, [2])
    np.testing.assert_array_equal(both, own(seen)["action"].numpy())
    with pytest.raises(ValueError, match=r"observation must have 9 numbers for .*, got shape \[3\]"):
        own.predict({**shown, "observation": np.zeros(3)})


@pytest.mark.parametrize(
    "actions",
    [
        spaces.Box(0, np.array([4, 9]), dtype=np.int32),
        spaces.Box(0, 1, (3,), dtype=np.uint8),
        spaces.Box(np.float32([-0.5, 0.3]), np.float32([1.0, 0.3])),  # the second is fixed
        spaces.Box(np.float32([-1.0, 1.0]), np.float32([1.0, 1.0])),
        spaces.Box(np.array([-0.1, 0.1]), np.array([0.1, 0.1]), dtype=np.float64),  # 0.1 is none of float32
    ],
)
def test_predict_gives_actions_of_the_space(
    actions: spaces.Box, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    own_walk = EnvSpec("tests/OwnWalk-v0", lambda: Walk(actions=actions), max_episode_steps=6)
    monkeypatch.setitem(gymnasium.registry, own_walk.id, own_walk)
    plain = {"learner": "ddpg", "gamma": 0.9, "normalize": False, "norm": "none"}
    tiny_policy(task=f"gym:{own_walk.id}", **plain).save(tmp_path / "mine.safetensors")
    assert ("round them" in (tmp_path / "mine.md").read_text()) == (actions.dtype.kind in "iu")
    own = load_policy(tmp_path / "mine.safetensors")
    seen = {key: 300 * value.numpy() for key, value in states(own.info, 200).items()}  # to all sides
    taken, _ = own.predict(seen)
    assert taken.dtype == actions.dtype
    assert all(actions.contains(action) for action in taken)
    moving = actions.low < actions.high
    assert (taken[:, moving].min(0) < taken[:, moving].max(0)).any()
    one, _ = own.predict({key: value[0] for key, value in seen.items()})
    assert actions.contains(one)
    given = own(TensorDict({key: torch.as_tensor(value) for key, value in seen.items()}, [200]))["action"]
    assert given.is_floating_point()
    assert (np.abs(given.numpy() - taken) <= (0.5 if own.info.whole else 1e-6)).all()


def test_predict_counts_discrete_actions_as_the_environment_does(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    actions = spaces.Discrete(2, start=5)
    own_walk = EnvSpec("tests/OwnWalk-v0", lambda: Walk(actions=actions), max_episode_steps=6)
    monkeypatch.setitem(gymnasium.registry, own_walk.id, own_walk)
    plain = {"learner": "dqn", "gamma": 0.9, "normalize": False, "norm": "none"}
    tiny_policy(task=f"gym:{own_walk.id}", **plain).save(tmp_path / "mine.safetensors")
    assert "whole numbers from 0 to 1; those of the task begin with 5" in (tmp_path / "mine.md").read_text()
    own = load_policy(tmp_path / "mine.safetensors")
    seen = states(own.info, 200)
    taken, _ = own.predict({key: value.numpy() for key, value in seen.items()})
    assert set(taken.tolist()) == {5, 6}
    assert (own(seen)["action"].numpy() + 5 == taken).all()
    own.info.check_plays(own.envs(1), own.info.task)


def test_a_policy_that_was_saved_is_the_same(tmp_path: Path) -> None:
    own = tiny_policy(normalize=True)
    own.save(tmp_path / "mine.safetensors")
    again = load_policy(tmp_path / "mine.safetensors")
    assert (again.info, again.recipe) == (own.info, own.recipe)
    seen = states(own.info, 9)
    assert torch.equal(again(seen.clone())["action"], own(seen)["action"])


@pytest.mark.parametrize("options", LEARNERS, ids=lambda options: options["learner"])
@pytest.mark.parametrize("copied", [False, True])
def test_weights_that_were_changed_are_saved(options: dict[str, Any], copied: bool, tmp_path: Path) -> None:
    own, other = tiny_policy(**options), tiny_policy(**options)
    own = copy.deepcopy(own) if copied else own
    own.load_state_dict(other.state_dict())
    own.save(tmp_path / "mine.safetensors")
    seen = states(own.info, 20)
    expected = other(seen.clone())["action"]
    assert torch.equal(own(seen.clone())["action"], expected)
    assert torch.equal(load_policy(tmp_path / "mine.safetensors")(seen)["action"], expected)


def test_options_that_a_file_does_not_know_have_their_defaults(tmp_path: Path) -> None:
    own, path = tiny_policy(gamma=0.9), tmp_path / "mine.safetensors"
    own.save(path)
    description, weights = read_policy(path)
    del description["recipe"]["learner"]["tau"], description["recipe"]["weights"]
    write_policy(path, weights, description)
    assert load_policy(path).recipe == own.recipe


def test_no_action_leaves_the_bounds_by_rounding() -> None:
    low, high = [0.1, 0.3], [0.7, 0.3]
    seen = torch.linspace(-1, 1 + 1e-6, 1_000)[:, None].expand(-1, 2)
    action = ScaledActions(torch.nn.Identity(), low, high)(seen)
    assert (action >= torch.tensor(low)).all()
    assert (action <= torch.tensor(high)).all()
    assert action[:, 0].std() > 0.1
