"""A recipe: every choice of a training run, as one dataclass with real defaults."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchrl_her.virtual_goals import check_strategy
from torchrl_her_recipes.algorithms import get_algorithm
from torchrl_her_recipes.plain import as_kind, read_yaml
from torchrl_her_recipes.worlds import check_task

if TYPE_CHECKING:
    from torchrl_her_recipes.parts import Parts

_SEEDS = 1 << 31  # so that those of evaluations, which are made of it, have room
_KINDS = {"str": str, "bool": bool, "int": int, "float": float, "float | None": float}  # by annotation
_WORDS = {
    "learner": ("auto", "ddpg", "td3", "sac", "dqn"),
    "sampler": ("prioritised", "uniform"),
    "dtype": ("float32", "float64"),
    "compile": ("auto", "always", "never"),
}
# Gradient steps from which on compiling them pays: 15 s the first time, half a millisecond less for each.
_WORTH_COMPILING = 20_000
_MOST_ROWS = 2_000  # of a gradient step: with more, arithmetic is all that is left


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """What a run is made of. Values are plain, so that they can come from Python, YAML or a shell.

    Lengths are counted in environment steps ("frames"). A field that is ``None`` takes the value
    of the task.

    Raises:
        ValueError: a value that cannot work; the message names it and what is allowed.

    Example:
        >>> recipe = Recipe(task="hand_v0", algo="her", seed=3)
        >>> recipe.gamma, recipe.total_frames
        (0.98, 614400)
    """

    task: str = "hand_v0"  # see `torchrl-her list`, or gym:ID for any environment of gymnasium with goals
    task_options: Any = None  # a mapping: options of a small world, or for gymnasium.make
    algo: str = "filtered_her"  # see `torchrl-her list`
    learner: str = "auto"  # ddpg, td3, sac or dqn; auto: ddpg, or dqn where actions are counted
    seed: int = 0
    num_runs: int = 1  # independent runs side by side; run i has the seed ``seed + i``

    epochs: int = 30
    epoch_frames: int = 20_480  # of each run, as all that follows
    num_envs: int = 64
    steps_per_batch: int = 10  # of each environment, before the updates that they pay for
    frames_per_update: float = 20.0
    warmup_frames: int = 3_200  # before the first update: an episode of each environment
    updates_per_draw: int = 8  # gradient steps whose rows are drawn in one call

    k: int = 4  # virtual rows for each real one
    strategy: str = "future"
    threshold: float | None = None  # how near is achieved, in shown coordinates

    ibs_sigma: float | None = None  # of the kernel around the real goals, as a share of the screen
    ibs_start_factor: float = 3.0  # the first sigma is this times ibs_sigma
    ibs_decay: float = 0.9  # of the covariance, an epoch
    ibs_floor: float = 0.002  # the least weight of a goal, as a share of the greatest
    ibs_cells: int = 20  # of the grid over the screen, in each direction

    curriculum: Any = None  # layers, as a list of their options or a YAML file of it; None: the task's own
    window: int = 20  # greedy episodes whose mean success ends a layer of a curriculum
    success_threshold: float = 0.9  # that mean
    layer_epsilon: float = 1.0  # where exploration starts again at a change of layer
    alpha_actor: float = 0.0  # what weights of inputs that the first layer does not use are multiplied by
    alpha_critic: float = 0.0

    sampler: str = "prioritised"
    priority_alpha: float = 0.6  # in Schaul's sense: of the absolute TD error
    priority_beta: float = 0.4
    buffer_size: int = 1_000_000  # real and virtual rows together
    batch_size: int = 256

    gamma: float = 0.98
    learning_rate: float = 1e-3
    max_grad_norm: float = 3.0
    action_penalty: float = 0.3  # keeps actions off the ends of tanh
    hidden: int = 64
    batch_norm: bool = False  # in the critic
    tau: float = 0.02  # of the soft target update
    hard_update_interval: int = 0  # gradient steps between hard target updates; 0: soft

    epsilon_start: float = 1.0
    epsilon_decay: float = 0.9  # an epoch
    epsilon_end: float = 0.05

    eval_episodes: int = 100
    checkpoint_interval: int = 10  # epochs
    keep_checkpoints: int = 2  # the newest, and those before it in case that it gets damaged
    threads: int = 1  # of torch: small networks are fastest with one
    compile: str = "auto"  # the gradient step: always, never, or auto: if the run is long enough to win by it
    dtype: str = "float32"  # of observations and networks

    def __post_init__(self) -> None:
        for field in fields(self):
            kind, value = _KINDS.get(str(field.type)), getattr(self, field.name)
            if kind is not None and not (value is None and field.default is None):
                object.__setattr__(self, field.name, as_kind(field.name, value, kind))
        check_task(self.task)
        get_algorithm(self.algo)
        check_strategy(self.strategy)
        if self.task_options is not None and not isinstance(self.task_options, Mapping):
            raise ValueError(f"task_options must be a mapping of options, got {self.task_options!r}")
        if isinstance(self.curriculum, str):
            object.__setattr__(self, "curriculum", _read_layers(Path(self.curriculum)))
        for name, words in _WORDS.items():
            if getattr(self, name) not in words:
                raise ValueError(f"{name} must be one of {', '.join(words)}, got {getattr(self, name)!r}")
        for name, least in _AT_LEAST.items():
            if not getattr(self, name) >= least:
                raise ValueError(f"{name} must be at least {least}, got {getattr(self, name)}")
        for name in _POSITIVE:
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise ValueError(f"{name} must be above 0, got {value}")
        for name in _SHARES:
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"{name} must be between 0 and 1, got {getattr(self, name)}")
        if self.batch_size > self.buffer_size:
            raise ValueError(f"batch_size={self.batch_size} must fit buffer_size={self.buffer_size}")
        if self.epoch_frames < self.num_envs * self.steps_per_batch:
            raise ValueError(
                f"epoch_frames={self.epoch_frames} must be at least num_envs times steps_per_batch, "
                f"{self.num_envs * self.steps_per_batch}"
            )
        if self.seed + self.num_runs > _SEEDS:
            raise ValueError(f"seed must be below {_SEEDS - self.num_runs + 1}, got {self.seed}")
        if self.epsilon_end > self.epsilon_start:
            raise ValueError(
                f"epsilon_end={self.epsilon_end} must not be above epsilon_start={self.epsilon_start}"
            )
        if self.gamma >= 1.0:
            raise ValueError(f"gamma must be below 1, got {self.gamma}")

    @property
    def total_frames(self) -> int:
        """Environment steps of a whole run."""
        return self.epochs * self.epoch_frames

    @property
    def compiles(self) -> bool:
        """Whether the gradient step is to be compiled."""
        if self.compile == "auto":
            long = self.total_frames / self.frames_per_update >= _WORTH_COMPILING
            return long and self.num_runs * self.batch_size <= _MOST_ROWS
        return self.compile == "always"

    @property
    def seeds(self) -> list[int]:
        """The seed of each run."""
        return [self.seed + run for run in range(self.num_runs)]

    def build(self) -> Parts:
        """Makes the parts of the run, each of which may be swapped before ``.run()``."""
        from torchrl_her_recipes.parts import build_parts  # noqa: PLC0415  (parts need recipes)

        return build_parts(self)

    @classmethod
    def from_dict(cls, values: dict[str, object]) -> Recipe:
        """A recipe from plain values; a ValueError names the ones that no recipe has."""
        known = {field.name for field in fields(cls)}
        if unknown := [str(name) for name in values if name not in known]:
            raise ValueError(f"a recipe has no {', '.join(unknown)}; it has {', '.join(sorted(known))}")
        return cls(**values)  # type: ignore[arg-type]


def _read_layers(path: Path) -> Any:
    """The layers that a YAML file lists, so that the recipe holds all of itself."""
    if not path.is_file():
        raise ValueError(f"curriculum must be a list of layers or a YAML file of one, got {str(path)!r}")
    return read_yaml(path)


_AT_LEAST = {
    "seed": 0,
    "num_runs": 1,
    "epochs": 1,
    "epoch_frames": 1,
    "num_envs": 1,
    "steps_per_batch": 1,
    "updates_per_draw": 1,
    "warmup_frames": 0,
    "k": 0,
    "priority_alpha": 0.0,
    "priority_beta": 0.0,
    "buffer_size": 1,
    "batch_size": 1,
    "hidden": 1,
    "ibs_start_factor": 1.0,
    "ibs_floor": 0.0,
    "ibs_cells": 1,
    "window": 1,
    "alpha_actor": 0.0,
    "alpha_critic": 0.0,
    "action_penalty": 0.0,
    "hard_update_interval": 0,
    "eval_episodes": 1,
    "checkpoint_interval": 1,
    "keep_checkpoints": 1,
    "threads": 1,
}
_POSITIVE = (
    "frames_per_update",
    "threshold",
    "learning_rate",
    "max_grad_norm",
    "epsilon_decay",
    "gamma",
    "ibs_sigma",
    "ibs_decay",
    "success_threshold",
)
_SHARES = (
    "tau",
    "gamma",
    "epsilon_start",
    "epsilon_end",
    "epsilon_decay",
    "ibs_decay",
    "layer_epsilon",
    "success_threshold",
)
