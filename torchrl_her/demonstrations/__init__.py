"""Learning from demonstrations: recording them, replaying them, and starting episodes at their states."""

from torchrl_her.demonstrations.dataset import Demonstrations
from torchrl_her.demonstrations.play import demonstrate
from torchrl_her.demonstrations.replay import MixedReplay, demonstration_rows, write_demonstrations
from torchrl_her.demonstrations.shown import in_stage, with_reward
from torchrl_her.demonstrations.starts import DemonstrationStarts
from torchrl_her.demonstrations.walk import WalkBack

__all__ = [
    "DemonstrationStarts",
    "Demonstrations",
    "MixedReplay",
    "WalkBack",
    "demonstrate",
    "demonstration_rows",
    "in_stage",
    "with_reward",
    "write_demonstrations",
]
