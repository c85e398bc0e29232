"""Checks of single values: each refuses by `wrong_value`, whose message is told in one form.

What a specification's field may be by its type is `core.typed.options`; these are for the rest.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Any, TypeVar

from mjhab.core.errors import unknown_name, wrong_type, wrong_value

Kind = TypeVar("Kind")


def check(
    good: bool,
    option: str,
    given: object,
    expected: str,
    advice: str = "",
    where: object = "",
) -> None:
    """Refuse a value unless it is good; the other checks are this one with an expectation of their own.

    Args:
        good: whether the value fits.
        option: what has the value.
        given: the value.
        expected: what would fit, as a phrase that follows "must be".
        advice: what to do, a sentence; "" if that is clear.
        where: the file or object that has the field; "" for none.

    Raises:
        FieldError: it does not fit.
    """
    if not good:
        raise wrong_value(option, given, expected, advice, where)


def check_least(option: str, value: float, least: float, where: object = "") -> None:
    """Refuse a number below ``least``, and NaN.

    Raises:
        FieldError: see `check`.
    """
    check(value >= least, option, value, f"at least {least:,}", where=where)


def check_above(option: str, value: float, low: float, where: object = "") -> None:
    """Refuse a number that is not above ``low``, and NaN.

    Raises:
        FieldError: see `check`.
    """
    check(value > low, option, value, f"above {low:g}", where=where)


def check_between(
    option: str, value: float, low: float, high: float, unit: str = "", where: object = ""
) -> None:
    """Refuse a number outside of ``low`` to ``high``, both of which are good, and NaN.

    Raises:
        FieldError: see `check`.
    """
    expected = f"between {low:g} and {high:g} {unit}".strip()
    check(low <= value <= high, option, value, expected, where=where)


def check_one_of(
    kind: str, name: object, names: Collection[str], where: object = ""
) -> None:
    """Refuse a name that is not in a closed list.

    Raises:
        FieldError: it names the nearest one.
    """
    if not isinstance(name, str) or name not in names:
        raise unknown_name(kind, name, names, where=where)


def check_kind(
    option: str, value: Any, kind: type[Kind], advice: str = "", where: object = ""
) -> Kind:
    """The value, if it is an object of a class.

    Raises:
        FieldError: see `check`.
    """
    if not isinstance(value, kind):
        raise wrong_type(option, value, f"a {kind.__name__}", advice, where)
    return value


def check_shape(
    option: str, array: Any, shape: tuple[int, ...], where: object = ""
) -> None:
    """Refuse an array of numpy or torch of another shape; -1 stands for any length. The error's ``given`` is its shape.

    Raises:
        FieldError: see `check`.
    """
    got = tuple(array.shape)
    good = len(got) == len(shape) and all(
        want in (-1, have) for want, have in zip(shape, got, strict=True)
    )
    check(good, option, got, f"of shape {shape}", where=where)
