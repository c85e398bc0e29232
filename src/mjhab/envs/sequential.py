"""SequentialTask: chains of subtasks, or one of them alone, in many worlds at once (Gymnasium VectorEnv).

Order of one control step: action, controllers, 5 substeps, measure, success, progress, reward, label events,
finished worlds (final_obs, reset), observe. Measuring mutates nothing; a reset of some worlds leaves every bit of the
others.
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from mjhab.config.env import JOINT_GROUPS, EnvConfig, task_config
from mjhab.core.arrays import where_rows
from mjhab.core.errors import UsageError, unknown_name
from mjhab.core.joints import BASE_XY
from mjhab.envs.parts.memory import check_memory
from mjhab.envs.parts.nav_distance import NavDistance
from mjhab.envs.parts.observing import Observer
from mjhab.envs.parts.plan_tables import PlanTables
from mjhab.envs.parts.reporting import Reporter
from mjhab.envs.parts.rewarding import Rewarder, RewardInputs
from mjhab.envs.parts.sensing import Sensing
from mjhab.envs.parts.snapshots import restore, snapshot
from mjhab.envs.parts.teleport import Teleports
from mjhab.envs.parts.tracking import Tracker
from mjhab.envs.parts.world_view import WorldView
from mjhab.envs.spaces import batched
from mjhab.episodes.generator import Episode, EpisodeMaker
from mjhab.episodes.hab.format import read_hab
from mjhab.episodes.hab.reader import FileEpisodes, file_roster
from mjhab.episodes.starts import Start, StartMaker, check_target
from mjhab.episodes.zones import with_zones
from mjhab.layout.layout import Layout
from mjhab.robots.controllers import check_actions, make_controller
from mjhab.robots.registry import robot_named
from mjhab.scenes.builtin.objects import roster
from mjhab.scenes.packs import open_pack
from mjhab.sim.mujoco.cpu import CpuSimulator
from mjhab.sim.protocol import TAINTS, SimState
from mjhab.tasks import progress as progress_rules
from mjhab.tasks.measure import Signals, WorldState, measure
from mjhab.tasks.plan import TARGETS_PER_TASK, SubtaskKind
from mjhab.tasks.progress import Outcome, Progress

SUBTASKS_PER_TARGET = {"tidy_house": 4, "prepare_groceries": 4, "set_table": 8}
INDEX_STRIDE = 1 << 20
"""Without explicit indices, the k-th episode of world i is number i * stride + k: it depends on nothing else."""


class SequentialTaskEnv(VectorEnv):
    """HAB tasks on the CPU simulator. Build it with `mjhab.envs.make`.

    Observations: the rows of `observer.table`, among them ``state``. Actions: (W, A), see ``action_table``.
    Reward: by ``config.reward``; "pointer" is the subtask pointer, as in MS-HAB.

    For reading: ``state``, ``signals``, ``progress``, ``focus`` are the present ones; ``judged`` are the signals that
    decided the last step, which in worlds where a subtask began are those of the one before.
    """

    def __init__(self, config: EnvConfig) -> None:
        self.config = config
        self.num_envs = config.num_envs
        check_memory(config.num_envs)
        self.robot = robot_named(config.robot)
        purpose = f"subtask {config.subtask!r}" if config.subtask else f"task {config.task!r}"
        self.robot.require(JOINT_GROUPS, purpose)
        self.task_config = task_config(config, self.robot)
        self.controller = make_controller(
            config.control_mode,
            config.num_envs,
            robot=self.robot,
            base=config.base,
            stationary=config.stationary,
        )
        self._open_world(config)
        self.starts = StartMaker(self.sim, config, self.task_config)
        points = config.handle_points
        self.sensing = Sensing(self.layout, self.sim.addresses, self.num_envs, handle_points=points)
        self.observer = Observer(
            self.sim,
            self.sensing,
            config.obs_mode,
            config.cameras,
            config.camera_size,
            config.threads,
        )
        length = (
            1
            if config.subtask
            else TARGETS_PER_TASK[config.task] * SUBTASKS_PER_TARGET[config.task]
        )
        self.tables = PlanTables(self.layout, self.task_config, self.num_envs, length)
        self.tracker = Tracker(self.num_envs)
        self.nav = NavDistance(self.layout, self.num_envs, self.starts.sampler.map)
        self.rewarder = Rewarder(
            self.num_envs,
            self.task_config,
            config.reward,
            config.reward_options,
            self.layout,
            self.sensing,
            lambda inputs: self.nav.at(inputs.world.base_pose[:, BASE_XY]),
            [SubtaskKind[config.subtask.upper()]] if config.subtask else list(SubtaskKind),
        )
        self._set_spaces()
        self._init_worlds()

    def _open_world(self, config: EnvConfig) -> None:
        pack = open_pack(config.assets)
        file = read_hab(Path(config.episodes_file)) if config.episodes_file else None
        objects = file_roster(file, pack) if file else roster(config.task)
        self.layout = Layout(pack, objects, self.robot)
        check_target(config, self.layout)
        self.sim = CpuSimulator(
            self.layout, config.num_envs, config.threads, self.controller.drives
        )
        wanted = config.target if config.target in self.layout.roster else ""
        self.episodes = (
            FileEpisodes(self.sim, file, config.task, config.home, wanted)
            if file
            else EpisodeMaker(self.sim, config.task, config.split, config.home, wanted)
        )

    def _set_spaces(self) -> None:
        autoreset = AutoresetMode[self.config.autoreset.upper()]
        self.metadata = {
            "autoreset_mode": autoreset,
            "render_fps": 20,
            "render_modes": ["rgb_array"],
        }
        self.render_mode = self.config.render_mode or None
        self.single_observation_space = self.observer.single_space
        self.observation_space = batched(self.single_observation_space, self.num_envs)
        low, high = (np.asarray(b, np.float32) for b in (self.controller.low, self.controller.high))
        self.single_action_space = spaces.Box(low, high, dtype=np.float32)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.action_table = self.controller.table
        self.taint_names = TAINTS

    def _init_worlds(self) -> None:
        n = self.num_envs
        self.episodes_now: list[Episode | None] = [None] * n
        self.homes = [self.layout.pack.homes[0].name] * n
        self.boxes: list[dict] = [{} for _ in range(n)]
        self.fallback, self.success, self.fail, self.due = np.zeros((4, n), bool)
        """(W,): spawned where nothing better was found; outcome of the last step; reset due in the next step."""
        self.nan_resets = np.zeros(n, np.int64)
        self.reward_terms: dict[str, np.ndarray] = {}
        self.count = np.zeros(n, np.int64)
        self.seeds = np.full(n, self.config.seed, np.int64)
        self.joint_start = np.zeros(n)
        self.grip = np.ones(n, np.float32)
        """(W,): joint of the active link when its subtask began; the gripper's number in the last action."""
        self.teleports = Teleports(self)
        self.reporter = Reporter(self)
        # A world that nobody has reset is like one whose episode is over.
        begun = progress_rules.start(self.tables.arrays, self.task_config)
        self.follow(dataclasses.replace(begun, done=np.ones(n, bool)))
        self.signals: Signals | None = None
        self.judged: Signals | None = None
        self.state: SimState = self.sim.state()

    def follow(self, progress: Progress) -> None:
        """Take over progress whose pointers, or the plans they point into, have changed."""
        self.progress: Progress = progress
        self.focus = self.tables.focus(progress.pointer)

    # -- reset -----------------------------------------------------------------------------------------------------

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[dict, dict]:
        """Start episodes. World i's k-th episode since its seed was set depends on (its seed, i, k) only.

        Args:
            seed: of the episodes from now on, one for all worlds or (W,) one each; None keeps the present one.
            options: "reset_mask" (W,) bool: worlds to reset (default all); "episode": indices of the episodes that
                the worlds in the mask get, in order of worlds.

        Raises:
            UsageError: unknown option, or shapes that do not fit.
        """
        options = dict(options or {})
        mask = np.asarray(options.pop("reset_mask", np.ones(self.num_envs, bool)))
        indices = options.pop("episode", None)
        if options:
            raise unknown_name("reset option", next(iter(options)), ("reset_mask", "episode"))
        if mask.shape != (self.num_envs,) or mask.dtype != bool:
            raise UsageError(
                f"reset_mask must be bool ({self.num_envs},), got {mask.dtype} {mask.shape}"
            )
        self._reseed(seed, mask)
        worlds = np.flatnonzero(mask)
        if indices is None:
            indices = worlds * INDEX_STRIDE + self.count[worlds]
        if len(indices) != len(worlds) or any(int(i) < 0 for i in indices):
            need = f"options['episode'] must give {len(worlds)} indices >= 0, one per reset world"
            raise UsageError(f"{need}; got {list(indices)}")
        self._begin(worlds, [int(i) for i in indices])
        return self._observe(), self.reporter.info(*self.reporter.nothing())

    def _reseed(self, seed: int | Sequence[int | None] | None, mask: np.ndarray) -> None:
        if seed is None:
            return
        seeds = [seed] * self.num_envs if isinstance(seed, int | np.integer) else list(seed)
        if len(seeds) != self.num_envs or any(s is not None and s < 0 for s in seeds):
            raise UsageError(
                f"seed must be a number >= 0 or {self.num_envs} of them, one per world; got {seed!r}"
            )
        for world in np.flatnonzero(mask).tolist():
            own = seeds[world]
            if own is not None:
                self.seeds[world] = own
                self.count[world] = 0

    def make_episode(self, seed: int, index: int) -> Episode:
        """The episode of a name."""
        return (self.starts.spawn_set or self.episodes).episode(seed, index)

    def episode_of(self, world: int) -> Episode:
        """The episode a world is in. It must have been reset."""
        episode = self.episodes_now[world]
        assert episode is not None, f"world {world} has not been reset"
        return episode

    def _begin(self, worlds: np.ndarray, indices: list[int]) -> None:
        if not len(worlds):
            return
        starts = []
        for world, index in zip(worlds.tolist(), indices, strict=True):
            start = self.adopt(world, self.make_episode(int(self.seeds[world]), index))
            self.fallback[world] = start.fallback
            starts.append(start)
        self.sim.reset(
            worlds.tolist(), [s.home for s in starts], np.stack([s.qpos for s in starts])
        )
        mask = np.zeros(self.num_envs, bool)
        mask[worlds] = True
        self.count[worlds] += 1
        self.success[worlds] = self.fail[worlds] = self.due[worlds] = False
        held = self.tables.arrays.kind[:, 0] == SubtaskKind.PLACE
        self.grip[worlds] = np.where(held[worlds], -1.0, 1.0)
        self.follow(
            progress_rules.reset_rows(self.progress, mask, self.tables.arrays, self.task_config)
        )
        self.state = self.sim.state()
        self.controller.reset(mask, self.state)
        self._enter_subtask(mask)

    def start_of(self, episode: Episode) -> Start:
        """How an episode begins here, with place zones where the goal type asks for them."""
        start = self.starts.start(episode)
        if self.task_config.goal_type != "zone":
            return start
        plan = with_zones(
            start.plan, self.layout, self.starts.home(start.home), self.task_config.goal_tol
        )
        return dataclasses.replace(start, plan=plan)

    def adopt(self, world: int, episode: Episode) -> Start:
        """Give a world an episode: its home, its plan; returns what it begins with."""
        start = self.start_of(episode)
        self.episodes_now[world] = episode
        self.homes[world] = start.home
        self.boxes[world] = start.boxes
        self.tables.set_row(world, start.plan, start.boxes)
        return start

    def _enter_subtask(self, mask: np.ndarray) -> None:
        """Begin the subtask at the pointer of the worlds in ``mask``: teleport if due, joint start, label state."""
        if self.config.teleports:
            self.teleports.begin(mask, self.focus.kind)
            self._teleport()
        now = self.sensing.joint_now(self.state, self.focus)
        self.joint_start = np.where(mask, now, self.joint_start)
        world = self._sense()
        signals = self._measure(world)
        self.signals = signals if self.signals is None else where_rows(mask, signals, self.signals)
        self.judged = self.signals if self.judged is None else self.judged
        self.tracker.begin(mask, self.signals, self.progress)
        if self.config.reward in ("dense", "normalized_dense"):
            for w in np.flatnonzero(mask & (self.focus.kind == SubtaskKind.NAVIGATE)).tolist():
                self.nav.begin(w, self.homes[w], self.focus.active.goal_pos[w, :2])
        self.rewarder.begin(mask, self._reward_inputs(world, signals))

    def _teleport(self) -> None:
        moved = self.teleports.run()
        if moved.any():
            self.state = self.sim.state()
            self.controller.reset(moved, self.state)

    def _sense(self) -> WorldState:
        return self.sensing.world_state(self.state, self.tables, self.focus, self.joint_start)

    def _measure(self, world: WorldState) -> Signals:
        signals = measure(
            world, self.tables.arrays, self.progress, self.task_config, self.focus.active
        )
        waiting = self.teleports.waiting
        # A Navigate that still waits for its spawn is not done, wherever the robot happens to stand.
        return (
            dataclasses.replace(signals, success=signals.success & ~waiting)
            if waiting.any()
            else signals
        )

    def _reward_inputs(self, world: WorldState, signals: Signals) -> RewardInputs:
        return RewardInputs(self.state, world, signals, self.focus, self.progress)

    # -- step ------------------------------------------------------------------------------------------------------

    def step(self, actions: np.ndarray) -> tuple[dict, np.ndarray, np.ndarray, np.ndarray, dict]:
        """One control step of 50 ms in every world. ``actions`` (W, A), clipped to the action space.

        Raises:
            UsageError: wrong shape or type, or actions that are not finite.
        """
        actions = check_actions(actions, self.action_table, self.num_envs)
        broken = self._advance_physics(actions)
        world = self._sense()
        self.progress = progress_rules.accumulate(self.progress, world.robot_force)
        signals = self._measure(world)
        if broken is not None:
            self.progress, signals = _give_up(broken, self.progress, signals)
        new, outcome = progress_rules.advance(
            self.progress, signals, self.tables.arrays, self.task_config
        )
        reward = self._reward(world, signals, new)
        events = self.tracker.update(signals, self.progress)
        ended = self.tracker.ended(signals, outcome, self.progress, self.tables.plans)
        if outcome.advanced.any():
            self.follow(new)
        self.progress = new
        self.signals = signals
        self.judged = signals
        self.success = outcome.success.copy()
        self.fail = outcome.fail.copy()
        moved = outcome.advanced & ~outcome.done
        if moved.any():
            self._enter_subtask(moved)
        elif self.teleports.waiting.any():
            self._teleport()
        return self._finish(events, ended, reward, outcome)

    def _advance_physics(self, actions: np.ndarray) -> np.ndarray | None:
        """Step the worlds; returns (W,) bool, those that broke and have been put back, or None."""
        teleporting = self.focus.kind == SubtaskKind.NAVIGATE
        if self.config.teleports and teleporting.any():
            # The teleport does the moving: the robot stands and keeps its grip.
            still = self.controller.still(self.state)
            still[:, self.controller.gripper] = self.grip
            actions = np.where(teleporting[:, None], still, actions)
        self.grip = actions[:, self.controller.gripper].copy()
        ctrl = self.controller.ctrl(actions, self.state)
        before = self.sim.qpos.copy()
        self.sim.step(ctrl)
        broken = self.sim.broken()
        if not broken.any():
            self.state = self.sim.state()
            return None
        worlds = np.flatnonzero(broken).tolist()
        self.nan_resets[worlds] += 1
        self.sim.mend(worlds, [self.homes[w] for w in worlds], before[worlds])
        self.state = self.sim.state()
        return broken.copy()

    def _reward(self, world: WorldState, signals: Signals, new: Progress) -> np.ndarray:
        if self.config.reward == "pointer":
            return new.pointer.astype(np.float64)
        reward, self.reward_terms = self.rewarder.step(self._reward_inputs(world, signals))
        return reward

    def _finish(
        self, events: list[list[str]], ended: list, reward: np.ndarray, outcome: Outcome
    ) -> tuple[dict, np.ndarray, np.ndarray, np.ndarray, dict]:
        terminated: np.ndarray = outcome.place_broken
        if not self.config.runs_to_horizon:
            terminated = terminated | outcome.success | outcome.force_exceeded
        truncated = outcome.done & ~terminated
        obs = None
        info = None
        if outcome.done.any() and self.config.autoreset == "same_step":
            obs, info = self._renew(events, ended, outcome.done)
        elif self.config.autoreset == "next_step":
            if self.due.any():
                # Gymnasium: the step after an episode's end is the reset, whatever the action; it brings no reward.
                reward = np.where(self.due, 0.0, reward)
                self._begin_next(np.flatnonzero(self.due))
            self.due = outcome.done.copy()
        if obs is None or info is None:
            obs = self._observe()
            info = self.reporter.info(events, ended)
        return obs, reward, terminated, truncated, info

    def _renew(self, events: list[list[str]], ended: list, done: np.ndarray) -> tuple[dict, dict]:
        """Reset finished worlds in the same step: their last observation and info go into final_obs, final_info."""
        final_obs = self._observe()
        final_info = self.reporter.info(events, ended)
        self._begin_next(np.flatnonzero(done))
        # What happened belongs to the old episode; the new one begins with nothing.
        gone = done.tolist()
        events = [[] if old else names for names, old in zip(events, gone, strict=True)]
        ended = [None if old else record for record, old in zip(ended, gone, strict=True)]
        info = self.reporter.info(events, ended)
        info |= {
            "final_obs": final_obs,
            "final_info": final_info,
            "_final_obs": done,
            "_final_info": done,
        }
        return self._observe(final_obs, done), info

    def _begin_next(self, worlds: np.ndarray) -> None:
        self._begin(worlds, [int(i) for i in worlds * INDEX_STRIDE + self.count[worlds]])

    def _observe(
        self, known: dict[str, np.ndarray] | None = None, changed: np.ndarray | None = None
    ) -> dict:
        assert self.signals is not None
        return self.observer.observe(
            self.state, self.focus, self.signals, self.homes, known, changed
        )

    # -- states and pictures ---------------------------------------------------------------------------------------

    def get_state(self, world: int) -> dict[str, Any]:
        """Everything one world is: nested dict of arrays, numbers, strings and lists. See `snapshots.snapshot`."""
        return snapshot(self, world)

    def set_state(self, world: int, state: dict[str, Any]) -> None:
        """Put one world into a state from ``get_state``; the others keep every bit. See `snapshots.restore`."""
        restore(self, world, state)

    def render_world(self, world: int, width: int = 480, height: int = 360) -> np.ndarray:
        """Human view (H, W, 3) uint8 of one world."""
        return self.observer.renderer.follow_view(
            self.state, self.homes[world], world, width, height
        )

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Human views (H, W, 3) uint8 of all worlds, or None without a render mode."""
        return (
            tuple(self.render_world(w) for w in range(self.num_envs)) if self.render_mode else None
        )

    def view(self, world: int) -> WorldView:
        """Privileged live view of one world, for scripted experts."""
        return WorldView(self, world)

    @property
    def ctrl(self) -> np.ndarray:
        """(W, nu) actuator commands of the last control step."""
        return self.sim.batch.ctrl.copy()

    def state_digest(self, world: int) -> str:
        """Hash of positions and velocities of one world: equal only if every bit is."""
        batch = self.sim.batch
        return hashlib.sha256(
            batch.qpos[world].tobytes() + batch.qvel[world].tobytes()
        ).hexdigest()[:16]


def _give_up(broken: np.ndarray, progress: Progress, signals: Signals) -> tuple[Progress, Signals]:
    """Let the time of worlds that broke be up, and nothing in them count as success."""
    progress = dataclasses.replace(progress, steps_left=np.where(broken, 0, progress.steps_left))
    return progress, dataclasses.replace(signals, success=signals.success & ~broken)
