"""Hindsight experience replay as parts of a TorchRL replay buffer.

The names that most scripts need are here; all others are in the sub-packages ``goals``, ``modules``,
``objectives``, ``replay_buffers``, ``trainers``, ``curriculum`` and ``demonstrations``.
"""

from importlib.metadata import version

from torchrl_her.curriculum.guide import GuidedExploration
from torchrl_her.curriculum.layers import Curriculum, CurriculumLayer, CurriculumProgress
from torchrl_her.curriculum.switch import enter_layer
from torchrl_her.curriculum.transforms import StateToObs, ZeroPad
from torchrl_her.goals.grid import GoalGrid, box_target, sampled_target
from torchrl_her.goals.ibs import Instructiveness
from torchrl_her.goals.rewards import EnvReward, GoalReward
from torchrl_her.goals.strategies import register_strategy
from torchrl_her.goals.weights import GoalWeights
from torchrl_her.modules.exploration import DecayingEpsilon, DecayingEpsilonGreedy
from torchrl_her.modules.networks import make_actor, make_critic
from torchrl_her.modules.q_actor import make_q_actor
from torchrl_her.modules.stochastic_actor import make_stochastic_actor
from torchrl_her.objectives.ddpg import make_ddpg_loss
from torchrl_her.objectives.dqn import make_dqn_loss
from torchrl_her.objectives.sac import make_sac_loss
from torchrl_her.objectives.targets import make_target_updater
from torchrl_her.objectives.td3 import make_td3_loss
from torchrl_her.objectives.tqc import make_tqc_loss
from torchrl_her.replay_buffers.env_ids import EnvIds
from torchrl_her.replay_buffers.options import HindsightOptions
from torchrl_her.replay_buffers.sample_unit import HERSampleUnit
from torchrl_her.replay_buffers.writer import HERWriter
from torchrl_her.trainers.checkpoint import load_checkpoint, save_checkpoint
from torchrl_her.trainers.fused import FusedLearner
from torchrl_her.trainers.learner import LossLearner
from torchrl_her.trainers.metrics import reached, success
from torchrl_her.trainers.trainer import Trainer, evaluate

__all__ = [
    "Curriculum",
    "CurriculumLayer",
    "CurriculumProgress",
    "DecayingEpsilon",
    "DecayingEpsilonGreedy",
    "EnvIds",
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
    "StateToObs",
    "Trainer",
    "ZeroPad",
    "box_target",
    "enter_layer",
    "evaluate",
    "load_checkpoint",
    "make_actor",
    "make_critic",
    "make_ddpg_loss",
    "make_dqn_loss",
    "make_q_actor",
    "make_sac_loss",
    "make_stochastic_actor",
    "make_target_updater",
    "make_td3_loss",
    "make_tqc_loss",
    "reached",
    "register_strategy",
    "sampled_target",
    "save_checkpoint",
    "success",
]

__version__ = version("torchrl-her")
