"""JSON objects of a file format, whose fields are checked when they are read."""

from __future__ import annotations

from typing import Any

import numpy as np

from mjhab.core.errors import shown


class Fields:
    """A JSON object. Fields that are not read are not checked.

    Args:
        value: the JSON value.
        where: its path in the document, such as ``"nodes[3]"``, for messages; "" for the document itself.

    Raises:
        ValueError: the value is no object. All methods raise it if a field has another type; the message names it.
    """

    def __init__(self, value: Any, where: str) -> None:
        if not isinstance(value, dict):
            raise _unfit(where, "an object", value)
        self._values: dict[str, Any] = value
        self.where = where

    def __contains__(self, name: str) -> bool:
        return name in self._values

    def place(self, name: str) -> str:
        """Return the path of a field in the document, for messages."""
        return f"{self.where}.{name}" if self.where else name

    def value(self, name: str) -> Any:
        """Return the value of a required field, unchecked."""
        if name not in self._values:
            raise ValueError(f"{self.place(name)} is missing")
        return self._values[name]

    def part(self, name: str) -> Fields:
        """Return an object; an empty one if the field is missing."""
        return Fields(self._values.get(name, {}), self.place(name))

    def parts(self, name: str) -> list[Fields]:
        """Return a list of objects; empty if the field is missing."""
        return [
            Fields(entry, f"{self.place(name)}[{number}]")
            for number, entry in enumerate(self._list(name))
        ]

    def whole(self, name: str, default: int | None = None) -> int:
        """Return an integer from 0, such as a count or an index; a field without ``default`` is required."""
        if default is not None and name not in self._values:
            return default
        return _whole(self.value(name), self.place(name))

    def wholes(self, name: str) -> list[int]:
        """Return a list of integers from 0; empty if the field is missing."""
        return [
            _whole(entry, f"{self.place(name)}[{number}]")
            for number, entry in enumerate(self._list(name))
        ]

    def numbers(self, name: str, default: tuple[float, ...]) -> np.ndarray:
        """Return a list of as many numbers as ``default`` has, (n,) float64; ``default`` if the field is missing."""
        if name not in self._values:
            return np.array(default, float)
        value = self.value(name)
        fits = isinstance(value, list) and len(value) == len(default)
        if not fits or not all(_is_number(entry) for entry in value):
            raise _unfit(self.place(name), f"{len(default)} numbers", value)
        return np.array(value, float)

    def number(self, name: str, default: float) -> float:
        """Return a number; ``default`` if the field is missing."""
        value = self._values.get(name, default)
        if not _is_number(value):
            raise _unfit(self.place(name), "a number", value)
        return float(value)

    def text(self, name: str) -> str:
        """Return a required string."""
        value = self.value(name)
        if not isinstance(value, str):
            raise _unfit(self.place(name), "a text", value)
        return value

    def pick(self, name: str, index: int) -> Fields:
        """Return the object at an index of a list."""
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
    # In Python True is an int, but no number in JSON.
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
    return ValueError(
        f"{where or 'the document'}: expected {expected}, got {shown(value)}"
    )
