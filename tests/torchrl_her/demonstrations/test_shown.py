"""Demonstrations as a run sees them: its reward and ends, and the stages of its curriculum."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import TransformedEnv

from torchrl_her import Curriculum, CurriculumProgress, CurriculumStage, EnvReward, GoalReward, StateToObs
from torchrl_her.demonstrations import Demonstrations, demonstrate, in_stage, with_reward
from torchrl_her_envs import make_controller, make_env

from .walks import walks


def rewards(own: Demonstrations) -> list[float]:
    return own.rows["next", "reward"].flatten().tolist()


def flags(own: Demonstrations, name: str) -> list[bool]:
    return own.rows["next", name].flatten().tolist()


def test_an_episode_ends_where_its_goal_is_achieved_first() -> None:
    own = with_reward(walks(3, 4, goal=102.0), GoalReward(1.5))  # within one step of the goal
    assert own.lengths.tolist() == [3, 1]  # from 100 to 101
    assert rewards(own) == [-1.0, -1.0, -1.0, 0.0]
    assert flags(own, "terminated") == [False, False, False, True]
    assert flags(own, "truncated") == [False, False, True, False]
    assert flags(own, "done") == [False, False, True, True]
    assert own.states is not None
    assert own.states["place"].flatten().tolist() == [0.0, 1.0, 2.0, 100.0]


def test_one_that_does_not_terminate_any_more_is_truncated() -> None:
    never = EnvReward(lambda a, d: (a == d).float(), lambda a, d: a > 1e9)
    own = with_reward(walks(3, 2), never)
    assert own.lengths.tolist() == [3, 2]
    assert rewards(own) == [0.0, 0.0, 1.0, 0.0, 1.0]
    assert flags(own, "truncated") == flags(own, "done") == [False, False, True, False, True]


def test_one_that_fell_still_does() -> None:
    fallen = walks(3, goal=9.0)
    fallen.rows["next", "terminated"][2], fallen.rows["next", "truncated"][2] = True, False
    own = with_reward(fallen, GoalReward(0.5))
    assert flags(own, "terminated") == [False, False, True]
    assert flags(own, "truncated") == [False] * 3
    assert rewards(own) == [-1.0] * 3


def test_what_was_recorded_stays_as_it_was() -> None:
    own = walks(3, 4, goal=102.0)
    before = own.digest
    with_reward(own, GoalReward(1.5))
    assert own.digest == before


# Stages


def curriculum() -> Curriculum:
    env = make_env("hand_v1")
    return Curriculum([CurriculumStage(**stage) for stage in env.stages()], 11)


@pytest.mark.parametrize("stage", [0, 1])
def test_a_stage_shows_what_its_environments_show(stage: int) -> None:
    """The actions of demonstrations, played in environments of the stage, give the same rows."""
    env = make_env("hand_v1", num_envs=6, seed=3)
    recorded = demonstrate(env, make_controller(env), max_steps=50, task="hand_v1")
    own = in_stage(recorded, curriculum(), stage)
    progress = CurriculumProgress(stages := curriculum())
    progress.set_stage(0, stage)
    shown = TransformedEnv(make_env("hand_v1", num_envs=6, seed=3), StateToObs(stages, progress))
    step, alive = shown.reset(), torch.ones(6, dtype=torch.bool)
    for t in range(int(own.lengths.max())):
        row = own.begins + t
        alive = alive & (t < own.lengths)
        action = torch.zeros(6, 3)
        action[alive] = own.rows["action"][row[alive]]
        step = shown.step(step.set("action", action))
        for key in ("observation", "achieved_goal", "desired_goal"):
            for at in (key, ("next", key)):
                assert torch.equal(own.rows[at][row[alive]], step[at][alive]), (at, t)
        for key in ("reward", "terminated", "truncated", "done"):
            assert torch.equal(own.rows["next", key][row[alive]], step["next", key][alive]), (key, t)
        ended = step["next", "done"].flatten()
        assert torch.equal(alive & (t + 1 == own.lengths), alive & ended)
        step = shown.step_mdp(step)
    assert own.achieved.all()
    assert (own.lengths < recorded.lengths).all() == (stage == 0)


def test_the_full_task_is_what_was_recorded() -> None:
    env = make_env("hand_v1", num_envs=3, seed=3)
    recorded = demonstrate(env, make_controller(env), max_steps=50, task="hand_v1")
    own = in_stage(recorded, curriculum(), 1)
    assert own.lengths.tolist() == recorded.lengths.tolist()
    assert (own.rows == recorded.rows).all()


def test_a_state_of_another_width_is_refused() -> None:
    with pytest.raises(ValueError, match="needs states of width 11, demonstrations of walk have 2"):
        in_stage(walks(3), curriculum(), 0)


def test_episodes_of_an_environment_without_states_have_none() -> None:
    env = TransformedEnv(make_env("hand_v1", num_envs=2, seed=0))
    assert demonstrate(env, make_controller(env), max_steps=3).states is not None  # below the transforms

    class Bare:
        """Only what a rollout needs."""

        def __init__(self) -> None:
            self.env = make_env("hand_v1", num_envs=2, seed=0)

        def rollout(self, *args: object, **options: object) -> TensorDict:
            return self.env.rollout(*args, **options)

    own = demonstrate(Bare(), make_controller(env), max_steps=3)  # type: ignore[arg-type]
    assert own.states is None
    assert own.lengths.tolist() == [3, 3]
