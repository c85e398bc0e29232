"""Read the links of a robot from a published MJCF file: tree, masses, joints, meshes.

In a `Robot` all link frames are parallel at joint position zero, and joint axes are x, y or z. In a published file the
link frames can have any orientation. So the links are read in a posture (``zero``) in which the joint axes are parallel
to the axes of the root. There every link gets a frame parallel to the root's, and joint positions count from that
posture.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path

import mujoco
import numpy as np
import trimesh

from mjhab.core.errors import MjhabError
from mjhab.core.rotations import mat_from_quat
from mjhab.robots.parts import Inertial, TreeLink
from mjhab.scenes.spec import Geom, Vec3

ROUND_DIGITS = 5
"""Decimals that computed lengths [m] are rounded to, so that they are equal on every processor."""
AXIS_TOLERANCE = 1e-4
"""Largest deviation of a joint axis from x, y or z."""
SURFACE_STEP_M = 0.015
"""Largest edge [m] of the triangles into which a mesh is subdivided before boxes are fitted to its vertices."""


@dataclass(frozen=True)
class MeshGeom:
    """A mesh of a link.

    ``rot`` (3, 3) and ``pos`` (3,) [m] are its pose in the frame of the link; ``group`` is MuJoCo's geom group.
    """

    link: str
    file: Path
    rot: np.ndarray
    pos: np.ndarray
    rgba: tuple[float, float, float, float]
    group: int


class MjcfLinks:
    """A body of an MJCF file and its descendants as links with parallel frames.

    Args:
        file: the MJCF file.
        root: name of the body.
        zero: joint positions in the file [m, rad] that become 0; 0 for joints that are not named.
        turn: (3, 3) rotation of the file's world frame in the robot's frame; None for the identity.
        flipped: joints whose sign is inverted.

    Raises:
        MjhabError: there is no such file, or MuJoCo cannot compile it.
    """

    def __init__(
        self,
        file: Path,
        root: str,
        zero: Mapping[str, float] | None = None,
        turn: np.ndarray | None = None,
        flipped: tuple[str, ...] = (),
    ) -> None:
        self.root = root
        self._zero = dict(zero or {})
        self._turn = np.eye(3) if turn is None else turn
        self._flipped = flipped
        if not file.is_file():
            raise MjhabError(
                f"{file} does not exist: install the package that it belongs to again."
            )
        spec = mujoco.MjSpec.from_file(str(file))
        self._files = {
            mesh.name: file.parent / spec.meshdir / mesh.file
            for mesh in spec.meshes
            if mesh.file
        }
        self._meshes = [(body.name, geom) for body in spec.bodies for geom in body.geoms]
        self._rgba = {material.name: tuple(material.rgba) for material in spec.materials}
        self._model = _without_meshes(file)
        self._data = mujoco.MjData(self._model)
        for joint, value in self._zero.items():
            self._data.joint(joint).qpos[0] = value
        mujoco.mj_kinematics(self._model, self._data)

    @cached_property
    def links(self) -> tuple[str, ...]:
        """Names of the links, root first, parents before children."""
        model = self._model
        top = model.body(self.root).id
        inside = {top}
        # MuJoCo numbers parents before children.
        for body in range(top + 1, model.nbody):
            if model.body_parentid[body] in inside:
                inside.add(body)
        return tuple(model.body(body).name for body in sorted(inside))

    def rot(self, link: str) -> np.ndarray:
        """Return the rotation (3, 3) of the file's frame of a link in the robot's frame."""
        return self._turn @ self._data.body(link).xmat.reshape(3, 3)

    def pos(self, link: str) -> np.ndarray:
        """Return the position (3,) [m] of a link relative to the root, in the robot's axes."""
        return self._turn @ (self._data.body(link).xpos - self._data.body(self.root).xpos)

    def tree(self, parent: str, origin: Vec3) -> tuple[TreeLink, ...]:
        """Return the links as rows of `Body.tree`, with the root fixed to link ``parent`` at ``origin`` [m].

        Raises:
            MjhabError: a link has several joints, or one that is not at its origin or not along x, y or z.
        """
        rows = []
        for link in self.links:
            body = self._model.body(link)
            if link == self.root:
                up = parent
                place = origin
            else:
                up = self._model.body(int(body.parentid[0])).name
                place = _vec3(self.pos(link) - self.pos(up))
            rows.append(
                self._row(link, up, place, int(body.jntnum[0]), int(body.jntadr[0]))
            )
        return tuple(rows)

    def _row(
        self, link: str, parent: str, origin: Vec3, count: int, first: int
    ) -> TreeLink:
        if not count:
            return TreeLink(link, parent, "", origin)
        model = self._model
        name = model.joint(first).name
        # Chains have one joint per link, in the origin of its frame.
        if count > 1 or np.abs(model.jnt_pos[first]).max() > 0:
            raise MjhabError(f"link {link!r} must have one joint, at its origin")
        axis = self._turn @ self._data.xaxis[first]
        if np.abs(np.abs(axis).max() - 1.0) > AXIS_TOLERANCE:
            raise MjhabError(f"joint {name!r} is not along x, y or z at its zero: {axis}")
        # Positions count from the posture in which the frames are parallel.
        low, high = model.jnt_range[first] - self._zero.get(name, 0.0)
        if name in self._flipped:
            axis = -axis
            low, high = -high, -low
        slide = model.jnt_type[first] == mujoco.mjtJoint.mjJNT_SLIDE
        # Adding zero turns -0.0 into 0.0.
        limits = (round(float(low), 6) + 0.0, round(float(high), 6) + 0.0)
        return TreeLink(link, parent, name, origin, _vec3(np.round(axis)), slide, limits)

    def inertials(self) -> dict[str, Inertial]:
        """Return the mass data of every link; links without mass in the file get 10 g."""
        found = {}
        for link in self.links:
            body = self._model.body(link)
            mass = float(body.mass[0])
            if not mass:
                found[link] = Inertial(
                    0.01, (0.0, 0.0, 0.0), (1e-5, 1e-5, 1e-5, 0.0, 0.0, 0.0)
                )
                continue
            rot = self.rot(link)
            axes = rot @ mat_from_quat(np.array(body.iquat))
            # The file has the principal moments, in axes of their own.
            full = axes @ np.diag(body.inertia) @ axes.T
            rows = [
                full[0, 0],
                full[1, 1],
                full[2, 2],
                full[0, 1],
                full[0, 2],
                full[1, 2],
            ]
            # Rounded as lengths are, so that the hash of the robot is the same on every processor.
            xx, yy, zz, xy, xz, yz = (float(x) for x in np.round(rows, 7))
            found[link] = Inertial(mass, _vec3(rot @ body.ipos), (xx, yy, zz, xy, xz, yz))
        return found

    def meshes(self, group: int) -> list[MeshGeom]:
        """Return the meshes of the links in one geom group of the file."""
        found = []
        for link, geom in self._meshes:
            if link in self.links and geom.group == group and geom.meshname:
                rot = self.rot(link)
                turn = rot @ mat_from_quat(
                    np.array(geom.quat, float) / np.linalg.norm(geom.quat)
                )
                rgba = self._rgba.get(geom.material, tuple(geom.rgba))
                place = rot @ np.array(geom.pos, float)
                file = self._files[geom.meshname]
                found.append(MeshGeom(link, file, turn, place, rgba, group))
        return found


def boxes_around(mesh: MeshGeom, pieces: int) -> tuple[Geom, ...]:
    """Return boxes that cover a mesh, in the frame of its link.

    Args:
        mesh: the mesh.
        pieces: number of slices along its longest side; each gets one box.
    """
    loaded = trimesh.load_mesh(mesh.file)
    vertices, *_ = trimesh.remesh.subdivide_to_size(
        # Long triangles have no vertices in the middle slices, whose boxes would be too small.
        loaded.vertices,
        loaded.faces,
        SURFACE_STEP_M,
        max_iter=12,
    )
    points = vertices @ mesh.rot.T + mesh.pos
    low = points.min(axis=0)
    high = points.max(axis=0)
    long = int(np.argmax(high - low))
    cuts = np.linspace(low[long], high[long], pieces + 1)
    boxes = []
    for start, end in pairwise(cuts):
        inside = points[
            # Rounding must not take the vertices at a cut out of both slices.
            (points[:, long] >= start - 1e-9) & (points[:, long] <= end + 1e-9)
        ]
        least = inside.min(axis=0)
        most = inside.max(axis=0)
        # Up to the cut, so that no gap is left between two boxes.
        least[long] = start
        most[long] = end
        half = _vec3(0.5 * (most - least))
        boxes.append(Geom("box", half, _vec3(0.5 * (most + least)), visual=False))
    return tuple(boxes)


def _without_meshes(file: Path) -> mujoco.MjModel:
    """Compile a file without its geoms, which poses and masses do not need."""
    spec = mujoco.MjSpec.from_file(str(file))
    for geom in list(spec.geoms):
        spec.delete(geom)
    for mesh in list(spec.meshes):
        spec.delete(mesh)
    # Without geoms some bodies have no mass, which MuJoCo refuses to compile.
    spec.compiler.boundmass = 1e-9
    spec.compiler.boundinertia = 1e-9
    try:
        return spec.compile()
    except ValueError as error:
        raise MjhabError(f"MuJoCo cannot read {file}: {error}") from error


def _vec3(values: np.ndarray) -> Vec3:
    # Adding 0 turns -0.0 into 0.0, which has another text and so another hash.
    x, y, z = (float(value) + 0.0 for value in np.round(values, ROUND_DIGITS))
    return (x, y, z)
