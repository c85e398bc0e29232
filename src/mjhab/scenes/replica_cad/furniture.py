"""Furniture of ReplicaCAD: rigid objects, and URDFs, either with their joints or with all joints fixed at 0 ("welded").

Template frames keep the origin of the data set, rotated to +z up; the fronts of counter, fridge and cupboards face +x.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from mjhab.core.errors import fault
from mjhab.core.rotations import mat_from_quat
from mjhab.scenes.builtin.furniture_kitchen import FRIDGE_FRONT_AREA
from mjhab.scenes.formats.gltf import TO_Z_UP, read_glb, read_hulls
from mjhab.scenes.formats.urdf import (
    Urdf,
    UrdfBox,
    UrdfJoint,
    UrdfLink,
    UrdfVisual,
    read_urdf,
)
from mjhab.scenes.replica_cad import handles
from mjhab.scenes.replica_cad.files import (
    HOW_TO_GET,
    file_in,
    load_json,
    place,
    point,
    quat_of,
    short_name,
)
from mjhab.scenes.replica_cad.looks import MeshFiles
from mjhab.scenes.replica_cad.receptacles import fit, spaces
from mjhab.scenes.shapes.footprints import outline
from mjhab.scenes.shapes.hulls import hull_mesh
from mjhab.scenes.shapes.meshes import Mesh
from mjhab.scenes.spec import (
    Articulation,
    Geom,
    Handle,
    Link,
    LinkInertial,
    Placement,
    Prop,
    Receptacle,
)

ARTICULATED = {"kitchen_counter": handles.drawer, "fridge": handles.door}
"""Furniture that opens by default, with the function for its handles; other URDFs are welded unless requested."""
FRONT_AREAS = {"fridge": FRIDGE_FRONT_AREA}
"""Areas where robots stand to open furniture, if not the default one."""
OPTIONAL = {
    "kitchen_cupboards": "kitchenCupboard_01",
    "cabinet": "cabinet",
    "chest_of_drawers": "chestOfDrawers_01",
}
"""Furniture that opens on request: name of the template by folder of the URDF."""
_FRONT = {"cabinet": (0.0, 0.0, 1.0)}
"""Axis of the links that points out of the front, if it is not x."""
FLAT_WORDS = ("rug", "mat", "carpet")
"""Words in the names of things that the base drives over, as in ManiSkill's ReplicaCAD scene builder."""
MATERIAL = "plain_white"


@dataclass(eq=False)
class Furniture:
    """Read furniture on demand and collect it: templates and collision meshes by name, and render meshes to be read."""

    folder: Path
    articulate: tuple[str, ...] = ()
    """Keys of `OPTIONAL` that open as well."""
    props: dict[str, Prop] = field(default_factory=dict)
    articulations: dict[str, Articulation] = field(default_factory=dict)
    meshes: dict[str, Mesh] = field(default_factory=dict)
    looks: MeshFiles = field(default_factory=MeshFiles)
    missing: list[Path] = field(default_factory=list)
    """Render meshes that do not exist; their collision pieces are drawn instead."""
    upright: dict[str, np.ndarray] = field(default_factory=dict)
    """Rotation (3, 3) from the root link's axes in the data set to the template frame, by name, of URDFs."""
    _scale: dict[str, float] = field(default_factory=dict)

    def rigid(self, template: str) -> str:
        """Read a rigid object of the data set unless it was read before; returns our name of it.

        Raises:
            UsageError: its files are missing or broken.
        """
        name = short_name(template)
        if name not in self.props:
            self.props[name] = self._rigid(name, template.rsplit("/", 1)[-1])
        return name

    def jointed(self, template: str, scale: float, at: Placement) -> Placement:
        """Read a URDF of the data set unless it has been read.

        Args:
            template: its name in the data set.
            scale: ``uniform_scale`` of the instance.
            at: placement of its root link in the scene.

        Returns:
            Placement of our template, whose +z is up; differs from ``at`` if the root link's +z is not.

        Raises:
            UsageError: it was read before with another scale, or its files are missing or broken.
        """
        name = short_name(template)
        # A template is compiled once for all homes, in one size.
        if self._scale.setdefault(name, scale) != scale:
            raise fault(
                self.folder,
                f"{name!r} has uniform_scale {self._scale[name]} in one scene and {scale} in another; scenes "
                "of one pack must agree.",
            )
        world = mat_from_quat(np.array(at.rotation))
        if name not in self.upright:
            self.upright[name] = _righted(world) @ TO_Z_UP
            urdf, path = self._urdf(name)
            if name in ARTICULATED or name in {OPTIONAL[key] for key in self.articulate}:
                self.articulations[name] = self._articulation(name, urdf, path, scale)
            else:
                self.props[name] = self._welded(name, urdf, path, scale)
        return place(name, np.array(at.pos), world @ TO_Z_UP @ self.upright[name].T)

    # -- rigid objects ---------------------------------------------------------------------------------------------

    def _rigid(self, name: str, stem: str) -> Prop:
        path = self.folder / "configs" / "objects" / f"{stem}.object_config.json"
        body = load_json(path)
        look = file_in(path, body, "render_asset")
        # Some configs name hulls and ask for the bounding box all the same.
        if not body.get("use_bounding_box_for_collision") and "collision_asset" in body:
            geoms = self._hulls(
                name,
                read_hulls(file_in(path, body, "collision_asset")),
                drawn=not look.is_file(),
            )
        elif look.is_file():
            points = (
                np.concatenate([p.vertices for p in read_glb(look, textures=False)])
                @ TO_Z_UP.T
            )
            low = points.min(0)
            high = points.max(0)
            geoms = [
                Geom(
                    "box", point((high - low) / 2), point((high + low) / 2), visual=False
                )
            ]
        else:
            raise fault(
                path,
                f"field 'render_asset' names {look}, which does not exist; {HOW_TO_GET}.",
            )
        if look.is_file():
            geoms.append(self._look(name, f"{name}/look", [(look, _as_pose(TO_Z_UP))]))
        else:
            # Collected, for one warning instead of one per piece.
            self.missing.append(look)
        # Whole words: a "mattress" is no "mat".
        blocks = not any(word in name.split("_") for word in FLAT_WORDS)
        pieces = [outline(g, self.meshes) for g in geoms if g.collide]
        places = [
            fit(space, pieces) for space in spaces(path, body, {"": _as_pose(TO_Z_UP)})
        ]
        return Prop(name, tuple(geoms), tuple(p for p in places if p), blocks)

    def _hulls(self, name: str, hulls: list[np.ndarray], *, drawn: bool) -> list[Geom]:
        geoms = []
        for k, points in enumerate(hulls):
            mesh = f"{name}/hull_{k}"
            self.meshes[mesh] = hull_mesh(points @ TO_Z_UP.T)
            geoms.append(
                Geom("mesh", (1.0, 1.0, 1.0), material="steel", mesh=mesh, visual=drawn)
            )
        return geoms

    def _look(self, name: str, mesh: str, parts: list[tuple[Path, np.ndarray]]) -> Geom:
        for file, pose in parts:
            if not file.is_file():
                raise fault(name, f"render mesh {file} does not exist; {HOW_TO_GET}.")
            self.looks.add(mesh, file, pose)
        return Geom("mesh", (1.0, 1.0, 1.0), material=MATERIAL, mesh=mesh, collide=False)

    # -- furniture from URDFs --------------------------------------------------------------------------------------

    def _urdf(self, name: str) -> tuple[Urdf, Path]:
        paths = sorted(self.folder.glob(f"urdf/*/{name}.urdf"))
        if not paths:
            raise fault(
                self.folder / "urdf",
                f"has no {name}.urdf, which a scene names; {HOW_TO_GET}.",
            )
        return read_urdf(paths[0]), paths[0]

    def _frames(self, name: str, urdf: Urdf, scale: float) -> dict[str, np.ndarray]:
        """Pose (4, 4) of every link in the template frame at joint positions 0, by name."""
        out = {}
        for link in urdf.links:
            pose = urdf.pose(link)
            # A uniform scale lengthens distances between frames and leaves their rotations.
            pose[:3, 3] *= scale
            out[link] = _as_pose(self.upright[name]) @ pose
        return out

    def _welded(self, name: str, urdf: Urdf, path: Path, scale: float) -> Prop:
        frames = self._frames(name, urdf, scale)
        geoms: list[Geom] = []
        for link in urdf.links.values():
            geoms += _boxes(link.boxes, frames[link.name], scale)
        seen = [
            v
            for link in urdf.links.values()
            for v in _placed(link, frames[link.name], scale)
        ]
        geoms.append(self._look(name, f"{name}/look", seen))
        places = self._receptacles(path, frames, scale, geoms, {})
        return Prop(name, tuple(geoms), places)

    def _articulation(
        self, name: str, urdf: Urdf, path: Path, scale: float
    ) -> Articulation:
        frames = self._frames(name, urdf, scale)
        fixed = [k for k in urdf.links if urdf.moving(k) == urdf.root]
        body: list[Geom] = [
            g for k in fixed for g in _boxes(urdf.links[k].boxes, frames[k], scale)
        ]
        seen = [v for k in fixed for v in _placed(urdf.links[k], frames[k], scale)]
        body.append(self._look(name, f"{name}/look", seen))
        links = []
        for joint in urdf.joints.values():
            if joint.kind == "fixed":
                continue
            # A `Link` has one joint, to the static body.
            if urdf.moving(joint.parent) != urdf.root:
                raise fault(
                    path,
                    f"joint {joint.name!r}: joints on moving links are not supported.",
                )
            links.append(
                self._link(
                    name, path, urdf.links[joint.child], joint, frames[joint.child], scale
                )
            )
        moved = {link.name: np.array(link.pos) for link in links}
        shapes = [*body, *(_shifted(g, link.pos) for link in links for g in link.geoms)]
        places = self._receptacles(path, frames, scale, shapes, moved)
        return Articulation(
            name, tuple(body), tuple(links), places, FRONT_AREAS.get(name)
        )

    def _link(
        self,
        name: str,
        path: Path,
        link: UrdfLink,
        joint: UrdfJoint,
        frame: np.ndarray,
        scale: float,
    ) -> Link:
        shapes, grip = self._grip(name, path, link, scale)
        origin = frame[:3, 3]
        local = frame.copy()
        # The origin of a link lies on its joint; its axes are those of the template.
        local[:3, 3] = 0.0
        geoms = _boxes(shapes, local, scale)
        geoms.append(
            self._look(name, f"{name}/{link.name}/look", _placed(link, local, scale))
        )
        turn = frame[:3, :3]
        # Links of other furniture may have the same names.
        published = handles.PUBLISHED.get(link.name) if name in ARTICULATED else None
        handle = Handle(
            point(turn @ grip.pos * scale),
            point(turn @ grip.bar),
            point(turn @ grip.out),
            grip.half_length * scale,
            grip.thickness * scale,
            point(turn @ np.array(published)) if published else None,
        )
        slide = joint.kind == "prismatic"
        # Lengths scale, angles do not.
        low, high = (limit * scale if slide else limit for limit in joint.limits)
        # Some doors of the data set open towards negative positions; ours open towards positive ones.
        mirrored = high <= 0.0
        axis, (low, high) = (
            # From 0.0, because the negative of 0 would be -0.0, which prints and hashes differently.
            (-joint.axis, (0.0 - high, -low)) if mirrored else (joint.axis, (low, high))
        )
        # Scaling a body by s scales its mass by s^3 (SAPIEN's convention, which ManiSkill uses for this data set).
        return Link(
            link.name,
            "slide" if slide else "hinge",
            point(turn @ axis),
            (low, high),
            point(origin),
            link.mass * scale**3,
            tuple(geoms),
            handle,
            mirrored,
            joint.damping,
            joint.friction,
            _inertial(link, turn, scale),
        )

    @staticmethod
    def _grip(
        name: str, path: Path, link: UrdfLink, scale: float
    ) -> tuple[tuple[UrdfBox, ...], handles.Grip]:
        """Collision boxes of a link, and its grip, in the frame of the URDF link."""
        if not link.boxes:
            raise fault(path, f"link {link.name!r} of {name!r} has no collision boxes.")
        if name not in ARTICULATED:
            return link.boxes, handles.plain(
                link.boxes, np.array(_FRONT.get(name, (1.0, 0.0, 0.0))), scale
            )
        try:
            return ARTICULATED[name](link.name, link.boxes)
        except KeyError as error:
            raise fault(
                path, f"link {link.name!r} of {name!r} has no known handle."
            ) from error

    def _receptacles(
        self,
        path: Path,
        frames: dict[str, np.ndarray],
        scale: float,
        geoms: list[Geom],
        moved: dict[str, np.ndarray],
    ) -> tuple[Receptacle, ...]:
        config = path.with_suffix(".ao_config.json")
        body: dict[str, Any] = load_json(config) if config.is_file() else {}
        pieces = [outline(g, self.meshes) for g in geoms if g.collide]
        places = []
        for space in spaces(config, body, frames, scale):
            # A receptacle on a fixed link does not move.
            link = space.link if space.link in moved else ""
            places.append(fit(space, pieces, link, moved.get(link)))
        return tuple(p for p in places if p)


def _inertial(link: UrdfLink, turn: np.ndarray, scale: float) -> LinkInertial | None:
    """How the file spreads the mass of a link, in a frame that ``turn`` (3, 3) leads to; None if it does not say.

    Scaling by s scales inertias by s^5 (SAPIEN's convention).
    """
    if link.inertia is None:
        return None
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = (
        turn @ link.inertia @ turn.T * scale**5
    ).tolist()
    return LinkInertial(point(turn @ link.com * scale), (xx, yy, zz, xy, xz, yz))


def _righted(world: np.ndarray) -> np.ndarray:
    """The rotation (3, 3) by multiples of 90 deg that maps to +z the axis of a frame that is nearest to the world's +z.

    ``world`` (3, 3): rotation from the frame to the world.
    """
    up = world[2]
    axis = np.zeros(3)
    # The nearest axis: scenes turn furniture upright with rotations of few digits.
    axis[np.abs(up).argmax()] = np.sign(up[np.abs(up).argmax()])
    if axis[2] == 1.0:
        return np.eye(3)
    if axis[2] == -1.0:
        return np.diag([1.0, -1.0, -1.0])
    side = np.cross(axis, [0.0, 0.0, 1.0])
    return np.stack(
        [side, np.cross([0.0, 0.0, 1.0], side), [0.0, 0.0, 1.0]]
    ).T @ np.stack([side, np.cross(axis, side), axis])


def _as_pose(rotation: np.ndarray) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = rotation
    return pose


def _boxes(boxes: tuple[UrdfBox, ...], frame: np.ndarray, scale: float) -> list[Geom]:
    """Collision geoms of a link with the pose ``frame`` (4, 4), whose boxes are scaled by ``scale``."""
    out = []
    for box in boxes:
        pos = frame[:3, :3] @ (scale * box.pose[:3, 3]) + frame[:3, 3]
        turn = quat_of(frame[:3, :3] @ box.pose[:3, :3])
        out.append(
            Geom(
                "box",
                point(scale * box.half),
                point(pos),
                turn,
                material=MATERIAL,
                visual=False,
            )
        )
    return out


def _placed(
    link: UrdfLink, frame: np.ndarray, scale: float
) -> list[tuple[Path, np.ndarray]]:
    """Render meshes of a link, each with the map (4, 4) from its points to the frame that ``frame`` is relative to."""
    out = []
    for visual in link.visuals:
        out.append((visual.file, _map(visual, frame, scale)))
    return out


def _map(visual: UrdfVisual, frame: np.ndarray, scale: float) -> np.ndarray:
    pose = visual.pose.copy()
    pose[:3, :3] *= visual.scale
    # The scale of the scene applies after the pose of the visual, whose own scale applies before.
    return frame @ np.diag([scale, scale, scale, 1.0]) @ pose


def _shifted(geom: Geom, by: tuple[float, float, float]) -> Geom:
    x, y, z = (a + b for a, b in zip(geom.pos, by, strict=True))
    return Geom(
        geom.shape,
        geom.size,
        (x, y, z),
        geom.quat,
        geom.material,
        geom.mesh,
        geom.collide,
        geom.visual,
    )
