"""TorchRL environments of a user's own, named as module:function."""

from __future__ import annotations

import importlib
from typing import Any

import pytest
import torch
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs.utils import check_env_specs

from torchrl_her import EnvReward, HERWriter
from torchrl_her_envs import BitFlip, OwnGoalEnv, goal_env, make_env, make_own_env, reward_range

HERE = "tests.envs.common.own_point"
KEYS = ("observation", "achieved_goal", "desired_goal")


def rollout(env: Any, steps: int = 40) -> Any:
    torch.manual_seed(0)
    return env.rollout(steps, break_when_any_done=False)


@pytest.mark.parametrize("name", ["Point", "make_points"])
def test_it_is_made_by_its_name_alone_or_as_a_batch(name: str) -> None:
    env = make_env(f"{HERE}:{name}", num_envs=3, seed=5)
    assert isinstance(env, OwnGoalEnv)
    check_env_specs(env)
    assert (env.batch_size, env.max_steps, env.task_name) == ((3,), 8, f"{HERE}:{name}")
    assert goal_env(env) is env
    assert reward_range(env) == (-1.0, 0.0)
    steps = rollout(env)
    after = steps["next"]
    goals = after["achieved_goal"], after["desired_goal"]
    met = after["reward"] == 0
    assert met.any()
    assert torch.equal(env.compute_reward(*goals), after["reward"])
    assert torch.equal(after["terminated"], met)
    assert torch.equal(env.compute_terminated(*goals), after["terminated"])
    assert after["truncated"].any()
    goes_on = ~after["done"].squeeze(-1)[:, :-1]
    for key in KEYS:
        assert torch.equal(steps[key][:, 1:][goes_on], after[key][:, :-1][goes_on])


def test_the_time_limit_counts_each_episode_from_its_own_start() -> None:
    after = rollout(make_own_env(f"{HERE}:Point", num_envs=4, max_steps=3, termination="never"))["next"]
    assert not after["terminated"].any()
    length = torch.zeros(4, dtype=torch.int64)
    for t in range(40):
        length += 1
        done, met = (after[key][:, t].squeeze(-1) for key in ("done", "reward"))
        assert torch.equal(done, (length == 3) | (met == 0))
        length[done] = 0


def test_seeds_give_each_environment_the_same_in_every_batch_and_leave_torch_alone() -> None:
    both, alone = (make_own_env(f"{HERE}:Point", num_envs=n, seed=s) for n, s in ((4, [7, 8]), (2, 8)))
    for _ in range(3):
        assert torch.equal(both.reset()["observation"][2:], alone.reset()["observation"])
    torch.manual_seed(4)
    expected = torch.rand(1)
    torch.manual_seed(4)
    both.set_seeds([1, 2])
    assert torch.equal(torch.rand(1), expected)


def test_a_function_is_given_each_seed_as_a_number(monkeypatch: pytest.MonkeyPatch) -> None:
    points, seen = importlib.import_module(HERE), []

    def make_seeded(num_envs: int, seed: Any) -> Any:
        seen.append(seed)
        return points.make_points(num_envs)

    monkeypatch.setattr(points, "make_seeded", make_seeded, raising=False)
    for seed in (5, [5]):
        make_own_env(f"{HERE}:make_seeded", num_envs=2, seed=seed)
    assert seen == [5, 0, 5, 0]  # each time, one more is made to be tried
    make_own_env(f"{HERE}:make_seeded", num_envs=2, seed=[5, 6])
    assert seen[4:] == [5, 6, 0]  # a batch of one environment for each


def test_batches_that_cannot_be_seeded_in_blocks_serve_several_runs_one_each() -> None:
    both, alone = (make_own_env(f"{HERE}:make_points", num_envs=n, seed=s) for n, s in ((6, [7, 8]), (3, 8)))
    assert both.batch_size == (6,)
    one, other = both.reset(), alone.reset()
    generator = torch.Generator().manual_seed(0)
    for _ in range(40):
        action = torch.rand(6, 2, generator=generator) * 2 - 1
        one, seen = both.step_and_maybe_reset(one.set("action", action))[::-1]
        other, wanted = alone.step_and_maybe_reset(other.set("action", action[3:]))[::-1]
        assert (seen[3:] == wanted).all()
        assert (one[3:] == other).all()
    assert both.render([0, 5]).shape == (2, 4, 6, 3)
    with pytest.raises(ValueError, match="is 2 batches without set_seeds: it needs 2 seeds, got 3"):
        both.set_seeds([1, 2, 3])
    with pytest.raises(ValueError, match="4 environments cannot be shared|cannot be shared"):
        make_own_env(f"{HERE}:make_points", num_envs=4, seed=[1, 2, 3])


def test_actions_have_the_shape_and_type_of_their_spec_and_fixed_ones_stay() -> None:
    env = make_own_env(f"{HERE}:Buttons", num_envs=2)
    actions = torch.tensor([[0.4, 3.6], [2.6, 4.0]])
    env.step(env.reset().set("action", actions))
    assert [own.pressed for own in env._envs] == [[[0, 4]], [[3, 4]]]
    fixed = make_own_env(f"{HERE}:Buttons", fixed=True)
    assert (fixed.action_spec.space.low < fixed.action_spec.space.high).all()
    assert [side.tolist() for side in fixed.action_limits()] == [[0, 2], [4, 2]]
    fixed.rollout(4)
    (seen,) = fixed._envs
    assert {pressed for _, pressed in seen.pressed} == {2}


def test_what_it_does_at_a_goal_does_not_depend_on_how_many_there_are() -> None:
    for n in (1, 5, 40):
        assert make_own_env(f"{HERE}:Point", num_envs=n, goes_on=True).ends == "never"


def test_a_complete_goal_environment_is_taken_as_it_is() -> None:
    env = make_own_env("torchrl_her_envs:BitFlip", num_envs=2, bits=4)
    assert type(env) is BitFlip
    with pytest.raises(ValueError, match="has its own rewards and ends"):
        make_own_env("torchrl_her_envs:BitFlip", bits=4, termination="never")
    with pytest.raises(ValueError, match="BitFlip needs the option 'bits', as in task.options.bits=..."):
        make_own_env("torchrl_her_envs:BitFlip")


@pytest.mark.parametrize("name", ["Point", "make_points"])
def test_pictures(name: str) -> None:
    env = make_own_env(f"{HERE}:{name}", num_envs=3)
    places = env.reset()["observation"][:, 0]
    frames = env.render()
    assert env.can_render
    assert (frames.shape, frames.dtype) == ((3, 4, 6, 3), torch.uint8)
    assert torch.equal(frames[:, 0, 0, 0], ((places + 1) * 100).to(torch.uint8))
    assert torch.equal(env.render(1), frames[1])


@pytest.mark.parametrize(
    ("path", "options", "message"),
    [
        ("no_such_module:make", {}, "there is no module 'no_such_module' for task=no_such_module:make"),
        (f"{HERE}:Nothing", {}, "needs a function or class 'Nothing' in the module"),
        (f"{HERE}:NOT_CALLABLE", {}, "needs a function or class 'NOT_CALLABLE'"),
        (f"{HERE}:make_number", {}, "must give a TorchRL EnvBase, got int"),
        (
            f"{HERE}:Near",
            {},
            "Near: compute_reward gave .* some steps later, for the same two goals; it must",
        ),
        (f"{HERE}:Lost", {}, "Lost: observation 1 must be a finite number, got (-?inf|nan)"),
        (f"{HERE}:Bare", {}, "lacks the method 'compute_reward'"),
        (f"{HERE}:Endless", {}, "needs a time limit, .* as in task.options.max_steps=100, got None"),
        (f"{HERE}:Wide", {}, r"compute_reward .* must give a tensor \[.*1\] for goals"),
        (f"{HERE}:Point", {"size": 2}, r"must give environments of batch size \[\], got \[2\], or take"),
        (f"{HERE}:Point", {"speed": 2}, "takes no option 'speed'; its options are max_steps, .* dense"),
        (f"{HERE}:Point", {"dense": True}, "has a dense reward"),
        (f"{HERE}:Point", {"termination": "success"}, r"needs info\['is_success'\]"),
    ],
)
def test_what_cannot_be_is_said_in_one_line(path: str, options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message) as raised:
        make_own_env(path, **options)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("name", ["Costly", "make_costly"])
def test_rewards_that_read_further_entries_get_those_of_the_step(name: str) -> None:
    env = make_env(f"{HERE}:{name}", num_envs=3, seed=5, info_keys=["cost"], achieved_reward=-0.5)
    check_env_specs(env)
    steps = rollout(env)
    writer = HERWriter(EnvReward.of(env), k=4, filter_achieved=True)
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(1_000), writer=writer)
    buffer.extend(steps)
    rows = buffer[:]
    after, virtual = rows["next"], rows["virtual"].flatten()
    far = (after["achieved_goal"] - after["desired_goal"]).norm(dim=-1, keepdim=True) >= 0.5
    expected = -far.float() - rows["action"].norm(dim=-1, keepdim=True) / 4
    assert int(virtual.sum()) > 100
    assert (~far[virtual]).any()
    torch.testing.assert_close(after["reward"], expected)


def test_further_entries_must_be_shown_and_given() -> None:
    with pytest.raises(ValueError, match=r"own_point:Costly's info_keys must be among .*cost.*, got 'wind'"):
        make_env(f"{HERE}:Costly", info_keys=["wind"])
    env = make_env(f"{HERE}:Costly", info_keys=["cost"], achieved_reward=-0.5)
    with pytest.raises(ValueError, match=r"EnvReward\.of\(env\)"):
        env.compute_reward(torch.zeros(1, 2), torch.zeros(1, 2))


@pytest.mark.parametrize("name", ["Crane", "make_crane"])
def test_entries_have_names_of_their_own_and_goals_may_be_several(name: str) -> None:
    names: dict[str, Any] = {"achieved_goal_key": ["y", "x"], "desired_goal_key": ["y_to", "x_to"]}
    names["observation_key"] = "sensors"
    env = make_env(f"{HERE}:{name}", num_envs=3, seed=5, **names)
    check_env_specs(env)
    after = rollout(env)["next"]
    assert torch.equal(after["achieved_goal"], after["observation"].flip(-1))
    met = (after["achieved_goal"] - after["desired_goal"]).norm(dim=-1, keepdim=True) < 0.5
    assert met.any()
    assert torch.equal(after["reward"], met.float() - 1)
    assert torch.equal(env.compute_reward(after["achieved_goal"], after["desired_goal"]), after["reward"])
    with pytest.raises(ValueError, match="own_point:Crane's observations must have 'angle', got sensors, "):
        make_env(f"{HERE}:Crane", **{**names, "achieved_goal_key": ["y", "angle"]})
    with pytest.raises(ValueError, match=r"must have one shape, got \[1\], \[1\] and \[1\]$"):
        make_env(f"{HERE}:Crane", **{**names, "desired_goal_key": "y_to"})
