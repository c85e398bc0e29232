"""The HAB tasks on the warp backend: what `SequentialTaskEnv` does, on torch tensors on the device.

The order of a control step is the same. Nothing in it waits for the device or copies to or from the host: worlds that
move on, end or break are told apart by masks, and every shape stays as it is.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from contextlib import AbstractContextManager
from typing import Any

import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from mjhab.config.env import EnvConfig, TrainConfig
from mjhab.core.arrays import to_numpy, where_rows
from mjhab.core.errors import UsageError, unknown_name
from mjhab.envs.device.landings import Teleporter
from mjhab.envs.device.notes import DeviceNotes
from mjhab.envs.device.observing import DeviceObserver
from mjhab.envs.device.pool import StartPool, pool_size
from mjhab.envs.parts.memory import check_device_memory
from mjhab.envs.parts.plan_tables import look_up
from mjhab.envs.parts.reporting import CHECKERS, describe_episode
from mjhab.envs.parts.rewarding import Rewarder, RewardInputs
from mjhab.envs.parts.sensing import Sensing
from mjhab.envs.sequential import SequentialTaskEnv
from mjhab.envs.spaces import batched
from mjhab.envs.subtask_train import SubtaskTrainEnv
from mjhab.episodes.narration import Narrator
from mjhab.robots.controllers import make_controller
from mjhab.sim.protocol import TAINTS, SimState
from mjhab.sim.warp.device import room_for
from mjhab.sim.warp.simulator import WarpSimulator
from mjhab.tasks import progress as progress_rules
from mjhab.tasks.events import EVENT_NAMES
from mjhab.tasks.measure import Signals, WorldState, measure
from mjhab.tasks.plan import SubtaskKind
from mjhab.tasks.progress import Outcome, Progress

Tensor = torch.Tensor


class DeviceEnv(VectorEnv):
    """HAB tasks on MuJoCo Warp. Build it with `mjhab.envs.make(backend="warp")` or `make_train`.

    Spaces, observations, rewards and flags are those of `SequentialTaskEnv`, as tensors (W, ...) on ``device``, float32
    where that has float64. It differs in this:

    * Episodes come from a pool of P starts: world w's k-th episode is start (w + k W) mod P, and start i is the episode
      (seed, i) of the cpu backend. A reset with another seed makes a new pool, which takes time.
    * `info` holds tensors only. "event_flags" (W, E) bool has the columns `tasks.events.EVENT_NAMES`, "ended" (W,) bool
      says whose subtask ended in this step and "label" (W,) its label, -1 for none. Records of them and descriptions
      of episodes are made on the host when asked for: `records`, `episode_spec`.
    * A teleport never waits; see `landings`.
    * Numbers of an action that are not finite count as 0 and are told by `check_taint`.
    * With autoreset "same_step" pictures of the final observations are drawn in every step, whether an episode ends or
      not, and those of worlds that begin anew or teleport are drawn again.
    """

    def __init__(self, config: EnvConfig) -> None:
        if config.render_mode:
            raise UsageError(
                "backend 'warp' gives no human views; leave render_mode empty, or use backend='cpu'"
            )
        self.config = config
        self.num_envs = config.num_envs
        check_device_memory(
            config.num_envs, config.obs_mode, config.camera_size, config.device, len(config.cameras)
        )
        alone = dataclasses.replace(config, num_envs=1, backend="cpu", autoreset="disabled")
        self._host = (
            SubtaskTrainEnv(alone) if isinstance(alone, TrainConfig) else SequentialTaskEnv(alone)
        )
        host = self._host
        self.layout = host.layout
        self._narrator = Narrator(host.layout)
        self.task_config = host.task_config
        drives = host.controller.drives
        self.sim = WarpSimulator(
            self.layout, self.num_envs, config.device, drives, buffers=config.buffers
        )
        self.device: torch.device = self.sim.qpos.device
        with self._room():
            self._make_parts(torch.zeros(1, dtype=torch.float32, device=self.device))
            self.pool = StartPool(host, self.sim, pool_size(config), config.seed, config)
            self._set_spaces()
            self._init_worlds()

    def _room(self) -> AbstractContextManager[None]:
        """For work that takes memory of the device."""
        return room_for(self.num_envs, self.sim.device)

    def _make_parts(self, like: Tensor) -> None:
        """What does the steps; it keeps arrays of the library and device of ``like``."""
        config = self.config
        count = self.num_envs
        self.controller = make_controller(
            config.control_mode,
            count,
            robot=self.layout.robot,
            base=config.base,
            stationary=config.stationary,
            like=like,
        )
        self.sensing = Sensing(self.layout, self.sim.addresses, count, like, config.handle_points)
        self.observer = DeviceObserver(self.sim, self.sensing, self._host.observer)
        self.rewarder = Rewarder(
            count,
            self.task_config,
            config.reward,
            config.reward_options,
            self.layout,
            self.sensing,
            self._nav_distance,
            [SubtaskKind(kind) for kind in self._host.rewarder.dense.tables],
            like=like,
        )
        self.notes = DeviceNotes(count, max(self.task_config.horizons), self.device)
        self.teleporter = Teleporter(self.sim.addresses, self.device)

    def _set_spaces(self) -> None:
        autoreset = AutoresetMode[self.config.autoreset.upper()]
        self.metadata = {
            "autoreset_mode": autoreset,
            "render_fps": 20,
            "render_modes": [],
            "tensors": True,
        }
        self.render_mode = None
        self.single_observation_space: spaces.Space = self._host.single_observation_space
        self.single_action_space: spaces.Space = self._host.single_action_space
        self.observation_space = batched(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.action_table = self.controller.table
        self.taint_names = TAINTS

    def _init_worlds(self) -> None:
        worlds = self.num_envs
        device = self.device
        self._worlds = torch.arange(worlds, device=device)
        self._no = torch.zeros(worlds, dtype=torch.bool, device=device)
        self.fallback = self.success = self.fail = self.due = self._no
        """(W,): spawned where nothing better was found; outcome of the last step; reset due in the next step."""
        zero = torch.zeros_like(self._worlds)
        self.count = zero
        self.start_row = zero
        self._judged_row = zero
        self.nan_resets = zero
        """(W,): episodes begun, start each world is at, start of the last step; times a world broke."""
        self.tainted = self.bad_actions = torch.zeros((), dtype=torch.int64, device=device)
        """Episodes that ended with a taint; actions of single worlds that were not finite."""
        self.reward_terms: dict[str, Tensor] = {}
        self.joint_start = torch.zeros(worlds, device=device)
        self.grip = torch.ones(worlds, device=device)
        self.tables = self.pool.rows(self.start_row)
        begun = progress_rules.start(self.tables.arrays, self.task_config)
        # A world that nobody has reset is like one whose episode is over.
        self.progress: Progress = dataclasses.replace(begun, done=~self._no)
        self.focus = look_up(self.tables, self.progress.pointer, self.task_config)
        self.state: SimState = self.sim.state()
        self.signals: Signals | None = None
        self.judged: Signals | None = None

    # -- reset -----------------------------------------------------------------------------------------------------

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[dict, dict]:
        """Start episodes.

        Args:
            seed: of the pool; another one than the present makes a new pool. None keeps it.
            options: "reset_mask" (W,) bool: worlds to reset (default all); "episode": numbers of starts in the pool
                that the worlds in the mask get, in order of worlds.

        Raises:
            UsageError: unknown option, shapes that do not fit, no such start, or no room on the device.
        """
        with self._room():
            return self._reset(seed, dict(options or {}))

    def _reset(self, seed: Any, options: dict[str, Any]) -> tuple[dict, dict]:
        mask = torch.as_tensor(options.pop("reset_mask", ~self._no), device=self.device)
        wanted = options.pop("episode", None)
        if options:
            raise unknown_name("reset option", next(iter(options)), ("reset_mask", "episode"))
        if mask.shape != (self.num_envs,) or mask.dtype != torch.bool:
            raise UsageError(
                f"reset_mask must be bool ({self.num_envs},), got {mask.dtype} {tuple(mask.shape)}"
            )
        self._reseed(seed, mask)
        rows = self._next_rows()
        if wanted is not None:
            rows = self._chosen_rows(wanted, mask)
        self._renew(mask, self._no, rows)
        return self._observe(), self._info(
            self._no_events(), self._no, torch.full_like(self._worlds, -1)
        )

    def _reseed(self, seed: Any, mask: Tensor) -> None:
        if seed is None:
            return
        if isinstance(seed, bool) or not isinstance(seed, int) or seed < 0:
            raise UsageError(
                f"backend 'warp' takes one seed for all worlds, a number >= 0; got {seed!r}"
            )
        if seed != self.pool.seed:
            if not bool(mask.all()):
                raise UsageError("a new seed is for all worlds: leave out reset_mask")
            self.pool = StartPool(self._host, self.sim, self.pool.count, seed, self.config)
        self.count = torch.where(mask, 0, self.count)

    def _chosen_rows(self, wanted: Any, mask: Tensor) -> Tensor:
        chosen = torch.as_tensor(wanted, device=self.device)
        count = int(mask.sum())
        integral = not (chosen.is_floating_point() or chosen.dtype == torch.bool)
        if (
            chosen.shape != (count,)
            or not integral
            or bool(((chosen < 0) | (chosen >= self.pool.count)).any())
        ):
            need = f"options['episode'] must give {count} starts in [0, {self.pool.count}), one per reset world"
            raise UsageError(
                f"{need}; got {to_numpy(chosen).tolist()}; option starts sets how many"
            )
        rows = self.start_row.clone()
        rows[mask] = chosen.to(rows.dtype)
        return rows

    def _next_rows(self) -> Tensor:
        return (self._worlds + self.count * self.num_envs) % self.pool.count

    def _renew(self, fresh: Tensor, moved: Tensor, rows: Tensor) -> Tensor:
        """Begin the episodes ``rows`` (W,) in the worlds ``fresh``, and the next subtask in the worlds ``moved``.

        Returns:
            (W,) bool, worlds whose physics is in another state now.
        """
        pool = self.pool
        moved = moved & ~fresh
        self.start_row = torch.where(fresh, rows, self.start_row)
        self.count = self.count + fresh
        self.tables = pool.rows(self.start_row)
        self.progress = progress_rules.reset_rows(
            self.progress, fresh, self.tables.arrays, self.task_config
        )
        self.focus = look_up(self.tables, self.progress.pointer, self.task_config)
        self.success = self.success & ~fresh
        self.fail = self.fail & ~fresh
        self.due = self.due & ~fresh
        held = self.tables.arrays.kind[:, 0] == int(SubtaskKind.PLACE)
        self.grip = torch.where(fresh, torch.where(held, -1.0, 1.0), self.grip)
        self.fallback = torch.where(fresh, pool.fallback[self.start_row], self.fallback)
        leaping = self._place(fresh, moved)
        self.state = self.sim.state()
        self.controller.reset(fresh | leaping, self.state)
        self._enter_subtask(fresh | moved)
        return fresh | leaping

    def _place(self, fresh: Tensor, moved: Tensor) -> Tensor:
        """Put the worlds ``fresh`` at their starts; teleport those of ``moved`` that navigate, and return them."""
        pool = self.pool
        row = self.start_row
        qpos = pool.qpos[row]
        leaping = self._no
        if self.config.teleports:
            leaping = moved & (self.focus.kind == int(SubtaskKind.NAVIGATE))
            at = self.focus.active.index
            there = self.teleporter.moved(
                self.sim.qpos, self.state, pool.landings[row, at], self.focus.columns[:, 1]
            )
            qpos = torch.where(fresh[:, None], qpos, there)
            self.fallback = self.fallback | (leaping & pool.landing_fallback[row, at])
        self.sim.reset_masked(
            fresh, pool.home_rows[row], qpos, pool.ctrl[row], pool.rings[row], leaping
        )
        return leaping

    def _enter_subtask(self, mask: Tensor) -> None:
        now = self.sensing.joint_now(self.state, self.focus)
        self.joint_start = torch.where(mask, now, self.joint_start)
        world = self._sense()
        signals = self._measure(world, self.progress)
        self.signals = signals if self.signals is None else where_rows(mask, signals, self.signals)
        self.judged = self.signals if self.judged is None else self.judged
        self.notes.begin(mask, self.signals, self.progress)
        self.rewarder.begin(mask, self._reward_inputs(world, signals))

    def _sense(self) -> WorldState:
        return self.sensing.world_state(self.state, self.tables, self.focus, self.joint_start)

    def _measure(self, world: WorldState, progress: Progress) -> Signals:
        return measure(world, self.tables.arrays, progress, self.task_config, self.focus.active)

    def _reward_inputs(self, world: WorldState, signals: Signals) -> RewardInputs:
        return RewardInputs(self.state, world, signals, self.focus, self.progress)

    def _nav_distance(self, inputs: RewardInputs) -> Tensor:
        fields = self.pool.fields
        at = self.pool.field_index[self.start_row, self.focus.active.index]
        xy = inputs.world.base_pose[:, :2]
        return torch.zeros_like(xy[:, 0]) if fields is None else fields.at(at, xy)

    # -- step ------------------------------------------------------------------------------------------------------

    def step(self, actions: Any) -> tuple[dict, Tensor, Tensor, Tensor, dict]:
        """One control step of 50 ms in every world. ``actions`` (W, A) on the device; clipped to the action space.

        Raises:
            UsageError: wrong shape or type, nothing has been reset yet, or no room on the device.
        """
        with self._room():
            return self._step(self._checked(actions))

    def _step(self, actions: Tensor) -> tuple[dict, Tensor, Tensor, Tensor, dict]:
        broken = self._advance_physics(actions)
        world = self._sense()
        progress = progress_rules.accumulate(self.progress, world.robot_force)
        signals = self._measure(world, progress)
        # The time of worlds that broke is up, and nothing in them counts as success.
        progress = dataclasses.replace(
            progress, steps_left=torch.where(broken, 0, progress.steps_left)
        )
        signals = dataclasses.replace(signals, success=signals.success & ~broken)
        new, outcome = progress_rules.advance(
            progress, signals, self.tables.arrays, self.task_config
        )
        self.progress = progress
        reward = self._reward(world, signals, new)
        events = self.notes.update(signals, progress)
        label = self.notes.end(signals, outcome, progress)
        self._judged_row = self.start_row
        self.progress = new
        self.signals = signals
        self.judged = signals
        self.focus = look_up(self.tables, new.pointer, self.task_config)
        self.success = outcome.success
        self.fail = outcome.fail
        self.tainted = self.tainted + ((self.sim.taint() != 0) & outcome.done).sum()
        return self._finish(events, label, reward, outcome)

    def _checked(self, actions: Any) -> Tensor:
        if self.signals is None:
            raise UsageError("call reset before step")
        # What a policy still knows of its gradients would stay in the buffers of the engine, and grow with every step.
        actions = torch.as_tensor(actions, device=self.device).detach()
        need = (self.num_envs, len(self.action_table))
        if actions.dtype in (torch.bool, torch.complex64, torch.complex128):
            raise UsageError(
                f"actions must be numbers (float32), got a tensor of type {actions.dtype}"
            )
        if actions.shape != need:
            raise UsageError(f"actions must have shape {need}, got {tuple(actions.shape)}")
        finite = torch.isfinite(actions)
        self.bad_actions = self.bad_actions + (~finite.all(-1)).sum()
        return torch.where(finite, actions, 0).to(torch.float32)

    def _advance_physics(self, actions: Tensor) -> Tensor:
        """Step the worlds; returns (W,) bool, those that broke and have been put back."""
        if self.config.teleports:
            # The teleport does the moving: the robot stands and keeps its grip.
            still = self.controller.still(self.state).to(torch.float32).clone()
            still[:, self.controller.gripper] = self.grip
            teleporting = self.focus.kind == int(SubtaskKind.NAVIGATE)
            actions = torch.where(teleporting[:, None], still, actions)
        self.grip = actions[:, self.controller.gripper].clone()
        self.sim.step(self.controller.ctrl(actions, self.state))
        broken = self.sim.broken().clone()
        self.nan_resets = self.nan_resets + broken
        self.sim.mend_broken()
        self.state = self.sim.state()
        return broken

    def _reward(self, world: WorldState, signals: Signals, new: Progress) -> Tensor:
        if self.config.reward == "pointer":
            return new.pointer.to(torch.float32)
        reward, self.reward_terms = self.rewarder.step(self._reward_inputs(world, signals))
        return reward

    def _finish(
        self, events: Tensor, label: Tensor, reward: Tensor, outcome: Outcome
    ) -> tuple[dict, Tensor, Tensor, Tensor, dict]:
        terminated: Tensor = outcome.place_broken
        done = outcome.done
        mode = self.config.autoreset
        if not self.config.runs_to_horizon:
            terminated = terminated | outcome.success | outcome.force_exceeded
        truncated = done & ~terminated
        moved = outcome.advanced & ~done
        ended = outcome.ended
        final: dict[str, Any] = {}
        changed: Tensor | None = None
        if mode == "same_step":
            final = {"final_obs": self._observe(), "final_info": self._info(events, ended, label)}
            final |= {"_final_obs": done, "_final_info": done}
            changed = self._renew(done, moved, self._next_rows())
            # What happened belongs to the old episode; the new one begins with nothing.
            events = events & ~done[:, None]
            ended = ended & ~done
            label = torch.where(done, -1, label)
        elif mode == "next_step":
            # Gymnasium: the step after an episode's end is the reset, whatever the action; it brings no reward.
            reward = torch.where(self.due, 0.0, reward)
            self._renew(self.due, moved, self._next_rows())
            self.due = done
        elif not self.config.subtask:
            self._renew(self._no, moved, self.start_row)
        return (
            self._observe(changed),
            reward,
            terminated,
            truncated,
            self._info(events, ended, label) | final,
        )

    def _observe(self, changed: Tensor | None = None) -> dict[str, Tensor]:
        """Observations; ``changed`` (W,) bool: worlds that are not as they were when last observed, None for all."""
        assert self.signals is not None
        return self.observer.observe(self.state, self.focus, self.signals, changed)

    def _no_events(self) -> Tensor:
        return torch.zeros((self.num_envs, len(EVENT_NAMES)), dtype=torch.bool, device=self.device)

    def _info(self, events: Tensor, ended: Tensor, label: Tensor) -> dict[str, Any]:
        """Tensors (W,) that stay as they are; see `envs.parts.reporting.Reporter.info`."""
        s = self.signals
        p = self.progress
        assert s is not None
        info: dict[str, Any] = {
            "pointer": p.pointer,
            "kind": self.focus.kind,
            "steps_left": p.steps_left,
            "robot_force": s.robot_force,
            "cumulative_force": s.cumulative_force,
            "success": self.success,
            "fail": self.fail,
            "taint": self.sim.taint(),
            "nan_resets": self.nan_resets,
            "spawn_fallback": self.fallback,
            "reward_terms": self.reward_terms,
        }
        info |= {name: getattr(s, name) for name in CHECKERS}
        return info | {"event_flags": events, "ended": ended, "label": label}

    # -- told on the host ------------------------------------------------------------------------------------------

    def records(self) -> list[dict[str, Any] | None]:
        """(W,) records of the subtasks that ended in the last step, like ``info["ended"]`` of the cpu backend."""
        rows = to_numpy(self._judged_row).tolist()
        return self.notes.records([self.pool.plans[row] for row in rows])

    def episode_spec(self, world: int) -> Mapping[str, Any]:
        """The episode a world is in; see `describe_episode`. Its "instructions" stand in the order of the plan."""
        row = int(self.start_row[world])
        return describe_episode(
            self.pool.episodes[row], self.pool.plans[row], self.config.subtask, self._narrator
        )

    def check_taint(self) -> None:
        """For evaluation: complain if a buffer of the engine overflowed, or an action was not finite, at any time.

        Raises:
            UsageError: names the buffer and a size for the option ``buffers``; or says how many actions were bad.
        """
        self.sim.check_overflow()
        if bad := int(self.bad_actions):
            raise UsageError(
                f"actions must be finite; {bad} actions of single worlds were not, and counted as 0 there"
            )
