"""Reader of URDF files of furniture: a tree of links with box collision shapes and mesh visuals.

Lists of numbers may be separated by spaces or commas.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mjhab.core.errors import about, fault
from mjhab.core.files.reading import beside, read_bytes
from mjhab.core.names import check_name
from mjhab.scenes.pack_check import MAX_FILE_NUMBER

JOINT_TYPES = ("fixed", "prismatic", "revolute")


@dataclass(frozen=True, eq=False)
class UrdfBox:
    """A collision box: ``half`` (3,) half-extents [m], ``pose`` (4, 4) in the link's frame."""

    half: np.ndarray
    pose: np.ndarray


@dataclass(frozen=True, eq=False)
class UrdfVisual:
    """A render mesh: its file, ``scale`` (3,), ``pose`` (4, 4) in the link's frame."""

    file: Path
    scale: np.ndarray
    pose: np.ndarray


@dataclass(frozen=True, eq=False)
class UrdfLink:
    """A rigid part; ``mass`` [kg], 0 if the file gives none.

    ``com`` (3,): centre of mass [m], ``inertia`` (3, 3) about it [kg m^2], both in the link's frame; ``inertia`` is
    None if the file gives none.
    """

    name: str
    mass: float
    boxes: tuple[UrdfBox, ...]
    visuals: tuple[UrdfVisual, ...]
    com: np.ndarray
    inertia: np.ndarray | None


@dataclass(frozen=True, eq=False)
class UrdfJoint:
    """A joint. ``kind``: one of `JOINT_TYPES`; ``pose`` (4, 4): of the child in the parent's frame at joint position 0;
    ``axis`` (3,): unit, in the child's frame; ``limits``: (lower, upper) [m or rad], (0, 0) for a fixed joint;
    ``damping`` [N s/m or N m s/rad] and dry ``friction`` [N or N m] of its <dynamics>, 0 where the file gives none."""

    name: str
    kind: str
    parent: str
    child: str
    pose: np.ndarray
    axis: np.ndarray
    limits: tuple[float, float]
    damping: float = 0.0
    friction: float = 0.0


MAX_URDF_MB = 16
"""Largest file that is read [MB]; furniture of ReplicaCAD takes about 10 kB."""


@dataclass(frozen=True, eq=False)
class Urdf:
    """A kinematic tree: links by name, joints by the name of their child link, and the name of the root link."""

    name: str
    links: dict[str, UrdfLink]
    joints: dict[str, UrdfJoint]
    root: str

    def pose(self, link: str) -> np.ndarray:
        """Compute the pose (4, 4) of a link in the frame of the root link, all joints at position 0."""
        out = np.eye(4)
        while link != self.root:
            joint = self.joints[link]
            out = joint.pose @ out
            link = joint.parent
        return out

    def moving(self, link: str) -> str:
        """Return the nearest link at or above ``link`` whose joint is not fixed; the root if there is none."""
        while link != self.root and self.joints[link].kind == "fixed":
            link = self.joints[link].parent
        return link


def read_urdf(path: Path) -> Urdf:
    """Read a URDF file.

    Raises:
        UsageError: it is missing, invalid, or has unsupported shapes or joints; the message names file and element.
    """
    raw = read_bytes(path, MAX_URDF_MB)
    # Entities may expand to gigabytes.
    if b"<!DOCTYPE" in raw or b"<!ENTITY" in raw:
        raise fault(path, "declares entities, which no furniture needs.")
    try:
        top = ElementTree.fromstring(raw)
    except (ElementTree.ParseError, RecursionError, ValueError) as error:
        raise fault(path, f"not valid XML ({error}); download the file again.") from error
    links = {_name(path, e, "name"): _link(path, e) for e in top.iter("link")}
    joints = {}
    for element in top.iter("joint"):
        joint = _joint(path, element)
        for end in (joint.parent, joint.child):
            if end not in links:
                raise fault(
                    path,
                    f"joint {joint.name!r} names the link {end!r}, which is not in the file.",
                )
        joints[joint.child] = joint
    roots = [name for name in links if name not in joints]
    if len(roots) != 1:
        raise fault(
            path,
            f"expected one root link, found {len(roots)} ({', '.join(roots) or 'none'}).",
        )
    for name in links:
        _check_reaches_root(path, name, joints, roots[0])
    return Urdf(top.get("name", path.stem), links, joints, roots[0])


def _check_reaches_root(
    path: Path, link: str, joints: dict[str, UrdfJoint], root: str
) -> None:
    """Raise a UsageError if the joints above a link form a loop instead of leading to the root."""
    above = link
    # More steps than joints mean that a joint was passed twice.
    for _ in range(len(joints) + 1):
        if above == root:
            return
        above = joints[above].parent
    raise fault(path, f"the joints above link {link!r} form a loop.")


def _link(path: Path, element: ElementTree.Element) -> UrdfLink:
    name = _need(path, element, "name")
    mass = element.find("inertial/mass")
    boxes = []
    visuals = []
    for part in element.findall("collision"):
        box = part.find("geometry/box")
        if box is None:
            raise fault(path, f"link {name!r}: collision shapes must be boxes.")
        size = _numbers(path, f"link {name!r}: box size", box.get("size"), 3)
        boxes.append(UrdfBox(size / 2, _origin(path, part, f"link {name!r}")))
    for part in element.findall("visual"):
        mesh = part.find("geometry/mesh")
        if mesh is None:
            raise fault(path, f"link {name!r}: visual shapes must be meshes.")
        scale = _numbers(
            path, f"link {name!r}: mesh scale", mesh.get("scale", "1 1 1"), 3
        )
        with about(f"{path}: link {name!r}"):
            file = beside(path, _need(path, mesh, "filename"))
        visuals.append(UrdfVisual(file, scale, _origin(path, part, f"link {name!r}")))
    value = (
        0.0
        if mass is None
        else float(_numbers(path, f"link {name!r}: mass", mass.get("value"), 1)[0])
    )
    com, inertia = _inertial(path, element, f"link {name!r}")
    return UrdfLink(name, value, tuple(boxes), tuple(visuals), com, inertia)


def _inertial(
    path: Path, element: ElementTree.Element, where: str
) -> tuple[np.ndarray, np.ndarray | None]:
    """Centre of mass (3,) and inertia (3, 3) about it in the link's frame; None without a whole <inertia>.

    Raises:
        UsageError: a number is missing, or no body has such an inertia.
    """
    inertial = element.find("inertial")
    if inertial is None:
        return np.zeros(3), None
    pose = _origin(path, inertial, f"{where}: inertial")
    given = inertial.find("inertia")
    if given is None or not {"ixx", "iyy", "izz"} <= given.attrib.keys():
        return pose[:3, 3], None
    xx, yy, zz, xy, xz, yz = (
        float(_numbers(path, f"{where}: {key}", given.get(key, "0"), 1)[0])
        for key in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
    )
    inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    moments = np.linalg.eigvalsh(inertia)
    # The tolerance is for thin plates, whose largest moment equals the sum of the others.
    if moments[0] <= 0.0 or moments[2] > moments[:2].sum() * (1 + 1e-9):
        raise fault(
            path,
            f"{where}: no body has the inertia {given.attrib}: its principal moments must be positive, and "
            "none larger than the sum of the others.",
        )
    turn = pose[:3, :3]
    # URDF gives inertia along the axes of <inertial>, which may be turned.
    return pose[:3, 3], turn @ inertia @ turn.T


def _joint(path: Path, element: ElementTree.Element) -> UrdfJoint:
    name = _name(path, element, "name")
    kind = _need(path, element, "type")
    if kind not in JOINT_TYPES:
        raise fault(
            path,
            f"joint {name!r}: unknown type {kind!r}; known are {', '.join(JOINT_TYPES)}.",
        )
    ends = []
    for tag in ("parent", "child"):
        found = element.find(tag)
        if found is None:
            raise fault(path, f"joint {name!r}: no <{tag}>.")
        ends.append(_need(path, found, "link"))
    axis = np.array([1.0, 0.0, 0.0])
    limits = (0.0, 0.0)
    damping = friction = 0.0
    if kind != "fixed":
        given = element.find("axis")
        limit = element.find("limit")
        if given is not None:
            axis = _numbers(path, f"joint {name!r}: axis", given.get("xyz"), 3)
        if limit is None or not np.linalg.norm(axis, axis=-1):
            raise fault(
                path, f"joint {name!r}: needs a <limit> and an axis that is not zero."
            )
        axis = axis / np.linalg.norm(axis, axis=-1)
        low, high = (
            float(_numbers(path, f"joint {name!r}: {k} limit", limit.get(k, "0"), 1)[0])
            for k in ("lower", "upper")
        )
        limits = (low, high)
        damping, friction = (
            _resistance(path, name, element.find("dynamics"), term)
            for term in ("damping", "friction")
        )
    return UrdfJoint(
        name,
        kind,
        ends[0],
        ends[1],
        _origin(path, element, f"joint {name!r}"),
        axis,
        limits,
        damping,
        friction,
    )


def _resistance(
    path: Path, joint: str, dynamics: ElementTree.Element | None, term: str
) -> float:
    """One number of a joint's <dynamics>; 0, as URDF has it, where there is none."""
    given = "0" if dynamics is None else dynamics.get(term, "0")
    value = float(_numbers(path, f"joint {joint!r}: {term}", given, 1)[0])
    if value < 0.0:
        raise fault(
            path,
            f"joint {joint!r}: {term} is {value:g}, which would drive the joint; expected 0 or more.",
        )
    return value


def _origin(path: Path, element: ElementTree.Element, where: str) -> np.ndarray:
    pose = np.eye(4)
    origin = element.find("origin")
    if origin is not None:
        roll, pitch, yaw = _numbers(
            path, f"{where}: origin rpy", origin.get("rpy", "0 0 0"), 3
        )
        # URDF's order: about the fixed axes x, y, z.
        pose[:3, :3] = _about(2, yaw) @ _about(1, pitch) @ _about(0, roll)
        pose[:3, 3] = _numbers(
            path, f"{where}: origin xyz", origin.get("xyz", "0 0 0"), 3
        )
    return pose


def _about(axis: int, angle: float) -> np.ndarray:
    c = np.cos(angle)
    s = np.sin(angle)
    i = (axis + 1) % 3
    j = (axis + 2) % 3
    turn = np.eye(3)
    turn[i, i] = c
    turn[i, j] = -s
    turn[j, i] = s
    turn[j, j] = c
    return turn


def _need(path: Path, element: ElementTree.Element, attribute: str) -> str:
    value = element.get(attribute)
    if value is None:
        raise fault(path, f"<{element.tag}> has no attribute {attribute!r}.")
    return value


def _name(path: Path, element: ElementTree.Element, attribute: str) -> str:
    with about(path):
        return check_name(
            f"<{element.tag}>, attribute {attribute!r}", _need(path, element, attribute)
        )


def _numbers(path: Path, where: str, text: str | None, count: int) -> np.ndarray:
    words = (text or "").replace(",", " ").split()
    try:
        numbers = np.array([float(word) for word in words])
    except ValueError:
        numbers = np.zeros(0)
    # Negated, so that NaN is refused, too.
    if len(numbers) != count or not (np.abs(numbers) <= MAX_FILE_NUMBER).all():
        raise fault(
            path,
            f"{where}: expected {count} numbers, got {text!r} (up to {MAX_FILE_NUMBER:g}).",
        )
    return numbers
