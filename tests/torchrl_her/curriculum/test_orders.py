"""Stages of episodes: which stage each is played in, how its rows carry it, and what is made of them."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import Compose, TransformedEnv
from torchrl.envs.utils import check_env_specs

from torchrl_her import Curriculum, GoalReward, GoalWeights, HERWriter, StateToObs, ZeroPad
from torchrl_her.curriculum import EpisodeStages, StageOutcomes, StageView, TeacherStudent, count_inputs
from torchrl_her.modules import RunningNorm
from torchrl_her.replay_buffers import RunsSampler, StageRule
from torchrl_her.replay_buffers.episodes import Episodes
from torchrl_her.replay_buffers.stage_rules import split_stages

from ..her_data import make_batch, tag
from .test_transforms import TinyEnv, make_three

THREE = make_three()


class Fixed(EpisodeStages):
    """Says which stages come next, and what it was told."""

    def __init__(self, *stages: int, runs: int = 1) -> None:
        super().__init__(THREE, runs=runs, generators=[torch.Generator() for _ in range(runs)])
        self.next, self.told = list(stages), []

    def draw(self, counts: object) -> Tensor:
        some, self.next = self.next[: sum(counts)], self.next[sum(counts) :]  # type: ignore[call-overload]
        return torch.tensor(some, dtype=torch.int64)

    def record_episodes(self, ended: Tensor, achieved: Tensor) -> None:
        self.told.append((ended.tolist(), achieved.tolist()))


def shown(progress: EpisodeStages, num_envs: int, **options: int) -> TransformedEnv:
    seen = progress.curriculum, progress
    transforms = StateToObs(*seen), ZeroPad(*seen), StageOutcomes(progress)
    return TransformedEnv(TinyEnv((num_envs,), **options), Compose(*transforms))


def act(env: TransformedEnv, rows: TensorDictBase, *actions: float) -> TensorDictBase:
    rows = rows.set("action", torch.tensor(actions).unsqueeze(-1))
    return env.step_and_maybe_reset(rows)


# Drawing


def test_all_stages_are_drawn_alike() -> None:
    stages = EpisodeStages(THREE, generators=[torch.Generator().manual_seed(0)])
    counts = stages.draw([3_000]).bincount()
    torch.testing.assert_close(counts / 3_000, torch.full((3,), 1 / 3), atol=0.03, rtol=0.0)


def test_a_share_of_the_episodes_is_of_the_full_task() -> None:
    assert EpisodeStages(THREE, task_share=0.5).shares.tolist() == [[0.25, 0.25, 0.5]]
    stages = EpisodeStages(THREE, task_share=1.0)
    assert stages.draw([100]).tolist() == [2] * 100
    with pytest.raises(ValueError, match=r"task_share must be in \[0, 1\], got 1.5"):
        EpisodeStages(THREE, task_share=1.5)


def test_a_run_draws_as_it_would_alone() -> None:
    both = EpisodeStages(THREE, runs=2, generators=[torch.Generator().manual_seed(seed) for seed in (0, 1)])
    alone = EpisodeStages(THREE, generators=[torch.Generator().manual_seed(1)])
    assert torch.equal(both.draw([5, 20])[5:], alone.draw([20]))
    assert torch.equal(both.draw([0, 7]), alone.draw([7]))


def test_runs_stay_in_the_last_stage() -> None:
    stages = EpisodeStages(THREE)
    assert stages.stages == (2,)
    stages.record(torch.ones(1, 30))
    assert stages.stages == (2,)
    with pytest.raises(ValueError, match="run 0 cannot be moved to stage 1"):
        stages.set_stage(0, 1)


def test_progress_is_preferred_whether_up_or_down() -> None:
    teacher = TeacherStudent(THREE, uniform_share=0.3, memory=100.0)
    assert teacher.shares[0].tolist() == pytest.approx([1 / 3] * 3)  # nothing is known
    ended = torch.tensor([[100, 100, 100]])
    teacher.record_episodes(ended, torch.tensor([[100, 50, 0]]))
    # short - long: (1 - e^-2) - (1 - e^-1) = 0.2325, half of it for the second stage
    assert (teacher.short - teacher.long)[0].tolist() == pytest.approx([0.2325, 0.1163, 0.0], abs=1e-4)
    each = [0.2525 / 0.4088, 0.1363 / 0.4088, 0.02 / 0.4088]  # each with 0.02 for standing still
    assert teacher.shares[0].tolist() == pytest.approx([0.1 + 0.7 * own for own in each], abs=1e-3)
    for _ in range(40):
        teacher.record_episodes(ended, torch.tensor([[100, 50, 0]]))  # nothing changes any more
    assert teacher.shares[0].tolist() == pytest.approx([1 / 3] * 3)
    teacher.record_episodes(ended, torch.tensor([[0, 50, 0]]))  # the first stage is forgotten
    assert teacher.shares[0].tolist() == pytest.approx([0.1 + 0.7 * 0.2525 / 0.2925, *[0.1479] * 2], abs=1e-3)


def test_chance_in_a_learned_stage_does_not_starve_another() -> None:
    teacher, generator = TeacherStudent(THREE), torch.Generator().manual_seed(0)
    shares = []
    for _ in range(2_000):
        achieved = (torch.rand(1, 3, generator=generator) < torch.tensor([[0.97, 0.9, 0.0]])).long()
        teacher.record_episodes(torch.ones(1, 3, dtype=torch.int64), achieved)
        shares.append(teacher.shares[0, 2].item())
    assert sum(shares[500:]) / 1_500 > 0.25  # a third, if nothing moved at all


def test_runs_have_progress_of_their_own() -> None:
    generators = [torch.Generator() for _ in range(2)]
    teacher = TeacherStudent(THREE, runs=2, generators=generators, uniform_share=0.3)
    teacher.record_episodes(torch.tensor([[9, 9, 9], [0, 0, 9]]), torch.tensor([[9, 0, 0], [0, 0, 5]]))
    assert teacher.shares.argmax(1).tolist() == [0, 2]
    assert teacher.shares[1, 0] == teacher.shares[1, 1]


def test_bad_options() -> None:
    with pytest.raises(ValueError, match=r"uniform_share must be in \(0, 1\], got 0"):
        TeacherStudent(THREE, uniform_share=0)
    with pytest.raises(ValueError, match="memory must be positive and finite, got -1"):
        TeacherStudent(THREE, memory=-1)
    with pytest.raises(ValueError, match="2 runs need 2 generators"):
        EpisodeStages(THREE, runs=2)


# What an environment shows. World n starts at 1000 n + (10, 20, 30, 40); a goes to b, b to c, c to d.


def test_each_environment_is_shown_in_its_stage() -> None:
    env = shown(Fixed(2, 0, 1), 3)
    rows = env.reset()
    assert rows["stage"].flatten().tolist() == [2, 0, 1]
    assert rows["observation"].tolist() == [
        [10.0, 20.0, 30.0],
        [1010.0, 0.0, 0.0],
        [2010.0, 2020.0, 0.0],
    ]
    assert rows["achieved_goal"].flatten().tolist() == [30.0, 1010.0, 2020.0]
    assert rows["desired_goal"].flatten().tolist() == [40.0, 1020.0, 2030.0]
    assert rows["input"].tolist() == [
        [10.0, 20.0, 30.0, 40.0],
        [1010.0, 1020.0, 0.0, 0.0],
        [2010.0, 2020.0, 2030.0, 0.0],
    ]


def test_an_episode_stays_in_its_stage() -> None:
    progress = Fixed(0, 1, 1)
    env = shown(progress, 2)
    step, after = act(env, env.reset(), 10.0, 0.0)  # the first stage's goal: a at b
    assert step["next", "reward"].flatten().tolist() == [0.0, -1.0]
    assert step["next", "stage"].flatten().tolist() == [0, 1]
    assert after["stage"].flatten().tolist() == [1, 1]  # a new episode, and the same one
    assert after["desired_goal"].flatten().tolist() == [30.0, 1030.0]
    step, _ = act(env, after, 0.0, 0.0)
    assert step["next", "stage"].flatten().tolist() == [1, 1]
    assert progress.next == []


@pytest.mark.parametrize("terminates", [True, False])
def test_it_is_told_how_the_episodes_of_each_stage_end(terminates: bool) -> None:
    progress = Fixed(0, 0, 1, 2, 0, 0, 0, 0, runs=2)
    progress.curriculum = Curriculum([replace(own, terminates=terminates) for own in THREE.stages], 4)
    env = shown(progress, 4, horizon=1)  # the last stage's goal is near enough from the beginning
    act(env, env.reset(), 10.0, 0.0, 0.0, 0.0)
    assert progress.told == [([[2, 0, 0], [0, 1, 1]], [[1, 0, 0], [0, 0, 1]])]


def test_episodes_with_proposed_goals_do_not_count() -> None:
    progress = Fixed(0, 0)
    outcomes = StageOutcomes(progress)
    flags = torch.tensor([[True], [True]])
    before = TensorDict({"stage": torch.tensor([[0], [2]]), "proposed": torch.tensor([[True], [False]])}, [2])
    outcomes._step(before, TensorDict({"done": flags, "terminated": flags, "reward": 0.0 * flags}, [2]))
    assert progress.told == [([[0, 0, 1]], [[0, 0, 1]])]


def test_specs_hold() -> None:
    check_env_specs(shown(EpisodeStages(THREE), 2))  # type: ignore[arg-type]


def test_thresholds_are_those_of_the_rows_stages() -> None:
    stages = [
        replace(own, threshold=threshold)
        for own, threshold in zip(THREE.stages, (8.0, 12.0, 8.0), strict=True)
    ]
    curriculum = Curriculum(stages, 4)
    progress = Fixed(0, 1, 2)
    progress.curriculum = curriculum
    env = TransformedEnv(TinyEnv((3,)), StateToObs(curriculum, progress))
    step = env.step(env.reset().set("action", torch.zeros(3, 1)))  # each goal is at a distance of 10
    assert step["next", "reward"].flatten().tolist() == [-1.0, 0.0, 7.0]
    assert step["next", "terminated"].flatten().tolist() == [False, True, False]


# The view of another stage

RULES = [*(own.reward_fn for own in THREE.stages[:-1]), lambda achieved, desired: always_seven(achieved)]


def always_seven(achieved: Tensor) -> tuple[Tensor, Tensor]:
    """The reward of the environment itself, with no end."""
    return torch.full_like(achieved, 7.0), torch.zeros_like(achieved, dtype=torch.bool)


@pytest.mark.parametrize("played", range(3))
@pytest.mark.parametrize("wanted", range(3))
@pytest.mark.parametrize("action", [0.0, 10.0])  # with 10 the goal of the first stage is achieved
def test_a_view_shows_what_the_stage_would_have_shown(played: int, wanted: int, action: float) -> None:
    def step(stage: int) -> TensorDictBase:
        env = shown(Fixed(*[stage] * 4), 2)
        return act(env, env.reset(), action, 0.0)[0]

    rows, own, view = step(played), step(wanted), StageView(THREE, wanted, RULES[wanted])  # type: ignore[arg-type]
    before = rows.clone()
    seen = view(rows)
    for key in ("observation", "achieved_goal", "desired_goal", "stage", "reward", "terminated"):
        assert torch.equal(seen["next", key], own["next", key]), key
        if key in own:
            assert torch.equal(seen[key], own[key]), key
    # Where the episode ended in its own stage, it does not go on in any other.
    assert torch.equal(seen["next", "done"], rows["next", "done"] | own["next", "done"])
    cut = rows["next", "done"] & ~own["next", "done"]
    assert torch.equal(seen["next", "truncated"], cut)
    assert (rows == before).all()


def test_a_view_keeps_what_was_played_in_its_stage() -> None:
    env = shown(Fixed(2, 2), 1)
    begun = env.reset().set("desired_goal", torch.tensor([[55.0]]))  # proposed in place of the state's
    rows = act(env, begun, 30.0)[0]  # the environment terminates the full task, which no rule would
    seen = StageView(THREE, 2, RULES[2])(rows)  # type: ignore[arg-type]
    assert seen["desired_goal"].item() == 55.0
    assert seen["next", "terminated"].item()
    assert not seen["next", "truncated"].item()
    with pytest.raises(ValueError, match=r"stage must be in \[0, 2\], got 3"):
        StageView(THREE, 3, strict)


# What is written and sampled


def test_transitions_are_written_for_every_stage() -> None:
    rules = [
        StageRule(rule, view=StageView(THREE, stage, rule))  # type: ignore[arg-type]
        for stage, rule in enumerate(RULES)
    ]
    writer = HERWriter(strict, k=1, strategy="final", stages=rules, exclude=["state", "input"])
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(100), writer=writer, batch_size=4)
    env, steps = shown(Fixed(0, 2, 0, 2), 2, horizon=2), []
    rows = env.reset()
    for _ in range(2):
        step, rows = act(env, rows, 1.0, 2.0)
        steps.append(step)
    index = buffer.extend(torch.stack(steps, -1))
    stored = buffer[:]
    real = stored[~stored["virtual"].squeeze(-1)]
    assert real["stage"].flatten().tolist() == [0] * 4 + [1] * 4 + [2] * 4
    assert stored["stage"].flatten().bincount().tolist() == [8] * 3
    first = real[real["stage"].squeeze(-1) == 1]
    assert first["achieved_goal"].flatten().tolist() == [20.0, 20.0, 1020.0, 1020.0]
    assert first["desired_goal"].flatten().tolist() == [30.0, 30.0, 1030.0, 1030.0]
    # A transition is where the writer says: its last copy, that of the last stage.
    assert stored["stage"][index].flatten().tolist() == [2] * 4
    assert stored["observation"][index][..., 0].tolist() == [[10.0, 11.0], [1010.0, 1012.0]]
    assert writer.counts.real == 12


def test_a_share_of_the_episodes_is_written_for_another_stage() -> None:
    generators = [torch.Generator().manual_seed(seed) for seed in (0, 1)]
    rules = [StageRule(strict, view=lambda rows: rows, share=0.25), StageRule(strict, view=lambda rows: rows)]
    played = [0] * 40 + [1] * 360  # in each of two runs
    lengths, run = torch.full((800,), 2), torch.arange(2).repeat_interleave(400)
    all_of_them = Episodes(torch.arange(1600).view(800, 2), lengths)
    rows = TensorDict({"stage": torch.tensor(played * 2).repeat_interleave(2).unsqueeze(-1)}, [1600])
    lower, upper = split_stages(rows, all_of_them, run, "stage", rules, generators)
    assert torch.equal(upper[2].rows, all_of_them.rows)
    for number in range(2):
        mine = lower[2].rows[lower[3] == number, 0] // 2 - 400 * number
        assert mine[:40].tolist() == list(range(40))  # those that were played in the stage
        drawn = torch.rand(400, generator=torch.Generator().manual_seed(number)) < 0.25
        assert mine[40:].tolist() == (drawn.nonzero().flatten()[drawn[:40].sum() :]).tolist()
    with pytest.raises(ValueError, match=r"share of a StageRule must be in \[0, 1\], got 1.5"):
        HERWriter(strict, stages=[StageRule(strict, share=1.5)])


class OnlyLast(GoalWeights):
    """Prefers the largest goals, and remembers which it was told of."""

    def __init__(self) -> None:
        self.told: list[float] = []

    def __call__(self, goals: Tensor) -> Tensor:
        return (goals[..., 0] % 100 >= 2.5).float()

    def update(self, goals: Tensor) -> None:
        self.told += goals[:, 0].tolist()


def episodes(stage: list[int], length: int = 3) -> TensorDict:
    """One episode of each of some environments, in a stage each."""
    rows = make_batch([[length]] * len(stage))
    stages = torch.tensor(stage).view(-1, 1, 1).expand(-1, length, 1).clone()
    rows["stage"], rows["next", "stage"] = stages, stages.clone()
    return rows


def strict(achieved: Tensor, desired: Tensor) -> tuple[Tensor, Tensor]:
    """A goal is never achieved."""
    return -torch.ones_like(achieved[..., :1]), torch.zeros_like(achieved[..., :1], dtype=torch.bool)


def test_each_stage_has_its_reward() -> None:
    writer = HERWriter(strict, k=1, strategy="final", stages=[StageRule(strict), StageRule(GoalReward(0.5))])
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(100), writer=writer, batch_size=4)
    index = buffer.extend(episodes([1, 0, 1]))
    stored = buffer[:]
    virtual = stored[stored["virtual"].squeeze(-1)]
    achieved = virtual["next", "reward"].squeeze(-1) == 0.0
    assert virtual["stage"][achieved].flatten().tolist() == [1, 1]  # the last steps of two episodes
    assert virtual["next", "terminated"].sum() == 2
    # Each transition is where the writer says.
    assert torch.equal(stored["achieved_goal"][index], episodes([1, 0, 1])["achieved_goal"])


def test_weights_apply_in_some_stages() -> None:
    weights = OnlyLast()
    rules = [StageRule(GoalReward(0.5), weighted=False), StageRule(GoalReward(0.5))]
    writer = HERWriter(strict, k=20, stages=rules, weights=weights)
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(1_000), writer=writer, batch_size=4)
    buffer.extend(episodes([0, 1]))
    stored = buffer[:]
    virtual = stored[stored["virtual"].squeeze(-1)]
    goals = [
        set(virtual["desired_goal"][virtual["stage"].squeeze(-1) == own][:, 0].tolist()) for own in (0, 1)
    ]
    assert goals == [{1.0, 2.0, 3.0}, {tag(1, 0, 3)}]
    assert set(weights.told) == {tag(1, 0, 3)}


def test_goals_of_other_episodes_are_of_the_same_stage() -> None:
    rules = [StageRule(GoalReward(0.5))] * 2
    writer = HERWriter(strict, goal_sources={"achieved": 30}, stages=rules)
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(1_000), writer=writer, batch_size=4)
    buffer.extend(episodes([0, 1, 0]))
    stored = buffer[:]
    virtual = stored[stored["virtual"].squeeze(-1)]
    for stage, envs in ((0, {0.0, 2.0}), (1, {1.0})):
        own = virtual["desired_goal"][virtual["stage"].squeeze(-1) == stage][:, 0]
        assert set(own.div(1000).floor().tolist()) == envs
    state = writer.state_dict()
    other = HERWriter(strict, goal_sources={"achieved": 30}, stages=rules)
    TensorDictReplayBuffer(storage=LazyTensorStorage(1_000), writer=other, batch_size=4)
    other.load_state_dict(state)
    assert [own["achieved"][0].shape for own in other.state_dict()["recent"]] == [(6, 2), (3, 2)]


def test_runs_with_stages_write_what_they_would_alone() -> None:
    def stored(stages: list[int], seeds: list[int]) -> TensorDictBase:
        generators = [torch.Generator().manual_seed(seed) for seed in seeds]
        rules = [StageRule(GoalReward(0.5)), StageRule(GoalReward(1.5))]
        writer = HERWriter(strict, k=2, stages=rules, runs=len(seeds), generators=generators)
        buffer = TensorDictReplayBuffer(
            storage=LazyTensorStorage(100 * len(seeds)),
            writer=writer,
            sampler=RunsSampler(100, runs=len(seeds), generators=generators),
            batch_size=4,
        )
        rows = episodes(stages)
        rows["achieved_goal"] %= 1000.0
        rows["next", "achieved_goal"] %= 1000.0
        buffer.extend(rows)
        return buffer.storage[:]

    both, alone = stored([0, 1, 1, 0], [0, 1]), stored([1, 0], [1])
    for key in ("desired_goal", "stage", ("next", "reward")):
        assert torch.equal(both[key][100:118], alone[key][:18])


def test_rows_without_a_stage_are_refused() -> None:
    writer = HERWriter(strict, stages=[StageRule(strict)])
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(100), writer=writer, batch_size=4)
    with pytest.raises(KeyError, match="episodes of several stages need the entry 'stage'"):
        buffer.extend(make_batch([[3]]))
    with pytest.raises(ValueError, match=r"'stage' must be in \[0, 0\], got 1"):
        buffer.extend(episodes([1]))
    with pytest.raises(TypeError, match="stages must be a list of StageRule"):
        HERWriter(strict, stages=[strict])  # type: ignore[list-item]


def test_sampled_rows_are_padded_by_their_stage() -> None:
    rows = TensorDict(
        {
            "observation": torch.tensor([[1.0, 0.0, 0.0], [1.0, 2.0, 3.0], [1.0, 2.0, 0.0]]),
            "desired_goal": torch.tensor([[9.0], [8.0], [7.0]]),
            "stage": torch.tensor([[0], [2], [1]]),
            "next": {
                "observation": torch.tensor([[4.0, 0.0, 0.0], [4.0, 5.0, 6.0], [4.0, 5.0, 0.0]]),
                "desired_goal": torch.tensor([[9.0], [8.0], [7.0]]),
            },
        },
        [3],
    )
    padded = ZeroPad(THREE, EpisodeStages(THREE))(rows)
    assert padded["input"].tolist() == [[1, 9, 0, 0], [1, 2, 3, 8], [1, 2, 7, 0]]
    assert padded["next", "input"].tolist() == [[4, 9, 0, 0], [4, 5, 6, 8], [4, 5, 7, 0]]
    assert ZeroPad(THREE, EpisodeStages(THREE)).in_keys == ["observation", "desired_goal", "stage"]


def test_inputs_are_counted_stage_by_stage() -> None:
    norm = RunningNorm({"input": 4})
    rows = TensorDict(
        {
            "observation": torch.tensor([[1.0, 0.0, 0.0], [3.0, 2.0, 3.0]]),
            "desired_goal": torch.tensor([[9.0], [8.0]]),
            "stage": torch.tensor([[0], [2]]),
        },
        [2],
    )
    count_inputs(norm, EpisodeStages(THREE), rows, [0], [2])
    moments = norm.moments_of("input")
    assert moments.n.tolist() == [2.0, 2.0, 1.0, 1.0]  # what a stage does not use does not count
