"""Episodes of the HAB tasks, each made from (task, split, seed, index) alone.

Objects and goals follow the HAB task definitions (habitat-lab hab/*.yaml): TidyHouse draws starts and goals from the
open receptacles, PrepareGroceries moves two objects from the fridge to the counter and one back, SetTable brings the
bowl from a drawer and the apple from the fridge to the table.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import cached_property
from pathlib import Path

import numpy as np

from mjhab.core.cache import cache_dir, write_atomic
from mjhab.core.errors import MjhabError, UsageError, unknown_name
from mjhab.core.names import below
from mjhab.core.seeding import stream
from mjhab.layout.compile import home_hash
from mjhab.layout.layout import Layout, yaw_quat
from mjhab.layout.receptacles import (
    PlacedReceptacle,
    link_to_open,
    placed_receptacles,
    with_role,
)
from mjhab.scenes.roles import (
    COUNTER_TOP,
    DINING_TABLE,
    DRAWER,
    FRIDGE_DOOR_LINK,
    FRIDGE_SHELF,
    KITCHEN_DRAWER_LINK,
    OPEN_SURFACE,
    link_with_role,
    require_roles,
    roles_of,
)
from mjhab.scenes.spec import Home, Pack, Roles, Vec3
from mjhab.sim.mujoco.cpu import CpuSimulator
from mjhab.sim.mujoco.settle import settle
from mjhab.tasks.plan import TARGETS_PER_TASK, Target

BOWL_DRAWER = "kitchen_counter/drawer3"
FRIDGE_DOOR = "fridge/top_door"
"""Links that play the roles `KITCHEN_DRAWER_LINK` and `FRIDGE_DOOR_LINK` in the built-in pack and in ReplicaCAD."""
NEEDED_ROLES = {
    "tidy_house": (OPEN_SURFACE,),
    "prepare_groceries": (FRIDGE_SHELF, FRIDGE_DOOR_LINK, COUNTER_TOP),
    "set_table": (FRIDGE_SHELF, FRIDGE_DOOR_LINK, DRAWER, KITCHEN_DRAWER_LINK, DINING_TABLE),
}
"""Roles of furniture for which a home must have a piece, by task."""
FRIDGE_PREOPEN = 1.5
"""Door angle [rad] of PrepareGroceries starts (HAB prepare_groceries, ao_states)."""
REGION_RATIO = {"set_table": 0.5, "prepare_groceries": 0.9}
"""Share of the fridge shelf, about its centre, in which objects stand. HAB's sample_region_ratio is 0.5; two targets
and the goal of a third do not fit into half of our shelf without touching."""
MIN_START_GOAL = 0.5
"""Smallest distance [m] between where an object starts and its goal (HAB generator constant)."""
GAP = 0.03
"""Free space [m] between the bounding circles of neighbours; a finger is 14 mm thick."""
TARGET_GAP = 0.06
SHELF_GAP = 0.02
MAX_SHELF_CLUTTER = {"tidy_house": 0, "prepare_groceries": 0, "set_table": 1}
MAX_DRIFT = 0.02
"""An object that settles further than this [m] from where it was put makes the draw invalid."""
MAX_SPEED = 0.05
_ATTEMPTS = 200
_VERSION = 3


@dataclass(frozen=True, eq=False)
class Episode:
    """A settled start and what to do. ``object_pose`` (N, 7) world; ``link_q`` (L,); ``targets`` in plan order."""

    task: str
    split: str
    seed: int
    index: int
    home: str
    object_pose: np.ndarray
    link_q: np.ndarray
    targets: tuple[Target, ...]


@dataclass
class _Draw:
    """Objects put so far: slot to (position, radius), in one home."""

    home: Home
    roles: Roles
    receptacles: tuple[PlacedReceptacle, ...]
    placed: dict[int, tuple[np.ndarray, float]]
    pose: np.ndarray

    def places(self, *names: str) -> list[PlacedReceptacle]:
        """The receptacles of the home that play one of some roles."""
        return with_role(self.receptacles, self.roles, *names)

    def on_shelf(self, place: PlacedReceptacle) -> bool:
        """Whether a receptacle is the fridge shelf, where there is little room."""
        return bool(with_role((place,), self.roles, FRIDGE_SHELF))

    def target_gap(self, place: PlacedReceptacle) -> float:
        """Free space [m] between the bounding circles of a target and of its neighbours on a receptacle."""
        return SHELF_GAP if self.on_shelf(place) else TARGET_GAP


class EpisodeMaker:
    """Makes and remembers the episodes of one task on one layout.

    Args:
        sim: the simulator whose compiled homes are used for settling.
        task: HAB task name.
        split: homes to draw from.
        home: name of one home to use always; or a pattern such as ``v3_sc0_staging_0?``, whose homes take turns:
            episode i is in the i-th of them, counted on from the start after the last; or "" to draw one of ``split``
            per episode.
        target: object type that must be among the targets, or "".
    """

    def __init__(
        self, sim: CpuSimulator, task: str, split: str, home: str = "", target: str = ""
    ) -> None:
        self.sim = sim
        self.task = task
        self.split = split
        self.target = target
        self.layout: Layout = sim.layout
        self.homes = (
            homes_named(self.layout.pack, home) if home else homes_of(self.layout.pack, split)
        )
        self._in_turn = bool(home)
        require_furniture(self.layout.pack, self.homes, task)

    def episode(self, seed: int, index: int) -> Episode:
        """The episode named by (seed, index); the same for everyone who asks.

        Raises:
            MjhabError: when no stable arrangement is found in a bounded number of draws.
        """
        path = self._path(seed, index)
        if path.exists():
            return self._load(path, seed, index)
        episode, _ = self.make(seed, index)
        self._save(path, episode)
        return episode

    def make(self, seed: int, index: int) -> tuple[Episode, int]:
        """The episode named by (seed, index), made now, and how many draws were rejected before it.

        Raises:
            MjhabError: when no stable arrangement is found in a bounded number of draws.
        """
        for attempt in range(_ATTEMPTS):
            episode = self._draw(seed, index, attempt)
            if episode is not None:
                return episode, attempt
        raise MjhabError(
            f"no stable start for {self.task} episode {index} of seed {seed} in {_ATTEMPTS} draws"
        )

    def _draw(self, seed: int, index: int, attempt: int) -> Episode | None:
        # The home is drawn apart from the attempts: a home where placing is hard stays as likely as the others.
        home = self._home(seed, index)
        rng = stream(seed, "episode", self.task, self.split, index, attempt)
        receptacles = placed_receptacles(self.layout, home)
        roles = roles_of(self.layout.pack, home)
        draw = _Draw(home, roles, receptacles, {}, self.layout.parked_poses.copy())
        targets = self._place_targets(rng, draw)
        if targets is None or not self._place_clutter(
            rng, draw, {self._slot(t.obj) for t in targets}
        ):
            return None
        qpos = self.sim.model(home.name).qpos0.copy()
        a = self.sim.addresses
        qpos[a.object_q[:, None] + np.arange(7)] = draw.pose
        if self.task == "prepare_groceries":
            door = link_with_role(roles, FRIDGE_DOOR_LINK)
            qpos[a.link_q[self.layout.link_ids.index(door)]] = FRIDGE_PREOPEN
        settled, speed = settle(self.sim.model(home.name), a, qpos)
        pose = settled[a.object_q[:, None] + np.arange(7)]
        if (
            speed > MAX_SPEED
            or np.linalg.norm(pose[:, :3] - draw.pose[:, :3], axis=1).max() > MAX_DRIFT
        ):
            return None
        return Episode(
            self.task, self.split, seed, index, home.name, pose, settled[a.link_q], targets
        )

    def _home(self, seed: int, index: int) -> Home:
        if self._in_turn:
            return self.homes[index % len(self.homes)]
        return self.homes[
            int(stream(seed, "home", self.task, self.split, index).integers(len(self.homes)))
        ]

    # -- where things go -------------------------------------------------------------------------------------------

    def _slot(self, name: str) -> int:
        return self.layout.object_names.index(name)

    def _place_targets(self, rng: np.random.Generator, draw: _Draw) -> tuple[Target, ...] | None:
        if self.task == "set_table":
            return self._set_table(rng, draw)
        if self.task == "prepare_groceries":
            return self._groceries(rng, draw)
        open_places = draw.places(OPEN_SURFACE)
        return self._targets(rng, draw, [(s, open_places, open_places) for s in self._slots(rng)])

    def _slots(self, rng: np.random.Generator) -> list[int]:
        """Target slots at random; with a wanted object type, one of them is of that type."""
        count = TARGETS_PER_TASK[self.task]
        slots = [int(s) for s in rng.choice(self.layout.num_objects, count, replace=False)]
        wanted = [i for i, kind in enumerate(self.layout.roster) if kind == self.target]
        if wanted and not any(self.layout.roster[s] == self.target for s in slots):
            slots[int(rng.integers(count))] = int(rng.choice(wanted))
        return slots

    def _set_table(self, rng: np.random.Generator, draw: _Draw) -> tuple[Target, ...] | None:
        last = {kind: slot for slot, kind in enumerate(self.layout.roster)}
        bowl = last["024_bowl"]
        apple = last["013_apple"]
        drawer = draw.places(DRAWER)
        table = draw.places(DINING_TABLE)
        shelf = draw.places(FRIDGE_SHELF)
        return self._targets(rng, draw, [(bowl, drawer, table), (apple, shelf, table)])

    def _groceries(self, rng: np.random.Generator, draw: _Draw) -> tuple[Target, ...] | None:
        slots = self._slots(rng)
        shelf = draw.places(FRIDGE_SHELF)
        tops = draw.places(COUNTER_TOP)
        return self._targets(
            rng, draw, [(slots[0], shelf, tops), (slots[1], shelf, tops), (slots[2], tops, shelf)]
        )

    def _targets(
        self,
        rng: np.random.Generator,
        draw: _Draw,
        wanted: list[tuple[int, list[PlacedReceptacle], list[PlacedReceptacle]]],
    ) -> tuple[Target, ...] | None:
        starts: list[PlacedReceptacle] = []
        for slot, places, _ in wanted:
            put = self._put(rng, draw, slot, places, draw.target_gap(places[0]))
            if put is None:
                return None
            starts.append(put)
        goals: list[tuple[np.ndarray, float]] = []
        targets = []
        for (slot, _, places), start in zip(wanted, starts, strict=True):
            goal = self._goal(rng, draw, slot, places, goals)
            if goal is None:
                return None
            where, pos = goal
            goals.append((pos, self._radius(slot)))
            # Goals stay free: clutter keeps away from them as from an object.
            draw.placed[-len(goals)] = goals[-1]
            targets.append(self._target(draw, slot, start, where, pos))
        return tuple(targets)

    def _target(
        self,
        draw: _Draw,
        slot: int,
        start: PlacedReceptacle,
        where: PlacedReceptacle,
        goal: np.ndarray,
    ) -> Target:
        link = link_to_open(start, draw.roles)
        return Target(
            obj=self.layout.object_names[slot],
            goal_pos=tuple(goal.tolist()),
            start_pos=tuple(draw.placed[slot][0].tolist()),
            start_link=link,
            goal_link=link_to_open(where, draw.roles),
            handle_pos=self.layout.closed_handle(draw.home, link) if link else (0.0, 0.0, 0.0),
        )

    def _radius(self, slot: int) -> float:
        return float(np.hypot(*self.layout.objects[slot].half[:2]))

    def _sample(
        self,
        rng: np.random.Generator,
        draw: _Draw,
        place: PlacedReceptacle,
        radius: float,
        half_z: float,
    ) -> np.ndarray | None:
        if 2 * half_z + 0.02 > place.height:
            return None
        ratio = REGION_RATIO[self.task] if draw.on_shelf(place) else 1.0
        room = ratio * np.maximum(np.array(place.half) - radius - 0.01, 0.0)
        if min(place.half) < radius * 0.75:
            return None
        u, v = rng.uniform(-room, room)
        return place.point(u, v) + np.array([0.0, 0.0, half_z])

    def _put(
        self,
        rng: np.random.Generator,
        draw: _Draw,
        slot: int,
        places: list[PlacedReceptacle],
        gap: float,
    ) -> PlacedReceptacle | None:
        radius = self._radius(slot)
        half_z = self.layout.objects[slot].half[2]
        weights = np.array([4 * r.half[0] * r.half[1] for r in places])
        for _ in range(60):
            place = places[int(rng.choice(len(places), p=weights / weights.sum()))]
            pos = self._sample(rng, draw, place, radius, half_z)
            if pos is None or not self._is_free(draw, pos, radius, gap):
                continue
            draw.placed[slot] = (pos, radius)
            draw.pose[slot, :3] = pos + np.array([0.0, 0.0, 0.001])
            draw.pose[slot, 3:] = yaw_quat(float(rng.uniform(-np.pi, np.pi)))
            return place
        return None

    def _goal(
        self,
        rng: np.random.Generator,
        draw: _Draw,
        slot: int,
        places: list[PlacedReceptacle],
        others: list[tuple[np.ndarray, float]],
    ) -> tuple[PlacedReceptacle, np.ndarray] | None:
        radius = self._radius(slot)
        half_z = self.layout.objects[slot].half[2]
        weights = np.array([4 * r.half[0] * r.half[1] for r in places])
        start = draw.placed[slot][0]
        for _ in range(100):
            place = places[int(rng.choice(len(places), p=weights / weights.sum()))]
            pos = self._sample(rng, draw, place, radius, half_z)
            if pos is None or np.linalg.norm(pos - start) < MIN_START_GOAL:
                continue
            if self._is_free(draw, pos, radius, draw.target_gap(place)):
                return place, pos
        return None

    @staticmethod
    def _is_free(draw: _Draw, pos: np.ndarray, radius: float, gap: float) -> bool:
        return all(
            abs(p[2] - pos[2]) > 0.35 or np.hypot(*(p[:2] - pos[:2])) > r + radius + gap
            for p, r in draw.placed.values()
        )

    def _place_clutter(self, rng: np.random.Generator, draw: _Draw, targets: set[int]) -> bool:
        in_shelf = 0
        for slot in range(self.layout.num_objects):
            if slot in targets:
                continue
            shelf = (FRIDGE_SHELF,) if in_shelf < MAX_SHELF_CLUTTER[self.task] else ()
            put = self._put(rng, draw, slot, draw.places(OPEN_SURFACE, *shelf), GAP)
            if put is None:
                return False
            in_shelf += draw.on_shelf(put)
        return True

    # -- memory ----------------------------------------------------------------------------------------------------

    @cached_property
    def digest(self) -> str:
        """Hash of everything an episode depends on besides its name: homes, objects, code that compiles them."""
        shared = home_hash(self.layout, self.homes[0])
        return hashlib.sha256(
            repr((_VERSION, shared, self.homes, self._in_turn)).encode()
        ).hexdigest()[:16]

    def _path(self, seed: int, index: int) -> Path:
        name = f"{self.task}{self.target}-{self.split}-{seed}-{index}.npz"
        return below(cache_dir() / "episodes" / self.digest, name)

    def _save(self, path: Path, episode: Episode) -> None:
        rows = np.array([(t.obj, t.start_link, t.goal_link) for t in episode.targets])
        goals = np.array([(t.goal_pos, t.start_pos, t.handle_pos) for t in episode.targets])
        arrays = {
            "home": np.array(episode.home),
            "object_pose": episode.object_pose,
            "link_q": episode.link_q,
            "targets": rows,
            "goals": goals,
        }
        write_atomic(path, lambda temporary: np.savez(temporary, allow_pickle=False, **arrays))

    def _load(self, path: Path, seed: int, index: int) -> Episode:
        with np.load(path, allow_pickle=False) as data:
            targets = tuple(
                Target(
                    str(obj),
                    _point(goal),
                    _point(start_pos),
                    str(start),
                    str(where),
                    _point(handle),
                )
                for (obj, start, where), (goal, start_pos, handle) in zip(
                    data["targets"], data["goals"], strict=True
                )
            )
            # Copies: what comes out of the file is a view of a buffer 20 times its size, and pools keep a thousand.
            pose = data["object_pose"].copy()
            link_q = data["link_q"].copy()
            return Episode(
                self.task, self.split, seed, index, str(data["home"]), pose, link_q, targets
            )


def homes_of(pack: Pack, split: str) -> list[Home]:
    """Homes of a split.

    Raises:
        UsageError: there is none.
    """
    found = [home for home in pack.homes if home.split == split]
    if not found:
        raise UsageError(f"pack {pack.name!r} has no home in split {split!r}")
    return found


def homes_named(pack: Pack, pattern: str) -> list[Home]:
    """Homes whose name is ``pattern``, or fits it as file names fit ``*``, ``?`` and ``[...]``.

    Raises:
        UsageError: there is none.
    """
    found = [home for home in pack.homes if fnmatchcase(home.name, pattern)]
    if not found:
        raise unknown_name("home", pattern, [home.name for home in pack.homes])
    return found


def require_furniture(pack: Pack, homes: Iterable[Home], task: str) -> None:
    """Refuse homes of a pack that lack furniture a task needs.

    Raises:
        UsageError: names the role of the furniture, and the homes that lack it.
    """
    require_roles(pack, homes, NEEDED_ROLES[task], f"task {task!r}")


def _point(row: np.ndarray) -> Vec3:
    x, y, z = row.tolist()
    return (x, y, z)
