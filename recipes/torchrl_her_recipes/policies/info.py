"""The class :class:`PolicyInfo`: inputs, outputs and origin of an exported policy, as plain values."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from typing import Any

from torchrl.data import Categorical
from torchrl.envs import EnvBase

from torchrl_her.curriculum.stages import Curriculum, CurriculumStage
from torchrl_her_envs.common.goal_env import goal_env

KEYS = ("observation", "desired_goal")

_PACKAGES = ("torchrl-her", "torch", "torchrl", "tensordict")
_WIDEST = 1 << 16  # largest width of an entry or action; a file with a larger one counts as damaged
_FLOATS = ("float32", "float64")
_WHOLE = ("bool", *(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)))


@dataclass(frozen=True, kw_only=True)
class PolicyInfo:
    """Inputs and outputs of an exported policy, its origin and its success.

    Attributes:
        task: name of the task that the policy was trained on.
        widths: widths of ``observation`` and ``desired_goal``: each is [..., width].
        dtype: dtype of ``observation`` and ``desired_goal``.
        action_shape: shape of one action: [width], or [] for an integer.
        action_dtype: ``"int64"`` for an integer, otherwise the dtype of the inputs.
        task_dtype: dtype of the task's own actions, which :meth:`Policy.predict` returns.
        low, high: the least and the greatest action of the task, one number for each entry. If actions are
            integers, those of the policy begin with 0, and only :meth:`Policy.predict` adds ``low``.
        normalize_clip: bound to which normalized inputs are clipped; None if the policy does not normalize.
            The policy itself normalizes: its inputs are the task's raw observations and goals.
        stages: options of each :class:`~torchrl_her.CurriculumStage` of a policy that acts in a
            :class:`~torchrl_her.curriculum.RelayPolicy`; empty for other policies.
        algorithm, learner, seed, frames: origin of the policy; frames are environment steps.
        success: share of 1,000 greedy episodes that end at their goal, with starts and goals from seeds that
            training does not use; NaN if it was not measured.
        reached: share of these episodes that achieve their goal at some step; NaN if it was not measured.
        versions: versions of the packages with which the policy was exported; may be empty.

    Raises:
        ValueError: a value is not valid for a policy.

    Example:
        >>> from torchrl_her_recipes import load_policy
        >>> info = load_policy("hand_v1").info
        >>> info.widths, info.action_shape, info.success > 0.9
        ({'observation': 9, 'desired_goal': 2}, (3,), True)
    """

    task: str
    widths: dict[str, int]
    dtype: str = "float32"
    action_shape: tuple[int, ...]
    action_dtype: str = "float32"
    task_dtype: str = "float32"
    low: tuple[float, ...]
    high: tuple[float, ...]
    normalize_clip: float | None = None
    stages: tuple[dict[str, Any], ...] = ()
    algorithm: str
    learner: str
    seed: int
    frames: int
    success: float = math.nan
    reached: float = math.nan
    versions: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name, fits, wanted in self._checks():
            if not fits:
                got = str(getattr(self, name))[:80]
                raise ValueError(f"{name} of a policy must {wanted}, got {got!r}")

    def _checks(self) -> Iterator[tuple[str, bool, str]]:
        """Yields for each value: its name, whether it is valid, and words for what is valid ("be a name")."""
        for name in ("task", "algorithm", "learner"):
            yield name, isinstance(getattr(self, name), str), "be a name"
        for name in ("seed", "frames"):
            yield name, _is_whole(getattr(self, name), least=0), "be a whole number of at least 0"
        named = isinstance(self.widths, dict) and tuple(self.widths) == KEYS
        wide = named and all(map(_is_width, self.widths.values()))
        yield "widths", wide, f"be {' and '.join(KEYS)}, each from 1 to {_WIDEST}"
        yield "dtype", self.dtype in _FLOATS, f"be one of {', '.join(_FLOATS)}"
        allowed = ("int64",) if self.discrete else _FLOATS
        yield "action_dtype", self.action_dtype in allowed, f"be {' or '.join(allowed)}"
        known = (*_FLOATS, "float16", *_WHOLE)
        yield "task_dtype", self.task_dtype in known, f"be one of {', '.join(known)}"
        flat = len(self.action_shape) < 2 and all(map(_is_width, self.action_shape))
        yield "action_shape", flat, f"have one width from 1 to {_WIDEST}, or none"
        entries = math.prod(self.action_shape)
        for name in ("low", "high"):
            limits = getattr(self, name)
            yield name, len(limits) == entries and all(map(_is_number, limits)), f"have {entries} numbers"
        if self.discrete:
            fits = self.low[0] % 1 == 0 and 1 <= self.high[0] - self.low[0] < _WIDEST
            yield "high", fits, f"be the last of the actions, of which there may be {_WIDEST}"
        for name in ("success", "reached"):
            yield name, _is_number(getattr(self, name)), "be a number"
        yield "stages", self._has_curriculum(), "be those of a curriculum"
        clip = self.normalize_clip
        yield "normalize_clip", clip is None or (_is_number(clip) and clip > 0), "be above 0 or None"
        words = isinstance(self.versions, dict) and all(
            isinstance(word, str) for pair in self.versions.items() for word in pair
        )
        yield "versions", words, "name packages and their versions"

    @property
    def curriculum(self) -> Curriculum | None:
        """The stages that act in turn; None if the policy acts as in the last stage only."""
        stages = [CurriculumStage(**stage) for stage in self.stages]
        return Curriculum(stages, sum(self.widths.values())) if stages else None

    @property
    def discrete(self) -> bool:
        """Whether actions are single integers."""
        return not self.action_shape

    @property
    def choices(self) -> int:
        """Number of actions if they are single integers."""
        return _choices(self.low, self.high)

    @property
    def whole(self) -> bool:
        """Whether the task takes only whole numbers as actions."""
        return self.task_dtype in _WHOLE

    def to_dict(self) -> dict[str, Any]:
        """Returns all values by name, as plain data."""
        return asdict(self)

    def _has_curriculum(self) -> bool:
        try:
            return self.curriculum is not None or not self.stages
        except (TypeError, ValueError):
            return False

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> PolicyInfo:
        """Makes the info from the values of :meth:`to_dict`, in which JSON may have turned tuples into lists.

        Raises:
            ValueError: A value is missing, unknown or not valid.
        """
        try:
            lists = {name: tuple(values[name]) for name in ("action_shape", "low", "high")}
            return cls(**{**values, **lists, "stages": tuple(values.get("stages", ()))})
        except (KeyError, TypeError) as error:
            raise ValueError(f"its info is damaged: {error}") from error

    def expects(self) -> str:
        """Describes inputs and outputs in words, for messages.

        Example:
            >>> from torchrl_her_recipes import load_policy
            >>> load_policy("hand_v1").info.expects()
            'observation [9], desired_goal [2] and action [3]'
        """
        return _words(self.widths, self.action_shape, self.low, self.high)

    def check_plays(self, env: EnvBase, task: str) -> None:
        """Refuses environments whose observations or actions do not fit the policy.

        Args:
            env: the environments.
            task: name of their task.

        Raises:
            ValueError: the environments do not fit; the message lists the entries of both.
        """
        entries = describe_env(env)
        limits = entries["low"], entries["high"]
        differ = any(entries[name] != getattr(self, name) for name in ("widths", "action_shape"))
        if differ or (self.discrete and _choices(*limits) != self.choices):
            offered = _words(entries["widths"], entries["action_shape"], *limits)
            raise ValueError(
                f"a policy of {self.task} cannot play {task}: the policy has {self.expects()}, but "
                f"{task} has {offered}"
            )


def describe_env(env: EnvBase) -> dict[str, Any]:
    """Returns the values of a :class:`PolicyInfo` that environments determine: widths, actions and limits.

    Example:
        >>> from torchrl_her_envs import make_env
        >>> entries = describe_env(make_env("bit_flip", bits=4))
        >>> entries["widths"], entries["action_shape"], entries["high"]
        ({'observation': 4, 'desired_goal': 4}, (), (3.0,))
    """
    task, action = goal_env(env), env.action_spec_unbatched
    specs = task.observation_spec
    entries = {"widths": {key: int(specs[key].shape[-1]) for key in KEYS}}
    if isinstance(action, Categorical):
        whole = {"action_dtype": "int64", "task_dtype": "int64"}
        first, last = float(task.first_action), float(task.first_action + action.space.n - 1)
        return {**entries, **whole, "action_shape": (), "low": (first,), "high": (last,)}
    low, high = task.action_limits()
    return {
        **entries,
        "action_shape": tuple(action.shape),
        "task_dtype": str(low.dtype).removeprefix("torch."),
        "low": tuple(low.double().tolist()),
        "high": tuple(high.double().tolist()),
    }


def present_versions() -> dict[str, str]:
    """Returns the installed versions of this package and its main dependencies, by name."""
    return {name: version(name) for name in _PACKAGES}


def _choices(low: tuple[float, ...], high: tuple[float, ...]) -> int:
    return int(high[0] - low[0]) + 1


def _words(
    widths: Mapping[str, int], shape: tuple[int, ...], low: tuple[float, ...], high: tuple[float, ...]
) -> str:
    inputs = ", ".join(f"{key} [{width}]" for key, width in widths.items())
    return f"{inputs} and " + (
        f"action [{shape[0]}]" if shape else f"action of {_choices(low, high)} choices"
    )


def _is_whole(value: object, *, least: int) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= least


def _is_width(value: Any) -> bool:
    return _is_whole(value, least=1) and value <= _WIDEST


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
