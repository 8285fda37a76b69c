"""The order of a curriculum's stages: its options, its former names, and one of one's own."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import pytest
import torch

from torchrl_her import CurriculumProgress
from torchrl_her.curriculum import TeacherStudent
from torchrl_her_recipes import ORDER, Order, Recipe, build, make_recipe, option
from torchrl_her_recipes.config.choices.order import AllAtOnce, Teacher, Threshold
from torchrl_her_recipes.runs.curriculum import move_on

from ..small import small


def test_short_names_choose_an_order_and_its_options() -> None:
    assert make_recipe(algo="cher", window=5, stage_epsilon=0.3).order == Threshold(
        window=5, stage_epsilon=0.3
    )
    assert make_recipe(algo="cher", order="all_at_once", task_share=1).order == AllAtOnce(task_share=1.0)
    recipe = make_recipe(algo="cher", order={"name": "teacher_student", "even_share": 0.5})
    assert recipe.order == Teacher(even_share=0.5)
    assert Recipe.from_dict(recipe.to_dict()) == recipe
    assert recipe.replace(order="threshold").order == Threshold()
    assert recipe.replace(algo="her").order == Threshold()  # as other options of curricula


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"curriculum.order": "all_at_once"}, "curriculum.order is called order now"),
        ({"curriculum": {"window": 5}}, "curriculum.window is called order.window now"),
        ({"curriculum.stage_epochs": 5}, "curriculum.stage_epochs is called order.stage_epochs now"),
        ({"curriculum.widow": 5}, "no option 'curriculum.widow'; the options of curriculum are name"),
        ({"order": "treshold"}, "order must be one of threshold, .* got 'treshold'; did you mean threshold?"),
        ({"order": "teacher_student", "even_share": 0.0}, "even_share must be above 0 and at most 1, got 0"),
        ({"even_share": 0.5}, "order=threshold has no option even_share; order=teacher_student has it"),
        ({"algo": "her", "order": "teacher_student"}, "order=teacher_student has no effect with algo=her"),
        ({"learner": "sac", "stage_epsilon": 0.5}, "stage_epsilon=0.5 has no effect with learner=sac"),
    ],
)
def test_what_cannot_be_is_refused_by_name(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_recipe(**{"algo": "cher", **options})


def test_the_options_of_a_teacher_arrive() -> None:
    options = {"progress_memory": 50.0, "even_share": 0.5, "least_progress": 0.1}
    state = build(small(task="hand_v1", algo="cher", order="teacher_student", **options)).curriculum
    assert isinstance(state.progress, TeacherStudent)
    assert (state.progress.memory, state.progress.uniform_share, state.progress.still) == (50.0, 0.5, 0.1)


def test_an_order_of_ones_own_moves_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    @dataclass(frozen=True, kw_only=True)
    class Soon(Order):
        """Each stage takes some epochs."""

        name = "soon"
        maker = f"{__name__}:make_soon"
        stay: int = option(2, "epochs of a stage", at_least=1)

    monkeypatch.setitem(ORDER, "soon", Soon)
    components = build(small(task="hand_v1", algo="cher", order="soon", stay=3, epsilon_start=0.4))
    state, failures = components.curriculum, torch.zeros(1, 4)
    assert [len(move_on(components, state, failures, 0)) for _ in range(4)] == [0, 0, 1, 0]
    assert state.at_the_top(0)
    assert components.exploration.epsilon.tolist() == [1.0]  # it has no option stage_epsilon


def make_soon(options: Any, curriculum: Any, *, runs: int, **_: Any) -> CurriculumProgress:
    return CurriculumProgress(curriculum, runs=runs, patience=options.stay)
