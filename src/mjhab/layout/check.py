"""Checks of the homes of a pack: they compile into one layout, the floor is connected, receptacles are in reach."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import mujoco

from mjhab.core.errors import UsageError
from mjhab.layout.compile import compile_home, model_path
from mjhab.layout.home_models import model_bytes
from mjhab.layout.layout import Layout
from mjhab.scenes.builtin.homes import MAX_REACH_TO_CENTER_M, MIN_CONNECTED_SHARE
from mjhab.scenes.freespace import NAVMESH_BASE_RADIUS_M, free_map, reach
from mjhab.scenes.shapes.openings import met_walls, stuck_links
from mjhab.scenes.spec import Home


@dataclass
class HomesReport:
    """Result of `check_homes`.

    Attributes:
        homes: number of homes checked.
        ok: number of homes that can be used.
        failed: (home, reason) of the others.
        remarks: (home, remark) of floor, receptacles, doors and drawers that a robot cannot use in a usable home.
        layout: `layout_hash` of the first home that compiled; all others must have the same.
        ngeom: geoms of a model.
        nv: dofs of a model.
        compile_s: time to compile or load all models [s].
        cold: models that were not in the cache.
        model_bytes: memory of all models [bytes].
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
    """Return the hash of the model data that all homes of a layout share: names, order, types and sizes, no poses."""
    names = model.names.split(b"\0", 1)[1]  # the first is the name of the home
    digest = hashlib.sha256(names)
    for array in (
        model.body_parentid,
        model.jnt_type,
        model.geom_type,
        # Which mesh a geom has, by number: homes share the list of meshes.
        model.geom_dataid,
        model.sensor_type,
    ):
        digest.update(array.tobytes())
    digest.update(
        repr((model.nq, model.nv, model.nu, model.ngeom, model.nsensordata)).encode()
    )
    return digest.hexdigest()[:16]


def check_homes(
    layout: Layout,
    homes: Sequence[Home],
    tell: Callable[[Home], object] = lambda home: None,
) -> HomesReport:
    """Compile and check homes of a layout.

    Args:
        layout: the layout of the whole pack.
        homes: the homes to check.
        tell: called with each home after its check, for progress messages.
    """
    report = HomesReport(homes=len(homes))
    for home in homes:
        # The floor of a home that does not compile says nothing more.
        why = _compile(layout, home, report) or _floor(layout, home)
        if why:
            report.failed.append((home.name, why))
        else:
            report.ok += 1
            report.remarks += [(home.name, what) for what in remarks(layout, home)]
        tell(home)
    return report


def _compile(layout: Layout, home: Home, report: HomesReport) -> str:
    """Compile one home and add it to the report; return why it failed, or ""."""
    report.cold += not model_path(layout, home).exists()
    start = time.perf_counter()
    try:
        model = compile_home(layout, home)
    except UsageError as error:
        return str(error)
    finally:
        report.compile_s += time.perf_counter() - start
    report.model_bytes += model_bytes(model)
    digest = layout_hash(model)
    # The first home is the measure for all others.
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
    """Return remarks on a home: unconnected floor, receptacles out of reach, links that do not open far enough."""
    free = free_map(home, layout.pack)
    share = free.navigable().sum() / (free.clearance >= NAVMESH_BASE_RADIUS_M).sum()
    found = (
        []
        if share >= MIN_CONNECTED_SHARE
        else [f"only {share:.0%} of the free floor is connected"]
    )
    for r in reach(home, layout.pack, free):
        if r.center > MAX_REACH_TO_CENTER_M:
            found.append(
                f"{r.thing}/{r.receptacle} is {r.center:.2f} m from where a robot can stand"
            )
    return found + met_walls(home, layout.pack) + stuck_links(home, layout.pack)
