"""The learners by name: the options of each, and where its builder is found.

A learner is one module with its options and its builder (see :mod:`torchrl_her_recipes.components.learners`),
and a call of :func:`register_learner`.
"""

from __future__ import annotations

from dataclasses import dataclass
from operator import not_
from typing import Any, ClassVar, Literal

from torchrl_her_recipes.config.groups import Group
from torchrl_her_recipes.config.options import AUTO, REGISTERED, Needs, option, what_there_is

Actions = Literal["continuous", "discrete"]

_CRITICS = "how many critics there are; targets have the least of their values"
_CLAMPED = "whether targets are clamped to the returns that rewards allow, where rewards have bounds"
_TARGET_CRITICS = "so many critics, drawn at random, are asked for each step's targets; 0: all"


def _norm(*more: str, text: str = "") -> Any:
    return option("layer", f"normalization of hidden layers{text}", choices=("none", "layer", *more))


@dataclass(frozen=True, kw_only=True)
class LearnerConfig(Group):
    """The learner and its networks.

    Attributes:
        has_epsilon: whether a share epsilon of the actions explores.
        clones: whether its loss can clone the behavior of demonstrations.
    """

    needs: ClassVar[Needs] = (
        ("normalize", bool, "normalize_clip normalize_least_std"),
        ("hard_update_interval", not_, "tau"),
        ("compile", "never".__ne__, "products"),
        ("hidden", lambda width: width >= 32, "products"),
    )
    has_epsilon: ClassVar[bool] = False
    clones: ClassVar[bool] = False

    @property
    def hidden_weights(self) -> int:
        """How many weights there are between hidden layers, of the actor and all critics."""
        return (self.depth - 1) * self.hidden**2 * (1 + getattr(self, "critics", 1))

    name: str = option(
        "auto",
        "auto: ddpg, or dqn where actions are discrete; or a learner of `torchrl-her list`",
        shown_as="learner",
    )
    device: str = option("cpu", "where the networks are: cpu, cuda, cuda:1, ..., or auto")
    gamma: float = option(
        AUTO, "discount factor; auto: 1 - 2 / steps of an episode, from 0.9 to 0.99", above=0, below=1
    )
    learning_rate: float = option(1e-3, "learning rate of Adam", above=0)
    max_grad_norm: float = option(
        3.0, "gradients of each network are clipped to this norm", above=0, infinite=True
    )
    hidden: int = option(256, "width of the hidden layers", at_least=1)
    depth: int = option(3, "number of hidden layers of the networks, at least 2", at_least=2)
    activation: str = option("relu", "behind each hidden layer", choices=("relu", "tanh", "elu"))
    norm: str = _norm()
    normalize: bool = option(
        True, "whether observations and goals are normalized, by mean and deviation of all that was written"
    )
    normalize_clip: float = option(
        5.0, "normalized values are clipped to plus and minus this", above=0, infinite=True
    )
    normalize_least_std: float | None = option(
        None,
        "least deviation that values are divided by; 1/10,000 of each entry's mean if not given",
        above=0,
    )
    tau: float = option(0.05, "rate of the soft target update", at_least=0, at_most=1)
    average_decay: float = option(
        0.9995,
        "what stays, in a gradient step, of the average of the actor's weights that is evaluated and kept; "
        "0: no average",
        at_least=0,
        below=1,
    )
    hard_update_interval: int = option(0, "gradient steps between hard target updates; 0: soft", at_least=0)
    compile: str = option(
        "auto",
        "compiled gradient steps, in C++ or, on a GPU, as CUDA graphs; auto: where that is possible; always: "
        "on a GPU through torch.compile, too",
        choices=("auto", "always", "never"),
    )
    products: str = option(
        "float32",
        "numbers that compiled gradient steps multiply between hidden layers; bfloat16: a third less time at "
        "hidden=256 where the processor has AVX512-BF16, more elsewhere",
        choices=("float32", "bfloat16"),
    )

    @property
    def critic_shape(self) -> dict[str, Any]:
        """What the hidden layers of critics are like, as the functions that make networks take it."""
        return {"hidden": self.hidden, "depth": self.depth, "activation": self.activation, "norm": self.norm}

    @property
    def actor_shape(self) -> dict[str, Any]:
        """The same for actors, which have no batch normalization."""
        return self.critic_shape | ({"norm": "none"} if self.norm == "batch" else {})


@dataclass(frozen=True, kw_only=True)
class EpsilonConfig(LearnerConfig):
    """A learner with a deterministic policy: a share epsilon of its actions explores."""

    has_epsilon: ClassVar[bool] = True

    epsilon_start: float = option(0.5, "share of exploring actions in the first epoch", at_least=0, at_most=1)
    epsilon_decay: float = option(0.99, "factor of epsilon each epoch", above=0, at_most=1)
    epsilon_end: float = option(0.1, "lowest epsilon", at_least=0, at_most=1)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.epsilon_end > self.epsilon_start:
            raise ValueError(
                f"epsilon_end={self.epsilon_end} must not be above epsilon_start={self.epsilon_start}"
            )


@dataclass(frozen=True, kw_only=True)
class DQNConfig(EpsilonConfig):
    """DQN."""

    clamp_targets: bool = option(True, _CLAMPED)


@dataclass(frozen=True, kw_only=True)
class NoiseConfig(EpsilonConfig):
    """A learner with a deterministic policy of continuous actions.

    Of its actions, the share ``epsilon * uniform_share`` is drawn uniformly, noise is added to
    ``epsilon * (1 - uniform_share)``, and all others are greedy. With ``epsilon_start=1 epsilon_end=1`` every
    action that is not uniform has noise.
    """

    needs: ClassVar[Needs] = (
        *EpsilonConfig.needs,
        ("uniform_share", (1.0).__ne__, "action_noise"),
    )

    action_noise: float = option(
        0.1, "standard deviation of noise on exploring actions, as a share of their range", at_least=0
    )
    uniform_share: float = option(
        0.6, "share of exploring actions that are uniform; the others have noise", at_least=0, at_most=1
    )


@dataclass(frozen=True, kw_only=True)
class DDPGConfig(NoiseConfig):
    """DDPG."""

    clones: ClassVar[bool] = True

    norm: str = _norm("batch", text=": layer, in all networks; batch, in the critic, and of its input")
    action_penalty: float = option(0.0, "action L2 penalty, which pulls all actions towards 0", at_least=0)
    saturation_penalty: float = option(
        0.3, "penalty on actions at the ends of tanh, from where an actor does not learn", at_least=0
    )
    clamp_targets: bool = option(True, _CLAMPED)


@dataclass(frozen=True, kw_only=True)
class TD3Config(DDPGConfig):
    """TD3."""

    norm: str = _norm()
    critics: int = option(2, _CRITICS, at_least=1)
    target_critics: int = option(0, _TARGET_CRITICS, at_least=0)

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_target_critics(self.target_critics, self.critics)


@dataclass(frozen=True, kw_only=True)
class EntropyConfig(LearnerConfig):
    """A learner whose policy is stochastic and explores by itself."""

    clones: ClassVar[bool] = True

    temperature: float = option(0.1, "the temperature that learning begins with", above=0)
    action_penalty: float = option(
        0.3, "action L2 penalty, which keeps actions off the ends of tanh", at_least=0
    )
    clamp_targets: bool = option(
        False, "whether targets are clamped to the returns that rewards allow, which entropy may exceed"
    )


@dataclass(frozen=True, kw_only=True)
class SACConfig(EntropyConfig):
    """SAC."""

    critics: int = option(2, _CRITICS, at_least=1)
    target_critics: int = option(0, _TARGET_CRITICS, at_least=0)

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_target_critics(self.target_critics, self.critics)


@dataclass(frozen=True, kw_only=True)
class REDQConfig(SACConfig):
    """SAC with many critics, of which targets take a few."""

    critics: int = option(10, _CRITICS, at_least=1)
    target_critics: int = option(2, _TARGET_CRITICS, at_least=0)


@dataclass(frozen=True, kw_only=True)
class TQCConfig(EntropyConfig):
    """TQC."""

    critics: int = option(2, "how many critics there are; targets have all of their quantiles", at_least=1)
    quantiles: int = option(25, "quantiles of the return that each critic gives", at_least=1)
    dropped_quantiles: int = option(
        2, "targets leave out so many of the greatest quantiles for each critic", at_least=0
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.dropped_quantiles >= self.quantiles:
            raise ValueError(
                f"dropped_quantiles={self.dropped_quantiles} must be below quantiles={self.quantiles}"
            )


def _check_target_critics(target_critics: int, critics: int) -> None:
    if target_critics > critics:
        raise ValueError(f"target_critics={target_critics} must be at most critics={critics}")


@dataclass(frozen=True, kw_only=True)
class LearnerSpec:
    """A learner that recipes can name.

    Args:
        name: the name.
        summary: one line for people.
        builder: where its :class:`~torchrl_her_recipes.components.learner.LearnerBuilder` is found, as
            ``module:Class``; it is imported when the learner is first built.
        options: its group of options, a subclass of :class:`LearnerConfig`.
        actions: which actions it can choose among.
        stacks: whether several runs can be trained side by side in one program.
        priority_power: its loss gives this power of the absolute TD error as a priority.
    """

    name: str
    summary: str
    builder: str
    options: type[LearnerConfig]
    actions: Actions = "continuous"
    stacks: bool = True
    priority_power: int = 2


_BUILDERS = "torchrl_her_recipes.components.learners"
LEARNERS: dict[str, LearnerSpec] = {}


def register_learner(spec: LearnerSpec) -> None:
    """Makes a learner known by its name.

    Raises:
        ValueError: the name is taken.
    """
    if spec.name in LEARNERS or spec.name == "auto":
        raise ValueError(f"there is a learner {spec.name!r} already")
    LEARNERS[spec.name] = spec


for _spec in (
    LearnerSpec(
        name="ddpg",
        summary="deterministic policy gradients (Lillicrap et al., 2016)",
        builder=f"{_BUILDERS}.ddpg:DDPGBuilder",
        options=DDPGConfig,
    ),
    LearnerSpec(
        name="td3",
        summary="two critics and smoothed targets (Fujimoto et al., 2018)",
        builder=f"{_BUILDERS}.td3:TD3Builder",
        options=TD3Config,
    ),
    LearnerSpec(
        name="sac",
        summary="soft actor-critic with a learned temperature (Haarnoja et al., 2018)",
        builder=f"{_BUILDERS}.sac:SACBuilder",
        options=SACConfig,
        priority_power=1,
    ),
    LearnerSpec(
        name="redq",
        summary="SAC with ten critics, targets of two of them at random (Chen et al., 2021)",
        builder=f"{_BUILDERS}.sac:SACBuilder",
        options=REDQConfig,
        priority_power=1,
    ),
    LearnerSpec(
        name="tqc",
        summary="SAC whose critics give quantiles, the greatest left out (Kuznetsov et al., 2020)",
        builder=f"{_BUILDERS}.tqc:TQCBuilder",
        options=TQCConfig,
        priority_power=1,
    ),
    LearnerSpec(
        name="dqn",
        summary="double DQN, for discrete actions (van Hasselt et al., 2016)",
        builder=f"{_BUILDERS}.dqn:DQNBuilder",
        options=DQNConfig,
        actions="discrete",
    ),
):
    register_learner(_spec)

BY_ACTIONS: dict[Actions, str] = {"continuous": "ddpg", "discrete": "dqn"}


def check_learner(name: str) -> None:
    """Refuses a learner that does not exist.

    Raises:
        ValueError: it does not exist; the message lists those that do.
    """
    if name != "auto" and name not in LEARNERS:
        known = ["auto", *LEARNERS]
        raise ValueError(f"unknown learner {name!r}{what_there_is(name, known, 'learners')}{REGISTERED}")


def priority_power(name: str) -> int:
    """The power of the absolute TD error that a learner's loss gives as a priority.

    Example:
        >>> priority_power("ddpg"), priority_power("sac")
        (2, 1)
    """
    check_learner(name)
    return LEARNERS[BY_ACTIONS["continuous"] if name == "auto" else name].priority_power


def options_of(name: str) -> type[LearnerConfig]:
    """The class of a learner's options; for ``auto`` that of DDPG, which it usually stands for.

    Example:
        >>> options_of("sac").__name__
        'SACConfig'
    """
    check_learner(name)
    return LEARNERS[BY_ACTIONS["continuous"] if name == "auto" else name].options
