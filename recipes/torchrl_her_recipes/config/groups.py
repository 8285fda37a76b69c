"""The groups of options in a recipe; those with several choices are in :mod:`.choices`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

from torchrl_her_envs.registry import check_options as check_task_options
from torchrl_her_envs.registry import check_task, get_task_spec
from torchrl_her_recipes.config.algorithms import Algorithm, check_goal_sources, check_strategy, get_algorithm
from torchrl_her_recipes.config.choices.behavior import BEHAVIOR, Behavior
from torchrl_her_recipes.config.choices.learners import LEARNERS, LearnerConfig
from torchrl_her_recipes.config.choices.order import ORDER, Order
from torchrl_her_recipes.config.choices.weights import WEIGHTS, Weights
from torchrl_her_recipes.config.loggers import check_loggers
from torchrl_her_recipes.config.options import AUTO, Group, Needs, option
from torchrl_her_recipes.config.plain_files import read_mapping, read_yaml
from torchrl_her_recipes.config.shipped import find_file


@dataclass(frozen=True, kw_only=True)
class TaskConfig(Group):
    """The task to learn."""

    name: str = option(
        "hand_v0",
        "a task of `torchrl-her list`, gym:ID for any gymnasium environment with goals, or "
        "my_module:make_env for a TorchRL environment of your own",
        shown_as="task",
    )
    options: Any = option(None, "options of the task or of gymnasium.make, as in task.options.bits=8")
    threshold: float | None = option(
        None, "distance below which a goal is achieved, in the coordinates that the agent sees", above=0
    )
    failure: str = option(
        "never_pays",
        "reward if an episode fails, as by a fall: never_pays (the return of never achieving the goal), "
        "environment (the environment's reward) or truncate (the same, and the episode is truncated)",
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
    """How experience is collected; all numbers are per run."""

    needs: ClassVar[Needs] = (("processes", bool, "sync"),)

    epoch_frames: int = option(
        AUTO,
        "environment steps in an epoch; auto: 100 episodes, or 4 per environment for this package's tasks",
        at_least=1,
    )
    num_envs: int = option(
        AUTO, "environments that are stepped together; auto: 8, or 64 for this package's tasks", at_least=1
    )
    steps_per_batch: int = option(
        10, "steps of each environment between two rounds of gradient steps", at_least=1
    )
    frames_per_update: float = option(
        AUTO,
        "environment steps per gradient step; 0.5: two gradient steps per environment step; auto: 1, or 5 "
        "for this package's tasks",
        above=0,
    )
    warmup_frames: int = option(
        AUTO,
        "environment steps before the first gradient step; auto: one episode per environment, at least 1,000",
        at_least=0,
    )
    processes: int = option(
        0,
        "additional processes that collect, for slow environments, while the main one learns; 0: none",
        at_least=0,
    )
    sync: bool = option(
        True, "true: processes collect batches together, reproducible by the seed; false: independently"
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
        0.6, "exponent alpha of the absolute TD error in priorities (Schaul et al.)", at_least=0
    )
    priority_beta: float = option(0.4, "exponent beta of importance weights (Schaul et al.)", at_least=0)
    priority_beta_end: float | None = option(
        None,
        "final value to which priority_beta rises linearly by the last epoch; if not given, it is constant",
        at_least=0,
    )
    device: str = option(
        "learner",
        "device on which transitions are stored and relabeled: learner (that of networks), cpu, cuda, ...",
    )
    buffer_size: int = option(
        1_000_000, "capacity in transitions, real and virtual ones together", at_least=1
    )
    batch_size: int = option(256, "number of transitions in a gradient step", at_least=1)
    batches_per_sample: int = option(32, "number of batches that one call of the sampler draws", at_least=1)
    symmetry: Any = option(
        None,
        "mirror images and shifts of the task, drawn anew in each batch: a name of `torchrl-her list`, a "
        "YAML file or a mapping",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if isinstance(self.symmetry, str):  # read at once: a saved recipe must not need the file
            object.__setattr__(self, "symmetry", read_mapping(find_file("symmetry", self.symmetry)))
        if self.symmetry is not None and not isinstance(self.symmetry, Mapping):
            raise ValueError(f"symmetry must be a mapping, got {self.symmetry!r}")
        if self.batch_size > self.buffer_size:
            raise ValueError(f"batch_size={self.batch_size} must be at most buffer_size={self.buffer_size}")


FUTURE_AND_ACTUAL = {"future": 3, "actual": 2}  # as "future-actual" goals of MRL (Pitis et al., 2020)


@dataclass(frozen=True, kw_only=True)
class HindsightConfig(Group):
    """How transitions are relabeled with virtual goals."""

    algo: str = option(
        AUTO,
        "an algorithm of `torchrl-her list`; auto: filtered_her, or cher if random actions seldom change the "
        "achieved goal, or if curriculum=FILE is given",
    )
    k: int = option(4, "number of virtual transitions for each real one", at_least=0)
    strategy: str = option(
        "future", "strategy that selects virtual goals: future, final, episode, or a registered name"
    )
    goal_sources: Any = option(
        AUTO,
        "numbers of virtual goals by source, in place of k and strategy, as in '{future: 2, actual: 2}'; a "
        "source is a strategy, actual (desired goals of recent episodes) or achieved (goals that recent "
        "episodes achieved); auto: {future: 3, actual: 2}, or k and strategy if one of them is given",
    )
    refill: int = option(
        5,
        "if the filter rejects all goals of a transition, others get more goals, up to this many times k",
        at_least=1,
    )
    redraw: bool = option(
        True,
        "true: replace goals that the filter rejects by others that it keeps; false: leave them out",
    )
    n_steps: int = option(1, "largest number of steps in a transition (n-step returns)", at_least=1)

    def __post_init__(self) -> None:
        super().__post_init__()
        get_algorithm(self.algo)
        check_strategy(self.strategy)
        if self.goal_sources not in (None, AUTO):
            object.__setattr__(self, "goal_sources", check_goal_sources(self.goal_sources))
        elif (self.k, self.strategy) != (4, "future"):  # k or strategy was given, which replaces auto
            object.__setattr__(self, "goal_sources", None)

    @property
    def algorithm(self) -> Algorithm:
        """The algorithm whose name is ``algo``."""
        return get_algorithm(self.algo)

    @property
    def sources(self) -> dict[str, int]:
        """Number of virtual goals per transition, by source; empty without virtual goals."""
        if self.goal_sources == AUTO:
            return dict(FUTURE_AND_ACTUAL)
        if self.goal_sources is not None:
            return dict(self.goal_sources)
        return {self.strategy: self.k} if self.k else {}


@dataclass(frozen=True, kw_only=True)
class CurriculumConfig(Group):
    """The stages that runs learn, one after the other or at once (Curriculum-HER)."""

    needs: ClassVar[Needs] = (("guided_share", bool, "guided_per guided_decay"),)

    name: str = option(
        "task",
        "task, for the stages that the task itself defines, a name of `torchrl-her list`, or a YAML file "
        "with a list of stages",
        shown_as="curriculum",
    )
    stages: Any = option(None, "the list of stages, each a mapping of its options, in place of a file")
    guided_share: float = option(
        0.0,
        "share of the episodes that the previous stage's policy begins, until that stage's goal is achieved",
        at_least=0,
        at_most=1,
    )
    guided_per: str = option(
        "episode",
        "what guided_share is a share of: episodes, or steps before the previous stage's goal is achieved",
        choices=("episode", "step"),
    )
    guided_decay: float = option(1.0, "factor by which guided_share shrinks each epoch", above=0, at_most=1)
    alpha_actor: float = option(
        0.0, "scale of the actor's initial weights for inputs that the first stage does not use", at_least=0
    )
    alpha_critic: float = option(0.0, "like alpha_actor, for the initial weights of critics", at_least=0)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.name != "task" and self.stages is None:  # read at once: a saved recipe must not need the file
            object.__setattr__(self, "stages", read_yaml(find_file("curriculum", self.name, "task")))
        stages = self.stages
        if (self.name, stages) != ("task", None) and not (
            isinstance(stages, list | tuple)
            and stages
            and all(isinstance(stage, Mapping) for stage in stages)
        ):
            raise ValueError(
                f"a curriculum must be a list of stages, each with its options by name, got {stages!r}"
            )


@dataclass(frozen=True, kw_only=True)
class DemonstrationsConfig(Group):
    """Use of recorded episodes of another policy, from a file that `torchrl-her record` wrote."""

    prefix = "demonstrations."
    needs: ClassVar[Needs] = (
        ("episodes", bool, "file share starts_share"),
        ("share", bool, "bc_weight"),
        ("bc_weight", bool, "q_filter"),
        ("starts_share", bool, "starts_width starts_stride starts_threshold starts_samples"),
    )

    episodes: int = option(0, "number of demonstrations used, the first in the file; 0: none", at_least=0)
    file: str | None = option(None, "file of demonstrations, written by `torchrl-her record`")
    share: float = option(
        0.125, "share of demonstrations in each batch; 0: use them only as starts", at_least=0, below=1
    )
    bc_weight: float = option(1.0, "weight of cloning demonstrations, in the actor's loss", at_least=0)
    q_filter: bool = option(True, "whether only actions are cloned that the critic prefers to the policy's")
    starts_share: float = option(
        0.0,
        "share of the episodes that start at a state of a demonstration, initially near its end",
        at_least=0,
        at_most=1,
    )
    starts_width: int = option(4, "number of successive states from which a start is drawn", at_least=1)
    starts_stride: int = option(
        2, "steps by which starts move toward the demonstration's beginning if episodes succeed", at_least=1
    )
    starts_threshold: float = option(
        0.5, "mean success of episodes with demonstrated starts at which starts move", above=0, at_most=1
    )
    starts_samples: int = option(50, "number of episodes averaged for starts_threshold", at_least=1)

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

    episodes: int = option(100, "number of greedy episodes in each evaluation", at_least=1)
    virtual_goals: bool = option(
        False,
        "whether to play extra episodes with virtual goals, and log virtual_success and virtual_q_bias",
    )


_SEEDS = 1 << 31  # upper bound of seeds, so that seeds of evaluations can be larger numbers


@dataclass(frozen=True, kw_only=True)
class RunConfig(Group):
    """Seeds, length and checkpoints of the runs."""

    seed: int = option(0, "seed of all random numbers", at_least=0)
    num_runs: int = option(1, "independent runs trained together; run i has the seed `seed + i`", at_least=1)
    epochs: int = option(30, "number of epochs; each ends with an evaluation", at_least=1)
    frames: int | None = option(
        None, "environment steps of each run, in place of epochs; rounded up to whole epochs", at_least=1
    )
    checkpoint_interval: int = option(10, "number of epochs between two checkpoints", at_least=1)
    keep_checkpoints: int = option(2, "number of checkpoints that are kept, the newest ones", at_least=1)
    keep_buffer: bool = option(
        False, "whether the last checkpoint keeps the replay buffer, so that epochs can be added later"
    )
    pictures: bool = option(
        True, "whether curves, a map of goals and a film of the policy are made at the end (takes seconds)"
    )
    log: Any = option(
        ("tensorboard",),
        "list of loggers, as in [tensorboard,wandb]: tensorboard, wandb, or registered ones; [] writes only "
        "the table of metrics, which every run has",
    )
    threads: int = option(1, "number of torch's threads; small networks are fastest with one", at_least=1)
    dtype: str = option("float32", "type of observations and networks", choices=("float32", "float64"))

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "log", check_loggers(self.log))
        if self.seed + self.num_runs > _SEEDS:
            raise ValueError(f"seed must be below {_SEEDS - self.num_runs + 1}, got {self.seed}")


@dataclass(frozen=True, kw_only=True)
class Groups:
    """All groups of options. Each group checks its own options, but not those of other groups."""

    task: TaskConfig = field(default_factory=TaskConfig)
    hindsight: HindsightConfig = field(default_factory=HindsightConfig)
    learner: LearnerConfig = field(default_factory=LEARNERS)
    collection: CollectionConfig = field(default_factory=CollectionConfig)
    replay: ReplayConfig = field(default_factory=ReplayConfig)
    weights: Weights = field(default_factory=WEIGHTS)
    curriculum: CurriculumConfig = field(default_factory=CurriculumConfig)
    order: Order = field(default_factory=ORDER)
    behavior: Behavior = field(default_factory=BEHAVIOR)
    demonstrations: DemonstrationsConfig = field(default_factory=DemonstrationsConfig)
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)
    run: RunConfig = field(default_factory=RunConfig)
