"""Batched TorchRL environments with goals: throwing and reaching tasks, toys, and wrapped gymnasium tasks.

Names are loaded when they are first used, so that listing the tasks does not take the seconds of importing
torch. All names are listed in ``__init__.pyi``.
"""

import lazy_loader

from torchrl_her_envs.gym.registration import register_gym_ids as _register_gym_ids

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

_register_gym_ids()  # gymnasium.make then accepts the ids of this package's tasks
