"""Presets, and YAML files of one's own."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from torchrl_her_recipes import load_preset, make_recipe
from torchrl_her_recipes.config.plain_files import read_yaml
from torchrl_her_recipes.config.resolve import auto_options
from torchrl_her_recipes.config.shipped import file_summary, find_file, shipped_names
from torchrl_her_recipes.config.study import load_study, study_names


@pytest.mark.parametrize("name", shipped_names("preset"))
def test_every_preset_makes_a_recipe_and_says_what_it_is_for(name: str) -> None:
    values = load_preset(name)
    recipe = make_recipe(values).to_dict()
    with_ibs = make_recipe(values, algo="filtered_her_ibs", behavior="ibs").to_dict()
    for group, own in values.items():
        made = (
            with_ibs if group in ("weights", "behavior") else recipe
        )  # options of IBS are dropped without it
        read = {key: read_yaml(find_file(key, value)) for key, value in own.items() if key == "symmetry"}
        assert own | read == {key: made[group][key] for key in own}
    assert 10 < len(file_summary("preset", name)) < 90


# The defaults before there were any for unknown environments; shipped presets and studies build on them.
THROWING = {
    "hindsight": {"algo": "filtered_her", "goal_sources": None, "refill": 1},
    "collection": {"epoch_frames": 20_480, "num_envs": 64, "frames_per_update": 20, "warmup_frames": 3_200},
    "learner": {
        "gamma": 0.98,
        "hidden": 64,
        "norm": "none",
        "normalize": False,
        "tau": 0.02,
        "action_penalty": 0.3,
        "saturation_penalty": 0.0,
        "epsilon_start": 1.0,
        "epsilon_decay": 0.9,
        "epsilon_end": 0.05,
        "uniform_share": 0.2,
        "action_noise": 0.05,
    },
}


def test_numbers_of_shipped_presets_and_studies_do_not_follow_the_defaults() -> None:
    assert load_preset("throwing") == THROWING
    for name in shipped_names("preset"):
        values = load_preset(name)
        for group, own in THROWING.items():
            assert own.keys() <= values[group].keys(), name
    for name in set(study_names()) - {"defaults"}:
        for label, recipe in load_study(name).cells():
            assert auto_options(recipe) == [], label
            assert recipe.learner.normalize_least_std is not None or not recipe.learner.normalize, label


def test_a_file_of_ones_own(tmp_path: Path) -> None:
    file = tmp_path / "own.yaml"
    file.write_text("seed: 3\ntask: {name: hand_v1}\n")
    assert make_recipe(load_preset(str(file))).run.seed == 3
    assert file_summary("preset", str(file)) == ""
    with pytest.raises(ValueError, match="there is no preset 'demoo'; did you mean demo. The presets are"):
        load_preset("demoo")


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ("curriculum", "a curriculum must be a list of stages, .* got None"),
        ("symmetry", r"own\.yaml cannot be read: it must hold names and values, got None"),
    ],
)
def test_an_empty_file_is_refused(tmp_path: Path, option: str, message: str) -> None:
    file = tmp_path / "own.yaml"
    file.write_text("# nothing yet\n")
    with pytest.raises(ValueError, match=message):
        make_recipe(algo="cher", **{option: str(file)})


def test_a_preset_begins_with_another_one(tmp_path: Path) -> None:
    file = tmp_path / "own.yaml"
    file.write_text("preset: demo\ntau: 0.01\nrun: {epochs: 3}\n")
    values, demo = load_preset(str(file)), load_preset("demo")
    assert values["learner"] == demo["learner"] | {"tau": 0.01}
    assert values["run"] == demo["run"] | {"epochs": 3}
    assert values["hindsight"] == demo["hindsight"]
    file.write_text("preset: deno\n")
    with pytest.raises(ValueError, match=r"own\.yaml cannot be read: there is no preset 'deno'; did you"):
        load_preset(str(file))


@pytest.mark.parametrize("other", ["a.yaml", "b.yaml"])
def test_a_preset_cannot_begin_with_itself(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, other: str
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("a.yaml").write_text(f"preset: {other}\n")
    Path("b.yaml").write_text("preset: a.yaml\n")
    with pytest.raises(ValueError, match=r"the preset 'a\.yaml' extends itself"):
        load_preset("a.yaml")


def test_panda_stack_does_the_same_in_its_mirror_image() -> None:
    env = pytest.importorskip("panda_gym.envs").PandaStackEnv()
    symmetry, draws = read_yaml(find_file("symmetry", "panda_stack")), np.random.default_rng(0)
    positions, speeds, spins = draws.uniform(-1, 1, [3, 2, 3])  # of two blocks in the air
    turns, goals, actions = (draws.uniform(-1, 1, shape) for shape in ([2, 4], [2, 3], [3, 4]))

    def last_state(position: list[int], turn: list[int], action: list[int]) -> np.ndarray:
        """Returns the state after three steps, from a start and actions with these signs."""
        env.reset(seed=0)
        env.task.goal = (goals * position).ravel()
        for block, name in enumerate(("object1", "object2")):
            env.sim.set_base_pose(name, positions[block] * position + [0, 0, 9], turns[block] * [*turn, 1])
            velocity = speeds[block] * position, spins[block] * turn
            env.sim.physics_client.resetBaseVelocity(env.sim._bodies_idx[name], *velocity)
        for each in actions * action:
            seen = env.step(each)[0]
        return np.append(seen["observation"], seen["desired_goal"])

    state = last_state([1, 1, 1], [1, 1, 1], [1, 1, 1, 1])
    mirrored = last_state([1, -1, 1], [-1, 1, -1], [1, -1, 1, 1])
    assert symmetry["mirror_action"] == [1]
    assert set(symmetry["mirror"].values()) == {0}
    assert set(symmetry["mirror"]) == set(np.flatnonzero(np.abs(state - mirrored) > 0.05))
    sides = [1 - 2 * (column in symmetry["mirror"]) for column in range(37)]
    np.testing.assert_allclose(mirrored * sides, state, atol=0.02)
