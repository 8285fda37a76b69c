"""Learning from demonstrations: their file, their rows beside a run's own, and starts of episodes at them."""

from torchrl_her.demonstrations.dataset import Demonstrations
from torchrl_her.demonstrations.replay import MixedReplay, demonstration_rows, write_demonstrations
from torchrl_her.demonstrations.shown import in_layer, with_reward

__all__ = [
    "Demonstrations",
    "MixedReplay",
    "demonstration_rows",
    "in_layer",
    "with_reward",
    "write_demonstrations",
]
