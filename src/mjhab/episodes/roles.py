"""Roles of receptacles: what household tasks ask for, and which pieces of furniture play them."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

from mjhab.core.errors import UsageError
from mjhab.core.registry import Registry
from mjhab.layout.receptacles import PlacedReceptacle
from mjhab.scenes.spec import Home
from mjhab.tasks.household.registry import TASKS

OPEN_TEMPLATES = ("chair_01", "table_01", "table_02", "tvstand", "sofa")
COUNTER_TOPS = ("counter_left", "counter_right")
SINK = "sink"
COUNTER = "kitchen_counter"
FRIDGE = "fridge"
FRIDGE_SHELF = "fridge/middle_top"
FRIDGE_DOOR = "fridge/top_door"
BOWL_DRAWER = "kitchen_counter/drawer3"
SETTABLE_TABLE = "table_01"


@dataclass(frozen=True)
class Role:
    """A role of receptacles, such as "counter_top".

    plays: whether a receptacle plays it. furniture: template that a home must have for it, "" for any. link: drawer or
    door that must be open to reach in, "" for none.
    """

    name: str
    plays: Callable[[PlacedReceptacle], bool]
    furniture: str = ""
    link: str = ""


ROLES: Registry[Role] = Registry("role of receptacles")


def _is_counter(place: PlacedReceptacle, names: tuple[str, ...]) -> bool:
    return place.template == COUNTER and place.name in names


def is_open(place: PlacedReceptacle) -> bool:
    """A seat, a table or a part of the kitchen counter: objects stand on it in the open."""
    return place.template in OPEN_TEMPLATES or _is_counter(place, (*COUNTER_TOPS, SINK))


for _role in (
    Role("open_surface", is_open),
    Role("counter_top", lambda r: _is_counter(r, COUNTER_TOPS), COUNTER),
    Role("sink", lambda r: _is_counter(r, (SINK,)), COUNTER),
    Role("dining_table", lambda r: r.template == SETTABLE_TABLE, SETTABLE_TABLE),
    Role("fridge_shelf", lambda r: r.id == FRIDGE_SHELF, FRIDGE, FRIDGE_DOOR),
    Role("bowl_drawer", lambda r: r.link == BOWL_DRAWER, COUNTER, BOWL_DRAWER),
):
    ROLES.add(_role.name, _role)


def receptacles_of(
    roles: Iterable[str], receptacles: Iterable[PlacedReceptacle]
) -> list[PlacedReceptacle]:
    """The receptacles of a home that play one of the roles, in the order of the home.

    Of a seat or table with several boards in the role "open_surface" the first counts, its top.

    Raises:
        UsageError: no such role.
    """
    wanted = [ROLES[name] for name in roles]
    tops: set[str] = set()
    found = []
    for place in receptacles:
        playing = [role for role in wanted if role.plays(place)]
        if not playing:
            continue
        if place.template in OPEN_TEMPLATES and all(r.name == "open_surface" for r in playing):
            thing = place.id.split("/")[0]
            if thing in tops:
                continue
            tops.add(thing)
        found.append(place)
    return found


def require_furniture(home: Home, task: str) -> None:
    """Refuse a home that lacks furniture a task is about.

    Raises:
        UsageError: names home, furniture and the role that it would play.
    """
    spec = TASKS[task]
    has = {p.template for p in (*home.articulations, *home.props)}
    needed = [(ROLES[role].furniture, f" as its {role}") for role in spec.roles]
    for furniture, use in (*needed, *((name, "") for name in spec.furniture)):
        if furniture and furniture not in has:
            raise UsageError(
                f"scene {home.name!r} of pack {home.pack!r} has no {furniture}, which {task} needs{use}."
            )


def opens(place: PlacedReceptacle) -> str:
    """The link that must be open to reach into a receptacle, or ""."""
    return place.link or (FRIDGE_DOOR if place.id == FRIDGE_SHELF else "")
