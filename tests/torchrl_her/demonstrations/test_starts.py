"""Episodes that start at states of demonstrations."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs import EnvBase, StepCounter, TransformedEnv

from torchrl_her.demonstrations import Demonstrations, DemonstrationStarts, demonstrate
from torchrl_her.trainers import load_checkpoint, save_checkpoint
from torchrl_her_envs import make_controller, make_env
from torchrl_her_envs.throwing.env import base_env

from .walks import walks


def thrown(count: int = 5) -> Demonstrations:
    env = make_env("hand_v1", num_envs=count, seed=9)
    return demonstrate(env, make_controller(env), max_steps=50, task="hand_v1")


SHOWN = thrown()


def started(env: EnvBase) -> list[tuple[int, int] | None]:
    """For each environment: the demonstration and the steps before its end at which it is."""
    worlds, found = base_env(env).world_state_dict(), []
    assert SHOWN.states is not None
    for k in range(env.batch_size[0]):
        same = torch.ones(len(SHOWN.rows), dtype=torch.bool)
        for name, own in SHOWN.states.items():
            same &= (own == worlds[name][k]).flatten(1).all(1) if own.ndim > 1 else own == worlds[name][k]
        rows = same.nonzero().flatten().tolist()
        assert len(rows) < 2
        episode = int(SHOWN.episode[rows[0]]) if rows else 0
        end = int(SHOWN.begins[episode] + SHOWN.lengths[episode])
        found.append((episode, end - rows[0]) if rows else None)
    return found


def make(num_envs: int = 40, seeds: tuple[int, ...] = (0,), **options: Any) -> TransformedEnv:
    generators = [torch.Generator().manual_seed(seed) for seed in seeds]
    starts = DemonstrationStarts(SHOWN, runs=len(seeds), generators=generators, **options)
    return TransformedEnv(make_env("hand_v1", num_envs=num_envs, seed=list(seeds)), starts)


def do_nothing(env: EnvBase, shown: TensorDict) -> TensorDict:
    return env.step(shown.set("action", torch.zeros(*env.batch_size, 3)))["next"]


def test_a_share_of_the_episodes_starts_near_the_end_of_demonstrations() -> None:
    env = make(400, share=0.25, width=3)
    shown = env.reset()
    found = [own for own in started(env) if own is not None]
    assert 70 <= len(found) <= 130
    assert {episode for episode, _ in found} == set(range(len(SHOWN)))
    assert {back for _, back in found} == {1, 2, 3}
    worlds = base_env(env).worlds
    assert torch.equal(shown["desired_goal"], worlds.goal.float())  # that of the demonstration
    assert worlds.step.tolist() == [0] * 400


@pytest.mark.parametrize(("share", "count"), [(0.0, 0), (1.0, 40)])
def test_none_or_all(share: float, count: int) -> None:
    env = make(share=share)
    env.reset()
    assert sum(own is not None for own in started(env)) == count


def test_what_the_others_do_is_what_they_would_do_anyway() -> None:
    env, plain = make(), make_env("hand_v1", num_envs=40, seed=0)
    one, other = env.reset(), plain.reset()
    usual = torch.tensor([own is None for own in started(env)])
    assert 0 < usual.sum() < 40
    assert torch.equal(one["state"][usual], other["state"][usual])


def test_a_partial_reset_leaves_the_others() -> None:
    env = make(share=1.0)
    after = do_nothing(env, env.reset())
    before = base_env(env).world_state_dict()
    mask = torch.zeros(40, 1, dtype=torch.bool)
    mask[::3] = True
    shown = env.reset(after.clone().set("_reset", mask))
    now, kept = base_env(env).world_state_dict(), ~mask.flatten()
    assert all(torch.equal(own[kept], before[name][kept]) for name, own in now.items())
    assert torch.equal(shown["state"][kept], after["state"][kept])
    assert all(own is not None for own in [started(env)[k] for k in range(0, 40, 3)])


def test_episodes_that_succeed_let_starts_walk_back() -> None:
    env = make(share=1.0, width=1, stride=1, threshold=1.0, samples=40)
    starts: DemonstrationStarts = env.transform
    for back in range(1, 4):  # in the air, the ball flies home by itself
        shown = env.reset()
        assert {own[1] for own in started(env) if own is not None} == {back}
        for _ in range(back):
            assert starts.walk.back == [back]
            shown = do_nothing(env, shown)
        assert shown["terminated"].all()
        assert starts.walk.back == [back + 1]


def test_episodes_that_fail_or_that_are_cut_short_do_not() -> None:
    env = make(share=1.0, width=1, stride=1, threshold=1.0, samples=1)
    env.reset()
    env.reset()  # nobody knows how the first ones would have ended
    assert env.transform.walk.back == [1]
    base_env(env).worlds.goal[:] = 5.0
    shown = env.reset()
    base_env(env).worlds.goal[:] = 5.0
    for _ in range(50):
        shown = do_nothing(env, shown)
    assert shown["truncated"].all()
    assert env.transform.walk.back == [1]


def test_usual_episodes_do_not_count() -> None:
    env = make(share=0.0, threshold=1.0, samples=1, stride=1)
    shown = env.reset()
    base_env(env).worlds.goal[:] = shown["achieved_goal"].double()  # the ball lies at the goal
    assert do_nothing(env, shown)["terminated"].all()
    assert env.transform.walk.back == [4]


def test_another_transform_may_say_how_episodes_end() -> None:
    env = make(share=1.0, width=1, stride=1, threshold=1.0, samples=40)
    starts = env.transform

    class AllFail(StepCounter):
        def _step(self, tensordict: TensorDict, next_tensordict: TensorDict) -> TensorDict:
            out = super()._step(tensordict, next_tensordict)
            out["terminated"] = torch.zeros_like(out["terminated"])
            return out

    env.append_transform(AllFail())
    env.append_transform(starts.outcomes())
    do_nothing(env, env.reset())
    assert starts.walk.back == [1]
    assert starts.walk.state_dict()["outcomes"] == [[False] * 40]


# Several runs


def test_each_run_starts_as_if_it_were_alone() -> None:
    together = make(20, (3, 4), share=0.5)
    alone = [make(10, (seed,), share=0.5) for seed in (3, 4)]
    for _ in range(3):
        shown, own = together.reset(), [env.reset() for env in alone]
        assert torch.equal(shown["state"], torch.cat([each["state"] for each in own]))
        after = do_nothing(together, shown)
        ends = torch.cat([do_nothing(env, each)["done"] for env, each in zip(alone, own, strict=True)])
        assert torch.equal(after["done"], ends)
    assert together.transform.walk.back == [env.transform.walk.back[0] for env in alone]


def test_a_run_may_get_other_demonstrations() -> None:
    env = make(20, (3, 4), share=1.0, width=1, samples=1, threshold=1.0)
    do_nothing(env, env.reset())
    assert env.transform.walk.back[0] > 1
    env.transform.show(SHOWN.select([2]), run=0)
    env.reset()
    found = [own for own in started(env) if own is not None]
    assert found[:10] == [(2, 1)] * 10
    assert {episode for episode, _ in found[10:]} != {2}


# State


def test_it_goes_on_from_its_state(tmp_path: Any) -> None:
    def play(env: TransformedEnv, shown: TensorDict, steps: int) -> tuple[Tensor, TensorDict]:
        seen = []
        for _ in range(steps):
            stepped = env.step(shown.set("action", torch.zeros(40, 3)))
            shown = env.maybe_reset(env.step_mdp(stepped))
            seen.append(shown["state"])
        return torch.stack(seen), shown

    options: dict[str, Any] = {"share": 0.5, "width": 2, "samples": 5, "stride": 1}
    env, other = make(**options), make(seeds=(7,), **options)
    _, shown = play(env, env.reset(), 3)
    state = {"starts": dict(env.transform.state_dict()), "worlds": base_env(env).world_state_dict()}
    save_checkpoint(state, tmp_path / "state.pt")
    kept = shown.clone()
    expected, _ = play(env, shown, 4)
    state = load_checkpoint(tmp_path / "state.pt")
    other.reset()
    other.transform.load_state_dict(state["starts"])
    base_env(other).load_world_state_dict(state["worlds"])
    found, _ = play(other, kept, 4)
    assert torch.equal(found, expected)
    assert other.transform.walk.state_dict() == env.transform.walk.state_dict()


# What it refuses


@pytest.mark.parametrize(
    ("shown", "options", "message"),
    [
        (SHOWN, {"share": 1.5}, r"share must be in \[0, 1\], got 1.5"),
        (SHOWN, {"width": 0}, "width must be at least 1, got 0"),
        ([SHOWN], {"runs": 2}, "runs=2 needs as many demonstrations, got 1"),
        (SHOWN, {"runs": 2, "generators": [None]}, "runs=2 needs as many generators, got 1"),
        (walks(3, states=False), {}, "demonstrations of walk hold no physical states that episodes could"),
        (walks(3, 4, goal=77.0), {}, "none of 2 demonstrations of walk achieves its goal"),
    ],
)
def test_what_it_refuses(shown: Any, options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        DemonstrationStarts(shown, **options)


def test_only_demonstrations_that_succeed_are_starts() -> None:
    starts = DemonstrationStarts(walks(2, 3, goal=103.0))
    assert [own.lengths.tolist() for own in starts._shown] == [[3]]


def test_an_environment_that_cannot_start_anywhere_is_refused_by_name() -> None:
    env = make_env("gym:torchrl_her/HandThrow-v1")
    with pytest.raises(ValueError, match="HandThrow-v1 cannot be started at states of demonstrations"):
        TransformedEnv(env, DemonstrationStarts(SHOWN)).reset()


def test_environments_that_cannot_be_shared_out_are_refused() -> None:
    starts = DemonstrationStarts([SHOWN] * 3, runs=3)
    with pytest.raises(ValueError, match="a batch must have a multiple of runs=3 environments, got 4"):
        TransformedEnv(make_env("hand_v1", num_envs=4, seed=0), starts).reset()
