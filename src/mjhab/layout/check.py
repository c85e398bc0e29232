"""Whether the homes of a pack work: they compile into one layout, a robot gets everywhere, doors and drawers open."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import mujoco

from mjhab.layout.compile import compile_home, model_path
from mjhab.layout.home_models import model_bytes
from mjhab.layout.layout import Layout
from mjhab.scenes.builtin.homes import MAX_REACH_TO_CENTER_M, MIN_CONNECTED_SHARE
from mjhab.scenes.freespace import NAVMESH_BASE_RADIUS_M, free_map, reach
from mjhab.scenes.shapes.openings import stuck_links
from mjhab.scenes.spec import Home


@dataclass
class HomesReport:
    """What a check found.

    ``failed``: (home, why) of homes that cannot be used. ``remarks``: (home, what) of places that a robot cannot get
    at; tasks draw their places from the others. ``layout``: hash of names, order and sizes, the same for all homes.
    ``compile_s``: time for all models [s], of which ``cold`` were not in the cache. ``model_bytes``: their memory.
    """

    homes: int = 0
    ok: int = 0
    failed: list[tuple[str, str]] = field(default_factory=list)
    remarks: list[tuple[str, str]] = field(default_factory=list)
    layout: str = ""
    ngeom: int = 0
    nv: int = 0
    compile_s: float = 0.0
    cold: int = 0
    model_bytes: int = 0


def layout_hash(model: mujoco.MjModel) -> str:
    """Hash of what all homes of a layout share: names, order, kinds and sizes, but no poses."""
    names = model.names.split(b"\0", 1)[1]  # the first is the name of the home
    digest = hashlib.sha256(names)
    for array in (
        model.body_parentid,
        model.jnt_type,
        model.geom_type,
        model.geom_dataid,
        model.sensor_type,
    ):
        digest.update(array.tobytes())
    digest.update(repr((model.nq, model.nv, model.nu, model.ngeom, model.nsensordata)).encode())
    return digest.hexdigest()[:16]


def check_homes(
    layout: Layout, homes: Sequence[Home], tell: Callable[[Home], object] = lambda home: None
) -> HomesReport:
    """Compile and examine homes of a layout.

    Args:
        layout: the layout of the whole pack.
        homes: the homes to look at.
        tell: called after each home.
    """
    report = HomesReport(homes=len(homes))
    for home in homes:
        why = _compile(layout, home, report) or _floor(layout, home)
        if why:
            report.failed.append((home.name, why))
        else:
            report.ok += 1
            report.remarks += [(home.name, what) for what in remarks(layout, home)]
        tell(home)
    return report


def _compile(layout: Layout, home: Home, report: HomesReport) -> str:
    """Compile one home and add it to the report; why it failed, or nothing."""
    report.cold += not model_path(layout, home).exists()
    start = time.perf_counter()
    try:
        model = compile_home(layout, home)
    except ValueError as error:
        return str(error)
    finally:
        report.compile_s += time.perf_counter() - start
    report.model_bytes += model_bytes(model)
    digest = layout_hash(model)
    if not report.layout:
        report.layout = digest
        report.ngeom = model.ngeom
        report.nv = model.nv
    return (
        ""
        if digest == report.layout
        else f"its layout is {digest}, that of the others {report.layout}"
    )


def _floor(layout: Layout, home: Home) -> str:
    free = free_map(home, layout.pack).navigable()
    return (
        ""
        if free.any()
        else f"no floor on which a base of radius {NAVMESH_BASE_RADIUS_M} m can stand"
    )


def remarks(layout: Layout, home: Home) -> list[str]:
    """Nooks, receptacles out of reach, and doors and drawers that do not open as far as they should."""
    free = free_map(home, layout.pack)
    share = free.navigable().sum() / (free.clearance >= NAVMESH_BASE_RADIUS_M).sum()
    found = (
        [] if share >= MIN_CONNECTED_SHARE else [f"only {share:.0%} of the free floor is connected"]
    )
    for r in reach(home, layout.pack, free):
        if r.center > MAX_REACH_TO_CENTER_M:
            found.append(
                f"{r.thing}/{r.receptacle} is {r.center:.2f} m from where a robot can stand"
            )
    return found + stuck_links(home, layout.pack)
