"""SequentialTask: vector environment of household tasks, or of single subtasks, on the CPU backend."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium.vector import VectorEnv

from mjhab.config.env import DENSE_MODES, EnvConfig
from mjhab.core.arrays import Array, may_hold
from mjhab.core.joints import BASE_XY
from mjhab.envs.host_sensing import HostSensing
from mjhab.envs.loop import TaskLoop
from mjhab.envs.parts.memory import check_memory
from mjhab.envs.parts.nav_distance import GoalPaths, NavDistance
from mjhab.envs.parts.observing import Observer
from mjhab.envs.parts.perturbing import Perturber
from mjhab.envs.parts.plan_tables import PlanTables
from mjhab.envs.parts.reporting import Reporter
from mjhab.envs.parts.reset_request import indices_of, seeds_of
from mjhab.envs.parts.sensing import Sensing
from mjhab.envs.parts.snapshots import Restorable, restore, snapshot
from mjhab.envs.parts.teleport import Teleports
from mjhab.envs.parts.tracking import StepNotes, Tracker
from mjhab.envs.parts.world_view import WorldView
from mjhab.episodes.episode import Episode
from mjhab.episodes.perturbing import as_perturbed
from mjhab.episodes.source import EpisodeSource, open_setting
from mjhab.episodes.starts import Start
from mjhab.robots.controllers import check_actions
from mjhab.sim.mujoco.cpu import CpuSimulator
from mjhab.tasks.host_checks import HostBodyCheck
from mjhab.tasks.measure import measure
from mjhab.tasks.progress import Progress, StepOutcome
from mjhab.tasks.signals import Signals, WorldState

INDEX_STRIDE = 1 << 20
"""Without explicit indices, the k-th episode of world i has the index i * stride + k."""


class SequentialTaskEnv(TaskLoop, VectorEnv):
    """HAB tasks on the CPU simulator. Build it with `mjhab.envs.make` or `make_train`.

    Observations: the rows of `observer.table`, among them ``state``. Actions: (W, A), see ``action_table``.
    Reward: by ``config.reward``; "pointer" is the subtask pointer, as in MS-HAB.

    The k-th episode of world i since its seed was set depends on (its seed, i, k) only. The seed of `reset` is one
    number for all worlds or (W,) numbers. `info` also has (W,) arrays of objects: "events" (list of the names of the
    events of this step), "ended" (record of the subtask that ended in this step, or None), "instruction" (sentence for
    the active subtask; for the last one once the plan is finished), and "episode_spec" (description of the episode; the
    key "episode" is left to Gymnasium's RecordEpisodeStatistics).
    """

    observer: Observer
    tables: PlanTables
    tracker: Tracker

    def __init__(self, config: EnvConfig) -> None:
        # First: a machine that runs out of memory kills the process without a word.
        check_memory(config.num_envs)
        super().__init__(config, np.zeros(0))
        setting = open_setting(config)
        drives = self.controller.drives
        self.sim = CpuSimulator(setting.layout, config.num_envs, config.threads, drives)
        self._check_body = HostBodyCheck(self.task_config)
        self.source = EpisodeSource(self.sim, config, self.task_config, setting.file)
        self.starts = self.source.starts
        self.nav: GoalPaths = NavDistance(
            setting.layout, self.num_envs, self.starts.sampler.map
        )
        self._make_parts(lambda inputs: self.nav.at(inputs.world.base_pose[:, BASE_XY]))
        self.observer = Observer(
            self.sim,
            self.sensing,
            config.obs_mode,
            config.cameras,
            config.camera_size,
            config.threads,
            # Otherwise a step alone resets worlds, and tells which.
            remembers=config.autoreset == "disabled",
            shading=config.path_shading,
        )
        length = self.source.plan_length
        self.tables = PlanTables(self.layout, self.task_config, self.num_envs, length)
        self.tracker = Tracker(self.num_envs, self.config.teleports)
        self.teleports = Teleports(self.starts, self.sensing, self.tables)
        self.perturber = Perturber(
            config.perturbations, self.layout.robot, self.controller, self.num_envs
        )
        if self.perturber.sees:
            self.observer.perturber = self.perturber
        self.reporter = Reporter(self.num_envs, self.layout, config)
        self._set_spaces(self.observer.single_space, render_modes=["rgb_array"])
        self.episodes_now: list[Episode | None] = [None] * self.num_envs
        # Some home, until the first reset gives each world its own.
        self.homes = [self.layout.pack.homes[0].name] * self.num_envs
        self.boxes: list[dict] = [{} for _ in range(self.num_envs)]
        self.seeds = np.full(self.num_envs, config.seed, np.int64)
        self._init_worlds()

    # -- episodes --------------------------------------------------------------------------------------------------

    def _reseed(self, seed: Any, mask: np.ndarray) -> None:
        if seed is None:
            return
        seeds = seeds_of(seed, self.num_envs)
        for world in np.flatnonzero(mask).tolist():
            own = seeds[world]
            if own is not None:
                self.seeds[world] = own
                # Episodes of a seed count from its first, whatever was run before.
                self.count[world] = 0

    def _next_episodes(self) -> np.ndarray:
        return self._worlds * INDEX_STRIDE + self.count

    def _chosen_episodes(self, wanted: Any, mask: np.ndarray) -> np.ndarray:
        worlds = np.flatnonzero(mask)
        indices = np.zeros(self.num_envs, np.int64)
        indices[worlds] = indices_of(wanted, len(worlds))
        return indices

    def _adopt(self, fresh: np.ndarray, episodes: np.ndarray) -> None:
        worlds = np.flatnonzero(fresh).tolist()
        wanted = [(int(self.seeds[w]), int(episodes[w])) for w in worlds]
        made = self.source.episodes(wanted, self.sim.num_threads)
        starts = []
        # The last one may be in an info that was returned.
        self.fallback = self.fallback.copy()
        for world, episode in zip(worlds, made, strict=True):
            start = self.adopt(world, episode)
            self.fallback[world] = start.fallback
            starts.append(start)
        self.sim.reset(
            worlds, [s.home for s in starts], np.stack([s.qpos for s in starts])
        )
        self.state = self.sim.state()

    def make_episode(self, seed: int, index: int) -> Episode:
        """Make the episode ``index`` of a seed."""
        return self.source.episode(seed, index)

    def episode_spec(self, world: int) -> Mapping[str, Any] | None:
        """Read-only description of a world's episode, see `describe_episode`; None before the first reset."""
        return self.reporter.describe(
            world, self.episodes_now[world], self.tables.plans[world]
        )

    def wordings(self, world: int) -> tuple[tuple[str, ...], ...]:
        """All sentences that ask for each subtask of a world's episode; one of them is its instruction."""
        episode = self.episodes_now[world]
        assert episode is not None, "wordings are those of an episode"
        return self.reporter.wordings(episode, self.tables.plans[world])

    def adopt(self, world: int, episode: Episode) -> Start:
        """Set home and plan of a world to those of an episode; returns the start state, which is not applied yet."""
        start = self.source.start(episode)
        self.episodes_now[world] = as_perturbed(episode, start)
        if self.perturber.plan:
            self.perturber.begin(world, episode.seed, episode.index)
        self.homes[world] = start.home
        self.boxes[world] = start.boxes
        self.tables.set_row(world, start.plan, start.boxes)
        return start

    def _place(self, fresh: np.ndarray, moved: np.ndarray) -> np.ndarray:
        if not self.config.teleports:
            return fresh
        self.teleports.begin(fresh | moved, self.focus.navigates)
        changed = fresh
        if may_hold(self.teleports.waiting):
            pointer = self.progress.pointer
            changed = fresh.copy()
            for teleport_pose in self.teleports.run(
                self.sim.qpos, self.state, pointer, self.episodes_now
            ):
                self.sim.write_qpos(teleport_pose.world, teleport_pose.qpos)
                changed[teleport_pose.world] = True
                if teleport_pose.fallback:
                    self.fallback = self.fallback | (self._worlds == teleport_pose.world)
        return changed

    def _enter_subtask(self, mask: np.ndarray) -> None:
        # Before the rewards, which read the way at the start of the subtask.
        self._find_ways(mask)
        super()._enter_subtask(mask)

    def _find_ways(self, mask: np.ndarray) -> None:
        """Compute distance fields to the goals of the navigating worlds in ``mask`` (W,), if the reward is dense."""
        if self.config.reward in DENSE_MODES:
            for w in np.flatnonzero(mask & self.focus.navigates).tolist():
                self.nav.begin(w, self.homes[w], self.focus.active.goal_pos[w, :2])

    # -- step ------------------------------------------------------------------------------------------------------

    def _checked(self, actions: Any) -> np.ndarray:
        # A copy, because the caller may modify its array later.
        return check_actions(actions, self.action_table, self.num_envs).copy()

    def _advance_physics(self, actions: np.ndarray) -> np.ndarray:
        if self.perturber.plan:
            still = self.controller.still(self.state, self.grip)
            actions = self.perturber.step(actions, still)
        return super()._advance_physics(actions)

    def _simulate(self, ctrl: np.ndarray) -> np.ndarray:
        # To go back to in worlds that become NaN in this step.
        before = self.sim.qpos.copy()
        self.sim.step(ctrl)
        broken = self.sim.broken()
        if may_hold(broken):
            worlds = np.flatnonzero(broken).tolist()
            self.sim.mend(worlds, [self.homes[w] for w in worlds], before[worlds])
        # The simulator clears its mask in the next step.
        return broken.copy()

    def _sensing_class(self) -> type[Sensing]:
        return HostSensing

    def _measure(self, world: WorldState, progress: Progress) -> Signals:
        plan = self.tables.arrays
        active = self.focus.active
        signals = measure(
            world, plan, progress, self.task_config, active, self._check_body
        )
        waiting = self.teleports.waiting
        if not may_hold(waiting):
            return signals
        # A Navigate that waits for its teleport has not succeeded, even if the robot is at the goal by chance.
        return dataclasses.replace(signals, success=signals.success & ~waiting)

    def _note(
        self, signals: Signals, outcome: StepOutcome, progress: Progress
    ) -> StepNotes:
        events = self.tracker.update(signals, progress)
        ended = self.tracker.ended(signals, outcome, progress, self.tables.plans)
        return StepNotes(events, ended)

    def _nothing(self) -> StepNotes:
        return StepNotes([[] for _ in range(self.num_envs)], [None] * self.num_envs)

    def _observe(
        self, known: dict[str, Array] | None = None, changed: Array | None = None
    ) -> dict:
        assert self.signals is not None
        return self.observer.observe(
            self.state, self.focus, self.signals, self.homes, known, changed
        )

    def _info(self, events: StepNotes) -> dict[str, Any]:
        about = self.reporter.entries(
            self.episodes_now, self.tables.plans, self.progress.pointer
        )
        return super()._info(events) | about

    def timed_methods(self) -> dict[str, list[tuple[Any, str]]]:
        """See `TaskLoop.timed_methods`."""
        return super().timed_methods() | {
            "labels": [(self.tracker, "update"), (self.tracker, "ended")],
            "render": [(self.observer, "draw")],
            "observe": [(self.observer, "observe")],
            "reset": [(self, "_restart")],
        }

    # -- states and pictures ---------------------------------------------------------------------------------------

    def get_state(self, world: int) -> dict[str, Any]:
        """Copy the full state of one world as a nested dict of plain data, see `snapshots.snapshot`.

        Raises:
            UsageError: the world has not been reset yet.
        """
        return snapshot(self, world)

    def set_state(self, world: int, state: dict[str, Any]) -> None:
        """Restore one world from ``get_state``; other worlds are not changed. See `snapshots.restore`.

        Raises:
            UsageError: the state belongs to another layout, or its episode does not exist here.
        """
        restore(self, world, state)
        # Distance fields are not part of a state: they follow from home and goal.
        self._find_ways(np.arange(self.num_envs) == world)

    def restorable_parts(self) -> Mapping[str, Restorable]:
        """Parts with state of their own, by their keys in a snapshot."""
        parts: dict[str, Restorable] = {
            "tracker": self.tracker,
            "controller": self.controller,
            "rewarder": self.rewarder,
            "pending": self.teleports,
        }
        # Left out where nothing is perturbed: the bytes of recorded states stay what they were.
        return parts | ({"perturber": self.perturber} if self.perturber.plan else {})

    def get_columns(self, world: int) -> dict[str, Any]:
        """State of a world that the environment itself holds, by its keys in a snapshot."""
        return {
            "next": {"seed": int(self.seeds[world]), "count": int(self.count[world])},
            "flags": {
                "fallback": bool(self.fallback[world]),
                "success": bool(self.success[world]),
                "fail": bool(self.fail[world]),
            },
            "joint_start": float(self.joint_start[world]),
            "grip": float(self.grip[world]),
        }

    def set_columns(self, world: int, columns: Mapping[str, Any]) -> None:
        """Restore a world from a snapshot; with "next_step" a reset is due if its episode has ended."""
        flags = columns["flags"]
        ended = bool(columns["progress"]["done"])
        due = ended and self.config.autoreset == "next_step"
        self.seeds[world] = columns["next"]["seed"]
        self.count = _with_entry(self.count, world, columns["next"]["count"])
        self.fallback = _with_entry(self.fallback, world, flags["fallback"])
        self.success = _with_entry(self.success, world, flags["success"])
        self.fail = _with_entry(self.fail, world, flags["fail"])
        self.due = _with_entry(self.due, world, due)
        self.joint_start = _with_entry(self.joint_start, world, columns["joint_start"])
        self.grip = _with_entry(self.grip, world, columns["grip"])

    def render_world(self, world: int, width: int = 480, height: int = 360) -> np.ndarray:
        """Human view (H, W, 3) uint8 of one world."""
        return self.render_worlds([world], width, height)[0]

    def render_worlds(
        self, worlds: Sequence[int], width: int = 480, height: int = 360
    ) -> np.ndarray:
        """Human views (n, H, W, 3) uint8 of n worlds, drawn by several threads."""
        homes = [self.homes[world] for world in worlds]
        return self.observer.renderer.follow_views(
            self.state, homes, worlds, width, height
        )

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Human views (H, W, 3) uint8 of all worlds, or None without a render mode."""
        return (
            tuple(self.render_worlds(range(self.num_envs))) if self.render_mode else None
        )

    def view(self, world: int) -> WorldView:
        """Privileged live view of one world, for scripted experts."""
        return WorldView(self, world)

    @property
    def ctrl(self) -> np.ndarray:
        """(W, nu) actuator commands of the last control step."""
        return self.sim.batch.ctrl.copy()

    def state_digest(self, world: int) -> str:
        """Hash of the positions and velocities of one world, to compare states bit by bit."""
        batch = self.sim.batch
        return hashlib.sha256(
            batch.qpos[world].tobytes() + batch.qvel[world].tobytes()
            # 64 bits tell states apart and keep records short.
        ).hexdigest()[:16]


def _with_entry(values: np.ndarray, world: int, value: float) -> np.ndarray:
    """Copy of an array with another value for one world; arrays that were returned before are not modified."""
    changed = values.copy()
    changed[world] = value
    return changed
