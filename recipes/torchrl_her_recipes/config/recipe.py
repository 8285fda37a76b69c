"""The class :class:`Recipe`, which holds all options of a training run, and functions that make recipes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

from torchrl_her_envs.registry import get_task_spec
from torchrl_her_recipes.config.algorithms import get_algorithm
from torchrl_her_recipes.config.choices.behavior import Proposed
from torchrl_her_recipes.config.choices.learners import BY_ACTIONS
from torchrl_her_recipes.config.groups import Groups
from torchrl_her_recipes.config.imports import permit_task
from torchrl_her_recipes.config.options import AUTO
from torchrl_her_recipes.config.shortcuts import GROUPS, KINDS, Nested, chosen, over, place, short_name
from torchrl_her_recipes.config.without_effect import without_effect

# Options that may change when a run is resumed, since they do not affect the training done so far.
EXTENDING = ("epochs", "checkpoint_interval", "keep_checkpoints", "keep_buffer", "pictures", "log")

# For each group: an option, and the options that it replaces if it is given.
_ALTERNATIVES = {
    "run": ("frames", ("epochs",)),
    "curriculum": ("stages", ("name",)),
    "hindsight": ("goal_sources", ("k", "strategy")),
}


@dataclass(frozen=True, kw_only=True)
class Recipe(Groups):
    """All options of a training run, as groups of plain values that have defaults.

    :func:`make_recipe` makes a recipe from short names of options. Options with the value ``auto`` are
    computed from the task's environment when the run is built, see ``torchrl_her_recipes.config.resolve``.
    Frames are environment steps.

    Raises:
        ValueError: a value is invalid or has no effect; the message names it and what is allowed.

    Example:
        >>> from torchrl_her_recipes.config.groups import HindsightConfig, RunConfig
        >>> recipe = Recipe(hindsight=HindsightConfig(algo="her"), run=RunConfig(seed=3))
        >>> recipe.learner.learning_rate, recipe.learner.gamma
        (0.001, 'auto')
    """

    def __post_init__(self) -> None:
        if self.hindsight.algo == AUTO and self.curriculum.stages is not None:
            object.__setattr__(self, "hindsight", replace(self.hindsight, algo="cher"))
        if self.run.frames is not None and self.collection.epoch_frames != AUTO:
            epochs = -(-self.run.frames // self.collection.epoch_frames)
            object.__setattr__(self, "run", replace(self.run, frames=None, epochs=epochs))
        if (given := self.hindsight.algorithm.weights) not in (None, self.weights.name):
            problem = f"weights must be {given} with algo={self.hindsight.algo}, got {self.weights.name}"
            raise ValueError(f"{problem}; choose another algo, as in algo=her weights=rare")
        self._check_proposed()
        changed = self.changed()
        for (group, name), why in without_effect(self).items():
            if (value := changed.get(group, {}).get(name)) is not None:
                raise ValueError(f"{short_name(group, name)}={value} has no effect {why}: leave it out")

    def _check_proposed(self) -> None:
        """Refuses options that cannot be used together with proposed behavior goals."""
        proposed, num_envs = self.behavior, self.collection.num_envs
        if not isinstance(proposed, Proposed):
            return
        if self.collection.processes > 0:
            raise ValueError(
                f"behavior={proposed.name} proposes goals that this process has collected: it needs "
                f"processes=0, got processes={self.collection.processes}"
            )
        if num_envs != AUTO and proposed.goal_memory < num_envs:
            raise ValueError(
                f"goal_memory={proposed.goal_memory} must be at least num_envs={num_envs}, "
                "since all environments get goals at once"
            )

    @property
    def total_frames(self) -> int:
        """Number of environment steps in a whole run."""
        return self.run.epochs * self.collection.epoch_frames

    @property
    def seeds(self) -> list[int]:
        """The seed of each run."""
        return [self.run.seed + run for run in range(self.run.num_runs)]

    def replace(self, **values: Any) -> Recipe:
        """Returns a copy with other values of some options, by their short names; see :func:`make_recipe`.

        Example:
            >>> Recipe().replace(seed=7).run.seed
            7
        """
        return compose(self.to_dict(), values)

    def extended(self, **values: Any) -> Recipe:
        """Returns a copy for resuming a run, with new values of options that may change then.

        Raises:
            ValueError: an option other than ``epochs``, ``checkpoint_interval``, ``keep_checkpoints``,
                ``keep_buffer``, ``pictures`` and ``log`` is given.

        Example:
            >>> Recipe().extended(epochs=80).run.epochs
            80
        """
        check_extending(values)
        return self.replace(**values)

    def to_dict(self) -> Nested:
        """Returns all values by group and name; omits the name of the weights if the algorithm implies it."""
        named = {group: {"name": getattr(self, group).name} for group in KINDS}
        if self.hindsight.algorithm.weights is not None:
            del named["weights"]
        return {group: named.get(group, {}) | asdict(options) for group, options in vars(self).items()}

    def changed(self) -> Nested:
        """Returns the values that differ from the defaults, by group and name.

        Example:
            >>> Recipe().replace(seed=3, gamma=0.9).changed()
            {'learner': {'gamma': 0.9}, 'run': {'seed': 3}}
        """
        changed: Nested = {}
        for group, values in self.to_dict().items():
            defaults = {definition.name: definition.default for definition in fields(getattr(self, group))}
            defaults |= {"name": KINDS[group].default} if group in KINDS else {}
            changed[group] = {name: value for name, value in values.items() if value != defaults[name]}
        return {group: values for group, values in changed.items() if values}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Recipe:
        """Makes a recipe from values as :meth:`to_dict` returns them; missing values are defaults.

        Raises:
            ValueError: a group or an option does not exist, or a value is invalid.
        """
        return Recipe(**_groups(place(values)))


def check_extending(values: Mapping[str, Any]) -> None:
    """Raises a ValueError for options that must not change when a run is resumed.

    Example:
        >>> check_extending({"epochs": 80})
        >>> check_extending({"gamma": 0.9})
        Traceback (most recent call last):
        ValueError: a resumed run takes epochs, checkpoint_interval, keep_checkpoints, keep_buffer,
        pictures, log only; gamma=0.9 would change its training so far: start a new run
    """
    for name, value in values.items():
        if name.removeprefix("run.") not in EXTENDING:
            raise ValueError(
                f"a resumed run takes {', '.join(EXTENDING)} only; {name}={value} would change its "
                "training so far: start a new run"
            )


def make_recipe(base: Mapping[str, Any] | None = None, /, **values: Any) -> Recipe:
    """Makes a recipe from options by name: ``make_recipe(task="hand_v0", algo="her", seed=3)``.

    An option is named by itself (``gamma``) or with its group (``{"learner.gamma": 0.95}``). A group that
    has an option ``name`` stands for it: ``task="hand_v0"`` sets ``task.name``.

    Args:
        base: values of a preset or of another recipe. If ``values`` make one of them ineffective, it is
            dropped, so that a preset for DDPG also works with TD3.
        values: options to set. An option that has no effect raises an error.

    Raises:
        ValueError: an option does not exist or has no effect, or a value is invalid.

    A task in ``values`` may import its module (``task="my_module:make_env"``); a task in ``base`` needs a
    permission, see :func:`~torchrl_her_recipes.allow_imports`.

    Example:
        >>> make_recipe(task="hand_v1", algo="cher", window=5, seed=3).run.seed
        3
    """
    recipe = compose(base, values)
    if "name" in place(values, place(base or {})).get("task", {}):
        permit_task(recipe.task.name)
    return recipe


def compose(base: Mapping[str, Any] | None, values: Mapping[str, Any]) -> Recipe:
    """Makes a recipe like :func:`make_recipe`, but does not permit the import of the task's module."""
    below = place(base or {})
    given = place(values, below)
    if get_algorithm(chosen("hindsight", given, below)).weights is not None:
        below.get("weights", {}).pop("name", None)
    _drop_options_of_other_choices(below, given)
    _drop_options_of_another_task(below, given)
    drop_alternatives(below, given)
    for group, option in without_effect(Groups(**_groups(over(below, given)))):
        if option not in given.get(group, {}):
            below.get(group, {}).pop(option, None)
    return Recipe(**_groups(over(below, given)))


def _meant(group: str, *values: Nested) -> str:
    """Returns the name of a group's choice; for ``auto``, the learner that it stands for on the task."""
    name, task = chosen(group, *values), chosen("task", *values)
    actions = get_task_spec(task).actions if isinstance(task, str) and name == AUTO else None
    return name if actions is None else BY_ACTIONS[actions]


def _drop_options_of_other_choices(below: Nested, given: Nested) -> None:
    """Drops options of the base that do not exist in the choices that the user requests.

    If the user requests another choice than the base, defaults of the base's choice are dropped, too, since
    the requested choice may have other defaults.

    Raises:
        ValueError: the user gives an option that ``auto`` has, but not the learner it stands for on the task.
    """
    for group, kind in KINDS.items():
        asked = kind.find(chosen(group, given, below))
        choice, former = kind.find(_meant(group, given, below)), kind.get(_meant(group, below))
        for key, value in given.get(group, {}).items():
            if hasattr(asked, key) and not hasattr(choice, key):
                raise ValueError(f"{key}={value} has no effect with {group}={choice.name}: leave it out")
        allowed = {option.name: option.metadata.get("choices", ()) for option in fields(choice)}
        below[group] = {
            key: value
            for key, value in below.get(group, {}).items()
            if hasattr(choice, key)
            and (not allowed.get(key) or value in allowed[key])
            and (former is choice or value != getattr(former, key, kind))
        }


def _drop_options_of_another_task(below: Nested, given: Nested) -> None:
    """If the user requests another task than the base, drops task options that this task does not have."""
    name, options = given.get("task", {}).get("name"), below.get("task", {}).get("options")
    if name is None or not isinstance(options, Mapping) or name == below["task"].get("name"):
        return
    takes = get_task_spec(str(name)).options
    below["task"]["options"] = {option: value for option, value in options.items() if option in takes} or None


def drop_alternatives(below: Nested, given: Nested) -> None:
    """Drops an option of the base, such as ``epochs``, if the user gives an alternative, such as ``frames``.

    Raises:
        ValueError: The user gives both alternatives.
    """
    for group, (option, others) in _ALTERNATIVES.items():
        asked, base = given.get(group, {}), below.get(group, {})
        named = [f"{name}={asked[name]}" for name in others if name in asked]
        if named and asked.get(option, AUTO) not in (None, AUTO):
            shown = " and ".join([*named, f"{option}={asked[option]}"])
            raise ValueError(f"{shown} say the same: give one of them")
        if named:
            asked[option] = None
        elif asked.get(option) is not None:
            below[group] = {name: value for name, value in base.items() if name not in others}
        elif base.keys() & others:
            base.setdefault(option, None)


def _groups(values: Nested) -> dict[str, Any]:
    """Makes the groups of a recipe by their names."""
    named = {group: {"name": chosen(group, values)} for group in KINDS}
    return {group: kind(**values.get(group, {}) | named.get(group, {})) for group, kind in GROUPS.items()}
