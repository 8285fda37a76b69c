"""Whether the installed versions of torch, tensordict and torchrl fit together."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable
from importlib import metadata

# The releases that the tests were run with; `make test-versions` runs some of them again.
TRIED = {
    "torch": ("2.14.0", "2.14.1", "2.15.0"),
    "tensordict": ("0.14.2", "0.14.3", "0.15.3"),
    "torchrl": ("0.14.0", "0.14.1", "0.15.0.dev20261027"),  # the last one was torchrl-nightly
}


def own_version() -> str:
    """The installed version of this project."""
    return metadata.version("torchrl-her")


def check_versions(installed: Callable[[str], str] = metadata.version) -> None:
    """Compares torch, tensordict and torchrl with the ranges that this project requires.

    Beside a torch that it does not fit, TorchRL only warns when it is imported, and fails later, in the
    middle of a run. So this is asked first, and without importing any of the three.

    Args:
        installed: gives the version of a package.

    Raises:
        ImportError: one of them is outside of its range, or not installed, or tensordict is not of TorchRL's
            minor release. The message names it and what to install.

    Warns:
        UserWarning: one of them is inside of its range, but a release that was never tried.
    """
    wanted = _ranges(metadata.requires("torchrl-her") or [])
    have = {name: installed(name).split("+")[0] for name in wanted}
    misfits = [f"{name} {have[name]}" for name, span in wanted.items() if not _contains(span, have[name])]
    if misfits:
        verb = "does" if len(misfits) == 1 else "do"
        remedy = " ".join(f"'{name}>={low},<{high}'" for name, (low, high) in wanted.items())
        raise ImportError(
            f"{', '.join(misfits)} {verb} not fit this version of torchrl-her; install {remedy}"
        )
    minor = _numbers(have["torchrl"])[:2]
    if _numbers(have["tensordict"])[:2] != minor:
        raise ImportError(
            f"tensordict {have['tensordict']} does not fit torchrl {have['torchrl']}; "
            f"install 'tensordict~={'.'.join(map(str, minor))}.0'"
        )
    for name, version in have.items():
        if version not in TRIED[name]:
            warnings.warn(
                f"{name} {version} was never tried with this version of torchrl-her; "
                f"the tests were run with {', '.join(TRIED[name])}",
                stacklevel=2,
            )


def _ranges(requirements: list[str]) -> dict[str, tuple[str, str]]:
    """The lowest version and the first one that is too new, of each of the three packages."""
    ranges = {}
    for name in TRIED:
        (requirement,) = (text for text in requirements if re.match(rf"{name}[<>=]", text))
        # The build tool chooses the order of the two bounds.
        bounds = dict(re.findall(r"(>=|<)([\d.]+)", requirement))
        ranges[name] = (bounds[">="], bounds["<"])
    return ranges


def _contains(span: tuple[str, str], version: str) -> bool:
    low, high = span
    # A pre-release of the first version that is too new (2.16.0.dev1) is too new as well.
    return _numbers(low) <= _numbers(version) < _numbers(high)


def _numbers(version: str) -> tuple[int, ...]:
    """The leading numbers of a version: (2, 16, 0) of 2.16.0.dev1."""
    (release,) = re.findall(r"^\d+(?:\.\d+)*", version) or ["0"]
    return tuple(int(number) for number in release.split("."))
