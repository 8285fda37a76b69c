"""Names of options: short, with their group, or as whole groups."""

from __future__ import annotations

from dataclasses import fields

import pytest

from torchrl_her_recipes import make_recipe
from torchrl_her_recipes.config.choices.weights import IBS
from torchrl_her_recipes.config.shortcuts import LONG_ONLY, locate, merge, option_names, place


def test_every_option_is_found_by_its_long_name() -> None:
    for group, names in option_names().items():
        for name in names:
            assert locate(f"{group}.{name}") == (group, name)


def test_short_names_are_unique_except_for_the_names_of_groups() -> None:
    short = {group: names for group, names in option_names().items() if group not in LONG_ONLY}
    every = [name for names in short.values() for name in names if name != "name"]
    several = {"device", *(own.name for own in fields(IBS))}  # which has to be said: of what?
    unique = [name for name in every if name not in several]
    assert sorted(unique) == sorted(set(every) - several)
    assert [locate(name)[1] for name in unique] == unique
    with pytest.raises(ValueError, match=r"write learner\.device or replay\.device"):
        locate("device")


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("sed", "no option 'sed'; did you mean seed"),
        ("runs.seed", "no group 'runs'; did you mean run. The groups are task"),
        ("seed.x", "no option 'seed.x': seed is an option of the group run"),
        ("run", "run is a group of options: write run.seed="),
        ("demonstrations", "demonstrations is a group of options: write demonstrations.episodes="),
        ("file", "no option 'file'; did you mean demonstrations.file?"),
        (
            "task_options.continuing_task",
            "are written task.options.NAME=VALUE: task.options.continuing_task, not task_options.continuing",
        ),
        ("task_options", "are written task.options.NAME=VALUE: task.options, not task_options$"),
        ("options.bits", "are written task.options.NAME=VALUE: task.options.bits, not options.bits$"),
        ("name", "several groups have an option 'name': write task.name or learner.name or weights.name"),
    ],
)
def test_unknown_names_get_a_hint(name: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        locate(name)


def test_one_entry_of_a_mapping_leaves_the_others() -> None:
    base = {"task": {"name": "bit_flip", "options": {"bits": 8, "max_steps": 9}}}
    recipe = make_recipe(base, **{"task.options.bits": 4})
    assert recipe.task.options == {"bits": 4, "max_steps": 9}
    assert type(recipe.task.options) is dict  # as YAML can write it
    assert make_recipe(base, **{"task.options": {"bits": 4}}).task.options == {"bits": 4}
    both = place({"task.options": {"bits": 4}, "task.options.max_steps": 3})
    assert both == {"task": {"options": {"bits": 4, "max_steps": 3}}}


def test_options_of_some_groups_are_never_short() -> None:
    assert locate("episodes") == ("evaluation", "episodes")
    recipe = make_recipe(**{"episodes": 7, "demonstrations.episodes": 3, "demonstrations.file": "demos.pt"})
    assert (recipe.evaluation.episodes, recipe.demonstrations.episodes) == (7, 3)
    assert make_recipe(demonstrations={"episodes": 3, "file": "demos.pt"}).demonstrations.file == "demos.pt"


def test_later_values_replace_earlier_ones() -> None:
    merged = merge(
        {"seed": 1, "task": "hand_v0"}, {"run.seed": 2}, {"task": None, "curriculum": [{"name": "a"}]}
    )
    assert merged == {
        "run": {"seed": 2},
        "task": {"name": "hand_v0"},
        "curriculum": {"stages": [{"name": "a"}]},
    }
