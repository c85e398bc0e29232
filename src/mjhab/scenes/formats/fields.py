"""Objects of JSON that a file format defines: each field is checked when it is read."""

from __future__ import annotations

from typing import Any

import numpy as np

from mjhab.core.errors import shown


class Fields:
    """An object of a file. Fields that nobody reads may hold anything.

    Args:
        value: what stands in its place.
        where: the place, such as ``"nodes[3]"``, for messages.

    Raises:
        ValueError: it is no object; so do all methods if a field does not fit. The message names the field.
    """

    def __init__(self, value: Any, where: str) -> None:
        if not isinstance(value, dict):
            raise _unfit(where, "an object", value)
        self._values: dict[str, Any] = value
        self.where = where

    def __contains__(self, name: str) -> bool:
        return name in self._values

    def place(self, name: str) -> str:
        """Where a field stands."""
        return f"{self.where}.{name}" if self.where else name

    def value(self, name: str) -> Any:
        """What a field holds, unchecked."""
        if name not in self._values:
            raise ValueError(f"{self.place(name)} is missing")
        return self._values[name]

    def part(self, name: str) -> Fields:
        """An object; one without fields where there is none."""
        return Fields(self._values.get(name, {}), self.place(name))

    def parts(self, name: str) -> list[Fields]:
        """A list of objects; empty where there is none."""
        return [
            Fields(entry, f"{self.place(name)}[{number}]")
            for number, entry in enumerate(self._list(name))
        ]

    def whole(self, name: str, default: int | None = None) -> int:
        """A whole number from 0, such as a count or an index."""
        if default is not None and name not in self._values:
            return default
        return _whole(self.value(name), self.place(name))

    def wholes(self, name: str) -> list[int]:
        """A list of whole numbers from 0; empty where there is none."""
        return [
            _whole(entry, f"{self.place(name)}[{number}]")
            for number, entry in enumerate(self._list(name))
        ]

    def numbers(self, name: str, default: tuple[float, ...]) -> np.ndarray:
        """As many numbers as there are in ``default``, (n,) float64."""
        if name not in self._values:
            return np.array(default, float)
        value = self.value(name)
        fits = isinstance(value, list) and len(value) == len(default)
        if not fits or not all(_is_number(entry) for entry in value):
            raise _unfit(self.place(name), f"{len(default)} numbers", value)
        return np.array(value, float)

    def number(self, name: str, default: float) -> float:
        """A number."""
        value = self._values.get(name, default)
        if not _is_number(value):
            raise _unfit(self.place(name), "a number", value)
        return float(value)

    def text(self, name: str) -> str:
        """A text."""
        value = self.value(name)
        if not isinstance(value, str):
            raise _unfit(self.place(name), "a text", value)
        return value

    def pick(self, name: str, index: int) -> Fields:
        """An object of a list, by its number."""
        entries = self._list(name)
        if index >= len(entries):
            raise ValueError(
                f"{self.place(name)} has {len(entries)} entries; entry {index} does not exist"
            )
        return Fields(entries[index], f"{self.place(name)}[{index}]")

    def _list(self, name: str) -> list[Any]:
        value = self._values.get(name, [])
        if not isinstance(value, list):
            raise _unfit(self.place(name), "a list", value)
        return value


def _whole(value: Any, where: str) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or value < 0:
        raise _unfit(where, "a whole number from 0", value)
    return value


def _is_number(value: Any) -> bool:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    try:
        float(value)
    except OverflowError:  # an integer of hundreds of digits
        return False
    return True


def _unfit(where: str, expected: str, value: Any) -> ValueError:
    return ValueError(f"{where or 'the document'}: expected {expected}, got {shown(value)}")
