"""Map episodes of the HAB format to a layout: object slots, start poses, joint positions, targets.

Furniture and links are found by name. Files number links with the root as 0 (files of the benchmark) or as -1
(habitat-lab today); `number_of_root` infers which from the numbers and from the object poses.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from fnmatch import fnmatchcase

import numpy as np

from mjhab.core.arithmetic.elementary import arccos
from mjhab.core.errors import UsageError, about, fault, unknown_name, wrong_value
from mjhab.core.memory_cache import MemoryCache
from mjhab.core.names import kind_of
from mjhab.core.rotations import mat_from_quat
from mjhab.core.typed.checks import check_one_of
from mjhab.episodes.episode import Episode
from mjhab.episodes.hab.format import (
    MAX_OBJECTS,
    HabEpisode,
    HabFile,
    pose_from_hab,
)
from mjhab.episodes.hab.format import Receptacle as NumberedLink
from mjhab.episodes.homes import require_furniture
from mjhab.layout.layout import Layout
from mjhab.layout.receptacles import PlacedReceptacle, link_to_open, placed_receptacles
from mjhab.scenes.roles import roles_of
from mjhab.scenes.spec import Home, Pack, Vec3
from mjhab.sim.mujoco.cpu import CpuSimulator
from mjhab.sim.mujoco.settle import settle
from mjhab.tasks.household.registry import TASKS
from mjhab.tasks.plan import Target

SETTLE_SECONDS = 2.0
"""Time [s] for which the objects of an episode settle."""
MOVED = 0.02
"""An object that moves farther than this [m] while it settles was not at rest."""
TIPPED = np.radians(10.0)
"""The same for the change of its tilt [rad]."""
MARGIN = 0.05
"""Distance [m] by which the centre of an object on a receptacle may be outside of the receptacle's rectangle."""
OUTSIDE_M = 2.0
"""Distance [m] by which an object may be outside of a home's floor; the floor of homes without stage is an estimate."""
LOWEST_M = -1.0
"""Least height of an object [m]."""
HIGHEST_M = 5.0
"""Largest height of an object [m]."""
PREFIX = "frl_apartment_"
"""Prefix of ReplicaCAD's furniture templates, which mjhab's names leave out."""
FIXED_LINKS = ("root", "body")
"""Links of every articulation that come before its moving links."""
_NUMBER_OF_ROOT = (0, -1)


def file_roster(file: HabFile, pack: Pack) -> tuple[str, ...]:
    """Return the object type of every slot that a layout needs for a file: of each type the most in any episode.

    Raises:
        UsageError: the pack lacks an object type, or there are more than `MAX_OBJECTS`; names the file.
    """
    most: Counter[str] = Counter()
    for i, episode in enumerate(file.episodes):
        for k, kind in enumerate(episode.types):
            if kind not in pack.objects:
                known = unknown_name("object", kind, pack.objects)
                raise fault(file.path, f"episodes[{i}].rigid_objs[{k}]: {known}")
        # The union of counters takes the larger number of each.
        most |= Counter(episode.types)
    if most.total() > MAX_OBJECTS:
        raise fault(
            file.path,
            f"its episodes need {most.total():,} objects at once; at most {MAX_OBJECTS} can be simulated.",
        )
    # Sorted, so that files with the same objects share one layout and its compiled models.
    return tuple(kind for kind in sorted(most) for _ in range(most[kind]))


@dataclass(frozen=True, eq=False)
class Rest:
    """How the M objects of an episode settled: ``moved`` (M,) distance [m], ``tipped`` (M,) change of tilt [rad]."""

    names: tuple[str, ...]
    moved: np.ndarray
    tipped: np.ndarray

    @property
    def fallen(self) -> tuple[str, ...]:
        """Names of the objects that moved by more than MOVED or tilted by more than TIPPED."""
        return tuple(
            n
            for n, m, t in zip(self.names, self.moved, self.tipped, strict=True)
            if m > MOVED or t > TIPPED
        )


class FileEpisodes:
    """The episodes of a file on a layout; objects are settled on first use of an episode.

    Args:
        sim: CPU simulator whose layout has at least the roster of `file_roster`.
        file: content of the file.
        task: household task that defines the plans.
        home: use only episodes in homes that match this name or pattern (``v3_sc0_*``); "" for all.
        target: use only episodes with a target of this object type; "" for all.

    Raises:
        UsageError: the layout lacks a scene, object, target or link of the file, or no episode is left to use.
    """

    def __init__(
        self,
        sim: CpuSimulator,
        file: HabFile,
        task: str,
        home: str = "",
        target: str = "",
    ) -> None:
        self.sim = sim
        self.file = file
        self.task = task
        self.layout = sim.layout
        self._homes = self.layout.pack.homes_by_name
        self._furnished: set[str] = set()
        self._settled = MemoryCache("episodes")
        for i in range(len(self.file.episodes)):
            # All at once: an error in the last episode must not show after hours.
            self._check(i)
        self._rows = [
            i
            for i, episode in enumerate(self.file.episodes)
            if fnmatchcase(episode.scene, home or "*")
            and (not target or target in map(kind_of, episode.target_names))
        ]
        if not self._rows:
            wanted = " ".join(
                filter(
                    None,
                    (home and f"in home {home!r}", target and f"with target {target!r}"),
                )
            )
            raise fault(
                file.path, f"none of its {len(self.file.episodes)} episodes is {wanted}."
            )

    def __len__(self) -> int:
        return len(self._rows)

    def episode(self, seed: int, index: int) -> Episode:
        """Return episode ``index`` modulo the number of used episodes.

        ``seed`` and ``index`` become those of the episode, and so determine the robot's spawn.
        """
        found = self.settled(index)[0]
        return Episode(
            seed,
            index,
            found.task,
            found.split,
            found.home,
            found.object_pose,
            found.link_q,
            found.targets,
        )

    def settled(self, index: int) -> tuple[Episode, Rest]:
        """Return an episode with its objects settled for `SETTLE_SECONDS`, and how they moved."""
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
            with about(f"{where}.scene_id", UsageError):
                require_furniture(
                    self.layout.pack, [self._homes[episode.scene]], self.task
                )
            # Thousands of episodes share a few scenes.
            self._furnished.add(episode.scene)
        names = episode.target_names
        limit = len(TASKS[self.task].targets)
        if not 1 <= len(names) <= limit:
            raise wrong_value(
                "targets", len(names), f"1 to {limit} for {self.task}", where=where
            )
        for name in names:
            check_one_of("object", name, episode.instances, where=f"{where}.targets")
        for name in episode.instances:
            if name not in self.layout.object_names:
                raise UsageError(
                    f"{where}.rigid_objs: the layout has no slot for {name!r}."
                )
        try:
            # Reading checks what it reads: its messages get the place in the file here.
            home, pose, _, root = self._read(row)
            _check_inside(self.layout, home, episode, pose)
        except ValueError as error:
            raise UsageError(f"{where}.{error}") from error
        rules = TASKS[self.task].targets
        if any(rule.opens for rule in rules):
            targets = file_targets(self.layout, home, episode, pose, root, self.task)
            # Fewer targets than rules are allowed, see above.
            for rule, target in zip(rules, targets, strict=False):
                if rule.opens == "start" and not target.start_link:
                    raise UsageError(
                        f"{where}.rigid_objs: {target.obj!r} starts in no drawer or fridge; {self.task} opens one."
                    )
                if rule.opens == "goal" and not target.goal_link:
                    raise UsageError(
                        f"{where}.targets: the goal of {target.obj!r} is in no drawer or fridge; {self.task} opens one."
                    )

    def _read(self, row: int) -> tuple[Home, np.ndarray, np.ndarray, int]:
        """Return home, object poses (N, 7) and joint positions (L,) of the file, and the number of the root link."""
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
        # By the axis alone: an object that turns about it has not fallen.
        axis_before, axis_after = (
            mat_from_quat(p[slots, 3:])[..., 2] for p in (pose, rested)
        )
        upright = np.einsum("mi,mi->m", axis_before, axis_after)
        # Rounding can bring the product of unit vectors beyond 1.
        rest = Rest(hab.instances, moved, arccos(np.clip(upright, -1.0, 1.0)))
        targets = file_targets(self.layout, home, hab, rested, root, self.task)
        return Episode(
            0, row, self.task, home.split, home.name, rested, after[a.link_q], targets
        ), rest


def _check_inside(
    layout: Layout, home: Home, episode: HabEpisode, pose: np.ndarray
) -> None:
    """Check that starts and goals of all objects are inside of the home.

    Raises:
        ValueError: one is outside; names its field.
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
    """Return poses (N, 7) [m, wxyz], world frame, of all object slots; slots not in the episode are parked."""
    pose = layout.parked_poses.copy()
    for name, kind, (_, matrix) in zip(
        episode.instances, episode.types, episode.rigid_objs, strict=True
    ):
        pose[layout.object_names.index(name)] = pose_from_hab(
            matrix, layout.pack.objects[kind].scan_yaw
        )
    return pose


def link_names(layout: Layout, furniture: str) -> tuple[str, ...]:
    """Return the links of an articulation in the order of their numbers in files: root, body, then moving links."""
    return (
        *FIXED_LINKS,
        *(ref.link.name for ref in layout.links if ref.articulation == furniture),
    )


def template_of(handle: str) -> str:
    """Return mjhab's template name of a furniture handle such as ``"frl_apartment_table_01_:0000"``."""
    return kind_of(handle).removeprefix(PREFIX)


def number_of_root(
    layout: Layout, home: Home, episode: HabEpisode, pose: np.ndarray
) -> int:
    """Infer whether an episode numbers root links as 0 or -1; 0 if both fit.

    Args:
        layout: the layout.
        home: home of the episode.
        episode: the episode.
        pose: (N, 7) of all object slots, to compare the numbered link of a target with the place of the object.

    Raises:
        ValueError: the numbers fit neither; the message names the field.
    """
    evidence: list[tuple[str, int, tuple[str, ...]]] = []
    jointed = {a.name for a in layout.articulations}
    for handle, joints in episode.ao_states.items():
        known = link_names(layout, template_of(handle))
        if template_of(handle) not in jointed:
            continue  # furniture without joints in this pack gives no evidence
        evidence += [
            (template_of(handle), int(n), known[2:])
            for n in joints
            if n.lstrip("-").isdigit()
        ]
    places = placed_receptacles(layout, home)
    for name, (handle, number) in zip(
        episode.target_names, episode.target_receptacles, strict=False
    ):
        furniture = template_of(handle)
        if number is not None and furniture in jointed:
            found = receptacle_at(
                layout, places, name, pose[layout.object_names.index(name)]
            )
            link = found.link.split("/")[1] if found is not None and found.link else ""
            evidence.append(
                (furniture, number, (link,) if link else link_names(layout, furniture))
            )
    for root in _NUMBER_OF_ROOT:
        if all(
            _link_name(layout, furniture, n, root) in valid
            for furniture, n, valid in evidence
        ):
            return root
    wrong = ", ".join(f"{furniture} link {n}" for furniture, n, _ in evidence)
    raise ValueError(
        f"ao_states: these numbers are not links of the furniture, however the root is counted: {wrong}."
    )


def _link_name(layout: Layout, furniture: str, number: int, root: int) -> str:
    names = link_names(layout, furniture)
    k = number - root
    return names[k] if 0 <= k < len(names) else ""


def joint_positions(layout: Layout, episode: HabEpisode, root: int) -> np.ndarray:
    """Return the joint positions (L,) [m or rad] of an episode; 0 for links that it does not name.

    Raises:
        ValueError: the layout has no such moving link, or a position is out of range; names the field.
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
                # A closed link that this pack does not have makes no difference.
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
            # Habitat's drawers and doors of this kind open towards negative values.
            position = -position if layout.links[k].link.mirrored else position
            # Settled joints may lie slightly beyond their limits.
            if not low - 0.05 <= position <= high + 0.05:
                raise ValueError(
                    f"{where}: {position:g} is outside the range {low:g} to {high:g} of the joint."
                )
            out[k] = min(max(position, low), high)
    return out


def receptacle_at(
    layout: Layout, places: tuple[PlacedReceptacle, ...], name: str, pose: np.ndarray
) -> PlacedReceptacle | None:
    """Return the receptacle that an object stands on, None if there is none.

    Of the receptacles below the object it is the one whose surface is nearest to the object's lowest point.

    Args:
        layout: the layout.
        places: receptacles of the home.
        name: instance name of the object.
        pose: (7,) its pose, world frame [m, wxyz].
    """
    half = np.array(layout.objects[layout.object_names.index(name)].half)
    lowest = pose[2] - np.abs(mat_from_quat(pose[3:])[2]) @ half
    best = None
    least = 0.10
    for place in places:
        over = np.abs(place.local(pose[:2])) <= np.array(place.half) + MARGIN
        gap = abs(lowest - place.pos[2])
        # Compared by the lowest point, but the centre must be above: an object may sink in a little, not lie under a
        # board.
        if over.all() and gap < least and pose[2] > place.pos[2]:
            best = place
            least = gap
    return best


def file_targets(
    layout: Layout,
    home: Home,
    episode: HabEpisode,
    pose: np.ndarray,
    root: int,
    task: str,
) -> tuple[Target, ...]:
    """Return the targets of an episode, in order; links that the file does not name are found by geometry.

    Args:
        layout: the layout.
        home: home of the episode.
        episode: the episode.
        pose: (N, 7) poses of all object slots, world frame [m, wxyz].
        root: number of the root link, from `number_of_root`.
        task: household task, whose rules say which link the plan opens for a target.
    """
    places = placed_receptacles(layout, home)
    out = []
    rules = TASKS[task].targets
    for k, (name, rule) in enumerate(zip(episode.target_names, rules, strict=False)):
        slot = layout.object_names.index(name)
        goal = pose_from_hab(episode.targets[name], layout.objects[slot].scan_yaw)
        starts = _listed_link(layout, episode.target_receptacles, k, root)
        ends = _listed_link(layout, episode.goal_receptacles, k, root)
        start_link = starts or _link_around(layout, home, places, name, pose[slot])
        goal_link = ends or _link_around(layout, home, places, name, goal)
        opened = goal_link if rule.opens == "goal" else start_link
        handle = layout.closed_handle(home, opened) if opened else (0.0, 0.0, 0.0)
        out.append(
            Target(name, _point(goal), _point(pose[slot]), start_link, goal_link, handle)
        )
    return tuple(out)


def _listed_link(
    layout: Layout, listed: tuple[NumberedLink, ...], k: int, root: int
) -> str:
    """Return the id of the link that a file lists for target ``k``; "" if there is none in the layout."""
    if k >= len(listed) or listed[k][1] is None:
        return ""
    furniture = template_of(listed[k][0])
    link = f"{furniture}/{_link_name(layout, furniture, int(listed[k][1] or 0), root)}"
    return link if link in layout.link_ids else ""


def _link_around(
    layout: Layout,
    home: Home,
    places: tuple[PlacedReceptacle, ...],
    name: str,
    pose: np.ndarray,
) -> str:
    """Return the id of the link that must be open to reach an object at ``pose`` (7,), "" if there is none."""
    found = receptacle_at(layout, places, name, pose)
    return link_to_open(found, roles_of(layout.pack, home)) if found is not None else ""


def _point(pose: np.ndarray) -> Vec3:
    x, y, z = pose[:3].tolist()
    return (x, y, z)
