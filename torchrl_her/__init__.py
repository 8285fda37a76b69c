"""Hindsight experience replay as parts of a TorchRL replay buffer.

The names that most scripts import are here; all others are in the sub-packages ``goals``, ``modules``,
``objectives``, ``replay_buffers``, ``trainers``, ``curriculum`` and ``demonstrations``.
"""

import warnings
from importlib import import_module
from importlib.metadata import version
from typing import TYPE_CHECKING

from torchrl_her.curriculum.guide import GuidedExploration
from torchrl_her.curriculum.stages import Curriculum, CurriculumProgress, CurriculumStage
from torchrl_her.curriculum.switch import enter_stage
from torchrl_her.curriculum.transforms import StateToObs, ZeroPad
from torchrl_her.env_keys import EnvKeys
from torchrl_her.goals.grid import GoalGrid, box_target
from torchrl_her.goals.ibs import Instructiveness
from torchrl_her.goals.rewards import EnvReward, GoalReward
from torchrl_her.goals.strategies import register_strategy
from torchrl_her.goals.weights import GoalWeights
from torchrl_her.modules.exploration import DecayingEpsilon
from torchrl_her.modules.networks import NetworkShape, make_actor, make_critic
from torchrl_her.objectives.ddpg import make_ddpg_loss
from torchrl_her.objectives.targets import make_target_updater
from torchrl_her.replay_buffers.env_ids import EnvIds
from torchrl_her.replay_buffers.options import HindsightOptions
from torchrl_her.replay_buffers.sample_unit import HERSampleUnit
from torchrl_her.replay_buffers.writer import HERWriter
from torchrl_her.trainers.checkpoint import load_checkpoint, save_checkpoint
from torchrl_her.trainers.fused import FusedLearner
from torchrl_her.trainers.learner import LossLearner
from torchrl_her.trainers.metrics import success
from torchrl_her.trainers.trainer import Trainer, evaluate

__all__ = [
    "Curriculum",
    "CurriculumProgress",
    "CurriculumStage",
    "DecayingEpsilon",
    "EnvIds",
    "EnvKeys",
    "EnvReward",
    "FusedLearner",
    "GoalGrid",
    "GoalReward",
    "GoalWeights",
    "GuidedExploration",
    "HERSampleUnit",
    "HERWriter",
    "HindsightOptions",
    "Instructiveness",
    "LossLearner",
    "NetworkShape",
    "StateToObs",
    "Trainer",
    "ZeroPad",
    "box_target",
    "enter_stage",
    "evaluate",
    "load_checkpoint",
    "make_actor",
    "make_critic",
    "make_ddpg_loss",
    "make_target_updater",
    "register_strategy",
    "save_checkpoint",
    "success",
]

__version__ = version("torchrl-her")

# Names that this package had until 0.1, and the sub-packages that have them now; 0.2 drops these aliases.
_MOVED = {
    "DecayingEpsilonGreedy": "modules",
    "make_dqn_loss": "objectives",
    "make_q_actor": "modules",
    "make_sac_loss": "objectives",
    "make_stochastic_actor": "modules",
    "make_td3_loss": "objectives",
    "make_tqc_loss": "objectives",
    "reached": "trainers",
    "sampled_target": "goals",
}

if not TYPE_CHECKING:  # hidden from type checkers, which then report missing names

    def __getattr__(name: str) -> object:
        """Returns a name that has moved to a sub-package, with a warning."""
        if name not in _MOVED:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        home = f"{__name__}.{_MOVED[name]}"
        warnings.warn(f"{name} is in {home}; it leaves {__name__} in 0.2", DeprecationWarning, stacklevel=2)
        return getattr(import_module(home), name)
