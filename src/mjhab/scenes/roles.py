"""Roles of furniture, by which tasks refer to receptacles and links independently of the pack.

A task needs "a counter top" or "the fridge shelf", never a piece by name. `Pack.roles`, or `Home.roles` if a home
differs, assign receptacles and links to the roles. The constants below are the roles of mjhab's tasks; tasks and packs
of plugins may use others.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from mjhab.core.errors import UsageError, fault
from mjhab.scenes.spec import Articulation, Home, Pack, Prop, Receptacle, Roles

OPEN_SURFACE = "open_surface"
"""Receptacles that are reached without opening anything: table tops, seats, counter tops."""
COUNTER_TOP = "counter_top"
"""Receptacles on the worktop of the kitchen counter."""
SINK = "sink"
"""The sink of the kitchen counter."""
DINING_TABLE = "dining_table"
"""The table that SetTable sets with bowl and apple."""
DRAWER = "drawer"
"""The inside of the kitchen drawer in which SetTable's bowl starts."""
FRIDGE_SHELF = "fridge_shelf"
"""The shelf of the fridge behind its main door."""
KITCHEN_DRAWER_LINK = "kitchen_drawer"
"""The link that `DRAWER` moves with."""
FRIDGE_DOOR_LINK = "fridge_door"
"""The link that closes `FRIDGE_SHELF`."""
_MAX_NAMED_HOMES = 5
"""Largest number of homes named in a message."""


def roles_of(pack: Pack, home: Home) -> Roles:
    """Return the roles of a home: its own if it has any, else those of its pack."""
    # Roles of a home may be empty, which is not the same as none.
    return home.roles if home.roles is not None else pack.roles


def plays(
    roles: Roles, role: str, template: str, receptacle: str, *, first: bool
) -> bool:
    """Return whether a receptacle has a role.

    Args:
        roles: roles of the home.
        role: name of the role.
        template: name of the piece of furniture.
        receptacle: name of the receptacle.
        first: whether it is the first receptacle of its template.
    """
    listed = roles.places.get(role, ())
    whole = (f"{template}/{receptacle}", f"{template}/*")
    # A template alone stands for its first receptacle.
    return any(name in listed for name in whole) or (first and template in listed)


def roles_in(pack: Pack, home: Home) -> set[str]:
    """Return the names of the roles for which a home has a receptacle or link."""
    roles = roles_of(pack, home)
    found: set[str] = set()
    for placement in (*home.props, *home.articulations):
        template = (
            pack.props.get(placement.template) or pack.articulations[placement.template]
        )
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


def require_roles(
    pack: Pack, homes: Iterable[Home], needed: Sequence[str], who: str
) -> None:
    """Check that homes have furniture for roles.

    Args:
        pack: the pack of the homes.
        homes: the homes.
        needed: names of roles.
        who: what needs the roles, for the message: "task 'set_table'".

    Raises:
        UsageError: a home lacks a role; the message names the role, the homes, and the roles of the pack.
    """
    lacking: dict[str, list[str]] = {}
    for home in homes:
        present = roles_in(pack, home)
        for role in needed:
            if role not in present:
                lacking.setdefault(role, []).append(home.name)
    if not lacking:
        return
    # One role is enough for a message; the next run tells of the next one.
    role, names = next(iter(lacking.items()))
    shown = ", ".join(repr(name) for name in names[:_MAX_NAMED_HOMES])
    more = (
        f" and {len(names) - _MAX_NAMED_HOMES} more"
        if len(names) > _MAX_NAMED_HOMES
        else ""
    )
    known = ", ".join(sorted({*pack.roles.places, *pack.roles.links})) or "none"
    raise fault(
        who,
        f"needs furniture with the role {role!r}, which these homes of pack {pack.name!r} lack: {shown}{more}. "
        f"Choose other homes, or give a piece the role (roles of the pack: {known}).",
    )


def link_with_role(roles: Roles, role: str) -> str:
    """Return the id ``"<articulation>/<link>"`` of the link with a role.

    Raises:
        UsageError: no link has it.
    """
    if role not in roles.links:
        known = ", ".join(sorted(roles.links)) or "none"
        raise UsageError(
            f"no link plays the role {role!r}; roles of links here: {known}."
        )
    return roles.links[role]


def present_roles(pack: Pack, roles: Roles) -> Roles:
    """Return ``roles`` restricted to the furniture that a pack has."""
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
    """Check that the roles of a pack and its homes name only furniture of the pack.

    Raises:
        ValueError: one does not; the message names the role and the piece.
    """
    places = _places_of((*pack.props.values(), *pack.articulations.values()))
    links = _links_of(pack)
    for roles in (
        pack.roles,
        *(home.roles for home in pack.homes if home.roles is not None),
    ):
        named = {
            (role, place) for role, listed in roles.places.items() for place in listed
        }
        named |= {(f"what closes {place}", place) for place in roles.closed_by}
        # Sorted, so that the message is the same in every run.
        for role, place in sorted(named):
            if place not in places:
                raise ValueError(
                    f"role {role!r} names {place!r}, which is no receptacle of the pack."
                )
        for role, link in sorted({*roles.links.items(), *roles.closed_by.items()}):
            if link not in links:
                raise ValueError(
                    f"role {role!r} names {link!r}, which is no link of the pack."
                )


def _links_of(pack: Pack) -> set[str]:
    return {
        f"{a.name}/{link.name}" for a in pack.articulations.values() for link in a.links
    }


def _places_of(templates: Iterable[Prop | Articulation]) -> set[str]:
    """All strings by which `Roles.places` may name the receptacles of templates."""
    found: set[str] = set()
    for template in templates:
        receptacles: tuple[Receptacle, ...] = template.receptacles
        if receptacles:
            found |= {template.name, f"{template.name}/*"}
        found |= {f"{template.name}/{r.name}" for r in receptacles}
    return found
