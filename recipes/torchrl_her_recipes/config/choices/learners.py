"""Choices of the learner, with their options; the makers are in :mod:`..components.learners`."""

from __future__ import annotations

from dataclasses import dataclass
from operator import not_
from typing import Any, ClassVar, Literal

from torchrl_her_recipes.config.choices.kind import Choice, Kind
from torchrl_her_recipes.config.options import AUTO, Needs, option

Actions = Literal["continuous", "discrete"]

_MAKERS = "torchrl_her_recipes.components.learners"
_CRITICS = "how many critics there are; targets have the least of their values"
_CLAMPED = "whether targets are clamped to the returns that rewards allow, where rewards have bounds"
_TARGET_CRITICS = "number of critics, drawn in each step, whose least value is the target; 0 uses all"


def _norm(*more: str, text: str = "") -> Any:
    return option("layer", f"normalization of hidden layers{text}", choices=("none", "layer", *more))


@dataclass(frozen=True, kw_only=True)
class LearnerConfig(Choice):
    """The learner and its networks. Its maker is a ``LearnerBuilder``.

    Attributes:
        actions: kinds of actions that it supports.
        stacks: whether several runs can be trained side by side in one program.
        priority_power: its loss gives each transition the absolute TD error to this power as a priority.
        has_epsilon: whether a share epsilon of the actions explores.
        clones: whether its loss can clone the behavior of demonstrations.
    """

    needs: ClassVar[Needs] = (
        ("normalize", bool, "normalize_clip normalize_least_std"),
        ("hard_update_interval", not_, "tau"),
        ("compile", "never".__ne__, "matmul_dtype"),
        ("hidden", lambda width: width >= 32, "matmul_dtype"),
    )
    actions: ClassVar[Actions] = "continuous"
    stacks: ClassVar[bool] = True
    priority_power: ClassVar[int] = 2
    has_epsilon: ClassVar[bool] = False
    clones: ClassVar[bool] = False

    @property
    def hidden_weights(self) -> int:
        """Number of weights between hidden layers, in the actor and all critics."""
        return (self.depth - 1) * self.hidden**2 * (1 + getattr(self, "critics", 1))

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
    ema_decay: float = option(
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
    matmul_dtype: str = option(
        "float32",
        "numbers that compiled gradient steps multiply between hidden layers; bfloat16: a third less time at "
        "hidden=256 where the processor has AVX512-BF16, more elsewhere",
        choices=("float32", "bfloat16"),
    )

    @property
    def critic_shape(self) -> dict[str, Any]:
        """Arguments of :class:`~torchrl_her.NetworkShape` for critics."""
        return {"hidden": self.hidden, "depth": self.depth, "activation": self.activation, "norm": self.norm}

    @property
    def actor_shape(self) -> dict[str, Any]:
        """Arguments of :class:`~torchrl_her.NetworkShape` for actors, which have no batch normalization."""
        return self.critic_shape | ({"norm": "none"} if self.norm == "batch" else {})


LEARNERS = Kind("learner", LearnerConfig, default="auto")


@dataclass(frozen=True, kw_only=True)
class EpsilonConfig(LearnerConfig):
    """A learner with a deterministic policy: a fraction epsilon of its actions explores."""

    has_epsilon: ClassVar[bool] = True

    epsilon_start: float = option(0.5, "share of exploring actions in the first epoch", at_least=0, at_most=1)
    epsilon_decay: float = option(0.9, "factor of epsilon each epoch", above=0, at_most=1)
    epsilon_end: float = option(0.1, "lowest epsilon", at_least=0, at_most=1)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.epsilon_end > self.epsilon_start:
            raise ValueError(
                f"epsilon_end={self.epsilon_end} must not be above epsilon_start={self.epsilon_start}"
            )


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


@LEARNERS.register
@dataclass(frozen=True, kw_only=True)
class DDPGConfig(NoiseConfig):
    """Deterministic policy gradients (Lillicrap et al., 2016)."""

    name = "ddpg"
    maker = f"{_MAKERS}:DDPGBuilder"
    clones: ClassVar[bool] = True

    norm: str = _norm("batch", text=": layer, in all networks; batch, in the critic, and of its input")
    action_penalty: float = option(0.0, "action L2 penalty, which pulls all actions towards 0", at_least=0)
    saturation_penalty: float = option(
        0.3, "penalty on actions at the ends of tanh, from where an actor does not learn", at_least=0
    )
    clamp_targets: bool = option(True, _CLAMPED)


@dataclass(frozen=True, kw_only=True)
class _SomeCritics(LearnerConfig):
    critics: int = option(2, _CRITICS, at_least=1)
    target_critics: int = option(0, _TARGET_CRITICS, at_least=0)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.target_critics > self.critics:
            raise ValueError(f"target_critics={self.target_critics} must be at most critics={self.critics}")


@LEARNERS.register
@dataclass(frozen=True, kw_only=True)
class TD3Config(_SomeCritics, DDPGConfig):
    """Two critics and smoothed targets (Fujimoto et al., 2018)."""

    name = "td3"
    maker = f"{_MAKERS}:TD3Builder"

    norm: str = _norm()


@dataclass(frozen=True, kw_only=True)
class EntropyConfig(LearnerConfig):
    """A learner whose policy is stochastic and explores by itself."""

    priority_power = 1
    clones: ClassVar[bool] = True

    temperature: float = option(0.1, "the temperature that learning begins with", above=0)
    action_penalty: float = option(
        0.3, "action L2 penalty, which keeps actions off the ends of tanh", at_least=0
    )
    clamp_targets: bool = option(
        False, "whether targets are clamped to the returns that rewards allow, which entropy may exceed"
    )


@LEARNERS.register
@dataclass(frozen=True, kw_only=True)
class SACConfig(_SomeCritics, EntropyConfig):
    """Soft actor-critic with a learned temperature (Haarnoja et al., 2018)."""

    name = "sac"
    maker = f"{_MAKERS}:SACBuilder"


@LEARNERS.register
@dataclass(frozen=True, kw_only=True)
class REDQConfig(SACConfig):
    """SAC with ten critics, targets of two of them at random (Chen et al., 2021)."""

    name = "redq"

    critics: int = option(10, _CRITICS, at_least=1)
    target_critics: int = option(2, _TARGET_CRITICS, at_least=0)


@LEARNERS.register
@dataclass(frozen=True, kw_only=True)
class TQCConfig(EntropyConfig):
    """SAC whose critics give quantiles, the greatest left out (Kuznetsov et al., 2020)."""

    name = "tqc"
    maker = f"{_MAKERS}:TQCBuilder"

    critics: int = option(2, "how many critics there are; targets have all of their quantiles", at_least=1)
    quantiles: int = option(25, "quantiles of the return that each critic gives", at_least=1)
    dropped_quantiles: int = option(
        2, "number of the greatest quantiles of each critic that targets leave out", at_least=0
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.dropped_quantiles >= self.quantiles:
            raise ValueError(
                f"dropped_quantiles={self.dropped_quantiles} must be below quantiles={self.quantiles}"
            )


@LEARNERS.register
@dataclass(frozen=True, kw_only=True)
class DQNConfig(EpsilonConfig):
    """Double DQN, for discrete actions (van Hasselt et al., 2016)."""

    name = "dqn"
    maker = f"{_MAKERS}:DQNBuilder"
    actions = "discrete"

    clamp_targets: bool = option(True, _CLAMPED)


@LEARNERS.register
@dataclass(frozen=True, kw_only=True)
class AutoConfig(DDPGConfig):
    """DDPG, or DQN where actions are discrete."""

    name = "auto"


BY_ACTIONS: dict[Actions, str] = {"continuous": "ddpg", "discrete": "dqn"}
