"""Visual meshes of the Fetch robot, from the gymnasium-robotics package, with Fetch's colours.

The MjModel does not contain them. Links that merge into their parent (wheels, laser, emergency stop, bellows) are given
in the frame of the parent body. Fingers and camera lenses, which the package lacks, are boxes and cylinders.
"""

from __future__ import annotations

import importlib.util
from functools import lru_cache
from pathlib import Path

import numpy as np
import trimesh

from mjhab.core.errors import MjhabError
from mjhab.core.machine import pip_install
from mjhab.robots.fetch.geometry import finger_box
from mjhab.robots.fetch.model import KINEMATIC_TREE, LINKS
from mjhab.robots.meshes import coarse_mesh
from mjhab.scenes.shapes.meshes import Mesh

_PARTS: dict[str, tuple[str, str]] = {
    "base_link": ("base_link_collision.stl", "fetch_grey"),
    "r_wheel_link": ("r_wheel_link_collision.stl", "fetch_dark"),
    "l_wheel_link": ("l_wheel_link_collision.stl", "fetch_dark"),
    "estop_link": ("estop_link.stl", "fetch_red"),
    "laser_link": ("laser_link.stl", "fetch_dark"),
    "torso_fixed_link": ("torso_fixed_link.stl", "fetch_shell"),
    "torso_lift_link": ("torso_lift_link_collision.stl", "fetch_shell"),
    "bellows_link2": ("bellows_link_collision.stl", "fetch_dark"),
    "head_pan_link": ("head_pan_link_collision.stl", "fetch_grey"),
    "head_tilt_link": ("head_tilt_link_collision.stl", "fetch_blue"),
    "shoulder_pan_link": ("shoulder_pan_link_collision.stl", "fetch_shell"),
    "shoulder_lift_link": ("shoulder_lift_link_collision.stl", "fetch_blue"),
    "upperarm_roll_link": ("upperarm_roll_link_collision.stl", "fetch_shell"),
    "elbow_flex_link": ("elbow_flex_link_collision.stl", "fetch_blue"),
    "forearm_roll_link": ("forearm_roll_link_collision.stl", "fetch_shell"),
    "wrist_flex_link": ("wrist_flex_link_collision.stl", "fetch_blue"),
    "wrist_roll_link": ("wrist_roll_link_collision.stl", "fetch_shell"),
    "gripper_link": ("gripper_link.stl", "fetch_grey"),
}
_MAX_FACES = 5000
_MAX_FACES_OF = {
    # Small on every image: more faces would only take time.
    "r_wheel_link": 400,
    "l_wheel_link": 400,
    "estop_link": 300,
    "laser_link": 300,
}


@lru_cache(maxsize=1)
def robot_meshes() -> list[tuple[str, Mesh, str]]:
    """Return the visual meshes: (body name, one of `model.LINKS`; mesh in that body's frame [m]; material name).

    Raises:
        MjhabError: the mesh files of gymnasium-robotics are not installed.
    """
    folder = _mesh_folder()
    parts: list[tuple[str, Mesh, str]] = []
    for link, (file, material) in _PARTS.items():
        path = folder / file
        if not path.is_file():
            raise MjhabError(
                f"Fetch mesh {file} is not in {folder}; install gymnasium-robotics>=1.3 again."
            )
        loaded = trimesh.load_mesh(path)
        body, offset, turn = _mount(link)
        vertices = np.asarray(loaded.vertices) @ turn.T + offset
        mesh = coarse_mesh(
            vertices, np.asarray(loaded.faces), _MAX_FACES_OF.get(link, _MAX_FACES)
        )
        parts.append((body, mesh, material))
    return parts + _fingers() + _eyes()


def _mesh_folder() -> Path:
    # find_spec locates the package without running it: importing it is slow and prints warnings.
    found = importlib.util.find_spec("gymnasium_robotics")
    if found is None or not found.submodule_search_locations:
        raise MjhabError(
            "the robot's visual meshes come from the package gymnasium-robotics, which is not installed; "
            f"run: {pip_install('gymnasium-robotics')}"
        )
    return (
        Path(next(iter(found.submodule_search_locations)))
        / "envs"
        / "assets"
        / "stls"
        / "fetch"
    )


def _mount(link: str) -> tuple[str, np.ndarray, np.ndarray]:
    """Return the body that a link is part of, and the link's position (3,) [m] and rotation (3, 3) in its frame."""
    if link in LINKS:
        return link, np.zeros(3), np.eye(3)
    entry = next(t for t in KINEMATIC_TREE if t.link == link)
    # Only one step up: no link of Fetch hangs deeper.
    if entry.parent not in LINKS:
        raise MjhabError(f"link {link!r} hangs on {entry.parent!r}, which is not a body")
    return (
        entry.parent,
        np.array(entry.origin),
        trimesh.transformations.quaternion_matrix(entry.quat)[:3, :3],
    )


def _box(half: tuple[float, float, float], pos: tuple[float, float, float]) -> Mesh:
    box = trimesh.creation.box(2.0 * np.array(half))
    return Mesh(
        (box.vertices + np.array(pos)).astype(np.float32), box.faces.astype(np.int32)
    )


def _fingers() -> list[tuple[str, Mesh, str]]:
    """Return meshes of the fingers: a grey box and a dark pad each, which together fill the collision box."""
    out: list[tuple[str, Mesh, str]] = []
    pad = 0.0015
    for link, inward in (("r_gripper_finger_link", -1.0), ("l_gripper_finger_link", 1.0)):
        geom = finger_box(-inward)
        (hx, hy, hz) = geom.size
        (x, y, z) = geom.pos
        out.append(
            (link, _box((hx, hy - pad, hz), (x, y - inward * pad, z)), "fetch_grey")
        )
        out.append(
            (
                link,
                _box((hx - 0.002, pad, hz - 0.001), (x, y + inward * (hy - pad), z)),
                "fetch_dark",
            )
        )
    return out


def _eyes() -> list[tuple[str, Mesh, str]]:
    """Return meshes of the two lenses of the head camera."""
    lenses = []
    for y in (0.02, 0.065):
        lens = trimesh.creation.cylinder(0.012, 0.006, sections=20)
        lens.apply_transform(
            trimesh.transformations.rotation_matrix(np.pi / 2, [0, 1, 0], [0, 0, 0])
        )
        vertices = lens.vertices + np.array([0.056, y, 0.0225])
        lenses.append(
            (
                "head_tilt_link",
                Mesh(vertices.astype(np.float32), lens.faces.astype(np.int32)),
                "fetch_dark",
            )
        )
    return lenses
