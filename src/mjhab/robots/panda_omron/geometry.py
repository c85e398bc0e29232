"""Links, masses and collision shapes of the Panda on the Omron base, read from the MJCF files of robosuite 1.5.2.

Files below ``models/assets``: ``bases/omron_mobile_base.xml``, ``robots/panda/robot.xml`` and
``grippers/panda_gripper.xml``. Base and lifting column are primitives in the files; each collision mesh of the arm is
replaced by boxes that cover slices of it.
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

BASE_LINK = "base"
COLUMN = "support"
TCP = "tcp"
WRIST_ZERO = {"joint6": np.pi / 2, "joint7": np.pi / 4}
"""Joint positions of robosuite [rad] that are 0 here: the hand then points forward with its fingers side by side, and
all joint axes are along x, y or z. All other joints have the same zero."""
CENTER_X = 0.21
"""Distance [m] of the origin of the file's base in front of the yaw axis of the base, which is the origin here."""
COLUMN_POS: Vec3 = (CENTER_X, 0.0, 0.70)
"""Position [m] of the arm's mount in the base frame with the column down."""
COLUMN_TRAVEL = (0.0, 0.34)
"""Limits of the lifting joint [m]."""
TCP_FROM_HAND = 0.0928
"""Distance [m] from the flange to the tcp, the middle of the flat part of the finger pads."""
SLICES = {"leftfinger": 2, "rightfinger": 2, "right_gripper": 1, "link7": 1}
"""Boxes per collision mesh by link; 2 for links that are not listed."""
_BASE_MASS = Inertial(60.0, (0.01, 0.0, 0.15), (2.0, 3.0, 4.0, 0.0, 0.0, 0.0))
_COLUMN_MASS = Inertial(10.0, (-0.05, 0.0, -0.2), (0.2, 0.2, 0.1, 0.0, 0.0, 0.0))
"""Estimated masses: the files give the platform a density of 10 kg/m^3, but the Omron LD-60 weighs about 60 kg. The
base has planar joints, so that it cannot tip."""


@dataclass(frozen=True, eq=False)
class PandaFiles:
    """The links of arm and gripper in frames parallel to the base, read from robosuite's files."""

    arm: MjcfLinks
    hand: MjcfLinks

    def meshes(self, group: int) -> list[MeshGeom]:
        """Return the meshes of arm and gripper in a geom group: 0 collision, 1 visual."""
        return self.arm.meshes(group) + self.hand.meshes(group)


@lru_cache(maxsize=1)
def panda_files() -> PandaFiles:
    """Read the files of arm and gripper.

    Raises:
        MjhabError: robosuite is not installed.
    """
    arm = MjcfLinks(robosuite_file("robots/panda/robot.xml"), "link0", zero=WRIST_ZERO)
    hand = MjcfLinks(
        robosuite_file("grippers/panda_gripper.xml"),
        "right_gripper",
        turn=arm.rot("right_hand"),
        # Both fingers then open with growing positions, as everywhere here.
        flipped=("finger_joint2",),
    )
    return PandaFiles(arm, hand)


def load_body() -> Body:
    """Return tree, masses and collision shapes of the robot.

    Raises:
        MjhabError: robosuite is not installed.
    """
    files = panda_files()
    up = (0.0, 0.0, 1.0)
    tree = (
        TreeLink(
            COLUMN, BASE_LINK, "joint_torso_height", COLUMN_POS, up, True, COLUMN_TRAVEL
        ),
        *files.arm.tree(COLUMN, (0.0, 0.0, 0.0)),
        *files.hand.tree("right_hand", (0.0, 0.0, 0.0)),
        TreeLink(TCP, "right_gripper", "", (TCP_FROM_HAND, 0.0, 0.0)),
    )
    light = Inertial(0.01, (0.0, 0.0, 0.0), (1e-5, 1e-5, 1e-5, 0.0, 0.0, 0.0))
    inertials = {
        BASE_LINK: _BASE_MASS,
        COLUMN: _COLUMN_MASS,
        **files.arm.inertials(),
        **files.hand.inertials(),
        TCP: light,
    }
    # A frame of the file without mass of its own.
    inertials["eef"] = light
    return Body(tree, inertials, _collision(files))


def _collision(files: PandaFiles) -> dict[str, tuple[Geom, ...]]:
    base = Geom("box", (0.35, 0.25, 0.19), (CENTER_X - 0.20, 0.0, 0.192), visual=False)
    lower = Geom("cylinder", (0.12, 0.2, 0.0), (CENTER_X - 0.05, 0.0, 0.50), visual=False)
    upper = Geom("cylinder", (0.1125, 0.2, 0.0), (-0.05, 0.0, -0.20), visual=False)
    found: dict[str, tuple[Geom, ...]] = {BASE_LINK: (base, lower), COLUMN: (upper,)}
    for mesh in files.meshes(group=0):
        boxes = boxes_around(mesh, SLICES.get(mesh.link, 2))
        found[mesh.link] = (*found.get(mesh.link, ()), *boxes)
    return found
