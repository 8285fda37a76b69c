"""Recipes: whole training runs composed of the library and the tasks.

Names are loaded when they are first used (they are listed in ``__init__.pyi``): asking for the list of
tasks must not import torch.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
