"""``mjhab homes check``: check that the homes of a pack compile into one layout and that a robot can work in them."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any

from mjhab.cli.output import Listing, report
from mjhab.cli.worlds.home_names import homes_of_split
from mjhab.config.env_spec import EnvSpec, env_options
from mjhab.core.progress import progress_bar


@dataclass(frozen=True)
class HomesCheckSpec(EnvSpec):
    """Check that homes compile into one layout, that a robot reaches all places, and that doors and drawers open fully.

    For instance: `mjhab homes check --split val`

    Fails if a home cannot be used. Places out of reach are reported; tasks do not use them.
    """

    tasks: bool = False
    """Also tell for which tasks each home has room: makes an episode of each, which takes about a second."""
    env: Annotated[
        Mapping[str, Any], env_options("assets", "split", shown={"split": "default: all"})
    ] = field(default_factory=dict)
    """The asset pack, and which of its homes."""


def check_homes(spec: HomesCheckSpec, json: bool) -> int:
    """Print the findings; returns 1 if a home cannot be used."""
    from mjhab.layout import check
    from mjhab.layout.layout import Layout
    from mjhab.scenes.packs import open_pack, stage_of

    pack = open_pack(spec.asked.assets)
    homes = homes_of_split(pack, spec.env.get("split"))
    with progress_bar("checking homes", len(homes)) as advance:
        layout = Layout(pack, roster_of(pack))
        found = check.check_homes(layout, homes, lambda home: advance())
    found.remarks += unasked_roles(pack, homes)
    result = {**as_json(found), **stage_of(spec.asked.assets)}
    tables = _tables(found)
    if spec.tasks:
        result["tasks"] = room = find_room(pack, homes)
        rows = [
            (home, ", ".join(task for task in why if not why[task]) or "none")
            for home, why in room.items()
        ]
        tables.append(Listing("tasks", ("home", "tasks with room"), rows))
    report(json, result, *tables)
    return 1 if found.failed else 0


def find_room(pack: Any, homes: Sequence[Any]) -> dict[str, dict[str, str]]:
    """Why no episode of a task can be made in a home, by home and task; "" where one can."""
    from mjhab.episodes.room import room_for_tasks
    from mjhab.tasks.household.registry import TASKS

    found: dict[str, dict[str, str]] = {home.name: {} for home in homes}
    with progress_bar("looking for room", len(homes) * len(list(TASKS))) as advance:
        for task, home, why in room_for_tasks(pack, homes):
            found[home][task] = why
            advance()
    return found


def unasked_roles(pack: Any, homes: Sequence[Any]) -> list[tuple[str, str]]:
    """(home, what) of roles that a home states itself and that no registered task asks for: perhaps misspelt."""
    from mjhab.scenes.roles import FRIDGE_SHELF, OPEN_SURFACE
    from mjhab.tasks.household.registry import TASKS

    # Clutter stands on open surfaces and on the fridge shelf, whatever the task.
    asked = {
        OPEN_SURFACE,
        FRIDGE_SHELF,
        *(role for spec in TASKS.values() for role in spec.roles),
    }
    asked |= {*pack.roles.places, *pack.roles.links}
    found = []
    for home in homes:
        own = () if home.roles is None else (*home.roles.places, *home.roles.links)
        for role in sorted(set(own) - asked):
            near = difflib.get_close_matches(role, asked, n=1)
            hint = f"; did you mean {near[0]!r}?" if near else ""
            found.append(
                (home.name, f"no registered task asks for the role {role!r}{hint}")
            )
    return found


def roster_of(pack: Any) -> tuple[str, ...]:
    """Objects to compile with the homes: those of TidyHouse if the pack has them, else one of each of the pack's."""
    from mjhab.episodes.rosters import roster

    usual = roster("tidy_house")
    # Some packs bring objects of their own alone, and still want their homes checked.
    return usual if set(usual) <= set(pack.objects) else tuple(sorted(pack.objects))


def as_json(report: Any) -> dict[str, Any]:
    """The report as JSON data."""
    return {
        "homes": report.homes,
        "ok": report.ok,
        "failed": [{"name": name, "why": why} for name, why in report.failed],
        "layout": report.layout,
        "ngeom": report.ngeom,
        "nv": report.nv,
        "compile_s": round(report.compile_s, 3),
        "compiled_cold": report.cold,
        "model_mb": round(report.model_bytes / 1e6, 1),
        "remarks": [{"name": name, "what": what} for name, what in report.remarks],
    }


def _tables(report: Any) -> list[Listing]:
    tables = []
    if report.failed:
        tables.append(
            Listing("homes that cannot be used", ("home", "why"), report.failed)
        )
    if report.remarks:
        tables.append(Listing("remarks", ("home", "what"), report.remarks))
    per_home = report.compile_s / max(report.homes, 1)
    facts = (
        ("homes", report.homes),
        ("usable", report.ok),
        ("layout", report.layout or "none"),
        ("geoms, degrees of freedom", f"{report.ngeom}, {report.nv}"),
        (
            "models",
            f"{report.compile_s:.1f} s, {per_home:.3f} s each; {report.cold} of them not in the cache",
        ),
        ("memory of all models", f"{report.model_bytes / 1e6:.1f} MB"),
    )
    return [*tables, Listing("homes check", ("what", "value"), facts)]
