"""Base class and registry of the alternatives ("choices") for a section of a recipe."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, TypeVar

from torchrl_her_recipes.config.options import REGISTERED, Group, nearest


@dataclass(frozen=True, kw_only=True)
class Choice(Group):
    """Base class of a section's alternatives. Fields are options; help shows the docstring's first line.

    Attributes:
        name: Name by which recipes refer to the choice.
        maker: Function or class that makes the component, as ``module:name``; imported when a run is built.
    """

    name: ClassVar[str] = ""
    maker: ClassVar[str] = ""


C = TypeVar("C", bound=Choice)


class Kind(dict[str, type[C]]):
    """Registry of the choices for one section of a recipe: a mapping from names to classes.

    Calling the registry makes a section: ``BEHAVIOR(name="mega", cutoff=-5.0)`` is a ``Mega`` instance.

    Args:
        section: Name of the section.
        base: Base class of the choices.
        default: Name of the choice that is used if a recipe names none.
    """

    def __init__(self, section: str, base: type[C], *, default: str) -> None:
        super().__init__()
        self.section, self.default, self.__doc__ = section, default, base.__doc__

    def __call__(self, *, name: str | None = None, **values: Any) -> C:
        choice = self.find(name or self.default)
        for option in values:
            if not hasattr(choice, option):
                homes = " or ".join(home for home in self if hasattr(self[home], option))
                problem = f"{self.section}={choice.name} has no option {option}"
                raise ValueError(f"{problem}; {self.section}={homes} has it")
        return choice(**values)

    def register(self, choice: type[C]) -> type[C]:
        """Class decorator that registers a choice under its ``name``, also when its module runs again."""
        before = self.get(choice.name, choice)
        if (before.__module__, before.__qualname__) != (choice.__module__, choice.__qualname__):
            raise ValueError(f"{self.section}={choice.name} is registered already")
        self[choice.name] = choice
        return choice

    def find(self, name: object) -> type[C]:
        """Returns the class of the choice with this name."""
        if str(name) not in self:
            hint = nearest(name, self) or REGISTERED
            raise ValueError(f"{self.section} must be one of {', '.join(self)}, got {name!r}{hint}")
        return self[str(name)]

    def summaries(self) -> dict[str, str]:
        """Returns the first line of each choice's docstring, by name."""
        return {name: str(choice.__doc__).split("\n")[0].rstrip(".") for name, choice in self.items()}
