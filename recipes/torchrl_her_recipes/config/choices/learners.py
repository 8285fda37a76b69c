"""Options of the learners (DDPG, SAC, ...), whose builders are in :mod:`..components.learners`."""

from __future__ import annotations

from dataclasses import dataclass
from operator import not_
from typing import Any, ClassVar, Literal

from torchrl_her_recipes.config.choices.kind import Choice, Kind
from torchrl_her_recipes.config.options import AUTO, Needs, option

Actions = Literal["continuous", "discrete"]

_MAKERS = "torchrl_her_recipes.components.learners"
_CRITICS = "number of critics; targets use the least of their values"
_CLAMPED = "whether targets are clamped to the range of possible returns, if rewards are bounded"
_TARGET_CRITICS = "number of critics, drawn in each gradient step, whose least value targets use; 0: all"


def _norm(*more: str, text: str = "") -> Any:
    return option("layer", f"normalization of hidden layers{text}", choices=("none", "layer", *more))


@dataclass(frozen=True, kw_only=True)
class LearnerConfig(Choice):
    """The learner and its networks.

    Attributes:
        maker: name of a subclass of :class:`~torchrl_her_recipes.LearnerBuilder`.
        actions: kind of actions that the learner supports.
        stacks: whether several runs can be trained side by side in one program.
        priority_power: power of the absolute TD error that the loss writes as a transition's priority.
        has_epsilon: whether a fraction epsilon of the actions explores.
        clones: whether the loss can clone the behavior of demonstrations.
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

    device: str = option("cpu", "device of the networks: cpu, cuda, cuda:1, ..., or auto")
    gamma: float = option(
        AUTO,
        "discount factor; auto: 1 - 2 / (steps of an episode), within 0.9 to 0.99; with shaped rewards "
        "1 - 10 / (steps of an episode), within 0.8 to 0.99",
        above=0,
        below=1,
    )
    learning_rate: float = option(1e-3, "learning rate of Adam", above=0)
    max_grad_norm: float = option(
        3.0, "norm to which the gradients of each network are clipped", above=0, infinite=True
    )
    hidden: int = option(256, "width of the hidden layers", at_least=1)
    depth: int = option(3, "number of hidden layers of the networks, at least 2", at_least=2)
    activation: str = option("relu", "activation after each hidden layer", choices=("relu", "tanh", "elu"))
    norm: str = _norm()
    normalize: bool = option(
        True, "whether observations and goals are normalized by the mean and deviation of stored transitions"
    )
    normalize_clip: float = option(
        5.0, "largest absolute value after normalization; larger ones are clipped", above=0, infinite=True
    )
    normalize_least_std: float | None = option(
        None,
        "least standard deviation to divide by; if not given, 1/10,000 of each entry's mean",
        above=0,
    )
    tau: float = option(0.05, "rate of the soft target update", at_least=0, at_most=1)
    ema_decay: float = option(
        0.9995,
        "decay, per gradient step, of the moving average of the actor's weights; this average is evaluated "
        "and saved; 0: no average",
        at_least=0,
        below=1,
    )
    hard_update_interval: int = option(0, "gradient steps between hard target updates; 0: soft", at_least=0)
    compile: str = option(
        "auto",
        "whether gradient steps are compiled, to C++ on a CPU or CUDA graphs on a GPU; auto: if possible; "
        "always: or raise an error, and on a GPU also apply torch.compile",
        choices=("auto", "always", "never"),
    )
    matmul_dtype: str = option(
        "float32",
        "dtype of matrix products between hidden layers in compiled gradient steps; bfloat16 takes a third "
        "less time at hidden=256 if the processor has AVX512-BF16, and more time otherwise",
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
    epsilon_decay: float = option(0.9, "factor by which epsilon shrinks each epoch", above=0, at_most=1)
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

    A fraction ``epsilon * uniform_share`` of the actions is drawn uniformly. Another fraction,
    ``epsilon * (1 - uniform_share)``, is greedy with noise added, and all other actions are greedy. With
    ``epsilon_start=1 epsilon_end=1`` every action is uniform or has noise.
    """

    needs: ClassVar[Needs] = (
        *EpsilonConfig.needs,
        ("uniform_share", (1.0).__ne__, "action_noise"),
    )

    action_noise: float = option(
        0.1, "standard deviation of noise on exploring actions, as a fraction of their range", at_least=0
    )
    uniform_share: float = option(
        0.6, "share of exploring actions that are uniformly random; others have noise", at_least=0, at_most=1
    )


@LEARNERS.register
@dataclass(frozen=True, kw_only=True)
class DDPGConfig(NoiseConfig):
    """Deterministic policy gradients (Lillicrap et al., 2016)."""

    name = "ddpg"
    maker = f"{_MAKERS}:DDPGBuilder"
    clones: ClassVar[bool] = True

    norm: str = _norm("batch", text="; layer: in all networks; batch: in the critic only, with its input")
    action_penalty: float = option(0.0, "weight of the L2 penalty that pulls actions to 0", at_least=0)
    saturation_penalty: float = option(
        0.3, "weight of the penalty on actions near the ends of tanh, where gradients vanish", at_least=0
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
    """TD3: two critics and smoothed targets (Fujimoto et al., 2018)."""

    name = "td3"
    maker = f"{_MAKERS}:TD3Builder"

    norm: str = _norm()
    target_noise: float = option(
        0.2, "standard deviation of noise on the targets' actions, which blurs values", at_least=0
    )


@dataclass(frozen=True, kw_only=True)
class EntropyConfig(LearnerConfig):
    """A learner whose policy is stochastic and explores by itself."""

    priority_power = 1
    clones: ClassVar[bool] = True

    temperature: float = option(0.1, "initial temperature of the entropy term", above=0)
    action_penalty: float = option(
        0.3, "weight of the L2 penalty that keeps actions off the ends of tanh", at_least=0
    )
    clamp_targets: bool = option(
        False, "whether targets are clamped to the range of possible returns, ignoring the entropy term"
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
    """SAC with ten critics, of which each target uses two at random (Chen et al., 2021)."""

    name = "redq"

    critics: int = option(10, _CRITICS, at_least=1)
    target_critics: int = option(2, _TARGET_CRITICS, at_least=0)


@LEARNERS.register
@dataclass(frozen=True, kw_only=True)
class TQCConfig(EntropyConfig):
    """SAC with quantiles; targets omit the greatest quantiles (Kuznetsov et al., 2020)."""

    name = "tqc"
    maker = f"{_MAKERS}:TQCBuilder"

    critics: int = option(2, "number of critics; targets use the quantiles of all of them", at_least=1)
    quantiles: int = option(25, "number of quantiles of the return that each critic predicts", at_least=1)
    dropped_quantiles: int = option(
        2, "number of quantiles, the greatest ones, that targets leave out for each critic", at_least=0
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
