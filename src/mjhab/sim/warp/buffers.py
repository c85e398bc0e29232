"""Buffers of fixed size in MuJoCo Warp, and the bits by which the engine tells that one of them overflowed."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco_warp as mjw

OVERFLOW = mjw.OverflowType
CONTACT_OVERFLOW = (
    OVERFLOW.BROADPHASE | OVERFLOW.NARROWPHASE | OVERFLOW.CCD | OVERFLOW.HFIELD
)
ROW_OVERFLOW = OVERFLOW.NEFC | OVERFLOW.NJMAX_NNZ | OVERFLOW.NVMAX
ENGINE_OVERFLOW = OVERFLOW.EPA_HORIZON
BUFFER_BITS = {
    "contacts": OVERFLOW.BROADPHASE | OVERFLOW.NARROWPHASE | OVERFLOW.HFIELD,
    "ccd": OVERFLOW.CCD,
    "rows": OVERFLOW.NEFC | OVERFLOW.NJMAX_NNZ,
    "awake": OVERFLOW.NVMAX,
}
"""Overflow bits of the engine for each field of `BufferSizes`."""


@dataclass(frozen=True)
class BufferSizes:
    """Capacities of the engine's buffers.

    Attributes:
        contacts: contacts, and also candidate geom pairs of the broad phase, of all worlds together.
        ccd: geom pairs of one pair of geom types in general convex collision, of all worlds together.
        rows: constraint rows of one world.
        awake: dofs of one world that may be awake at the same time; None for all.
    """

    contacts: int
    ccd: int
    rows: int
    awake: int | None = None
