"""Gymnasium environments with goals as batched TorchRL environments."""

from __future__ import annotations

import os
import secrets
import sys
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from tensordict import TensorDict
from torchrl.data import Bounded, Categorical
from torchrl.envs import ActionScaling, TransformedEnv
from torchrl.envs.utils import check_env_specs

from torchrl_her_envs import GymGoalEnv, goal_env, make_gym_env
from torchrl_her_envs.gym.drawing import choose_renderer

from .walk import LAST, WALK, Walk, walk

KEYS = ("observation", "achieved_goal", "desired_goal")


def rollout(env: GymGoalEnv, steps: int = 40) -> TensorDict:
    torch.manual_seed(0)
    return env.rollout(steps, break_when_any_done=False)


def same(one: TensorDict, other: TensorDict) -> bool:
    return bool((one == other).all())


# What comes out


@pytest.mark.parametrize("num_envs", [1, 3])
def test_specs(num_envs: int) -> None:
    env = walk(num_envs)
    check_env_specs(env, seed=0)
    steps = rollout(env, 3)
    for seen in (steps, steps["next"]):
        for key in KEYS:
            assert seen[key].shape == (num_envs, 3, 1)
            assert seen[key].dtype == torch.float32
    assert steps["next", "reward"].dtype == torch.float32
    assert set(steps["next"].keys()) == {*KEYS, "reward", "terminated", "truncated", "done"}
    assert (goal_env(env), env.max_steps) == (env, 6)


def test_counted_actions_are_whole_numbers_one_for_each_environment() -> None:
    env = walk(3, actions=spaces.Discrete(2, start=5))  # the environment asserts that it gets 5 or 6
    assert isinstance(env.action_spec, Categorical)
    assert (env.action_spec.shape, env.action_spec.n) == ((3,), 2)
    before = env.reset()["observation"]
    after = env.step(TensorDict({"action": torch.tensor([0, 1, 1])}, [3]))["next", "observation"]
    assert torch.equal(after, (before + torch.tensor([[-1.0], [1.0], [1.0]])).clamp(0, LAST))


@pytest.mark.parametrize(
    "actions",
    [
        spaces.Box(-1.0, 1.0, (2, 3), np.float32),
        spaces.Box(-1.0, 1.0, (), np.float32),
        spaces.Box(0, 4, (2,), np.int32),
        spaces.Box(np.float32([-0.5, 0.3]), np.float32([1.0, 0.3])),  # the second is fixed
        spaces.Box(np.array([-0.1, 0.0]), np.array([0.1, 0.0]), dtype=np.float64),  # none of it in float32
    ],
)
def test_actions_have_the_shape_type_and_bounds_of_their_space(actions: spaces.Box) -> None:
    env = walk(3, actions=actions)  # the environment asserts that its space contains each action
    width = int(np.prod(actions.shape))
    assert env.action_spec.shape == (3, width)
    seen = env.read_action(env.action_spec.rand())
    assert (seen.shape, seen.dtype) == ((3, *actions.shape), actions.dtype)
    spec = env.action_spec_unbatched
    assert isinstance(spec, Bounded)
    assert (spec.space.low < spec.space.high).all()
    limits = zip(
        (actions.low, actions.high), env.action_limits(), (spec.space.low, spec.space.high), strict=True
    )
    for bound, own, side in limits:
        assert np.array_equal(env.read_action(side.expand(3, -1))[0], bound)
        assert np.array_equal(own.numpy(), bound.flatten())
    assert rollout(TransformedEnv(env, ActionScaling()))["action"].shape == (3, 40, width)


def test_an_observation_that_is_not_finite_is_named_before_it_is_passed_on() -> None:
    class Lidar(Walk):
        def _show(self) -> dict[str, np.ndarray]:
            seen = super()._show()
            return seen | {"observation": np.where(seen["observation"] == LAST, np.inf, 0.0)}

    gymnasium.register("tests/Lidar-v0", Lidar, max_episode_steps=6)
    env = make_gym_env("tests/Lidar-v0")
    with pytest.raises(ValueError, match=r"^tests/Lidar-v0: observation 0 must be a finite number, got inf$"):
        rollout(env, 100)


def test_a_step_without_success_in_its_info_has_not_achieved_its_goal() -> None:
    class Rare(Walk):
        def step(self, action: Any) -> Any:
            *seen, _ = super().step(action)
            return *seen, ({"is_success": True} if seen[1] == 0 else {})

    gymnasium.register("tests/Rare-v0", lambda: Rare(ends=False), max_episode_steps=6)
    after = rollout(make_gym_env("tests/Rare-v0", termination="success"))["next"]
    assert torch.equal(after["terminated"], after["reward"] == 0)
    assert after["terminated"].any()


def test_further_keys_are_left_out_and_goals_may_be_bits() -> None:
    bit = spaces.MultiBinary(1)

    class Bits(gymnasium.ObservationWrapper):
        def observation(self, shown: dict[str, np.ndarray]) -> dict[str, Any]:
            goals = {key: (shown[key] > 2).astype(np.int8) for key in KEYS[1:]}
            return {"observation": shown["observation"], **goals, "words": "some"}

        def step(self, action: Any) -> Any:
            shown, _, *ends = super().step(action)
            goals = (shown[key] for key in KEYS[1:])
            return shown, float(self.env.get_wrapper_attr("compute_reward")(*goals, {})), *ends

    shown = {"achieved_goal": bit, "desired_goal": bit, "words": spaces.Text(9)}
    gymnasium.register(
        "tests/Bits-v0",
        lambda **options: Bits(gymnasium.make(WALK, shown=shown, **options).unwrapped),
        max_episode_steps=6,
    )
    env = make_gym_env("tests/Bits-v0", num_envs=2)
    goals = rollout(env)["achieved_goal"]
    assert goals.dtype == torch.float32
    assert set(goals.flatten().tolist()) == {0.0, 1.0}
    assert env.compute_reward(goals[0, 0], goals[0, 0]).tolist() == [0.0]


# Ends


def test_an_end_at_the_goal_is_terminated_and_one_out_of_time_is_truncated() -> None:
    steps = rollout(walk(4), 60)
    after, step = steps["next"], torch.zeros(4, dtype=torch.int64)
    for t in range(60):
        step += 1
        now = after[:, t]
        met = now["achieved_goal"] == now["desired_goal"]
        assert torch.equal(now["terminated"], met)
        assert torch.equal(now["truncated"], (step == 6).unsqueeze(-1))
        assert torch.equal(now["done"], now["terminated"] | now["truncated"])
        step[now["done"].squeeze(-1)] = 0
    assert after["terminated"].any()
    assert (after["truncated"] & ~after["terminated"]).any()


def test_only_environments_that_are_done_begin_anew() -> None:
    steps = rollout(walk(4), 60)
    inside = ~steps["next", "done"].squeeze(-1)[:, :-1]
    for key in KEYS:
        assert torch.equal(steps[key][:, 1:][inside], steps["next", key][:, :-1][inside])
    new = (steps["achieved_goal"] != steps["desired_goal"]).squeeze(-1)[:, 1:]
    assert new[~inside].all()  # no episode starts at its goal, where many ended


class OwnLimit(Walk):
    """It truncates its episodes itself, after seven steps."""

    def reset(self, **options: Any) -> Any:
        self.steps = 0
        return super().reset(**options)

    def step(self, action: Any) -> Any:
        self.steps += 1
        shown, reward, terminated, _, info = super().step(action)
        return shown, reward, terminated, self.steps == 7, info


gymnasium.register("tests/Own-Limit-v0", OwnLimit, kwargs={"ends": False})


def test_an_environment_without_a_time_limit_is_given_one() -> None:
    assert make_gym_env("tests/Endless-v0").max_steps == 100
    assert make_gym_env("tests/Own-Limit-v0").max_steps == 7
    env = make_gym_env("tests/Endless-v0", max_steps=3, ends=False)
    assert env.max_steps == 3
    assert rollout(env, 9)["next", "truncated"].flatten().tolist() == [False, False, True] * 3


# Seeds


def test_the_same_seed_gives_the_same_run_and_another_one_another() -> None:
    runs = [rollout(walk(3, seed=seed)) for seed in (5, 5, 6)]
    assert same(runs[0], runs[1])
    assert not same(runs[0], runs[2])


def test_environments_that_draw_a_seed_at_each_reset_repeat(monkeypatch: pytest.MonkeyPatch) -> None:
    """As those of panda-gym do if they get none."""

    def reset(self: Walk, *, seed: int | None = None, options: Any = None) -> Any:
        return usual(self, seed=secrets.randbits(31) if seed is None else seed, options=options)

    usual = Walk.reset
    monkeypatch.setattr(Walk, "reset", reset)
    one, other = (torch.cat([env.reset()["desired_goal"] for _ in range(9)]) for env in (walk(), walk()))
    assert torch.equal(one, other)
    assert len(one.unique()) > 1


def test_a_environment_does_the_same_in_every_batch() -> None:
    many, few, one = (walk(n, seed=3) for n in (5, 2, 1))
    starts = [torch.stack([env.reset()["desired_goal"] for _ in range(20)], 1) for env in (many, few, one)]
    assert torch.equal(starts[0][:2], starts[1])
    assert torch.equal(starts[0][:1], starts[2])
    assert len({tuple(row.flatten().tolist()) for row in starts[0]}) == 5


def test_blocks_of_environments_are_each_as_if_alone() -> None:
    both, alone = walk(4, seed=[7, 8]), walk(2, seed=8)
    for _ in range(10):
        assert torch.equal(both.reset()["observation"][2:], alone.reset()["observation"])
    with pytest.raises(ValueError, match="4 environments cannot be shared out among 3 seeds"):
        both.set_seeds([1, 2, 3])


def test_seeding_again_starts_over_at_the_next_reset_of_each_environment() -> None:
    env = walk(3, seed=1)
    first = rollout(env)
    env.set_seeds([1])
    assert same(rollout(env), first)
    env.set_seed(1)
    shown = first[:, -1].clone()
    shown = env.reset(shown.set("_reset", torch.tensor([[True], [False], [True]])))
    assert torch.equal(shown["desired_goal"][[0, 2]], first["desired_goal"][[0, 2], 0])
    shown = env.reset(shown.set("_reset", torch.tensor([[False], [True], [False]])))
    assert torch.equal(shown["desired_goal"], first["desired_goal"][:, 0])


# The environment's own functions


@pytest.mark.parametrize("form", ["batch", "single"])
@pytest.mark.parametrize("ends", [True, False])
def test_rewards_and_ends_are_the_environment_s_own(form: str, ends: bool) -> None:
    env = walk(4, form=form, ends=ends)
    after = rollout(env)["next"]
    goals = after["achieved_goal"], after["desired_goal"]
    assert torch.equal(env.compute_reward(*goals), after["reward"])
    assert torch.equal(env.compute_terminated(*goals), after["terminated"])
    assert set(after["reward"].flatten().tolist()) == {-2.0, -1.0, 0.0}
    assert (env.missed_reward, env.achieved_reward) in {(-1.0, 0.0), (-2.0, 0.0)}


@pytest.mark.parametrize(
    ("options", "answers"),
    [
        ({"form": "batch"}, ("batch", "batch")),
        ({"form": "single"}, ("loop", "loop")),
        ({"form": "batch", "ends": False}, ("batch", "one")),
    ],
)
def test_functions_are_called_with_batches_where_they_take_them(
    options: dict[str, Any], answers: tuple[str, str]
) -> None:
    env = walk(2, **options)
    assert (env._reward_of.answers, env._terminated_of.answers) == answers
    asked = env._reference_env.unwrapped.asked
    asked.clear()
    env.compute_reward(torch.zeros(3, 5, 1), torch.ones(3, 5, 1))
    assert asked == ([(15, 1)] if answers[0] == "batch" else [(1,)] * 15)


@pytest.mark.parametrize("form", ["batch", "single"])
def test_goals_keep_their_order_and_broadcast(form: str) -> None:
    env = walk(form=form)
    low, high = torch.zeros(1), torch.full((1,), 4.0)
    assert env.compute_reward(high, low).tolist() == [-2.0]
    assert env.compute_reward(low, high).tolist() == [-1.0]
    table = env.compute_reward(torch.tensor([[[0.0]], [[4.0]]]), torch.tensor([[0.0], [4.0], [2.0]]))
    assert table.squeeze(-1).tolist() == [[0.0, -1.0, -1.0], [-2.0, 0.0, -1.0]]
    met = env.compute_terminated(torch.tensor([[0.0], [4.0]]), high)
    assert met.tolist() == [[False], [True]]
    assert (met.dtype, table.dtype) == (torch.bool, torch.float32)
    assert env.compute_reward(torch.zeros(0, 1), torch.zeros(0, 1)).shape == (0, 1)


def test_goals_are_not_written_over_whatever_a_function_does() -> None:
    class Spoiling(Walk):
        def compute_reward(self, achieved: np.ndarray, desired: np.ndarray, info: Any) -> Any:
            answer = super().compute_reward(achieved.copy(), desired, info)
            achieved += 1.0
            return answer

    gymnasium.register("tests/Spoiling-v0", Spoiling, max_episode_steps=6)
    env = make_gym_env("tests/Spoiling-v0")
    goals = torch.zeros(3, 1, dtype=torch.float64)
    assert env.compute_reward(goals, goals).tolist() == [[0.0]] * 3
    assert goals.tolist() == [[0.0]] * 3


def test_there_is_at_least_one_environment() -> None:
    with pytest.raises(ValueError, match="num_envs must be at least 1, got 0"):
        walk(0)


# The rest


def test_processes_do_what_one_does() -> None:
    pytest.importorskip("gymnasium_robotics")
    options: dict[str, Any] = {"num_envs": 2, "seed": 4, "max_steps": 5}
    runs = []
    for parallel in (True, False):
        env = make_gym_env("PointMaze_UMaze-v3", parallel=parallel, **options)
        runs.append(rollout(env, 12))
        env.close()
    assert same(*runs)


def test_pictures() -> None:
    env = walk(3, render_mode="rgb_array")
    places = env.reset()["observation"]
    frames = env.render()
    assert (frames.shape, frames.dtype) == ((3, 4, 6, 3), torch.uint8)
    assert torch.equal(frames[:, 0, 0, 0], places.flatten().to(torch.uint8))
    assert env.can_render
    assert torch.equal(env.render([2, 0]), frames[[2, 0]])
    assert torch.equal(env.render(1), frames[1])
    assert env.render([1], size=3).shape == (1, 2, 3, 3)
    assert not torch.equal(env.render(0, size=96, caption="epoch 3"), env.render(0, size=96))
    with pytest.raises(ValueError, match=r"worlds must be one or more indices from 0 to 2, got \[3\]"):
        env.render([3])
    with pytest.raises(ValueError, match="a picture needs a size of at least 1 pixel, got 0"):
        env.render(size=0)
    with pytest.raises(ValueError, match='pictures need render_mode="rgb_array", got None'):
        walk().render()


@pytest.mark.full
@pytest.mark.parametrize(
    ("drawn", "got"), [(None, "None"), (np.zeros((4, 6)), r"\[4, 6\] of float64"), (3, "3")]
)
def test_what_is_no_picture_is_said(drawn: Any, got: str, monkeypatch: pytest.MonkeyPatch) -> None:
    env = walk(2, pictures=True)
    env.reset()
    monkeypatch.setattr(Walk, "render", lambda self: drawn)
    with pytest.raises(
        ValueError, match=f"{WALK} must give a picture .height, width, 3. of uint8, got {got}$"
    ):
        env.render(0)


def test_an_environment_that_only_says_that_it_draws_takes_no_render_mode() -> None:
    class Drawn(Walk):
        def __init__(self) -> None:
            super().__init__()

    gymnasium.register("tests/Drawn-v0", Drawn, max_episode_steps=6)
    make_gym_env("tests/Drawn-v0").close()
    with pytest.raises(ValueError, match=r"^tests/Drawn-v0 gives no pictures: .* takes no render_mode$"):
        make_gym_env("tests/Drawn-v0", pictures=True)


def test_pictures_of_other_processes() -> None:
    env, same = (walk(3, render_mode="rgb_array", parallel=parallel) for parallel in (True, False))
    env.reset()
    same.reset()
    assert torch.equal(env.render([2, 0]), same.render([2, 0]))
    env.close()


# gymnasium-robotics


@pytest.mark.parametrize(
    ("id", "options", "answers"),
    [
        ("FetchReach-v4", {}, ("batch", "one")),
        ("FetchPush-v4", {}, ("batch", "one")),
        ("gymnasium_robotics:PointMaze_UMaze-v3", {"max_steps": 50}, ("batch", "one")),
        ("PointMaze_UMaze-v3", {"max_steps": 50, "continuing_task": False}, ("batch", "loop")),
    ],
)
def test_robots(id: str, options: dict[str, Any], answers: tuple[str, str]) -> None:
    pytest.importorskip("gymnasium_robotics")
    env = make_gym_env(id, num_envs=2, seed=0, **options)
    check_env_specs(env, seed=0)
    assert (env._reward_of.answers, env._terminated_of.answers) == answers
    assert (env.missed_reward, env.achieved_reward) == ((0.0, 1.0) if "Maze" in id else (-1.0, 0.0))
    steps = rollout(env, 52)
    after = steps["next"]
    assert after["truncated"].nonzero()[:, 1].tolist() == [49, 49]
    assert not after["terminated"].any()
    goals = after["achieved_goal"], after["desired_goal"]
    assert torch.equal(env.compute_reward(*goals), after["reward"])
    assert torch.equal(env.compute_terminated(*goals), after["terminated"])
    met = env.compute_terminated(goals[0], goals[0])
    assert bool(met.all()) is bool(met.any()) is (answers[1] == "loop")
    env.close()


def test_robots_repeat_and_do_the_same_in_every_batch() -> None:
    pytest.importorskip("gymnasium_robotics")
    two, one = (make_gym_env("FetchPush-v4", num_envs=n, seed=9) for n in (2, 1))
    action = torch.tensor([[1.0, -0.5, -1.0, 0.3]])
    shown, alone = two.reset(), one.reset()
    for _ in range(10):
        assert torch.equal(shown["observation"][:1], alone["observation"])
        shown = two.step(shown.set("action", action.expand(2, 4)))["next"]
        alone = one.step(alone.set("action", action))["next"]
    assert not torch.equal(shown["desired_goal"][0], shown["desired_goal"][1])


def test_goals_that_are_all_met_from_the_start_tell_nothing() -> None:
    """The reward of a goal that is far away is not known then."""
    with pytest.raises(
        ValueError, match=r"HandReach-v0: different goals have the reward 0, like equal goals; it must .*"
    ):
        make_gym_env("torchrl_her_envs:torchrl_her/HandReach-v0", threshold=10.0)


class Judged(Walk):
    """A walk with a reward function of one's own, which may look at the walk itself."""

    def __init__(self, judge: Callable[[Any, np.ndarray, np.ndarray, Any], Any]) -> None:
        super().__init__(ends=False)
        self.judge = judge

    def compute_reward(self, achieved: np.ndarray, desired: np.ndarray, info: Any) -> Any:
        return self.judge(self, achieved, desired, info)

    def step(self, action: Any) -> Any:
        self.place = float(np.clip(self.place + (1 if action else -1), 0, LAST))
        return self._show(), 0.0, False, False, {}


gymnasium.register("tests/Judged-v0", Judged, max_episode_steps=6)


def sparse(met: Any) -> Any:
    return np.asarray(met, np.float64) - 1


@pytest.mark.parametrize(
    ("judge", "message"),
    [
        (lambda own, a, d, _: sparse(own.place == d).max(-1), "some steps later, for the same two goals; it"),
        (lambda own, a, d, _: sparse(a > d).max(-1), "equal goals have the reward -1, other pairs -1 to 0"),
        (
            lambda own, a, d, _: sparse(a * 0 > d).max(-1),
            "equal goals have the reward -1, other pairs -1 to -1",
        ),
        (lambda own, a, d, _: sparse(a < d + 9).max(-1), "different goals have the reward 0, like equal"),
    ],
)
def test_rewards_that_do_not_tell_goals_apart_are_refused(judge: Any, message: str) -> None:
    with pytest.raises(ValueError, match=f"^tests/Judged-v0: .*{message}"):
        make_gym_env("tests/Judged-v0", judge=judge)


@pytest.mark.parametrize(
    ("met", "pairs"),
    [
        (
            lambda a, d: a >= d,
            [[True, True, True], [False, True, True], [False, False, True]],
        ),  # more is better
        (lambda a, d: (a - d) % 4 == 0, [[True, False, True], [False, True, False], [True, False, True]]),
    ],
)
def test_goals_with_the_greatest_difference_may_be_achieved(met: Any, pairs: list[list[bool]]) -> None:
    env = make_gym_env("tests/Judged-v0", judge=lambda own, a, d, _: sparse(met(a, d)).min(-1))
    assert (env.missed_reward, env.achieved_reward, env.dense_reward) == (-1.0, 0.0, False)
    places = torch.tensor([[0.0], [2.0], [4.0]])
    reward = env.compute_reward(places, places.unsqueeze(1)).squeeze(-1)  # [desired, achieved]
    assert reward.eq(0).tolist() == pairs


def test_what_a_machine_cannot_draw_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(_self: Walk) -> None:
        raise AttributeError("no context\nwas made")

    env = walk(2, render_mode="rgb_array")
    env.reset()
    monkeypatch.setattr(Walk, "render", fail)
    monkeypatch.delitem(sys.modules, "mujoco", raising=False)
    with pytest.raises(ValueError, match="could not be drawn: AttributeError: no context was made$"):
        env.render()
    monkeypatch.setitem(sys.modules, "mujoco", sys)
    monkeypatch.setenv("MUJOCO_GL", "glfw")
    with pytest.raises(
        ValueError, match=r"was made \(MuJoCo was to draw by MUJOCO_GL=glfw; MUJOCO_GL may be"
    ):
        env.render()


def test_mujoco_draws_without_a_display_unless_somebody_says_how(monkeypatch: pytest.MonkeyPatch) -> None:
    for display, before, after in ((":0", None, None), (None, None, "egl"), (None, "osmesa", "osmesa")):
        for name, value in (("DISPLAY", display), ("MUJOCO_GL", before)):
            monkeypatch.setenv(name, value) if value else monkeypatch.delenv(name, raising=False)
        monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
        monkeypatch.setattr(sys, "platform", "linux")
        choose_renderer()
        assert os.environ.get("MUJOCO_GL") == after
        monkeypatch.delenv("MUJOCO_GL", raising=False)
