"""Stages and their checks, when a stage ends, and what the unused inputs of a network do."""

from __future__ import annotations

import copy
import math
import pickle
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor, nn

from torchrl_her import Curriculum, CurriculumProgress, CurriculumStage
from torchrl_her.curriculum import zero_unused_inputs
from torchrl_her.modules import ActorNet, CriticNet


def make_stage(name: str = "one", **options: Any) -> CurriculumStage:
    return CurriculumStage(
        **{
            "name": name,
            "observation": [0, 1],
            "achieved_goal": [0],
            "desired_goal": [2],
            "threshold": 0.5,
            **options,
        }
    )


def make_three(threshold: float = 0.5) -> Curriculum:
    """State [a, b, c, d]: a goes to b, then b to c, then c to d."""
    return Curriculum(
        [
            make_stage(
                f"stage {i}",
                observation=range(i + 1),
                achieved_goal=[i],
                desired_goal=[i + 1],
                threshold=threshold,
            )
            for i in range(3)
        ],
        4,
    )


# Stages


def test_widths_and_indices_of_the_hand() -> None:
    reach = make_stage("reach", observation=range(5), achieved_goal=[0, 1], desired_goal=[5, 6])
    throw = make_stage("throw", observation=range(9), achieved_goal=[5, 6], desired_goal=[9, 10])
    curriculum = Curriculum([reach, throw], 11)
    assert len(curriculum) == 2
    assert (curriculum.observation_width, curriculum.goal_width, curriculum.input_width) == (9, 2, 11)
    assert curriculum.first_inputs == 7
    assert curriculum.state_index.tolist() == [  # 11 is the zero behind the state
        [0, 1, 2, 3, 4, 11, 11, 11, 11, 0, 1, 5, 6],
        [0, 1, 2, 3, 4, 5, 6, 7, 8, 5, 6, 9, 10],
    ]
    assert curriculum.input_index.tolist() == [  # the goal stands at 9 and 10
        [0, 1, 2, 3, 4, 9, 10, 11, 11, 11, 11],
        [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10],
    ]


def test_names_stand_for_indices() -> None:
    names = {"hand": [0, 1, 2], "ball": [3, 4], "hole": [5, 6]}
    reach = make_stage("reach", observation="hand", achieved_goal=[0, 1], desired_goal="ball")
    throw = make_stage("throw", observation=["hand", 3, 4], achieved_goal=["ball"], desired_goal="hole")
    first, last = Curriculum([reach, throw], 7, names=names).stages
    assert (first.observation, first.achieved_goal, first.desired_goal) == ((0, 1, 2), (0, 1), (3, 4))
    assert (last.observation, last.achieved_goal, last.desired_goal) == ((0, 1, 2, 3, 4), (3, 4), (5, 6))


def test_a_stage_keeps_what_it_is_given() -> None:
    stage = Curriculum([make_stage(threshold=0.25, instructive=False)], 3).stages[0]
    assert (stage.name, stage.threshold, stage.instructive) == ("one", 0.25, False)
    assert make_stage().instructive
    with pytest.raises(AttributeError, match="cannot assign"):
        stage.threshold = 1.0  # type: ignore[misc]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"threshold": 0.0}, r"stage 'one': threshold must be positive and finite, got 0.0"),
        ({"threshold": -1.0}, r"got -1.0"),
        ({"threshold": math.nan}, r"got nan"),
        ({"threshold": math.inf}, r"got inf"),
        ({"terminates": 3}, r"stage 'one': terminates must be true or false, got 3"),
        ({"observation": []}, r"stage 'one': observation must not be empty"),
        ({"desired_goal": [-1]}, r"stage 'one': desired_goal must have indices of at least 0, got \(-1,\)"),
        ({"observation": [0, 1, 0]}, r"stage 'one': observation must not repeat an index, got \(0, 1, 0\)"),
        ({"desired_goal": [1]}, r"stage 'one': desired_goal must share no index with observation, got \[1\]"),
        (
            {"observation": [1], "desired_goal": [0]},
            r"stage 'one': desired_goal must share no index with achieved_goal, got \[0\]",
        ),
        ({"desired_goal": [2, 3]}, r"stage 'one': .* the same width, got \(0,\) and \(2, 3\)"),
        ({"constant_goal": [0.5]}, r"stage 'one': .* the same width, got \(0,\) and \(2, 0.5\)"),
        ({"desired_goal": [], "constant_goal": [math.nan]}, r"constant_goal must be finite, got \(nan,\)"),
        ({"desired_goal": [], "constant_goal": [1.0, 2.0]}, r"the same width, got \(0,\) and \(1.0, 2.0\)"),
        ({"desired_goal": []}, r"stage 'one': desired_goal must not be empty"),
    ],
)
def test_bad_stages_are_named(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_stage(**options)


def test_a_goal_or_its_last_entries_may_be_constant() -> None:
    gap = CurriculumStage(
        name="gap", observation=[0, 1], achieved_goal=[0, 1], constant_goal=[5.0, 8.5], threshold=0.5
    )
    cross = CurriculumStage(
        name="cross", observation=[0, 1], achieved_goal=[0, 1], desired_goal=[2, 3], threshold=0.5
    )
    half = CurriculumStage(
        name="half",
        observation=[0, 1],
        achieved_goal=[0, 1],
        desired_goal=[2],
        constant_goal=[0.5],
        threshold=0.5,
    )
    curriculum = Curriculum([gap, half, cross], 4)
    states = torch.tensor([[1.0, 2.0, 3.0, 4.0], [6.0, 7.0, 8.0, 9.0]])
    index = curriculum.state_index
    assert curriculum.extend(states)[:, index[0]].tolist() == [
        [1.0, 2.0, 1.0, 2.0, 5.0, 8.5],
        [6.0, 7.0, 6.0, 7.0, 5.0, 8.5],
    ]
    assert curriculum.extend(states)[1, index[1]].tolist() == [6.0, 7.0, 6.0, 7.0, 8.0, 0.5]
    assert curriculum.extend(states)[1, index[2]].tolist() == [6.0, 7.0, 6.0, 7.0, 8.0, 9.0]


def test_goals_narrower_than_the_last_stage_s_have_zeros_behind_them() -> None:
    one = make_stage("one", observation=[0], desired_goal=[1])
    fixed = make_stage("fixed", observation=[0], desired_goal=[], constant_goal=[9.0])
    both = make_stage("both", achieved_goal=[0, 1], desired_goal=[2, 3])
    curriculum, state = Curriculum([one, fixed, both], 4), torch.tensor([5.0, 6.0, 7.0, 8.0])
    assert (curriculum.goal_width, curriculum.input_width, curriculum.first_inputs) == (2, 4, 2)
    shown = [[part.tolist() for part in curriculum.show(state, stage)] for stage in range(3)]
    assert shown == [
        [[5.0, 0.0], [5.0, 0.0], [6.0, 0.0]],
        [[5.0, 0.0], [5.0, 0.0], [9.0, 0.0]],
        [[5.0, 6.0], [5.0, 6.0], [7.0, 8.0]],
    ]


def test_indices_must_be_whole_numbers() -> None:
    with pytest.raises(TypeError, match="float"):
        make_stage(observation=[0.5])


@pytest.mark.parametrize(
    ("stages", "message"),
    [
        ([], r"at least one stage, got none"),
        ([make_stage(desired_goal=[], constant_goal=[1.0])], r"'one': .* its goal must not be constant"),
        ([make_stage(desired_goal=[9])], r"stage 'one': desired_goal has index 9, .* at most 4 is allowed"),
        (
            [make_stage("a", observation=[0, 1, 4]), make_stage("b")],
            r"stage 'a': observation has 3 entries, but may have at most 2, as in the last stage, 'b'",
        ),
        (
            [make_stage("a", achieved_goal=[0, 1], desired_goal=[2, 3]), make_stage("b")],
            r"stage 'a': achieved_goal has 2 entries, but may have at most 1, as in the last stage, 'b'",
        ),
        ([make_stage("a", observation="arm")], r"stage 'a': .* unknown name 'arm'; known are 'hand', 'hole'"),
        # What a stage of names hides until the names are resolved
        ([make_stage("a", desired_goal="hand")], r"stage 'a': .* share no index with observation, got \[0\]"),
        ([make_stage("a", observation=["hand", 0])], r"stage 'a': .* not repeat an index, got \(0, 0\)"),
        ([make_stage("a", desired_goal="hole")], r"stage 'a': .* the same width, got \(0,\) and \(2, 3\)"),
    ],
)
def test_bad_curricula_are_named(stages: list[CurriculumStage], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Curriculum(stages, 5, names={"hand": [0], "hole": [2, 3]})


def test_a_stage_may_be_as_wide_as_the_last_one() -> None:
    curriculum = Curriculum([make_stage("a"), make_stage("b", desired_goal=[3])], 4)
    assert curriculum.first_inputs == curriculum.input_width == 3


# The success window


def make_progress(**options: Any) -> CurriculumProgress:
    return CurriculumProgress(make_three(), **{"window": 4, "success_threshold": 0.75, **options})


def flags(text: str) -> Tensor:
    """Samples written as ``"1101"``."""
    return torch.tensor([float(sign) for sign in text])


def test_the_defaults_of_the_thesis() -> None:
    progress = CurriculumProgress(make_three())
    assert not progress.record_run(0, flags("1" * 17 + "00"))  # 19 samples are no window
    assert progress.record_run(0, flags("1"))  # 18 of 20: exactly 0.9
    worse = CurriculumProgress(make_three())
    assert not worse.record_run(0, flags("1" * 17 + "000"))


def test_a_stage_ends_after_some_evaluations_at_the_latest() -> None:
    curriculum = Curriculum([make_stage("a"), make_stage("b")], 5)
    progress = CurriculumProgress(curriculum, runs=2, window=2, patience=3)
    poor = torch.tensor([[0.0], [0.5]])
    assert progress.record(poor).tolist() == progress.record(poor).tolist() == [False, False]
    again = CurriculumProgress(curriculum, runs=2, window=2, patience=3)
    again.load_state_dict(progress.state_dict())
    assert again.evaluations == [2, 2]
    assert again.record(poor).tolist() == [True, True]
    assert (again.stages, again.evaluations) == ((1, 1), [0, 0])
    assert [again.record(poor).tolist() for _ in range(4)] == 4 * [[False, False]]  # the last one has no end


def test_each_run_moves_on_by_itself() -> None:
    progress = make_progress(runs=3)
    moved = progress.record(torch.stack((flags("0000"), flags("1111"), flags("1100"))))
    assert moved.tolist() == [False, True, False]
    assert moved.dtype == torch.bool
    assert progress.stage.tolist() == [0, 1, 0]
    assert progress.stage.dtype == torch.int64
    assert progress.successes == [[0.0] * 4, [], [1.0, 1.0, 0.0, 0.0]]
    assert [progress.stage_of(run).name for run in range(3)] == ["stage 0", "stage 1", "stage 0"]


def test_what_is_read_is_a_copy() -> None:
    progress = make_progress()
    progress.stage.add_(2)
    progress.successes[0].append(1.0)
    assert progress.stages == (0,)
    assert progress.successes == [[]]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"runs": 0}, "runs must be at least 1, got 0"),
        ({"window": 0}, "window must be at least 1, got 0"),
        ({"success_threshold": 0.0}, r"success_threshold must be in \(0, 1\], got 0.0"),
        ({"success_threshold": 1.1}, r"got 1.1"),
        ({"success_threshold": math.nan}, r"got nan"),
    ],
)
def test_bad_options_are_named(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_progress(**options)


def test_bad_samples_are_named_and_none_of_them_counts() -> None:
    progress = make_progress(runs=2)
    good = torch.ones(4)
    for bad, message in (
        (torch.stack((good, 2 * good)), r"in \[0, 1\], got 2.0"),
        (torch.stack((good, math.nan * good)), r"in \[0, 1\], got nan"),
        (torch.ones(3, 4), r"must be \[2, n\], got \[3, 4\]"),
        (good, r"must be \[2, n\], got \[4\]"),
    ):
        with pytest.raises(ValueError, match=message):
            progress.record(bad)
    with pytest.raises(ValueError, match=r"must be \[n\], got \[\]"):
        progress.record_run(0, torch.tensor(1.0))
    for run in (-1, 2):
        with pytest.raises(ValueError, match=rf"run must be in \[0, 1\], got {run}"):
            progress.record_run(run, good)
    with pytest.raises(ValueError, match=r"stage must be in \[0, 2\], got 3"):
        progress.set_stage(0, 3)
    assert progress.stages == (0, 0)
    assert progress.successes == [[], []]


def test_state_goes_through_a_file(tmp_path: Path) -> None:
    progress, other = make_progress(runs=3), make_progress(runs=3)
    progress.set_stage(2, 2)
    progress.record(torch.stack((flags("1100"), flags("1111"), flags("1111"))))
    torch.save(progress.state_dict(), tmp_path / "progress.pt")
    other.load_state_dict(torch.load(tmp_path / "progress.pt", weights_only=True))
    assert other.stages == (0, 1, 2)
    assert other.successes == [[1.0, 1.0, 0.0, 0.0], [], [1.0] * 4]
    more = flags("11").expand(3, 2)  # goes on as the first one does
    assert other.record(more).tolist() == progress.record(more).tolist() == [False, False, False]
    assert other.record_run(0, flags("1")) is progress.record_run(0, flags("1")) is True


def test_state_is_not_shared() -> None:
    progress, other = make_progress(), make_progress()
    state = progress.state_dict()
    other.load_state_dict(state)
    other.record_run(0, flags("0"))
    assert progress.successes == state["successes"] == [[]]


def test_a_state_that_does_not_fit_is_refused() -> None:
    with pytest.raises(ValueError, match="the state must have 1 runs, got 2"):
        make_progress().load_state_dict(make_progress(runs=2).state_dict())
    deep = make_progress()
    deep.set_stage(0, 2)
    shallow = CurriculumProgress(Curriculum([make_stage()], 3))
    with pytest.raises(ValueError, match=r"stages in the state must be in \[0, 0\], got \(2,\)"):
        shallow.load_state_dict(deep.state_dict())


def test_a_smaller_window_keeps_the_latest_samples() -> None:
    progress, smaller = make_progress(), make_progress(window=2)
    progress.record_run(0, flags("1001"))
    smaller.load_state_dict(progress.state_dict())
    assert smaller.successes == [[0.0, 1.0]]


def test_progress_can_be_copied_and_pickled() -> None:
    progress = make_progress()
    progress.set_stage(0, 1)
    for copied in (copy.deepcopy(progress), pickle.loads(pickle.dumps(progress))):
        copied.set_stage(0, 2)
        assert (progress.stages, copied.stages) == ((1,), (2,))


@settings(max_examples=100, deadline=None)
@given(
    st.lists(st.lists(st.booleans(), max_size=12), max_size=6), st.integers(1, 5), st.sampled_from([0.5, 1.0])
)
def test_progress_by_the_book(calls: list[list[bool]], window: int, threshold: float) -> None:
    progress = make_progress(window=window, success_threshold=threshold)
    stage, seen = 0, []
    for call in calls:
        moved = False
        for sample in call:
            seen.append(sample)
            if stage < 2 and len(seen) >= window and sum(seen[-window:]) >= threshold * window:
                stage, seen, moved = stage + 1, [], True
                break
        assert progress.record_run(0, torch.tensor(call, dtype=torch.bool)) is moved
        assert progress.stages == (stage,)
        assert progress.successes == [seen[-window:]]


# Unused inputs


def test_weights_of_unused_inputs_are_multiplied() -> None:
    weight = torch.arange(1.0, 9.0).view(1, 4, 2)
    assert zero_unused_inputs(weight, 3).tolist() == [[[1, 2], [3, 4], [5, 6], [0, 0]]]
    assert zero_unused_inputs(weight, 2, alpha=0.5).tolist() == [[[1, 2], [3, 4], [2.5, 3], [3.5, 4]]]
    assert torch.equal(zero_unused_inputs(weight, 1, alpha=1.0), weight)
    assert torch.equal(zero_unused_inputs(weight, 4), weight)
    assert weight[0, 3].tolist() == [7.0, 8.0]  # what was given stays


@pytest.mark.parametrize(
    ("used", "alpha", "message"),
    [
        (5, 0.0, r"used must be in \[0, 4\], got 5"),
        (-1, 0.0, r"used must be in \[0, 4\], got -1"),
        (2, -0.1, r"alpha must be finite and at least 0, got -0.1"),
        (2, math.nan, r"got nan"),
    ],
)
def test_bad_numbers_are_named(used: int, alpha: float, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        zero_unused_inputs(torch.zeros(1, 4, 2), used, alpha=alpha)


def prepare(net: ActorNet | CriticNet, used: int, alpha: float) -> nn.Parameter:
    first = net.layers[0][0] if isinstance(net, ActorNet) else net.first[0][0]
    with torch.no_grad():
        first.weight.copy_(zero_unused_inputs(first.weight, used, alpha=alpha))
    return first.weight


def inputs_of_stage(stage: int, rows: int) -> Tensor:
    """Network inputs of the three-stage curriculum: 2, 3 or 4 numbers, then zeros."""
    return torch.cat((torch.randn(rows, stage + 2), torch.zeros(rows, 2 - stage)), -1)


def test_new_inputs_change_no_output_at_the_change_of_stage() -> None:
    """With alpha = 0: the first inputs keep their values (b was the goal, and is b), all others are free."""
    for alpha, same in ((0.0, True), (1.0, False)):
        actor = ActorNet(4, 1)
        prepare(actor, 2, alpha)
        old = inputs_of_stage(0, 8)
        new = torch.cat((old[:, :2], 100 * torch.randn(8, 2)), -1)
        assert torch.equal(actor(old), actor(new)) is same
