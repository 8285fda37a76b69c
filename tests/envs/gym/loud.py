"""An environment that prints while it is made; its processes load no TorchRL."""

from __future__ import annotations

import os
import sys
from typing import Any

import gymnasium

from .walk import Walk


class Loud(Walk):
    def __init__(self, **options: Any) -> None:
        os.write(1, b"argv[0]=--background\n")  # as compiled code does
        sys.stdout.write("the user's own line\n")
        super().__init__(**options)


gymnasium.register("tests/Loud-v0", Loud, max_episode_steps=6)
