"""Episodes of the HAB format on a layout: which objects a file needs, where they start, what their goals are, and back.

Furniture and links are resolved by name. Files number links, and count the root as 0 (the files of the benchmark) or
as -1 (habitat-lab today); which of the two is found from the numbers themselves and from where the objects are.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from fnmatch import fnmatchcase

import numpy as np

from mjhab.core.errors import UsageError, unknown_name
from mjhab.core.memory_cache import MemoryCache
from mjhab.core.names import kind_of
from mjhab.core.rotations import mat_from_quat
from mjhab.episodes.generator import Episode, require_furniture
from mjhab.episodes.hab.format import (
    MAX_OBJECTS,
    HabEpisode,
    HabFile,
    pose_from_hab,
)
from mjhab.episodes.hab.format import Receptacle as NumberedLink
from mjhab.layout.layout import Layout
from mjhab.layout.receptacles import PlacedReceptacle, link_to_open, placed_receptacles
from mjhab.scenes.roles import roles_of
from mjhab.scenes.spec import Home, Pack, Vec3
from mjhab.sim.mujoco.cpu import CpuSimulator
from mjhab.sim.mujoco.settle import settle
from mjhab.tasks.household.registry import TASKS
from mjhab.tasks.plan import Target

SETTLE_SECONDS = 2.0
MOVED = 0.02
TIPPED = np.radians(10.0)
"""An object is not at rest if it moves further [m] or leans further [rad] than this while it settles."""
MARGIN = 0.05
"""How far beyond a receptacle's rectangle the middle of an object may lie and still be taken to stand on it [m]."""
OUTSIDE_M = 2.0
"""How far beyond the floor of a home an object may lie [m]: the extent of homes without stage is an estimate."""
LOWEST_M = -1.0
"""Lowest place of an object [m]."""
HIGHEST_M = 5.0
"""Highest place of an object [m]."""
PREFIX = "frl_apartment_"
"""Start of the template names of ReplicaCAD's furniture, left out in our names."""
FIXED_LINKS = ("root", "body")
"""Links that every articulation has before those that move."""
_NUMBER_OF_ROOT = (0, -1)


def file_roster(file: HabFile, pack: Pack) -> tuple[str, ...]:
    """Object type per slot that a layout needs to hold every episode of a file: the most of each type in any of them.

    Raises:
        UsageError: an object type that the pack does not have; names file and field.
    """
    most: Counter[str] = Counter()
    for i, episode in enumerate(file.episodes):
        for k, kind in enumerate(episode.types):
            if kind not in pack.objects:
                known = unknown_name("object", kind, pack.objects)
                raise UsageError(f"{file.path}: episodes[{i}].rigid_objs[{k}]: {known}")
        most |= Counter(episode.types)
    if most.total() > MAX_OBJECTS:
        raise UsageError(
            f"{file.path}: its episodes need {most.total():,} objects at once; at most {MAX_OBJECTS} can be simulated."
        )
    return tuple(kind for kind in sorted(most) for _ in range(most[kind]))


@dataclass(frozen=True, eq=False)
class Rest:
    """How the objects of an episode settle: ``moved`` (M,) [m], ``tipped`` (M,) [rad] for its M object names."""

    names: tuple[str, ...]
    moved: np.ndarray
    tipped: np.ndarray

    @property
    def fallen(self) -> tuple[str, ...]:
        """Names of the objects that did not stay where the file puts them."""
        return tuple(
            n
            for n, m, t in zip(self.names, self.moved, self.tipped, strict=True)
            if m > MOVED or t > TIPPED
        )


class FileEpisodes:
    """The episodes of a file on a simulator's layout, settled on first use.

    Args:
        sim: its layout has the roster of `file_roster` (or more objects).
        file: what the file holds.
        task: HAB task the plans belong to.
        home, target: only the episodes in homes that fit this name or pattern (``v3_sc0_*``), with a target of this
            object type; "" for all.

    Raises:
        UsageError: the file does not fit the layout: a scene, an object, a target or a link it does not have; or no
            episode of it is wanted.
    """

    def __init__(
        self, sim: CpuSimulator, file: HabFile, task: str, home: str = "", target: str = ""
    ) -> None:
        self.sim = sim
        self.file = file
        self.task = task
        self.layout = sim.layout
        self._homes = self.layout.pack.homes_by_name
        self._furnished: set[str] = set()
        self._settled = MemoryCache("episodes")
        for i in range(len(self.file.episodes)):
            self._check(i)
        self._rows = [
            i
            for i, episode in enumerate(self.file.episodes)
            if fnmatchcase(episode.scene, home or "*")
            and any(n.startswith(target) for n in episode.target_names)
        ]
        if not self._rows:
            wanted = " ".join(
                filter(None, (home and f"in home {home!r}", target and f"with target {target!r}"))
            )
            raise UsageError(
                f"{file.path}: none of its {len(self.file.episodes)} episodes is {wanted}."
            )

    def __len__(self) -> int:
        return len(self._rows)

    def episode(self, seed: int, index: int) -> Episode:
        """The ``index``-th wanted episode of the file, counted on from the start after the last.

        The same episode under another index or seed has the same objects and another spawn of the robot.
        """
        found = self.settled(index)[0]
        return Episode(
            found.task,
            found.split,
            seed,
            index,
            found.home,
            found.object_pose,
            found.link_q,
            found.targets,
        )

    def settled(self, index: int) -> tuple[Episode, Rest]:
        """An episode after `SETTLE_SECONDS` of simulation, and how its objects came to rest."""
        row = self._rows[index % len(self)]
        return self._settled.get(row, lambda: self._settle(row))

    def _check(self, row: int) -> None:
        episode = self.file.episodes[row]
        where = f"{self.file.path}: episodes[{row}]"
        if episode.scene not in self._homes:
            near, _, _ = str(unknown_name("scene", episode.scene, self._homes)).partition(
                " Valid names"
            )
            raise UsageError(
                f"{where}.scene_id: {near} `mjhab homes list` names those of {self.layout.pack.name!r}; scenes of "
                "ReplicaCAD that are not staged are opened by name, as --assets FOLDER/apt_0."
            )
        if episode.scene not in self._furnished:
            try:
                require_furniture(self.layout.pack, [self._homes[episode.scene]], self.task)
            except UsageError as error:
                raise UsageError(f"{where}.scene_id: {error}") from error
            self._furnished.add(episode.scene)
        names = episode.target_names
        limit = len(TASKS[self.task].targets)
        if not 1 <= len(names) <= limit:
            raise UsageError(
                f"{where}.targets: {self.task} handles 1 to {limit} targets, got {len(names)}."
            )
        for name in names:
            if name not in episode.instances:
                raise UsageError(
                    f"{where}.targets: {unknown_name('object', name, episode.instances)}"
                )
        for name in episode.instances:
            if name not in self.layout.object_names:
                raise UsageError(f"{where}.rigid_objs: the layout has no slot for {name!r}.")
        try:
            home, pose, _, root = self._read(row)
            _check_inside(self.layout, home, episode, pose)
        except ValueError as error:
            raise UsageError(f"{where}.{error}") from error
        rules = TASKS[self.task].targets
        if any(rule.opens for rule in rules):
            targets = file_targets(self.layout, home, episode, pose, root)
            for rule, target in zip(rules, targets, strict=False):
                if rule.opens == "start" and not target.start_link:
                    raise UsageError(
                        f"{where}.rigid_objs: {target.obj!r} starts in no drawer or fridge; {self.task} opens one."
                    )

    def _read(self, row: int) -> tuple[Home, np.ndarray, np.ndarray, int]:
        """Home, object poses (N, 7), joint positions (L,) as the file gives them, and the number of the root link."""
        episode = self.file.episodes[row]
        home = self._homes[episode.scene]
        pose = object_poses(self.layout, episode)
        root = number_of_root(self.layout, home, episode, pose)
        return home, pose, joint_positions(self.layout, episode, root), root

    def _settle(self, row: int) -> tuple[Episode, Rest]:
        home, pose, link_q, root = self._read(row)
        model = self.sim.model(home.name)
        a = self.sim.addresses
        rows = a.object_q[:, None] + np.arange(7)
        qpos = model.qpos0.copy()
        qpos[rows] = pose
        qpos[a.link_q] = link_q
        after, _ = settle(model, a, qpos, SETTLE_SECONDS)
        hab = self.file.episodes[row]
        rested = after[rows]
        slots = [self.layout.object_names.index(name) for name in hab.instances]
        moved = np.linalg.norm(rested[slots, :3] - pose[slots, :3], axis=1)
        axis_before, axis_after = (mat_from_quat(p[slots, 3:])[..., 2] for p in (pose, rested))
        upright = np.einsum("mi,mi->m", axis_before, axis_after)
        rest = Rest(hab.instances, moved, np.arccos(np.clip(upright, -1.0, 1.0)))
        targets = file_targets(self.layout, home, hab, rested, root)
        return Episode(
            self.task, home.split, 0, row, home.name, rested, after[a.link_q], targets
        ), rest


def _check_inside(layout: Layout, home: Home, episode: HabEpisode, pose: np.ndarray) -> None:
    """Refuse an object that starts, or is to go, where there is no home.

    Raises:
        ValueError: names the field.
    """
    goals = [
        (f"targets[{name!r}]", pose_from_hab(matrix)[:3])
        for name, matrix in episode.targets.items()
    ]
    starts = [
        (f"rigid_objs[{k}]", pose[layout.object_names.index(name), :3])
        for k, name in enumerate(episode.instances)
    ]
    x_min, y_min, x_max, y_max = home.floor
    low = np.array([x_min - OUTSIDE_M, y_min - OUTSIDE_M, LOWEST_M])
    high = np.array([x_max + OUTSIDE_M, y_max + OUTSIDE_M, HIGHEST_M])
    for field, point in [*starts, *goals]:
        if ((point < low) | (point > high)).any():
            extent = f"{_shown(low)} to {_shown(high)} m (+z up)"
            raise ValueError(
                f"{field}: {_shown(point)} m is not in {home.name!r}, which extends from {extent}."
            )


def _shown(point: np.ndarray) -> str:
    return f"({', '.join(f'{value:.2f}' for value in point)})"


# -- from the file -----------------------------------------------------------------------------------------------------


def object_poses(layout: Layout, episode: HabEpisode) -> np.ndarray:
    """Poses (N, 7) of all slots: those of the episode, the others parked."""
    pose = layout.parked_poses.copy()
    for name, kind, (_, matrix) in zip(
        episode.instances, episode.types, episode.rigid_objs, strict=True
    ):
        pose[layout.object_names.index(name)] = pose_from_hab(
            matrix, layout.pack.objects[kind].scan_yaw
        )
    return pose


def link_names(layout: Layout, furniture: str) -> tuple[str, ...]:
    """Links of an articulation in the order in which files number them: root, body, then those that move."""
    return (*FIXED_LINKS, *(ref.link.name for ref in layout.links if ref.articulation == furniture))


def template_of(handle: str) -> str:
    """Our template name of a handle such as ``"frl_apartment_table_01_:0000"``."""
    return kind_of(handle).removeprefix(PREFIX)


def number_of_root(layout: Layout, home: Home, episode: HabEpisode, pose: np.ndarray) -> int:
    """Whether the episode numbers the root link 0 or -1; 0 when it does not matter.

    Args:
        pose: (N, 7) of all slots, to compare a numbered drawer with where the object is.

    Raises:
        ValueError: some number fits neither; the message names the field.
    """
    evidence: list[tuple[str, int, tuple[str, ...]]] = []
    jointed = {a.name for a in layout.articulations}
    for handle, joints in episode.ao_states.items():
        known = link_names(layout, template_of(handle))
        if template_of(handle) not in jointed:
            continue  # welded shut: its numbers tell nothing
        evidence += [
            (template_of(handle), int(n), known[2:]) for n in joints if n.lstrip("-").isdigit()
        ]
    places = placed_receptacles(layout, home)
    for name, (handle, number) in zip(
        episode.target_names, episode.target_receptacles, strict=False
    ):
        furniture = template_of(handle)
        if number is not None and furniture in jointed:
            found = receptacle_at(layout, places, name, pose[layout.object_names.index(name)])
            link = found.link.split("/")[1] if found is not None and found.link else ""
            evidence.append((furniture, number, (link,) if link else link_names(layout, furniture)))
    for root in _NUMBER_OF_ROOT:
        if all(_link_name(layout, furniture, n, root) in valid for furniture, n, valid in evidence):
            return root
    told = ", ".join(f"{furniture} link {n}" for furniture, n, _ in evidence)
    raise ValueError(
        f"ao_states: these numbers are not links of the furniture, however the root is counted: {told}."
    )


def _link_name(layout: Layout, furniture: str, number: int, root: int) -> str:
    names = link_names(layout, furniture)
    k = number - root
    return names[k] if 0 <= k < len(names) else ""


def joint_positions(layout: Layout, episode: HabEpisode, root: int) -> np.ndarray:
    """Joint positions (L,) of an episode, 0 where it tells none.

    Raises:
        ValueError: furniture or a link that the layout does not move, or a position out of range; names the field.
    """
    out = np.zeros(len(layout.links))
    for handle, joints in episode.ao_states.items():
        furniture = template_of(handle)
        for number, position in joints.items():
            where = f"ao_states[{handle!r}][{number!r}]"
            name = (
                _link_name(layout, furniture, int(number), root)
                if number.lstrip("-").isdigit()
                else number
            )
            if f"{furniture}/{name}" not in layout.link_ids:
                if position == 0.0:
                    continue
                if furniture in layout.pack.props:
                    raise ValueError(
                        f"{where}: {furniture!r} is welded shut in this pack (--articulate lets it open)."
                    )
                raise ValueError(
                    f"{where}: {unknown_name('link', f'{furniture}/{name}', layout.link_ids)}"
                )
            k = layout.link_ids.index(f"{furniture}/{name}")
            low, high = layout.links[k].link.range
            position = -position if layout.links[k].link.mirrored else position
            if not low - 0.05 <= position <= high + 0.05:
                raise ValueError(
                    f"{where}: {position:g} is outside the range {low:g} to {high:g} of the joint."
                )
            out[k] = min(max(position, low), high)
    return out


def receptacle_at(
    layout: Layout, places: tuple[PlacedReceptacle, ...], name: str, pose: np.ndarray
) -> PlacedReceptacle | None:
    """The receptacle that an object instance stands in at ``pose`` (7,), None if there is none.

    Among those whose rectangle it is over, the one with the surface nearest to its lowest point.
    """
    half = np.array(layout.objects[layout.object_names.index(name)].half)
    lowest = pose[2] - np.abs(mat_from_quat(pose[3:])[2]) @ half
    best = None
    least = 0.10
    for place in places:
        over = np.abs(place.local(pose[:2])) <= np.array(place.half) + MARGIN
        gap = abs(lowest - place.pos[2])
        if over.all() and gap < least and pose[2] > place.pos[2]:
            best = place
            least = gap
    return best


def file_targets(
    layout: Layout, home: Home, episode: HabEpisode, pose: np.ndarray, root: int
) -> tuple[Target, ...]:
    """The targets of an episode in their order; receptacles that the file does not name are found by geometry.

    Args:
        pose: (N, 7) where the objects of all slots are.
        root: number of the root link, from `number_of_root`.
    """
    places = placed_receptacles(layout, home)
    out = []
    for k, name in enumerate(episode.target_names):
        slot = layout.object_names.index(name)
        goal = pose_from_hab(episode.targets[name], layout.objects[slot].scan_yaw)
        starts = _listed_link(layout, episode.target_receptacles, k, root)
        ends = _listed_link(layout, episode.goal_receptacles, k, root)
        start_link = starts or _link_around(layout, home, places, name, pose[slot])
        goal_link = ends or _link_around(layout, home, places, name, goal)
        handle = layout.closed_handle(home, start_link) if start_link else (0.0, 0.0, 0.0)
        out.append(Target(name, _point(goal), _point(pose[slot]), start_link, goal_link, handle))
    return tuple(out)


def _listed_link(layout: Layout, listed: tuple[NumberedLink, ...], k: int, root: int) -> str:
    """Id of the link that a file lists for target ``k``, or "" if it lists none that is here."""
    if k >= len(listed) or listed[k][1] is None:
        return ""
    furniture = template_of(listed[k][0])
    link = f"{furniture}/{_link_name(layout, furniture, int(listed[k][1] or 0), root)}"
    return link if link in layout.link_ids else ""


def _link_around(
    layout: Layout, home: Home, places: tuple[PlacedReceptacle, ...], name: str, pose: np.ndarray
) -> str:
    """Id of the link to open before an object at ``pose`` (7,) can be reached, or ""."""
    found = receptacle_at(layout, places, name, pose)
    return link_to_open(found, roles_of(layout.pack, home)) if found is not None else ""


def _point(pose: np.ndarray) -> Vec3:
    x, y, z = pose[:3].tolist()
    return (x, y, z)
