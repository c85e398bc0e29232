"""SequentialTask: chains of subtasks, or one of them alone, in many worlds at once (Gymnasium VectorEnv).

Order of one control step: action, controllers, 5 substeps, measure, success, progress, reward, label events,
finished worlds (final_obs, reset), observe. Measuring mutates nothing; a reset of some worlds leaves every bit of the
others.
"""

from __future__ import annotations

import dataclasses
import hashlib
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from mjhab.core.arrays import where_rows
from mjhab.core.errors import UsageError, unknown_name
from mjhab.core.rotations import pose_inv, pose_mul
from mjhab.core.seeding import stream
from mjhab.envs.actions import ACTION_DIM, GRIPPER, JointDeltaController
from mjhab.envs.config import EnvConfig
from mjhab.envs.episodes import Episode, EpisodeMaker
from mjhab.envs.hab_episodes import FileEpisodes, file_roster
from mjhab.envs.hab_format import read_hab
from mjhab.envs.observations import CAMERA_KEYS, camera_key, image_observation, single_space, state_observation
from mjhab.envs.plan_tables import PlanTables
from mjhab.envs.privileged import WorldView
from mjhab.envs.sensing import Sensing
from mjhab.envs.spawns import MAX_TRIES, Held
from mjhab.envs.starts import StartMaker, check_target
from mjhab.envs.tracking import Tracker
from mjhab.scenes.fetch import REST_QPOS
from mjhab.scenes.layout import Layout
from mjhab.scenes.objects import roster
from mjhab.scenes.packs import open_pack
from mjhab.sim.cpu import POSITION_STAGE, SUBSTEPS, CpuSimulator
from mjhab.sim.home_scene import HomeRenderer
from mjhab.sim.protocol import TAINTS, SimState
from mjhab.tasks import progress as progress_rules
from mjhab.tasks.measure import Signals, WorldState, measure
from mjhab.tasks.plan import KIND_NAMES, TARGETS_PER_TASK, SubtaskKind, TaskConfig, TaskPlan
from mjhab.tasks.progress import Outcome, Progress

SUBTASKS_PER_TARGET = {"tidy_house": 4, "prepare_groceries": 4, "set_table": 8}
TRIES_PER_STEP = 3
"""Teleport tries of one world in one control step: a hard spawn waits over several steps, alone."""
INDEX_STRIDE = 1 << 20
"""Without explicit indices, the k-th episode of world i is number i * stride + k: it depends on nothing else."""


class SequentialTaskEnv(VectorEnv):
    """HAB tasks on the CPU simulator. Build it with `mjhab.envs.make`.

    Observations: the keys of `observations.STATE_TABLE`, ``state`` (W, 42), and camera images when asked for.
    Actions: (W, 13) in [-1, 1], see `actions.action_table`. Reward: the subtask pointer, as in MS-HAB; in a single
    subtask 1.0 while it is achieved.
    """

    def __init__(self, config: EnvConfig) -> None:
        self.config = config
        pack = open_pack(config.assets)
        if config.home and config.home not in {h.name for h in pack.homes}:
            raise unknown_name("home", config.home, [h.name for h in pack.homes])
        file = read_hab(Path(config.episodes_file)) if config.episodes_file else None
        self.layout = Layout(pack, file_roster(file, pack) if file else roster(config.task))
        check_target(config, self.layout)
        self.num_envs = config.num_envs
        self.sim = CpuSimulator(self.layout, config.num_envs, config.threads)
        self.task_config = TaskConfig(rest_qpos=REST_QPOS, continuous=bool(config.subtask))
        wanted = config.target if config.target in self.layout.roster else ""
        self.episodes = (
            FileEpisodes(self.sim, file, config.task, config.home, wanted)
            if file
            else EpisodeMaker(self.sim, config.task, config.split, config.home, wanted)
        )
        self.starts = StartMaker(self.sim, config, self.task_config)
        self.controller = JointDeltaController()
        self.sensing = Sensing(self.layout, self.sim.addresses, self.num_envs)
        length = 1 if config.subtask else TARGETS_PER_TASK[config.task] * SUBTASKS_PER_TARGET[config.task]
        self.tables = PlanTables(self.layout, self.task_config, self.num_envs, length)
        self.tracker = Tracker(self.num_envs)
        self.metadata = {"autoreset_mode": _MODES[config.autoreset], "render_fps": 20}
        self.single_observation_space = single_space(config.cameras, config.camera_size)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.single_action_space = spaces.Box(-1.0, 1.0, (ACTION_DIM,), np.float32)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.taint_names = TAINTS
        self._renderer: HomeRenderer | None = None
        self._seed = config.seed
        self._init_worlds()

    def _init_worlds(self) -> None:
        n = self.num_envs
        self._episode: list[Episode | None] = [None] * n
        self._home = [""] * n
        self._boxes: list[dict] = [{} for _ in range(n)]
        self._count = np.zeros(n, np.int64)
        self._fallback = np.zeros(n, bool)
        self._pending = np.full(n, -1)
        """Teleport tries done for the active Navigate, -1 when none is due."""
        self._outcome: Outcome | None = None
        self._described: list[TaskPlan | None] = [None] * n
        self._descriptions: list[dict[str, Any]] = [{} for _ in range(n)]
        self._gripper = np.ones(n, np.float32)
        self._joint_start = np.zeros(n)
        self._follow(progress_rules.start(self.tables.arrays, self.task_config))
        self.signals: Signals | None = None
        self._state: SimState = self.sim.state()

    def _follow(self, progress: Progress) -> None:
        """Take over progress whose pointers, or the plans they point into, have changed."""
        self.progress: Progress = progress
        self._focus = self.tables.focus(progress.pointer)

    # -- reset -----------------------------------------------------------------------------------------------------

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict, dict]:
        """Start episodes.

        Args:
            seed: seed of the episodes from now on; keeps the present one when None.
            options: "reset_mask" (W,) bool: worlds to reset (default all); "episode": indices of the episodes that
                the worlds in the mask get, in order of worlds.

        Raises:
            UsageError: unknown option, or shapes that do not fit.
        """
        options = dict(options or {})
        mask = np.asarray(options.pop("reset_mask", np.ones(self.num_envs, bool)), bool)
        indices = options.pop("episode", None)
        if options:
            raise unknown_name("reset option", next(iter(options)), ("reset_mask", "episode"))
        if mask.shape != (self.num_envs,):
            raise UsageError(f"reset_mask must have shape ({self.num_envs},), got {mask.shape}")
        if seed is not None:
            self._seed = int(seed)
            self._count[mask] = 0
        worlds = np.flatnonzero(mask)
        if indices is None:
            indices = worlds * INDEX_STRIDE + self._count[worlds]
        if len(indices) != len(worlds):
            need = f"options['episode'] must give {len(worlds)} indices, one per reset world"
            raise UsageError(f"{need}; got {len(indices)}")
        self._begin(worlds, [int(i) for i in indices])
        return self._observe(), self._info([[] for _ in range(self.num_envs)], [None] * self.num_envs)

    def _begin(self, worlds: np.ndarray, indices: list[int]) -> None:
        starts = []
        for world, index in zip(worlds, indices, strict=True):
            episode = self.episodes.episode(self._seed, index)
            start = self.starts.start(episode)
            starts.append(start)
            self._episode[world], self._home[world], self._boxes[world] = episode, start.home, start.boxes
            self._fallback[world] = start.fallback
            self.tables.set_row(int(world), start.plan, start.boxes)
        if not len(worlds):
            return
        self.sim.reset(worlds.tolist(), [s.home for s in starts], np.stack([s.qpos for s in starts]))
        mask = np.zeros(self.num_envs, bool)
        mask[worlds] = True
        self._count[worlds] += 1
        self._pending[worlds] = -1
        held = self.tables.arrays.kind[:, 0] == SubtaskKind.PLACE
        self._gripper[worlds] = np.where(held[worlds], -1.0, 1.0)
        self._follow(progress_rules.reset_rows(self.progress, mask, self.tables.arrays, self.task_config))
        self._enter_subtask(mask)

    def _enter_subtask(self, mask: np.ndarray) -> None:
        """Begin the subtask at the pointer of the worlds in ``mask``: teleport if due, joint start, label state."""
        if not self.config.subtask:
            due = np.where(self._focus.kind == SubtaskKind.NAVIGATE, 0, -1)
            self._pending = np.where(mask, due, self._pending)
            self._teleport()
        self._state = self.sim.state()
        now = self.sensing.joint_now(self._state, self._focus)
        self._joint_start = np.where(mask, now, self._joint_start)
        signals = self._measure(self._sense())
        self.signals = signals if self.signals is None else where_rows(mask, signals, self.signals)
        self.tracker.begin(mask, self.signals, self.progress)

    def _sense(self) -> WorldState:
        return self.sensing.world_state(self._state, self.tables, self._focus, self._joint_start)

    def _measure(self, state: WorldState) -> Signals:
        signals = measure(state, self.tables.arrays, self.progress, self.task_config, self._focus.active)
        waiting = self._pending >= 0
        # A Navigate that still waits for its spawn is not done, wherever the robot happens to stand.
        return dataclasses.replace(signals, success=signals.success & ~waiting) if waiting.any() else signals

    # -- teleport --------------------------------------------------------------------------------------------------

    def _teleport(self) -> None:
        """Try to spawn the worlds whose Navigate is due; a few tries each, the rest in later steps."""
        for world in np.flatnonzero(self._pending >= 0):
            self._teleport_world(int(world))

    def _teleport_world(self, world: int) -> None:
        plan, position = self.tables.plans[world], int(self.progress.pointer[world])
        goal = self.starts.spawn_goal(plan, position, self._boxes[world])
        slot = int(self.tables.held[world, position])
        qpos = self.sim.qpos[world]
        held = Held(slot, self._held_pose(world, slot)) if slot >= 0 and self._is_held(world, slot) else None
        episode = self._episode[world]
        assert episode is not None
        found = None
        for _ in range(TRIES_PER_STEP):
            rng = stream(self._seed, "navigate", episode.task, episode.index, position, int(self._pending[world]))
            found = self.starts.sampler.try_once(self._home[world], qpos, goal, rng, held)
            self._pending[world] += 1
            if found is not None:
                break
        if found is None and self._pending[world] >= MAX_TRIES:
            found = self.starts.sampler.fallback(self._home[world], qpos, goal, held)
            self._fallback[world] = True
        if found is not None:
            self.sim.write_qpos(world, found)
            self._pending[world] = -1

    def _held_pose(self, world: int, slot: int) -> np.ndarray:
        tcp = self.sensing.tcp_pose(self._state)[world]
        return pose_mul(pose_inv(tcp), self._state.object_pose[world, slot])

    def _is_held(self, world: int, slot: int) -> bool:
        return bool((np.linalg.norm(self._state.finger_force[world, :, slot], axis=-1) > 0).all())

    # -- step ------------------------------------------------------------------------------------------------------

    def step(self, actions: np.ndarray) -> tuple[dict, np.ndarray, np.ndarray, np.ndarray, dict]:
        """One control step of 50 ms in every world. ``actions`` (W, 13) in [-1, 1], clipped.

        Raises:
            UsageError: wrong shape, or actions that are not finite.
        """
        actions = self._check(actions)
        self._advance_physics(actions)
        signals = self._measure_step()
        new, outcome = progress_rules.advance(self.progress, signals, self.tables.arrays, self.task_config)
        events = self.tracker.update(signals, self.progress)
        ended = self.tracker.ended(signals, outcome, self.progress, self.tables.plans)
        if outcome.advanced.any():
            self._follow(new)
        self.progress, self.signals = new, signals
        reward = self._reward(signals)
        terminated: np.ndarray = outcome.place_broken
        if not self.config.subtask:
            terminated = terminated | outcome.success | outcome.force_exceeded
        truncated = outcome.done & ~terminated
        self._outcome = outcome
        moved = outcome.advanced & ~outcome.done
        if moved.any():
            self._enter_subtask(moved)
        elif (self._pending >= 0).any():
            self._teleport()
            self._state = self.sim.state()
        return self._finish(events, ended, reward, terminated, truncated)

    def _check(self, actions: np.ndarray) -> np.ndarray:
        actions = np.asarray(actions, np.float32)
        if actions.shape != (self.num_envs, ACTION_DIM):
            raise UsageError(f"actions must have shape ({self.num_envs}, {ACTION_DIM}), got {actions.shape}")
        if not np.isfinite(actions).all():
            raise UsageError("actions must be finite, got NaN or infinity")
        return actions

    def _advance_physics(self, actions: np.ndarray) -> None:
        teleporting = self._focus.kind == SubtaskKind.NAVIGATE
        if not self.config.subtask and teleporting.any():
            # The teleport does the moving: the robot stands and keeps its grip.
            actions = actions.copy()
            actions[teleporting] = 0.0
            actions[teleporting, GRIPPER] = self._gripper[teleporting]
        self._gripper = actions[:, GRIPPER].copy()
        self.sim.step(self.controller.ctrl(actions, self._state.robot_q))
        self._state = self.sim.state()

    def _measure_step(self) -> Signals:
        state = self._sense()
        self.progress = progress_rules.accumulate(self.progress, state.robot_force)
        return self._measure(state)

    def _reward(self, signals: Signals) -> np.ndarray:
        if self.config.subtask:
            return signals.success.astype(np.float64)
        return self.progress.pointer.astype(np.float64)

    def _finish(
        self, events: list[list[str]], ended: list, reward: np.ndarray, terminated: np.ndarray, truncated: np.ndarray
    ) -> tuple[dict, np.ndarray, np.ndarray, np.ndarray, dict]:
        done = terminated | truncated
        if done.any() and self.config.autoreset == "same_step":
            final_obs, final_info = self._observe(), self._info(events, ended)
            self._begin_next(np.flatnonzero(done))
            obs, info = self._observe(), self._info(events, ended)
            info |= {"final_obs": final_obs, "final_info": final_info, "_final_obs": done, "_final_info": done}
            return obs, reward, terminated, truncated, info
        return self._observe(), reward, terminated, truncated, self._info(events, ended)

    def _begin_next(self, worlds: np.ndarray) -> None:
        self._begin(worlds, [int(i) for i in worlds * INDEX_STRIDE + self._count[worlds]])

    # -- what comes back -------------------------------------------------------------------------------------------

    def _observe(self) -> dict[str, np.ndarray]:
        assert self.signals is not None
        context = self.sensing.context(self._state, self._focus, self.signals)
        obs = state_observation(context)
        if self.config.cameras:
            images = self.renderer.robot_views(self._state, self._home, self.config.camera_size, self.config.cameras)
            for c, name in enumerate(CAMERA_KEYS):
                for output in self.config.cameras:
                    obs[camera_key(name, output)] = image_observation(name, output, images[output][:, c])
        return obs

    def _info(self, events: list[list[str]], ended: list) -> dict[str, Any]:
        s, p = self.signals, self.progress
        assert s is not None
        outcome = self._outcome
        no = np.zeros(self.num_envs, bool)
        info: dict[str, Any] = {
            "pointer": p.pointer, "kind": self._focus.kind, "steps_left": p.steps_left,
            "robot_force": s.robot_force, "cumulative_force": s.cumulative_force,
            "success": no if outcome is None else outcome.success, "fail": no if outcome is None else outcome.fail,
            "taint": self.sim.taint(), "spawn_fallback": self._fallback.copy(),
        }  # fmt: skip
        for name in _CHECKERS:
            info[name] = getattr(s, name)
        info["events"], info["ended"] = events, ended
        info["episode"] = [self._describe(w) for w in range(self.num_envs)]
        return info

    def _describe(self, world: int) -> dict[str, Any] | None:
        episode = self._episode[world]
        if episode is None:
            return None
        plan = self.tables.plans[world]
        if self._described[world] is not plan:
            self._described[world] = plan
            self._descriptions[world] = {
                "seed": self._seed, "index": episode.index, "home": episode.home, "task": episode.task,
                "split": episode.split, "subtask": self.config.subtask or None,
                "plan": [
                    {"kind": KIND_NAMES[s.kind], "target": s.target, "goal": list(s.goal_pos)} for s in plan.subtasks
                ],
            }  # fmt: skip
        return self._descriptions[world]

    # -- pictures --------------------------------------------------------------------------------------------------

    @property
    def renderer(self) -> HomeRenderer:
        """The renderer of this layout, made on first use."""
        if self._renderer is None:
            self._renderer = HomeRenderer(self.sim, self.config.threads)
        return self._renderer

    def render_world(self, world: int, width: int = 480, height: int = 360) -> np.ndarray:
        """Human view (H, W, 3) uint8 of one world, from behind the robot's shoulder."""
        return self.renderer.follow_view(self._state, self._home[world], world, width, height)

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
        return hashlib.sha256(batch.qpos[world].tobytes() + batch.qvel[world].tobytes()).hexdigest()[:16]

    def bare_step(self, ctrl: np.ndarray) -> None:
        """One control step of the engine alone under commands (W, nu), for benchmarks."""
        self.sim.batch.ctrl[:] = ctrl
        self.sim.batch.step(nstep=SUBSTEPS, stage=POSITION_STAGE)

    def close_extras(self, **kwargs: Any) -> None:
        """Nothing outlives the environment."""


_MODES = {
    "same_step": AutoresetMode.SAME_STEP,
    "disabled": AutoresetMode.DISABLED,
}
_CHECKERS = (
    "is_grasped", "at_goal", "ee_rest", "robot_rest", "is_static", "force_ok", "opened", "closed", "near", "oriented",
    "contact", "touch",
)  # fmt: skip
