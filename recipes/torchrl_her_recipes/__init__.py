"""Recipes: complete training runs, composed of the library and its tasks.

Public names (listed in ``__init__.pyi``) are loaded at their first use, so that commands such as
``torchrl-her list`` start without importing torch.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
