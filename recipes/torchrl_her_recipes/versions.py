"""Whether the installed versions fit together."""

from __future__ import annotations

import re
from collections.abc import Callable
from importlib import metadata

_TRIO = ("torch", "tensordict", "torchrl")


def check_versions(installed: Callable[[str], str] = metadata.version) -> None:
    """Compares torch, tensordict and torchrl with the versions that this project pins.

    TorchRL's compiled part is bound to the torch that it was built with; with another one it only
    warns when it is imported and fails later, in the middle of a run.

    Args:
        installed: gives the version of a package.

    Raises:
        ImportError: one of them is another version; the message names both and the remedy.
    """
    wanted = _pinned(metadata.requires("torchrl-her") or [])
    have = {name: installed(name).split("+")[0] for name in wanted}
    if have != wanted:
        names = ", ".join(f"{name} {have[name]}" for name in have if have[name] != wanted[name])
        remedy = " ".join(f"{name}=={version}" for name, version in wanted.items())
        raise ImportError(f"{names} does not fit this version of torchrl-her; install {remedy}")


def _pinned(requirements: list[str]) -> dict[str, str]:
    pins = (re.match(r"([\w-]+)==([\w.]+)$", requirement) for requirement in requirements)
    return {pin[1]: pin[2] for pin in pins if pin and pin[1] in _TRIO}
