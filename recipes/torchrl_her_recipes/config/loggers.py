"""Registry of the loggers that can receive a run's metrics, in addition to its table ``metrics.csv``."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

from torchrl_her_recipes.config.options import REGISTERED, nearest


@dataclass(frozen=True, kw_only=True)
class LoggerSpec:
    """A logger that ``log=[NAME]`` chooses.

    Args:
        name: name of the logger, and of its folder in the run's folder.
        factory: function that opens the logger, as ``module:function``; imported when a run begins. It is
            called with the :class:`~torchrl_her_recipes.RunView` and a number of frames, and removes what
            was logged after that many frames, so that a resumed run does not log it twice. It returns a
            TorchRL ``Logger`` and the number of frames that are logged already: 0 for a new logger.
        needs: the package that the logger needs, which is also the name of the extra; empty for none.
    """

    name: str
    factory: str
    needs: str = ""


_HERE = "torchrl_her_recipes.runs.loggers"
LOGGERS: dict[str, LoggerSpec] = {
    "tensorboard": LoggerSpec(name="tensorboard", factory=f"{_HERE}.tensorboard:open_tensorboard"),
    "wandb": LoggerSpec(name="wandb", factory=f"{_HERE}.wandb_run:open_wandb", needs="wandb"),
}


def register_logger(spec: LoggerSpec) -> None:
    """Registers a logger by its name.

    Raises:
        ValueError: the name is taken by a logger with another factory.
    """
    if LOGGERS.get(spec.name, spec).factory != spec.factory:
        raise ValueError(f"there is a logger {spec.name!r} already")
    LOGGERS[spec.name] = spec


def check_loggers(value: Any) -> tuple[str, ...]:
    """Checks the names of loggers and returns them as a tuple; None gives an empty tuple.

    Example:
        >>> check_loggers("wandb"), check_loggers(["tensorboard", "wandb"]), check_loggers(None)
        (('wandb',), ('tensorboard', 'wandb'), ())
    """
    names = [value] if isinstance(value, str) else [] if value is None else value
    known = ", ".join(LOGGERS)
    if not isinstance(names, list | tuple):
        raise ValueError(f"log must be a list of {known}, got {value!r}")
    for name in names:
        if not isinstance(name, str) or name not in LOGGERS:
            raise ValueError(f"log must be some of {known}, got {name!r}{_instead(name)}")
    if len(set(names)) < len(names):
        raise ValueError(f"log names a logger twice: {', '.join(names)}")
    return tuple(names)


def _instead(name: object) -> str:
    """Returns a suggestion for an unknown logger, as the end of a message."""
    if name == "csv":
        return "; metrics.csv has the same numbers, or choose LogTo(CSVLogger(...)) in Python"
    if name == "mlflow":
        return "; choose LogTo(MLFlowLogger(...)) in Python"
    return nearest(name, LOGGERS) + REGISTERED


def check_installed(names: tuple[str, ...]) -> None:
    """Raises an ImportError if a logger needs a package that is not installed."""
    for name in names:
        needs = LOGGERS[name].needs
        if needs and find_spec(needs) is None:
            raise ImportError(f"log={name} needs {needs}: pip install '.[{needs}]'")
