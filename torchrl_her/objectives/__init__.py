"""TorchRL's losses of DDPG, TD3, SAC, TQC and DQN, with clamped targets and costs of actions."""

from torchrl_her.objectives.actor_terms import ActorTerms, action_cost
from torchrl_her.objectives.cloning import DEMONSTRATION, Cloning, cloning_terms
from torchrl_her.objectives.critics import critic_value, critic_values
from torchrl_her.objectives.ddpg import PenalizedDDPGLoss, make_ddpg_loss
from torchrl_her.objectives.dqn import make_dqn_loss
from torchrl_her.objectives.sac import PenalizedSACLoss, make_sac_loss
from torchrl_her.objectives.targets import ClampedTD0, RunsHardUpdate, Targets, make_target_updater
from torchrl_her.objectives.td3 import PenalizedTD3Loss, make_td3_loss
from torchrl_her.objectives.tqc import PenalizedTQCLoss, make_tqc_loss

__all__ = [
    "DEMONSTRATION",
    "ActorTerms",
    "ClampedTD0",
    "Cloning",
    "PenalizedDDPGLoss",
    "PenalizedSACLoss",
    "PenalizedTD3Loss",
    "PenalizedTQCLoss",
    "RunsHardUpdate",
    "Targets",
    "action_cost",
    "cloning_terms",
    "critic_value",
    "critic_values",
    "make_ddpg_loss",
    "make_dqn_loss",
    "make_sac_loss",
    "make_target_updater",
    "make_td3_loss",
    "make_tqc_loss",
]
