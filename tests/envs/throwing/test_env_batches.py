"""Many worlds in one environment: each as if it were alone, repeatable, resumable, reset one by one."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torchrl_her_envs import TASKS, ThrowingEnv, make_env

State = dict[str, Tensor]


def make(name: str, num_envs: int, *, seed: int = 0) -> ThrowingEnv:
    env = make_env(name, num_envs=num_envs, seed=seed, dtype=torch.float64)
    env.reset()
    return env


def random_actions(env: ThrowingEnv, steps: int, *, seed: int = 0) -> Tensor:
    """[steps, N, n] actions; the grip opens and closes at random."""
    generator = torch.Generator().manual_seed(seed)
    shape = (steps, *env.action_spec.shape)
    return 2.4 * torch.rand(shape, dtype=torch.float64, generator=generator) - 1.2


def put_balls_into_flight(env: ThrowingEnv, *, seed: int = 0) -> None:
    """Free balls in the left half at up to 10 m/s, so that they bounce off everything there is."""
    generator = torch.Generator().manual_seed(seed)
    state = env.world_state_dict()
    u = torch.rand(env.batch_size[0], 4, dtype=torch.float64, generator=generator)
    state["ball"] = u[:, :2] * torch.tensor([2.4, 5.4]) + 0.2
    state["ball_velocity"] = u[:, 2:] * 20.0 - 10.0
    state["free"].fill_(True)
    for flag in ("held", "closed"):
        state[flag].fill_(False)
    env.load_world_state_dict(state)


def act(env: ThrowingEnv, action: Tensor) -> TensorDictBase:
    return env.step(TensorDict({"action": action}, batch_size=env.batch_size))["next"]


def follow(env: ThrowingEnv, actions: Tensor) -> Tensor:
    """[steps, N, ...]: state, reward and ends that follow, without resets."""
    shown = []
    for action in actions:
        after = act(env, action)
        ends = [after[key].to(torch.float64) for key in ("reward", "terminated", "truncated")]
        shown.append(torch.cat([after["state"], *ends], -1))
    return torch.stack(shown)


def collect(env: ThrowingEnv, actions: Tensor) -> TensorDictBase:
    """[N, steps] transitions, with episodes that end and begin again, as a collector gets them."""
    steps, now = [], env.reset()
    for action in actions:
        step, now = env.step_and_maybe_reset(now.set("action", action))
        steps.append(step)
    return torch.stack(steps, 1)


def rows(state: State, which: Tensor | slice) -> State:
    return {name: value[which].clone() for name, value in state.items()}


def equal(a: State, b: State) -> dict[str, bool]:
    return {name: torch.equal(a[name], b[name]) for name in a}


def bounces(path: Tensor) -> int:
    """How often the ball's vertical speed, in a path of :func:`follow`, jumped up."""
    speed = path[..., -6]  # the goal, the reward and two ends are behind it
    return int((speed.diff(dim=0) > 0.2).sum())


# Seeds


@pytest.mark.parametrize("name", TASKS)
def test_the_same_seed_repeats_bit_for_bit(name: str) -> None:
    one, same = make_env(name, num_envs=8, seed=5), make_env(name, num_envs=8, seed=5)
    actions = random_actions(one, 70).to(torch.float32)
    assert (collect(one, actions) == collect(same, actions)).all()


def test_seeds_environments_and_episodes_all_start_differently() -> None:
    starts = []
    for seed in (0, 1, 2):
        env = make_env("hand_v1", num_envs=5, seed=seed)
        starts += [env.reset()["state"] for _ in range(4)]
    everything = torch.cat(starts)
    for column in (0, 1, 5, 9, 10):  # hand, ball, goal
        assert len(everything[:, column].unique()) == 3 * 5 * 4


def test_making_and_running_an_environment_leaves_torchs_generator_alone() -> None:
    before = torch.get_rng_state()
    follow(make("robot_v2", 3), torch.zeros(3, 3, 3, dtype=torch.float64))
    assert torch.equal(before, torch.get_rng_state())


# Each world as if it were alone


@pytest.mark.parametrize("name", ["hand_wall_v2", "robot_v2", "hand_reach"])
@pytest.mark.parametrize("num_envs", [1, 3, 16])
def test_environments_start_alike_in_every_batch(name: str, num_envs: int) -> None:
    few, many = make(name, num_envs, seed=9), make(name, 64, seed=9)
    for _ in range(3):
        assert all(equal(few.world_state_dict(), rows(many.world_state_dict(), slice(num_envs))).values())
        few.reset()
        many.reset()


@pytest.mark.parametrize(
    ("name", "num_envs", "singles"),
    [("hand_v1", 4, 4), ("hand_wall_v2", 4, 4), ("robot_v2", 4, 4), ("hand_wall_v1", 256, 12)],
)
def test_a_batch_equals_single_environments(name: str, num_envs: int, singles: int) -> None:
    env = make(name, num_envs)
    put_balls_into_flight(env)
    start, actions = env.world_state_dict(), random_actions(env, 200)
    path = follow(env, actions)
    assert bounces(path) > num_envs
    for k in torch.linspace(0, num_envs - 1, singles).long():
        alone = make(name, 1)
        alone.load_world_state_dict(rows(start, k.view(1)))
        torch.testing.assert_close(
            follow(alone, actions[:, k : k + 1]), path[:, k : k + 1], rtol=0, atol=1e-9
        )


@pytest.mark.parametrize(("name", "more"), [("hand_wall_v1", 257), ("hand_wall_v1", 600), ("robot_v1", 600)])
def test_a_batch_equals_a_part_of_a_larger_one(name: str, more: int) -> None:
    few, many = make(name, 256), make(name, more)
    put_balls_into_flight(many)
    few.load_world_state_dict(rows(many.world_state_dict(), slice(256)))
    actions = random_actions(many, 200)
    path = follow(few, actions[:, :256])
    assert bounces(path) > 256
    torch.testing.assert_close(path, follow(many, actions)[:, :256], rtol=0, atol=1e-9)


def test_a_batch_equals_a_part_of_a_larger_one_from_ordinary_starts() -> None:
    few, many = make("hand_v1", 16), make("hand_v1", 600)
    actions = random_actions(many, 50)
    paths = follow(few, actions[:, :16]), follow(many, actions)[:, :16]
    torch.testing.assert_close(*paths, rtol=0, atol=1e-9)


def test_hands_catch_balls_in_the_runs_above() -> None:
    env = make("hand_wall_v1", 256)
    put_balls_into_flight(env)
    held = torch.zeros(256, dtype=torch.bool)
    for action in random_actions(env, 200):
        act(env, action)
        held |= env.worlds.held
    assert held.sum() > 32  # else those runs would say nothing about hands


# Resuming


@pytest.mark.parametrize("name", ["hand_wall_v1", "hand_v2", "robot_v2"])
@pytest.mark.parametrize("when", [3, 40, 77])
def test_resuming_changes_nothing(name: str, when: int) -> None:
    env, resumed = make(name, 32, seed=2), make(name, 32, seed=2)
    actions = random_actions(env, 150)
    put_balls_into_flight(env)
    follow(env, actions[:when])
    kept = env.world_state_dict()
    follow(resumed, actions[:9].flip(0))  # it has a past of its own, which must not show
    resumed.load_world_state_dict(kept)
    path, again = follow(env, actions[when:]), follow(resumed, actions[when:])
    assert bounces(path) > 32
    assert torch.equal(path, again)
    assert all(equal(env.world_state_dict(), resumed.world_state_dict()).values())


def test_resuming_goes_on_with_the_same_episodes() -> None:
    env, resumed = make("hand_v2", 16, seed=2), make("hand_v2", 16, seed=2)
    collect(env, random_actions(env, 75))
    resumed.load_world_state_dict(env.world_state_dict())
    actions = random_actions(env, 120, seed=1)
    assert (collect(env, actions) == collect(resumed, actions)).all()


@pytest.mark.parametrize("count", [1, 3, 5])
def test_a_state_of_another_number_of_environments_is_refused(count: int) -> None:
    env, other = make("hand_v1", 4), make("hand_v1", count, seed=1)
    for each in (env, other):
        each.reset()
    before = env.world_state_dict()
    with pytest.raises(ValueError, match=f"the state must have 4 rows, got 'joints' with {count}"):
        env.load_world_state_dict(other.world_state_dict())
    key = other.world_state_dict()["key"]
    with pytest.raises(ValueError, match=f"the state must have 4 rows, got 'key' with {count}"):
        env.load_world_state_dict(before | {"goal": before["goal"] + 1.0, "key": key})
    assert all(equal(env.world_state_dict(), before).values())


def test_a_state_of_another_task_is_refused() -> None:
    env, other = make("robot_v1", 4), make("robot_v1", 4)
    wide = other.world_state_dict() | {"joints": torch.zeros(4, 3, dtype=torch.float64)}
    with pytest.raises(ValueError, match=r"'joints' of the state must be of shape \[4, 2\], got \[4, 3\]"):
        env.load_world_state_dict(wide)


@pytest.mark.parametrize("load", [False, True])
def test_a_state_that_was_taken_stays_as_it_was(load: bool) -> None:
    env = make("hand_v1", 4)
    taken = env.world_state_dict()
    copy = rows(taken, slice(None))
    if load:
        env.load_world_state_dict(taken)
    follow(env, random_actions(env, 5))
    env.reset()
    assert all(equal(taken, copy).values())


# Partial resets


@pytest.mark.parametrize("name", TASKS)
@pytest.mark.parametrize("which", [[0], [1, 4], [0, 1, 2, 3, 4], []])
def test_a_partial_reset_leaves_the_other_environments_alone(name: str, which: list[int]) -> None:
    env = make(name, 5)
    after = {}
    for action in random_actions(env, 7):
        after = act(env, action)
    mask = torch.zeros(5, 1, dtype=torch.bool)
    mask[which] = True
    before = env.world_state_dict()
    shown = env.reset(after.clone().set("_reset", mask))
    now, others = env.world_state_dict(), ~mask.squeeze(-1)
    assert all(equal(rows(before, others), rows(now, others)).values())
    for key in ("state", "observation", "achieved_goal", "desired_goal"):
        assert torch.equal(shown[key][others], after[key][others])
    assert (now["step"][which] == 0).all()
    assert (now["episode"][which] == 2).all()
    assert (now["joints"][which] != before["joints"][which]).all()
    assert (now["goal"][which] != before["goal"][which])[:, 0].all()
    assert not shown["done"][which].any()


def test_what_the_others_do_later_is_not_changed_either() -> None:
    reset, calm = make("hand_wall_v1", 6), make("hand_wall_v1", 6)
    for env in (reset, calm):
        put_balls_into_flight(env)
    actions = random_actions(calm, 100)
    others = [0, 2, 3, 5]
    mask = torch.tensor([False, True, False, False, True, False]).unsqueeze(-1)
    for action in actions:
        a, b = act(reset, action), act(calm, action)
        assert torch.equal(a["state"][others], b["state"][others])
        reset.reset(TensorDict({"_reset": mask}, batch_size=[6]))


def test_a_environments_episodes_do_not_depend_on_when_it_is_reset() -> None:
    env, plain = make("hand_v2", 3, seed=4), make("hand_v2", 3, seed=4)
    follow(env, random_actions(env, 11))
    for world in (2, 0, 1):
        mask = torch.arange(3).unsqueeze(-1) == world
        env.reset(TensorDict({"_reset": mask}, batch_size=[3]))
        follow(env, random_actions(env, 3))
    env.reset()
    plain.reset()
    plain.reset()
    assert all(equal(env.world_state_dict(), plain.world_state_dict()).values())


# Blocks of several seeds


@pytest.mark.parametrize("name", ["hand_v0", "hand_wall_v2", "robot_v2"])
@pytest.mark.parametrize("num_envs", [2, 5, 16])
def test_a_block_of_a_batch_of_several_seeds_is_that_seed_alone(name: str, num_envs: int) -> None:
    seeds = (3, 11, 3, 2**63)
    every = make_env(name, num_envs=4 * num_envs, seed=seeds, dtype=torch.float64)
    actions = random_actions(every, 130)
    together = collect(every, actions)
    assert together["next", "done"].sum() >= 2 * 4 * num_envs  # whole episodes, and more of them
    for block, seed in enumerate(seeds):
        part = slice(block * num_envs, (block + 1) * num_envs)
        alone = make_env(name, num_envs=num_envs, seed=seed, dtype=torch.float64)
        own = collect(alone, actions[:, part])
        for key in ("state", ("next", "state"), ("next", "reward"), ("next", "done"), "achieved_goal"):
            pair = (together[key][part].double(), own[key].double())
            torch.testing.assert_close(*pair, rtol=0, atol=1e-9)


def test_all_seeds_share_one_space() -> None:
    env = make("hand_v0", 30)
    env.set_seeds(range(15))
    env.reset()
    physics = env._core._arrays._physics
    assert physics is env._core._numbers._physics
    assert physics._settled.shape == (4, 30)
    follow(env, random_actions(env, 60))
    assert len(physics._space._space.static_body.shapes) == 4  # the sides of one screen


def test_new_seeds_may_be_more_than_before() -> None:
    alone, both = make("hand_v0", 4, seed=4), make("hand_v0", 8)
    both.set_seeds([3, 4])
    both.reset()
    actions = random_actions(both, 40)
    assert torch.equal(follow(both, actions)[:, 4:], follow(alone, actions[:, 4:]))
