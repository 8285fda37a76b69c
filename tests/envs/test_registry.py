"""Environments by name: every name makes one, and what cannot be made is said in one line."""

from __future__ import annotations

import importlib
import inspect
import subprocess
import sys

import pytest
import torch
from torchrl.data import Categorical

from torchrl_her_envs import (
    TASKS,
    BatchedEnv,
    BitFlip,
    Chain,
    GymGoalEnv,
    TaskSpec,
    ThrowingEnv,
    TreasureHunt,
    check_task,
    get_task_spec,
    goal_env,
    make_env,
    register_task,
    registry,
    task_names,
)
from torchrl_her_envs.common.goal_env import reward_range
from torchrl_her_envs.registry import check_options

from .gym.walk import WALK

TOYS = {"bit_flip": BitFlip, "treasure_hunt": TreasureHunt, "chain": Chain}
NAMES = [*TASKS, *TOYS]
LISTED = ", ".join(NAMES)
OTHERS = "or gym:ID for one of gymnasium's, or my_module:make_env for a TorchRL environment of your own"


@pytest.fixture
def own_tasks(monkeypatch: pytest.MonkeyPatch) -> None:
    """What a test registers is forgotten at its end."""
    monkeypatch.setattr(registry, "_SPECS", dict(registry._SPECS))


def test_all_tasks_have_a_name() -> None:
    assert task_names() == NAMES


@pytest.mark.parametrize("name", [*NAMES, f"gym:{WALK}"])
def test_every_name_makes_an_environment(name: str) -> None:
    env = make_env(name, num_envs=2, seed=[4, 9])
    assert env.batch_size == (2,)
    assert goal_env(env) is env
    assert env.task_name == name
    kind = GymGoalEnv if name.startswith("gym:") else TOYS.get(name, ThrowingEnv)
    assert type(env) is kind
    assert reward_range(env)[1] == 0.0
    discrete = isinstance(env.action_spec, Categorical)
    assert get_task_spec(name).actions in (("discrete" if discrete else "continuous"), None)
    again = make_env(name, num_envs=1, seed=9)
    assert torch.equal(env.reset()["desired_goal"][1:], again.reset()["desired_goal"])


@pytest.mark.parametrize("name", NAMES)
def test_a_spec_lists_all_options_with_the_defaults_of_what_makes_it(name: str) -> None:
    spec = get_task_spec(name)
    module, _, function = spec.make.partition(":")
    maker = getattr(importlib.import_module(module), function)
    taken = inspect.signature(maker.__init__).parameters
    others = ("self", "num_envs", "seed")
    assert [*spec.arguments, *spec.options] == [key for key in taken if key not in others]
    given = {key: own.default for key, own in taken.items() if own.default is not inspect.Parameter.empty}
    shared = spec.options.keys() & given.keys()
    assert {key: spec.options[key] for key in shared} == {key: given[key] for key in shared}
    assert (spec.name, spec.family) == (name, "toy" if name in TOYS else "throwing")
    assert spec.summary


def test_names_and_options_are_there_without_torch() -> None:
    code = (
        "import sys\n"
        "import torchrl_her_envs\n"
        "from torchrl_her_envs.registry import check_options, check_task, get_task_spec, task_names\n"
        "specs = [get_task_spec(name) for name in (*task_names(), 'gym:FetchReach-v4')]\n"
        "assert len(specs) == 15 and all(spec.summary for spec in specs)\n"
        "for check in (lambda: check_task('hand_v9'), lambda: check_options(specs[0], {'bits': 1})):\n"
        "    try:\n"
        "        check()\n"
        "    except ValueError:\n"
        "        continue\n"
        "    raise AssertionError('nothing was refused')\n"
        "import torchrl_her_envs.gym.quiet\n"  # in each process of an environment of gymnasium's
        "loaded = {'torch', 'tensordict', 'torchrl', 'pymunk', 'matplotlib'} & set(sys.modules)\n"
        "assert not loaded, loaded\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


# Options


def test_options_reach_the_environment() -> None:
    assert make_env("bit_flip").bits == 15
    assert make_env("bit_flip", bits=4, useless_action=True).num_actions == 5
    assert make_env("treasure_hunt", step=20).max_steps == 5
    assert make_env("chain").max_steps == 10
    chain = make_env("chain", length=6, stages=3)
    assert (chain.length, chain.forward_probability, len(chain.stages())) == (6, 1.0, 3)
    assert make_env("robot_v0", num_links=3, threshold=0.2, dtype="float64").action_spec.shape == (1, 4)
    walk = make_env(f"gym:{WALK}", max_steps=3, ends=False)
    assert walk.max_steps == 3


@pytest.mark.parametrize(
    ("name", "option", "allowed"),
    [
        ("hand_v0", "bits", "world, num_links, threshold, dtype"),
        ("hand_v0", "task", "world, num_links, threshold, dtype"),
        ("bit_flip", "bit", "bits, useless_action, max_steps"),
        ("treasure_hunt", "threshold", "step, max_steps"),
        ("chain", "p", "length, forward_probability, stages, alternating, reset_state, max_steps"),
        (
            f"gym:{WALK}",
            "speed",
            "max_steps, parallel, termination, achieved_reward, info_keys, shaping, "
            "observation_key, achieved_goal_key, desired_goal_key, pictures, "
            "ends, form, without, actions, shown, render_mode",
        ),
    ],
)
def test_options_that_a_task_does_not_take(name: str, option: str, allowed: str) -> None:
    says = f"^{name.removeprefix('gym:')} takes no option '{option}'; its options are {allowed}$"
    with pytest.raises(ValueError, match=says):
        make_env(name, **{option: 1})


# Names that there are not


@pytest.mark.parametrize("call", [check_task, get_task_spec, make_env])
@pytest.mark.parametrize(
    ("name", "nearest"),
    [
        ("hand_v9", "hand_v0"),
        ("bitflip", "bit_flip"),
        ("robot-v1", "robot_v1"),
        ("hand_wall", "hand_wall_v0"),
        ("treasure", "treasure_hunt"),
    ],
)
def test_the_nearest_name_is_suggested(call, name: str, nearest: str) -> None:
    tasks = f"The tasks are {LISTED}, {OTHERS}"
    with pytest.raises(ValueError, match=f"^unknown task '{name}'; did you mean {nearest}\\? {tasks}$"):
        call(name)


@pytest.mark.parametrize("name", ["", "gym:", "FetchReach-v4", "x"])
def test_nothing_is_suggested_where_nothing_is_near(name: str) -> None:
    tasks = f"the tasks are {LISTED}, {OTHERS}"
    with pytest.raises(ValueError, match=f"^unknown task '{name}'; {tasks}$"):
        check_task(name)


# Tasks of one's own


def make_own(*, num_envs: int, seed: int, size: int, fixed: str) -> BatchedEnv:
    assert fixed == "always"
    return BitFlip(size, num_envs=num_envs, seed=seed)


def own_spec(**changes: object) -> TaskSpec:
    values = {
        "name": "own",
        "summary": "a task of one's own",
        "family": "own",
        "make": f"{__name__}:make_own",
    }
    return TaskSpec(**values | {"arguments": {"fixed": "always"}, "options": {"size": 3}} | changes)


def test_a_task_that_is_registered_can_be_made(own_tasks: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, __name__, sys.modules.get(__name__) or inspect.getmodule(make_own))
    register_task(own_spec())
    assert task_names() == [*NAMES, "own"]
    assert make_env("own").bits == 3
    assert make_env("own", size=5, num_envs=2).batch_size == (2,)
    with pytest.raises(ValueError, match="own takes no option 'fixed'; its options are size"):
        make_env("own", fixed="never")
    with pytest.raises(ValueError, match="unknown task 'owm'; did you mean own"):
        check_task("owm")


def test_a_task_that_is_registered_again_replaces_itself(own_tasks: None) -> None:
    register_task(own_spec())
    register_task(own_spec(summary="as it is now"))
    assert get_task_spec("own").summary == "as it is now"
    with pytest.raises(ValueError, match="the task 'own' is registered already"):
        register_task(own_spec(make="another_module:make_own"))
    with pytest.raises(ValueError, match="the task 'hand_v0' is registered already"):
        register_task(get_task_spec("hand_v0"))


def test_a_task_without_options_says_so(own_tasks: None) -> None:
    with pytest.raises(ValueError, match="own takes no option 'size'; it has none"):
        check_options(own_spec(options={}), {"size": 1})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"name": "hand_v0"}, "the task 'hand_v0' is registered already"),
        ({"name": "my:own"}, "a task's name must be some text without a colon, got 'my:own'"),
        ({"name": ""}, "a task's name must be some text without a colon, got ''"),
        ({"make": "module"}, "make must be 'module:name', got 'module'"),
        ({"make": ":name"}, "make must be 'module:name', got ':name'"),
    ],
)
def test_tasks_that_cannot_be_registered(own_tasks: None, changes: dict[str, str], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        register_task(own_spec(**changes))
    assert task_names() == NAMES
