"""Roles: what a task asks of the furniture of a home, and which pieces of a pack play them.

A task asks for "a counter top" or "the fridge shelf", never for a piece by name; every pack says in `Pack.roles` (a
home in `Home.roles`, where it differs) which of its receptacles and links these are. The names below are those that
the tasks of mjhab ask for; tasks and packs of plugins may use others.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from mjhab.core.errors import UsageError
from mjhab.scenes.spec import Articulation, Home, Pack, Prop, Receptacle, Roles

OPEN_SURFACE = "open_surface"
"""A place that is reached without opening anything: table tops, seats, counter tops."""
COUNTER_TOP = "counter_top"
"""A free part of the kitchen counter's worktop."""
SINK = "sink"
DINING_TABLE = "dining_table"
"""Where SetTable brings bowl and apple."""
DRAWER = "drawer"
"""The inside of the kitchen drawer in which SetTable's bowl starts."""
FRIDGE_SHELF = "fridge_shelf"
"""The shelf of the fridge behind its main door."""
KITCHEN_DRAWER_LINK = "kitchen_drawer"
"""The link that `DRAWER` moves with."""
FRIDGE_DOOR_LINK = "fridge_door"
"""The link that closes `FRIDGE_SHELF`."""
_MAX_NAMED_HOMES = 5
"""Homes named in a message."""


def roles_of(pack: Pack, home: Home) -> Roles:
    """The roles that hold in a home: its own where it states them, else those of its pack."""
    return home.roles if home.roles is not None else pack.roles


def plays(roles: Roles, role: str, template: str, receptacle: str, *, first: bool) -> bool:
    """Whether a receptacle plays a role.

    Args:
        roles: of the home.
        role: name of the role.
        template: name of the piece of furniture.
        receptacle: name of the receptacle.
        first: it is the first receptacle of its template.
    """
    listed = roles.places.get(role, ())
    whole = (f"{template}/{receptacle}", f"{template}/*")
    return any(name in listed for name in whole) or (first and template in listed)


def roles_in(pack: Pack, home: Home) -> set[str]:
    """Names of the roles of places and links for which a home has a piece."""
    roles = roles_of(pack, home)
    found: set[str] = set()
    for placement in (*home.props, *home.articulations):
        template = pack.props.get(placement.template) or pack.articulations[placement.template]
        for k, receptacle in enumerate(template.receptacles):
            found |= {
                role
                for role in roles.places
                if plays(roles, role, template.name, receptacle.name, first=k == 0)
            }
        if isinstance(template, Articulation):
            links = {f"{template.name}/{link.name}" for link in template.links}
            found |= {role for role, link in roles.links.items() if link in links}
    return found


def require_roles(pack: Pack, homes: Iterable[Home], needed: Sequence[str], who: str) -> None:
    """Refuse homes that lack furniture.

    Args:
        pack: the pack of the homes.
        homes: to look at.
        needed: names of roles.
        who: who needs them, for the message: "task 'set_table'".

    Raises:
        UsageError: names the role, which homes lack it, and which roles the pack has.
    """
    lacking: dict[str, list[str]] = {}
    for home in homes:
        present = roles_in(pack, home)
        for role in needed:
            if role not in present:
                lacking.setdefault(role, []).append(home.name)
    if not lacking:
        return
    role, names = next(iter(lacking.items()))
    shown = ", ".join(repr(name) for name in names[:_MAX_NAMED_HOMES])
    more = f" and {len(names) - _MAX_NAMED_HOMES} more" if len(names) > _MAX_NAMED_HOMES else ""
    known = ", ".join(sorted({*pack.roles.places, *pack.roles.links})) or "none"
    raise UsageError(
        f"{who} needs furniture with the role {role!r}, which these homes of pack {pack.name!r} lack: {shown}{more}. "
        f"Choose other homes, or give a piece the role (roles of the pack: {known})."
    )


def link_with_role(roles: Roles, role: str) -> str:
    """Id of the link that plays a role.

    Raises:
        UsageError: none does.
    """
    if role not in roles.links:
        known = ", ".join(sorted(roles.links)) or "none"
        raise UsageError(f"no link plays the role {role!r}; roles of links here: {known}.")
    return roles.links[role]


def present_roles(pack: Pack, roles: Roles) -> Roles:
    """The part of ``roles`` that names furniture of a pack."""
    places = _places_of((*pack.props.values(), *pack.articulations.values()))
    links = _links_of(pack)
    kept = {
        role: tuple(place for place in listed if place in places)
        for role, listed in roles.places.items()
    }
    return Roles(
        {role: listed for role, listed in kept.items() if listed},
        {role: link for role, link in roles.links.items() if link in links},
        {p: link for p, link in roles.closed_by.items() if p in places and link in links},
    )


def check_roles(pack: Pack) -> None:
    """Refuse roles that name furniture the pack does not have.

    Raises:
        ValueError: names the role and the piece.
    """
    places = _places_of((*pack.props.values(), *pack.articulations.values()))
    links = _links_of(pack)
    for roles in (pack.roles, *(home.roles for home in pack.homes if home.roles is not None)):
        named = {(role, place) for role, listed in roles.places.items() for place in listed}
        named |= {(f"what closes {place}", place) for place in roles.closed_by}
        for role, place in sorted(named):
            if place not in places:
                raise ValueError(
                    f"role {role!r} names {place!r}, which is no receptacle of the pack."
                )
        for role, link in sorted({*roles.links.items(), *roles.closed_by.items()}):
            if link not in links:
                raise ValueError(f"role {role!r} names {link!r}, which is no link of the pack.")


def _links_of(pack: Pack) -> set[str]:
    return {f"{a.name}/{link.name}" for a in pack.articulations.values() for link in a.links}


def _places_of(templates: Iterable[Prop | Articulation]) -> set[str]:
    """Every way in which `Roles.places` may name the receptacles of templates."""
    found: set[str] = set()
    for template in templates:
        receptacles: tuple[Receptacle, ...] = template.receptacles
        if receptacles:
            found |= {template.name, f"{template.name}/*"}
        found |= {f"{template.name}/{r.name}" for r in receptacles}
    return found
