"""Links, masses and collision shapes of the Panda on the Omron base, read from the MJCF files of robosuite 1.5.2.

Files below ``models/assets``: ``bases/omron_mobile_base.xml``, ``robots/panda/robot.xml`` and
``grippers/panda_gripper.xml``. Base and lifting column are primitives in the files; the arm's collision meshes become
boxes that cover them slice by slice.
Lengths [m], angles [rad].
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from mjhab.robots.mjcf import MeshGeom, MjcfLinks, boxes_around
from mjhab.robots.panda_omron.assets import robosuite_file
from mjhab.robots.parts import Body, Inertial, TreeLink
from mjhab.scenes.spec import Geom, Vec3

BASE = "base"
COLUMN = "support"
TCP = "tcp"
WRIST_ZERO = {"joint6": np.pi / 2, "joint7": np.pi / 4}
"""Joint values of robosuite [rad] that are 0 here: the hand then points forward with its fingers side by side, and all
joint axes are along x, y or z. All other joints count as there."""
CENTER_X = 0.21
"""How far [m] the origin of the file's base lies before the axis about which the base turns, the origin here."""
COLUMN_POS: Vec3 = (CENTER_X, 0.0, 0.70)
"""Where the arm stands while the column is down."""
COLUMN_TRAVEL = (0.0, 0.34)
TCP_FROM_HAND = 0.0928
"""From the flange to the middle of the flat part of the finger pads."""
SLICES = {"leftfinger": 2, "rightfinger": 2, "right_gripper": 1, "link7": 1}
"""Boxes per collision mesh, 2 for all others."""
_BASE_MASS = Inertial(60.0, (0.01, 0.0, 0.15), (2.0, 3.0, 4.0, 0.0, 0.0, 0.0))
_COLUMN_MASS = Inertial(10.0, (-0.05, 0.0, -0.2), (0.2, 0.2, 0.1, 0.0, 0.0, 0.0))
"""Estimates: the files have the density 10 kg/m^3 for the platform, whose real model (Omron LD-60) weighs about 60 kg.
The base is driven in speed and never tips."""


@dataclass(frozen=True, eq=False)
class PandaFiles:
    """The links of the arm and of the gripper, in parallel frames."""

    arm: MjcfLinks
    hand: MjcfLinks

    def meshes(self, group: int) -> list[MeshGeom]:
        """Meshes of arm and gripper in a geom group: 0 collides, 1 is seen."""
        return self.arm.meshes(group) + self.hand.meshes(group)


@lru_cache(maxsize=1)
def panda_files() -> PandaFiles:
    """The files of arm and gripper, read.

    Raises:
        MjhabError: robosuite is not installed.
    """
    arm = MjcfLinks(robosuite_file("robots/panda/robot.xml"), "link0", zero=WRIST_ZERO)
    hand = MjcfLinks(
        robosuite_file("grippers/panda_gripper.xml"),
        "right_gripper",
        turn=arm.rot("right_hand"),
        flipped=("finger_joint2",),
    )
    return PandaFiles(arm, hand)


def load_body() -> Body:
    """Tree, masses and collision shapes.

    Raises:
        MjhabError: robosuite is not installed.
    """
    files = panda_files()
    up = (0.0, 0.0, 1.0)
    tree = (
        TreeLink(COLUMN, BASE, "joint_torso_height", COLUMN_POS, up, True, COLUMN_TRAVEL),
        *files.arm.tree(COLUMN, (0.0, 0.0, 0.0)),
        *files.hand.tree("right_hand", (0.0, 0.0, 0.0)),
        TreeLink(TCP, "right_gripper", "", (TCP_FROM_HAND, 0.0, 0.0)),
    )
    light = Inertial(0.01, (0.0, 0.0, 0.0), (1e-5, 1e-5, 1e-5, 0.0, 0.0, 0.0))
    inertials = {
        BASE: _BASE_MASS,
        COLUMN: _COLUMN_MASS,
        **files.arm.inertials(),
        **files.hand.inertials(),
        TCP: light,
    }
    inertials["eef"] = light
    return Body(tree, inertials, _collision(files))


def _collision(files: PandaFiles) -> dict[str, tuple[Geom, ...]]:
    base = Geom("box", (0.35, 0.25, 0.19), (CENTER_X - 0.20, 0.0, 0.192), visual=False)
    lower = Geom("cylinder", (0.12, 0.2, 0.0), (CENTER_X - 0.05, 0.0, 0.50), visual=False)
    upper = Geom("cylinder", (0.1125, 0.2, 0.0), (-0.05, 0.0, -0.20), visual=False)
    found: dict[str, tuple[Geom, ...]] = {BASE: (base, lower), COLUMN: (upper,)}
    for mesh in files.meshes(group=0):
        boxes = boxes_around(mesh, SLICES.get(mesh.link, 2))
        found[mesh.link] = (*found.get(mesh.link, ()), *boxes)
    return found
