"""The ids under which gymnasium knows our tasks."""

from __future__ import annotations

import warnings

import gymnasium

from torchrl_her_envs import TASKS, gym_id, register_gym_ids

from .tasks import IDS, make


def test_every_task_has_a_name_of_gymnasium_s() -> None:
    assert {name: gym_id(task) for name, task in TASKS.items()} == IDS
    assert set(IDS.values()) <= set(gymnasium.registry)


def test_names_with_the_module_work_where_nothing_was_imported() -> None:
    assert gymnasium.make(f"torchrl_her_envs:{IDS['hand_v1']}").unwrapped.spec.id == IDS["hand_v1"]


def test_no_task_is_called_out_of_date() -> None:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        register_gym_ids()
        make("hand_v0")
    assert not [warning for warning in caught if "out of date" in str(warning.message)]
