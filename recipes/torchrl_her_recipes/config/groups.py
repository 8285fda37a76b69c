"""The groups of options that a recipe is made of; the learner's group is in :mod:`.learners`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from torchrl_her_envs.registry import check_options as check_task_options
from torchrl_her_envs.registry import check_task, get_task_spec
from torchrl_her_recipes.config.algorithms import Algorithm, check_goal_sources, check_strategy, get_algorithm
from torchrl_her_recipes.config.loggers import check_loggers
from torchrl_her_recipes.config.options import AUTO, Needs, check_options, option
from torchrl_her_recipes.config.plain_files import read_yaml


@dataclass(frozen=True, kw_only=True)
class Group:
    """A group of options, which are checked when it is made.

    Attributes:
        needs: Options that have an effect only with some values of another option; see ``idle_options``.
        prefix: Text before the names of its options in messages.
    """

    needs: ClassVar[Needs] = ()
    prefix: ClassVar[str] = ""

    def __post_init__(self) -> None:
        check_options(self)


@dataclass(frozen=True, kw_only=True)
class TaskConfig(Group):
    """The task to learn."""

    name: str = option(
        "hand_v0",
        "a task of `torchrl-her list`, gym:ID for any gymnasium environment with goals, or "
        "my_module:make_env for a TorchRL environment of your own",
        shown_as="task",
    )
    options: Any = option(None, "options of the task or for gymnasium.make, as in task.options.bits=8")
    threshold: float | None = option(
        None, "distance to the goal that counts as achieved, in the coordinates that the agent sees", above=0
    )
    failure: str = option(
        "never_pays",
        "what an end without the goal, as by a fall, is worth: never_pays (as if the goal was never "
        "achieved), environment (the reward that it gives) or truncate (the episode is cut off there)",
        choices=("never_pays", "environment", "truncate"),
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        check_task(self.name)
        if self.options is None:
            return
        if not isinstance(self.options, Mapping) or not all(isinstance(name, str) for name in self.options):
            raise ValueError(f"task.options must be a mapping of options by name, got {self.options!r}")
        object.__setattr__(self, "options", dict(self.options))
        check_task_options(get_task_spec(self.name), self.options)
        if self.threshold is not None and "threshold" in self.options:
            raise ValueError("threshold and task.options.threshold are the same option: give one of them")


@dataclass(frozen=True, kw_only=True)
class CollectionConfig(Group):
    """How experience is collected; numbers are for each run."""

    needs: ClassVar[Needs] = (("processes", bool, "sync"),)

    epoch_frames: int = option(AUTO, "environment steps in an epoch; auto: 100 episodes' length", at_least=1)
    num_envs: int = option(
        AUTO, "environments that are stepped together; auto: 8, or 64 of this package's tasks", at_least=1
    )
    steps_per_batch: int = option(10, "steps of each environment between two rounds of updates", at_least=1)
    frames_per_update: float = option(
        AUTO,
        "environment steps for each gradient step; 0.5: two gradient steps for each environment step; "
        "auto: 1, or 5 with this package's tasks",
        above=0,
    )
    warmup_frames: int = option(
        AUTO,
        "environment steps before the first gradient step; auto: an episode of each environment",
        at_least=0,
    )
    processes: int = option(
        0,
        "processes that collect while this one learns, for slow environments; 0: this one collects",
        at_least=0,
    )
    sync: bool = option(
        True, "whether processes collect batches together, which a seed repeats, or each at its own pace"
    )
    ray: str | None = option(
        None, "address of a Ray cluster on whose nodes the processes collect: HOST:PORT or auto"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.ray is not None and self.processes == 0:
            raise ValueError(
                f"ray={self.ray} needs the number of processes that collect there, as in processes=4"
            )
        if AUTO in (self.num_envs, self.epoch_frames):
            return
        if self.processes and self.num_envs % self.processes:
            raise ValueError(
                f"num_envs={self.num_envs} cannot be shared out among processes={self.processes}: "
                "it must be a multiple of it"
            )
        if self.epoch_frames < self.num_envs * self.steps_per_batch:
            raise ValueError(
                f"epoch_frames={self.epoch_frames} must be at least num_envs times steps_per_batch, "
                f"{self.num_envs * self.steps_per_batch}"
            )


@dataclass(frozen=True, kw_only=True)
class ReplayConfig(Group):
    """How transitions are stored and sampled."""

    needs: ClassVar[Needs] = (
        ("sampler", "prioritized".__eq__, "priority_alpha priority_beta priority_beta_end"),
    )

    sampler: str = option(
        "prioritized", "prioritized or uniform sampling", choices=("prioritized", "uniform")
    )
    priority_alpha: float = option(
        0.6, "exponent of priorities, for absolute TD errors (Schaul et al.)", at_least=0
    )
    priority_beta: float = option(0.4, "exponent of importance weights (Schaul et al.)", at_least=0)
    priority_beta_end: float | None = option(
        None,
        "value that priority_beta rises to linearly until the last epoch; it stays as it is if not given",
        at_least=0,
    )
    device: str = option(
        "learner",
        "where transitions are stored and relabeled: learner (where the networks are), cpu, cuda, ...",
    )
    buffer_size: int = option(
        1_000_000, "capacity in transitions, real and virtual ones together", at_least=1
    )
    batch_size: int = option(256, "transitions of a gradient step", at_least=1)
    batches_per_sample: int = option(32, "batches that are sampled in one call", at_least=1)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.batch_size > self.buffer_size:
            raise ValueError(f"batch_size={self.batch_size} must fit buffer_size={self.buffer_size}")


FUTURE_AND_ACTUAL = {"future": 3, "actual": 2}  # as "future-actual" goals of MRL (Pitis et al., 2020)


@dataclass(frozen=True, kw_only=True)
class HindsightConfig(Group):
    """How transitions are relabeled with virtual goals."""

    algo: str = option(
        AUTO,
        "an algorithm of `torchrl-her list`; auto: filtered_her, or cher where random actions seldom change "
        "the achieved goal, or with the stages of curriculum=FILE",
    )
    k: int = option(4, "virtual transitions for each real one", at_least=0)
    strategy: str = option(
        "future", "where virtual goals come from: future, final, episode, or a registered name"
    )
    goal_sources: Any = option(
        AUTO,
        "in place of k and strategy, how many virtual goals come from where, as in '{future: 2, actual: 2}': "
        "any strategy, actual (goals wanted in recent episodes), achieved (goals achieved in them); auto: "
        "three future ones and two actual ones, or none if k or strategy is given",
    )
    refill: int = option(
        5,
        "if the filter leaves transitions without goals, others get up to this multiple of k",
        at_least=1,
    )
    redraw: bool = option(
        True,
        "where the filter refuses a goal, draw another one that it keeps; false: store no transition for it",
    )
    n_steps: int = option(1, "steps that a transition spans, at most (n-step returns)", at_least=1)

    def __post_init__(self) -> None:
        super().__post_init__()
        get_algorithm(self.algo)
        check_strategy(self.strategy)
        if self.goal_sources not in (None, AUTO):
            object.__setattr__(self, "goal_sources", check_goal_sources(self.goal_sources))
        elif (self.k, self.strategy) != (4, "future"):  # given by the user, in place of auto
            object.__setattr__(self, "goal_sources", None)

    @property
    def algorithm(self) -> Algorithm:
        """The algorithm whose name is ``algo``."""
        return get_algorithm(self.algo)

    @property
    def sources(self) -> dict[str, int]:
        """Number of virtual goals of each transition by source; empty if there are none."""
        if self.goal_sources == AUTO:
            return dict(FUTURE_AND_ACTUAL)
        if self.goal_sources is not None:
            return dict(self.goal_sources)
        return {self.strategy: self.k} if self.k else {}


@dataclass(frozen=True, kw_only=True)
class CurriculumConfig(Group):
    """The stages that runs learn, one after the other or at once (Curriculum-HER)."""

    needs: ClassVar[Needs] = (("guided_share", bool, "guided_per"),)

    name: str = option(
        "task",
        "task: the stages that the task itself has; or a YAML file with a list of stages",
        shown_as="curriculum",
    )
    stages: Any = option(None, "the stages themselves, as a list of their options")
    guided_share: float = option(
        0.0,
        "share of the episodes that the policy of the stage below begins, until its goal is achieved",
        at_least=0,
        at_most=1,
    )
    guided_per: str = option(
        "episode",
        "whether guided_share is of episodes, or of the steps in which the goal of the stage below is not "
        "achieved",
        choices=("episode", "step"),
    )
    alpha_actor: float = option(
        0.0, "scale of the actor's initial weights for inputs that the first stage hides", at_least=0
    )
    alpha_critic: float = option(0.0, "the same scale for the critic", at_least=0)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.name != "task" and self.stages is None:  # a recipe holds the stages, not just their file
            object.__setattr__(self, "stages", _read_stages(Path(self.name)))
        stages = self.stages
        if stages is not None and not (
            isinstance(stages, list | tuple)
            and stages
            and all(isinstance(stage, Mapping) for stage in stages)
        ):
            raise ValueError(
                f"a curriculum must be a list of stages, each with its options by name, got {stages!r}"
            )


def _read_stages(path: Path) -> Any:
    if not path.is_file():
        raise ValueError(f"curriculum must be 'task' or a YAML file with a list of stages, got {str(path)!r}")
    return read_yaml(path)


@dataclass(frozen=True, kw_only=True)
class DemonstrationsConfig(Group):
    """Episodes played by another policy, from a file of `torchrl-her record`."""

    prefix = "demonstrations."
    needs: ClassVar[Needs] = (
        ("episodes", bool, "file share starts_share"),
        ("share", bool, "bc_weight"),
        ("bc_weight", bool, "q_filter"),
        ("starts_share", bool, "starts_width starts_stride starts_threshold starts_samples"),
    )

    episodes: int = option(0, "how many of the file's episodes are used, the first ones; 0: none", at_least=0)
    file: str | None = option(None, "the file")
    share: float = option(
        0.125, "share of each batch that are demonstrations; 0: none, for starts alone", at_least=0, below=1
    )
    bc_weight: float = option(1.0, "weight of behavior cloning on them, in the actor's loss", at_least=0)
    q_filter: bool = option(True, "whether only actions are cloned that the critic prefers to the policy's")
    starts_share: float = option(
        0.0,
        "share of the episodes that start at states of demonstrations, at first near their ends",
        at_least=0,
        at_most=1,
    )
    starts_width: int = option(4, "steps of a demonstration among which such starts are drawn", at_least=1)
    starts_stride: int = option(
        2, "steps by which they walk back from the end when these episodes succeed", at_least=1
    )
    starts_threshold: float = option(
        0.5, "mean success of these episodes at which starts walk back", above=0, at_most=1
    )
    starts_samples: int = option(50, "episodes of which it is the mean", at_least=1)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.episodes and self.file is None:
            raise ValueError(
                f"demonstrations.episodes={self.episodes} needs a file: demonstrations.file=FILE, as "
                "`torchrl-her record` writes it"
            )
        if self.episodes and self.share == self.starts_share == 0:
            raise ValueError(
                f"demonstrations.episodes={self.episodes} has no effect with demonstrations.share=0 and "
                "demonstrations.starts_share=0"
            )

    @property
    def in_batches(self) -> bool:
        """Whether batches contain demonstrations."""
        return self.episodes > 0 and self.share > 0

    @property
    def as_starts(self) -> bool:
        """Whether episodes start at states of demonstrations."""
        return self.episodes > 0 and self.starts_share > 0


@dataclass(frozen=True, kw_only=True)
class EvaluationConfig(Group):
    """How runs are evaluated at the end of each epoch."""

    episodes: int = option(100, "greedy episodes of each evaluation", at_least=1)
    virtual_goals: bool = option(
        False,
        "whether to play extra episodes with virtual goals, and log virtual_success and virtual_q_bias",
    )


_SEEDS = 1 << 31  # seeds are below it, to leave room for the larger seeds of evaluations


@dataclass(frozen=True, kw_only=True)
class RunConfig(Group):
    """Seeds, length and checkpoints of the runs."""

    seed: int = option(0, "seed of everything random", at_least=0)
    num_runs: int = option(1, "independent runs side by side; run i has the seed `seed + i`", at_least=1)
    epochs: int = option(30, "epochs; each ends with an evaluation", at_least=1)
    frames: int | None = option(
        None, "environment steps of each run, in place of epochs; rounded up to whole epochs", at_least=1
    )
    checkpoint_interval: int = option(10, "epochs between two checkpoints", at_least=1)
    keep_checkpoints: int = option(2, "how many of the newest checkpoints are kept", at_least=1)
    keep_buffer: bool = option(
        False, "whether the checkpoint of a finished run keeps the replay buffer, for more epochs later"
    )
    pictures: bool = option(
        True, "whether curves, map of goals and film of the policy are made at the end; it takes some seconds"
    )
    log: Any = option(
        ("tensorboard",),
        "loggers, as [tensorboard,wandb]: tensorboard, wandb, or registered ones; [] for none besides "
        "the table of metrics, which is always written",
    )
    threads: int = option(1, "threads of torch: small networks are fastest with one", at_least=1)
    dtype: str = option("float32", "of observations and networks", choices=("float32", "float64"))

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "log", check_loggers(self.log))
        if self.seed + self.num_runs > _SEEDS:
            raise ValueError(f"seed must be below {_SEEDS - self.num_runs + 1}, got {self.seed}")
