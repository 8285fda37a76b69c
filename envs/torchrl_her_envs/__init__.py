"""Throwing and reaching tasks with goals, toy environments and gymnasium's, batched, for TorchRL.

Names are loaded when they are first used, so that listing the tasks does not take the seconds of importing
torch. All names are listed in ``__init__.pyi``.
"""

import lazy_loader

from torchrl_her_envs.gym.registration import register_gym_ids as _register_gym_ids

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

_register_gym_ids()  # from here on, gymnasium.make accepts their ids
