"""Recipes: whole training runs composed of the library and the tasks.

The names, listed in ``__init__.pyi``, are loaded when they are first used, so that a list of tasks does not
import torch.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
