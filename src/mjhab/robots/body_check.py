"""Consistency check of a robot's links with the other fields of its `Robot`, done on first use of the links."""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from numbers import Real
from typing import Any

from mjhab.core.errors import fault, wrong_type
from mjhab.core.typed.checks import check, check_one_of
from mjhab.core.typed.options import fitting
from mjhab.robots.parts import Body, Inertial
from mjhab.scenes.spec import Geom

REST_TOLERANCE = 1e-6
"""How far a rest position may exceed the joint limits [m or rad], because published numbers are rounded."""


@dataclass(frozen=True)
class BodyNeeds:
    """Links and joints that the fields of a `Robot` name.

    Attributes:
        robot: name of the robot.
        base_link: link that the base joints move.
        links: names of links, by the field that names them.
        bodies: names of links whose poses or forces are read, by field.
        rest: rest position by joint, without those of the base [m or rad].
    """

    robot: str
    base_link: str
    links: Mapping[str, tuple[str, ...]]
    bodies: Mapping[str, tuple[str, ...]]
    rest: Mapping[str, float]


def check_record(record: Any, owner: str, apart: Collection[str] = ()) -> None:
    """Check the types of the fields of a dataclass.

    Args:
        record: the dataclass.
        owner: what it is, for messages.
        apart: fields that are checked elsewhere.

    Raises:
        UsageError: a field is of another type than its annotation states.
    """
    hints = typing.get_type_hints(type(record))
    for field in dataclasses.fields(record):
        if field.name not in apart:
            value = getattr(record, field.name)
            fitting(field.name, hints[field.name], value, owner)


def check_body(body: Body, needs: BodyNeeds) -> Body:
    """Check that a body has the links and joints that the other fields of a robot name, and return it.

    Raises:
        UsageError: it is not a `Body`; a field of it or of its parts is of another type; the tree does not list parents
            before children from the base link on; a link has no mass; a field names a link that does not exist or
            merges into its parent; a joint is missing, or its rest position is outside of its limits.
    """
    robot = f"robot {needs.robot!r}"
    if not isinstance(body, Body):
        raise wrong_type("what load_body returns", body, "a Body", where=robot)
    _check_types(body, f"{robot}: load_body: Body")
    links = _links(body, needs.base_link, robot)
    _check_names("load_body: Body.collision", body.collision, links, robot)
    for link in links:
        check(
            link in body.inertials,
            "load_body: Body.inertials",
            tuple(body.inertials),
            f"given for every link; {link} lacks one",
            where=robot,
        )
    for field, names in needs.links.items():
        _check_names(field, names, links, robot)
    moved = tuple(row.link for row in body.tree if row.joint)
    for field, names in needs.bodies.items():
        _check_names(field, names, links, robot)
        for name in names:
            if name not in (*body.collision, *moved, needs.base_link):
                raise fault(
                    robot,
                    f"{field}: link {name!r} has neither a joint nor collision shapes, so that it merges into "
                    "its parent and no force on it is known. Leave it out, or give it shapes.",
                )
    _check_rest(body, needs.rest, robot)
    return body


def _check_types(body: Body, owner: str) -> None:
    check_record(body, owner)
    for row in body.tree:
        name = f"{owner}.tree: link {row.link!r}"
        # Limits may be infinite.
        check_record(row, name, ("limits",))
        check(
            _is_range(row.limits),
            "limits",
            row.limits,
            "a lower and an upper number",
            where=name,
        )
    for link, inertial in body.inertials.items():
        name = f"{owner}.inertials of {link!r}"
        check_record(fitting(name, Inertial, inertial), name)
    for link, geoms in body.collision.items():
        fitting(f"collision of {link!r}", tuple[Geom, ...], geoms, owner)


def _is_range(limits: Any) -> bool:
    pair = isinstance(limits, list | tuple) and len(limits) == 2
    return pair and all(isinstance(x, Real) for x in limits) and limits[0] <= limits[1]


def _links(body: Body, base_link: str, robot: str) -> tuple[str, ...]:
    """Return the names of all links, base link first; checks the order of the tree."""
    above = {row.link for row in body.tree}
    check(
        base_link not in above,
        "base_link",
        base_link,
        "the root of the tree of load_body",
        where=robot,
    )
    found = [base_link]
    for row in body.tree:
        check(
            # Parents first: the model and the chains are built in one pass over the tree.
            row.parent in found,
            f"parent of link {row.link!r} of load_body",
            row.parent,
            f"base_link ({base_link!r}) or a link before it",
            where=robot,
        )
        check(
            row.link not in found,
            "link of load_body",
            row.link,
            "in the tree once",
            where=robot,
        )
        found.append(row.link)
    return tuple(found)


def _check_names(
    field: str, names: Iterable[str], links: tuple[str, ...], robot: str
) -> None:
    for name in names:
        check_one_of("link", name, links, where=f"{robot}: {field}")


def _check_rest(body: Body, rest: Mapping[str, float], robot: str) -> None:
    limits = {row.joint: row.limits for row in body.tree if row.joint}
    for joint, value in rest.items():
        check_one_of("joint of load_body", joint, limits, where=f"{robot}: joints")
        low, high = limits[joint]
        check(
            low - REST_TOLERANCE <= value <= high + REST_TOLERANCE,
            f"rest_qpos of joint {joint!r}",
            value,
            f"within its limits {low:g} to {high:g}",
            where=robot,
        )
