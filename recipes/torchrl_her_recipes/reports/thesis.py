"""What the thesis says of a study: its numbers, and the orders of algorithms that it states."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import yaml

_FILE = Path(__file__).parent.parent / "conf" / "thesis.yaml"


@dataclass(frozen=True)
class Order:
    """Of two algorithms, which one reaches more.

    Attributes:
        measure: of what.
        more: the one with more of it.
        less: the other one.
        text: as it is written.
    """

    measure: str
    more: str
    less: str
    text: str

    @classmethod
    def parse(cls, measure: str, text: str) -> Order:
        """An order from ``a > b`` or ``a < b``.

        Raises:
            ValueError: it is written in another way.

        Example:
            >>> order = Order.parse("kl", "her_ibs < her")
            >>> order.more, order.less
            ('her', 'her_ibs')
        """
        words = text.split()
        if len(words) != 3 or words[1] not in "<>":
            raise ValueError(f"an order is written 'a > b' or 'a < b', got {text!r}")
        more, less = (words[0], words[2]) if words[1] == ">" else (words[2], words[0])
        return cls(measure, more, less, text)


@dataclass(frozen=True)
class Thesis:
    """What it says of one study; nothing of studies that are not in it.

    Attributes:
        orders: the ones that it states.
        numbers: measure, task, algorithm to the number that it gives.
        where: measure to section.
        notes: measure to what a reader should know.
    """

    orders: tuple[Order, ...] = ()
    numbers: dict[str, dict[str, dict[str, float]]] = field(default_factory=dict)
    where: dict[str, str] = field(default_factory=dict)
    notes: dict[str, str] = field(default_factory=dict)

    def number(self, measure: str, task: str, algorithm: str) -> float | None:
        """The number that it gives; None if it gives none."""
        return self.numbers.get(measure, {}).get(task, {}).get(algorithm)


def load_thesis(study: str) -> Thesis:
    """What the thesis says of a study, by the study's name.

    Example:
        >>> load_thesis("bias").number("kl", "hand_v2", "her")
        2.0317
    """
    said = yaml.safe_load(_FILE.read_text()).get(study, {})
    expected = said.pop("expect", {})
    orders = [Order.parse(measure, text) for measure, texts in expected.items() for text in texts]
    return Thesis(orders=tuple(orders), **said)
