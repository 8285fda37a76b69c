"""Learning from demonstrations: their file, their rows beside a run's own, and starts of episodes at them."""

from torchrl_her.demonstrations.dataset import Demonstrations

__all__ = [
    "Demonstrations",
]
