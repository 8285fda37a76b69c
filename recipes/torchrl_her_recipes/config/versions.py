"""Checks that the installed versions of torch, tensordict and torchrl fit together."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from importlib import metadata

from packaging.requirements import Requirement
from packaging.version import Version

# The releases that the tests were run with; `make test-versions` repeats the tests with some of them.
TRIED = {
    "torch": ("2.14.0", "2.14.1", "2.15.0"),
    "tensordict": ("0.14.2", "0.14.3", "0.15.3"),
    "torchrl": ("0.14.0", "0.14.1", "0.15.0.dev20261027"),  # the last one was torchrl-nightly
}


def own_version() -> str:
    """Returns the installed version of the package ``torchrl-her``."""
    return metadata.version("torchrl-her")


def check_versions(installed: Callable[[str], str] = metadata.version) -> None:
    """Compares the installed torch, tensordict and torchrl with the versions that this project requires.

    With an incompatible torch, TorchRL only warns when it is imported, and fails in the middle of a run.
    Therefore, versions are checked first, without importing any of the three packages.

    Raises:
        ImportError: a package is missing or outside its required range, or tensordict and TorchRL have
            different minor releases. The message says what to install.

    Warns:
        UserWarning: the tests were never run with the installed release of a package.
    """
    requirements = {entry.name: entry for entry in map(Requirement, metadata.requires("torchrl-her") or [])}
    have = {name: Version(installed(name)) for name in TRIED}
    misfits = [
        f"{name} {version.public}"
        for name, version in have.items()
        if not requirements[name].specifier.contains(version, prereleases=True)
    ]
    if misfits:
        verb = "does" if len(misfits) == 1 else "do"
        remedy = " ".join(f"'{requirements[name]}'" for name in TRIED)
        raise ImportError(
            f"{', '.join(misfits)} {verb} not fit this version of torchrl-her; install {remedy}"
        )
    torchrl, tensordict = have["torchrl"], have["tensordict"]
    if tensordict.release[:2] != torchrl.release[:2]:
        raise ImportError(
            f"tensordict {tensordict.public} does not fit torchrl {torchrl.public}; "
            f"install 'tensordict~={torchrl.major}.{torchrl.minor}.0'"
        )
    for name, version in have.items():
        if version.public not in TRIED[name]:
            warnings.warn(
                f"{name} {version.public} was never tried with this version of torchrl-her; "
                f"the tests were run with {', '.join(TRIED[name])}",
                stacklevel=2,
            )
