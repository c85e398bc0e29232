"""Make task plans, episodes and spawn data of mjhab's own in MS-HAB's layout, so that its scripts need no download.

Below a folder, which takes the place of ``scene_datasets/replica_cad_dataset/rearrange`` of the original's assets:

- ``task_plans/<task>/<subtask>/<split>/all.json``, and ``<object or furniture>.json`` with those of one target
- ``task_plans/<task>/sequential/<split>/all.json``: whole tasks
- ``spawn_data/<task>/<subtask>/<split>/spawn_data.pt``: one spawn of every plan
- ``grasp_poses/<task>/<object>/grasp_poses.pt``: the grasps that Place starts from
- ``<split>/<task>/episode_<n>.json``: the episodes
- ``configs/scenes/<scene>.fetch.navigable_positions*``: with plans of Navigate, where the base can stand in their homes
"""

from __future__ import annotations

import dataclasses
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mjhab.compat.mshab.files.init_configs import init_config_name, write_init_config
from mjhab.compat.mshab.files.matching import (
    SCENE_SUFFIX,
    home_of,
    subtask_in_files,
)
from mjhab.compat.mshab.files.navigable import FOLDER, write_map
from mjhab.compat.mshab.files.plans import (
    MsHabTaskPlan,
    PlanData,
    write_plan_data,
)
from mjhab.compat.mshab.files.spawn_data import (
    Spawns,
    write_grasp_poses,
    write_spawn_data,
)
from mjhab.compat.mshab.files.spawned_states import SpawnedStates
from mjhab.compat.mshab.files.subtasks import (
    MsHabSubtask,
    NavigateSubtask,
    PlaceSubtask,
)
from mjhab.config.env import EnvConfig
from mjhab.config.thresholds import task_config
from mjhab.core.errors import unknown_name
from mjhab.core.names import kind_of
from mjhab.core.rotations import pose_mul, quat_from_yaw
from mjhab.data.imports.ms_hab_layout import dataset_name
from mjhab.episodes.source import EpisodeSource, open_setting
from mjhab.episodes.starts import StartMaker
from mjhab.episodes.zones import receptacle_below, zone
from mjhab.layout.receptacles import placed_receptacles
from mjhab.scenes.freespace import shared_map
from mjhab.scenes.spec import Home
from mjhab.sim.mujoco.cpu import CpuSimulator
from mjhab.tasks.household.registry import TASKS, chain
from mjhab.tasks.subtasks.registry import SUBTASKS

SEQUENTIAL = "sequential"
"""Name of whole tasks among the subtasks."""
SPAWN_FILE = "spawn_data.pt"


@dataclass(frozen=True)
class MadePlans:
    """What was written.

    plans: number of task plans. files: of plans, spawns, grasps and maps. episodes: number of their files. left_out:
    plans that have no valid spawn, or whose object is too wide for the gripper.
    """

    plans: int
    files: tuple[Path, ...]
    episodes: int
    left_out: int


@dataclass(frozen=True, eq=False)
class _Planned:
    """A plan of one subtask of an episode, and its spawn."""

    subtask: MsHabSubtask
    entry: Spawns
    target: str


@dataclass(frozen=True, eq=False)
class _EpisodePlans:
    """What one episode gives: its scene and file, plans by kind of subtask, the whole task, plans left out."""

    scene: str
    name: str
    singles: dict[str, list[_Planned]]
    whole: list[MsHabSubtask]
    left_out: int


def make_plans(
    config: EnvConfig,
    out: Path,
    count: int,
    subtasks: Sequence[str] = (),
    threads: int = 1,
    tell: Callable[[], object] | None = None,
) -> MadePlans:
    """Write the plans of episodes 0 to ``count - 1``, and everything that they name.

    Args:
        config: task, split, seed, assets, homes and rule of the spawns; without subtask.
        out: folder.
        count: number of episodes.
        subtasks: kinds to write, "sequential" for whole tasks; empty for all.
        threads: number of threads; does not change the files.
        tell: called after each episode.

    Raises:
        UsageError: the task has no such subtask, or a home has no room for the objects.
    """
    factory = _Factory(config, out, subtasks)

    def made(index: int) -> _EpisodePlans:
        found = factory.make(index)
        if tell is not None:
            tell()
        return found

    with ThreadPoolExecutor(threads) as pool:
        # map keeps the order, so that the numbers in uids do not depend on threads.
        parts = list(pool.map(made, range(count)))
    files: list[Path] = []
    plans = 0
    for kind in factory.starts:
        singles = [(part, one) for part in parts for one in part.singles[kind]]
        plans += len(singles)
        files += factory.write_singles(kind, singles)
    if factory.with_whole:
        plans += len(parts)
        files.append(factory.write_whole(parts))
    files += factory.write_grasps()
    if "navigate" in factory.starts:
        files += factory.write_maps(dict.fromkeys(part.scene for part in parts))
    left_out = sum(part.left_out for part in parts)
    return MadePlans(plans, tuple(files), len(parts), left_out)


def written_before(config: EnvConfig, out: Path, subtasks: Sequence[str]) -> list[Path]:
    """Files of plans in a folder that `make_plans` would replace."""
    kinds = subtasks or (*TASKS[config.task].subtasks, SEQUENTIAL)
    places = (out / "task_plans" / config.task / kind / config.split for kind in kinds)
    return [path for place in places for path in sorted(place.glob("*.json"))]


class _Factory:
    """Makes and writes the plans of episodes. `make` may run in several threads."""

    def __init__(self, config: EnvConfig, out: Path, subtasks: Sequence[str]) -> None:
        self.config = config
        self.out = out
        kinds = (*TASKS[config.task].subtasks, SEQUENTIAL)
        for name in subtasks:
            if name not in kinds:
                raise unknown_name("subtask of the plans", name, kinds)
        wanted = [name for name in kinds if not subtasks or name in subtasks]
        self.with_whole = SEQUENTIAL in wanted
        setting = open_setting(config)
        self.layout = setting.layout
        self.sim = CpuSimulator(self.layout, 1, 1)
        thresholds = task_config(config, self.layout.robot)
        self.source = EpisodeSource(self.sim, config, thresholds, setting.file)
        self.starts: dict[str, StartMaker] = {}
        for name in wanted:
            if name != SEQUENTIAL:
                own = dataclasses.replace(config, subtask=name)
                limits = task_config(own, self.layout.robot)
                self.starts[name] = StartMaker(self.sim, own, limits)

    def make(self, index: int) -> _EpisodePlans:
        """Make the plans of an episode, and write its file."""
        config = self.config
        episode = self.source.episode(config.seed, index)
        home = self.layout.pack.homes_by_name[episode.home]
        name = init_config_name(config.task, config.split, index)
        write_init_config(self.out, name, self.layout, episode)
        plan = chain(episode.task, episode.targets, episode.home)
        singles: dict[str, list[_Planned]] = {kind: [] for kind in self.starts}
        whole: list[MsHabSubtask] = []
        left_out = 0
        for position, own in enumerate(plan.subtasks):
            subtask = subtask_in_files(self.layout, plan, position)
            if isinstance(subtask, PlaceSubtask):
                subtask.goal_rectangle_corners = self._corners(home, own.goal_pos)
            whole.append(
                NavigateSubtask()
                if subtask is None or subtask.type == "navigate"
                # A copy: in the plan of the whole task it has another uid than alone.
                else dataclasses.replace(subtask)
            )
            starts = self.starts.get(own.name)
            if subtask is None or starts is None:
                continue
            start = None
            if starts.holdable(own):
                start = starts.start_at(episode, plan, position)
            if start is None or start.fallback:
                left_out += 1
                continue
            about = own.link if SUBTASKS[own.name].jointed else own.obj
            target = "" if subtask.type == "navigate" else kind_of(about).split("/")[0]
            entry = SpawnedStates(starts).entry(episode, subtask, start.qpos)
            singles[own.name].append(_Planned(subtask, entry, target))
        return _EpisodePlans(f"{home.name}{SCENE_SUFFIX}", name, singles, whole, left_out)

    def _corners(self, home: Home, goal: tuple[float, float, float]) -> list[list[float]]:
        """Corners of the surface below a goal [m], world frame, in order around it."""
        receptacles = placed_receptacles(self.layout, home)
        below = receptacle_below(goal, receptacles)
        height = goal[2] if below is None else float(below.pos[2])
        tolerance = self.source.task_config.goal_tol
        return [[x, y, height] for x, y in zone(goal, receptacles, tolerance)]

    def write_singles(
        self, kind: str, singles: Sequence[tuple[_EpisodePlans, _Planned]]
    ) -> list[Path]:
        """Write the plans of a kind of subtask, all and by target, and their spawns."""
        plans: dict[str, list[MsHabTaskPlan]] = defaultdict(list)
        spawns: dict[str, Spawns] = {}
        for number, (part, one) in enumerate(singles):
            self._name(one.subtask, kind, number, 0)
            spawns[one.subtask.uid] = one.entry
            plan = MsHabTaskPlan([one.subtask], part.scene, part.name)
            for target in filter(None, ("all", one.target)):
                plans[target].append(plan)
        files = [self._write_plans(kind, target, own) for target, own in plans.items()]
        if spawns:
            place = (self.config.task, kind, self.config.split, SPAWN_FILE)
            files.append(self.out.joinpath("spawn_data", *place))
            write_spawn_data(files[-1], spawns)
        return files

    def write_whole(self, parts: Sequence[_EpisodePlans]) -> Path:
        """Write the plans of whole tasks."""
        plans = []
        for number, part in enumerate(parts):
            for position, subtask in enumerate(part.whole):
                self._name(subtask, SEQUENTIAL, number, position)
                if hasattr(subtask, "remove_obj_id"):
                    # What was placed is on the table, not in the drawer.
                    subtask.remove_obj_id = None  # type: ignore[attr-defined]
            plans.append(MsHabTaskPlan(part.whole, part.scene, part.name))
        return self._write_plans(SEQUENTIAL, "all", plans)

    def write_grasps(self) -> list[Path]:
        """Write the postures with a held object that Place starts from, by object."""
        starts = self.starts.get("place")
        if starts is None or not starts.published:
            return []
        files = []
        types = TASKS[self.config.task].object_types or sorted(set(self.layout.roster))
        robot = self.layout.robot
        for kind in types:
            if not starts.held.holds(kind):
                continue
            yaw = self.layout.pack.objects[kind].scan_yaw
            # Poses in files are in the axes of the object's scan.
            turn = np.concatenate([np.zeros(3), quat_from_yaw(np.asarray(yaw))])
            arms = starts.arms.arms(kind)
            joints = np.tile(robot.rest, (len(arms), 1))
            for row, posture in zip(joints, arms, strict=True):
                row[list(robot.arm_columns)] = posture.arm
                row[robot.columns.fingers] = posture.grasp.fingers
            poses = np.array([pose_mul(arm.grasp.pose, turn) for arm in arms])
            place = ("grasp_poses", self.config.task, kind, "grasp_poses.pt")
            files.append(self.out.joinpath(*place))
            write_grasp_poses(files[-1], joints, poses)
        return files

    def write_maps(self, scenes: Iterable[str]) -> list[Path]:
        """Write the navigable positions of homes."""
        pack = self.layout.pack
        files: list[Path] = []
        for scene in scenes:
            free = shared_map(pack.homes_by_name[home_of(scene)], pack)
            files += write_map(self.out / FOLDER, scene, free)
        return files

    def _name(self, subtask: MsHabSubtask, kind: str, number: int, position: int) -> None:
        config = self.config
        subtask.uid = f"{config.task}-{kind}-{config.split}-{number}-{position}"
        subtask.composite_subtask_uids = [subtask.uid]

    def _write_plans(self, kind: str, target: str, plans: list[MsHabTaskPlan]) -> Path:
        config = self.config
        place = ("task_plans", config.task, kind, config.split, f"{target}.json")
        path = self.out.joinpath(*place)
        write_plan_data(path, PlanData(dataset_name(config.task, config.split), plans))
        return path
