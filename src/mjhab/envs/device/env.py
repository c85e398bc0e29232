"""The HAB tasks on the warp backend: the control step of `envs.loop` on torch tensors on the device.

No step waits for the device or copies to or from the host. Masks select the worlds that begin a subtask, end or become
invalid, and all shapes are constant.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import AbstractContextManager
from numbers import Integral
from typing import Any

import torch
from gymnasium.vector import VectorEnv

from mjhab.config.env import EnvConfig
from mjhab.core.arrays import to_numpy
from mjhab.core.errors import wrong_value
from mjhab.core.joints import BASE_XY
from mjhab.core.seeding import stream
from mjhab.core.typed.checks import check_shape
from mjhab.envs.device.notes import DeviceNotes, DeviceStepNotes
from mjhab.envs.device.observing import DeviceObserver
from mjhab.envs.device.pool import StartPool, pool_size
from mjhab.envs.device.teleport_poses import Teleporter
from mjhab.envs.loop import TaskLoop
from mjhab.envs.parts.memory import WorldPictures, check_device_memory
from mjhab.envs.parts.plan_tables import Rows
from mjhab.envs.parts.reporting import describe_episode
from mjhab.envs.parts.rewarding import RewardInputs
from mjhab.episodes.narration import InstructionGenerator
from mjhab.episodes.source import EpisodeSource, open_setting
from mjhab.robots.controllers import make_controller
from mjhab.sim.mujoco.cpu import CpuSimulator
from mjhab.sim.warp.device import room_for
from mjhab.sim.warp.simulator import WarpSimulator
from mjhab.tasks.progress import Progress, StepOutcome
from mjhab.tasks.signals import Signals
from mjhab.tasks.subtasks.registry import event_columns, horizons

Tensor = torch.Tensor


class DeviceEnv(TaskLoop, VectorEnv):
    """HAB tasks on MuJoCo Warp. Build it with `mjhab.envs.make(backend="warp")` or `make_train`.

    Spaces, observations, rewards and flags are those of `SequentialTaskEnv`, as tensors (W, ...) on ``device``, float32
    where that has float64. The differences are:

    * Episodes come from a pool of P starts: the k-th episode of world w is start (w + k W) mod P, and start i is the
      episode (seed, i) of the cpu backend. A reset with another seed makes a new pool, which takes time; `draw_starts`
      does not.
    * `info` holds tensors only: "event_flags" (W, E) bool with the columns `registry.event_columns`, "ended" (W,) bool
      for subtasks that ended in this step, and "label" (W,) for their labels, -1 for none. `records` and `episode_spec`
      make records and descriptions of episodes on the host.
    * A teleport never waits; see `teleport_poses`.
    * Entries of an action that are not finite count as 0; `check_taint` reports them.
    * With autoreset "same_step" images of the final observations are drawn in every step, whether an episode ends or
      not; those of worlds that begin an episode or teleport are drawn again.
    """

    observer: DeviceObserver
    sim: WarpSimulator
    tables: Rows
    tracker: DeviceNotes

    def __init__(self, config: EnvConfig) -> None:
        if config.render_mode:
            raise wrong_value(
                "render_mode",
                config.render_mode,
                "left out with backend 'warp'",
                "Backend 'cpu' gives human views.",
            )
        config.perturbations.check_device()
        check_device_memory(
            config.num_envs,
            WorldPictures(config.obs_mode, config.camera_size, len(config.cameras)),
            config.device,
        )
        setting = open_setting(config)
        drives = make_controller(
            config.control_mode,
            robot=setting.layout.robot,
            base=config.base,
            stationary=config.stationary,
        ).drives
        # One world is enough: it compiles homes and makes starts, and steps nothing.
        host = CpuSimulator(setting.layout, 1, config.threads, drives)
        self.sim = WarpSimulator(
            setting.layout, config.num_envs, config.device, drives, buffers=config.buffers
        )
        self.device: torch.device = self.sim.qpos.device
        with room_for(config.num_envs, self.sim.device):
            # Inside, because its arrays are the first that take device memory.
            super().__init__(
                config, torch.zeros(1, dtype=torch.float32, device=self.device)
            )
            self._make_parts(self._nav_distance)
            self.observer = DeviceObserver(
                self.sim,
                self.sensing,
                config.obs_mode,
                config.cameras,
                config.camera_size,
            )
            # Room for the steps of any subtask, since shapes are constant.
            longest = max(horizons(self.task_config))
            self.tracker = DeviceNotes(
                self.num_envs, longest, self.device, self.config.teleports
            )
            self.teleporter = Teleporter(self.sim.addresses, self.device)
            self._narrator = InstructionGenerator(self.layout)
            self._source = EpisodeSource(host, config, self.task_config, setting.file)
            self.pool = StartPool(self._source, self.sim, pool_size(config), config.seed)
            self._set_spaces(self.observer.single_space, render_modes=[], tensors=True)
            self.start_row = torch.zeros_like(self._worlds)
            # Before a reset moves the worlds on: records are of the episodes that ended.
            self._judged_row = self.start_row
            """(W,) index in the pool of each world's start (``start_row``), and of its start in the last step."""
            self.tainted = torch.zeros((), dtype=torch.int64, device=self.device)
            self.bad_actions = self.tainted
            """``tainted``: number of episodes that ended with a taint. ``bad_actions``: number of actions (A,) with an
            entry that was not finite."""
            self.tables = self.pool.rows(self.start_row)
            self._init_worlds()

    def _room(self) -> AbstractContextManager[None]:
        """Context for work that allocates device memory: it turns a lack of memory into a `UsageError`."""
        return room_for(self.num_envs, self.sim.device)

    def _nav_distance(self, inputs: RewardInputs) -> Tensor:
        fields = self.pool.fields
        at = self.pool.field_index[self.start_row, self.focus.active.index]
        xy = inputs.world.base_pose[:, BASE_XY]
        return torch.zeros_like(xy[:, 0]) if fields is None else fields.at(at, xy)

    # -- episodes --------------------------------------------------------------------------------------------------

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[dict, dict]:
        """Start episodes.

        Args:
            seed: seed of the pool; a new seed makes a new pool, None keeps the present one.
            options: "reset_mask" (W,) bool: worlds to reset (default all); "episode": numbers of starts in the pool
                that the worlds in the mask get, in order of worlds.

        Raises:
            UsageError: unknown option, shapes that do not fit, no such start, or no room on the device.
        """
        with self._room():
            return super().reset(seed=seed, options=options)

    def _reseed(self, seed: Any, mask: Tensor) -> None:
        if seed is None:
            return
        if isinstance(seed, bool) or not isinstance(seed, Integral) or seed < 0:
            raise wrong_value(
                "seed", seed, "one number >= 0 for all worlds of backend 'warp'"
            )
        # The pool belongs to its seed, and takes long to make.
        if seed != self.pool.seed:
            if not bool(mask.all()):
                raise wrong_value(
                    "reset_mask",
                    mask.tolist(),
                    "left out with a new seed, which is for all worlds",
                )
            self.pool = StartPool(self._source, self.sim, self.pool.count, int(seed))
        self.count = torch.where(mask, 0, self.count)

    def draw_starts(self, seed: int) -> None:
        """Let ``seed`` draw with which of its starts in the pool each world goes on; the next resets begin there.

        Its further episodes follow in the order of the pool. Unlike a reset with another seed this takes no time, and
        the pool keeps its starts.
        """
        drawn = stream(seed, "starts").integers(self.pool.count, size=self.num_envs)
        self.count = torch.as_tensor(drawn, device=self.device)

    def _next_episodes(self) -> Tensor:
        return (self._worlds + self.count * self.num_envs) % self.pool.count

    def _chosen_episodes(self, wanted: Any, mask: Tensor) -> Tensor:
        count = int(mask.sum())
        try:
            chosen = torch.as_tensor(wanted, device=self.device)
        except (TypeError, ValueError, RuntimeError):
            # Of no length that fits, so that the check below refuses it.
            chosen = torch.zeros(0)
        # A float would be cut off silently, and a bool be taken for 0 and 1.
        integral = not (chosen.is_floating_point() or chosen.dtype == torch.bool)
        if (
            chosen.shape != (count,)
            or not integral
            or bool(((chosen < 0) | (chosen >= self.pool.count)).any())
        ):
            raise wrong_value(
                "options['episode']",
                wanted,
                f"{count} starts in [0, {self.pool.count}), one per reset world",
                "Option starts sets how many there are.",
            )
        # Tensors that were returned are never modified.
        rows = self.start_row.clone()
        rows[mask] = chosen.to(rows.dtype)
        return rows

    def _adopt(self, fresh: Tensor, episodes: Tensor) -> None:
        self.start_row = torch.where(fresh, episodes, self.start_row)
        self.tables = self.pool.rows(self.start_row)
        self.fallback = torch.where(
            fresh, self.pool.fallback[self.start_row], self.fallback
        )

    def _place(self, fresh: Tensor, moved: Tensor) -> Tensor:
        pool = self.pool
        row = self.start_row
        qpos = pool.qpos[row]
        leaping = self._no
        if self.config.teleports:
            leaping = moved & self.focus.navigates
            at = self.focus.active.index
            there = self.teleporter.moved(
                self.sim.qpos,
                self.state,
                pool.teleport_poses[row, at],
                self.focus.columns[:, 1],
            )
            # A start has its first teleport in it already.
            qpos = torch.where(fresh[:, None], qpos, there)
            self.fallback = self.fallback | (leaping & pool.landing_fallback[row, at])
        self.sim.reset_masked(
            fresh, pool.home_rows[row], qpos, pool.ctrl[row], pool.rings[row], leaping
        )
        return fresh | leaping

    # -- step ------------------------------------------------------------------------------------------------------

    def step(self, actions: Any) -> tuple[dict, Tensor, Tensor, Tensor, dict]:
        """Advance every world by one control step of 50 ms, see `TaskLoop.step`.

        Args:
            actions: (W, A) tensor on the device, clipped to the action space.

        Raises:
            UsageError: wrong shape or type, nothing has been reset yet, or no room on the device.
        """
        with self._room():
            return super().step(actions)

    def _checked(self, actions: Any) -> Tensor:
        # Without detach, the engine's buffers would keep the policy's autograd graph, which grows with every step.
        actions = torch.as_tensor(actions, device=self.device).detach()
        need = (self.num_envs, len(self.action_table))
        # torch would convert them silently.
        if actions.dtype in (torch.bool, torch.complex64, torch.complex128):
            raise wrong_value("actions", actions.dtype, "numbers (float32)")
        check_shape("actions", actions, need)
        # Counted and set to 0 in place of an error, which would have to wait for the device.
        finite = torch.isfinite(actions)
        self.bad_actions = self.bad_actions + (~finite.all(-1)).sum()
        return torch.where(finite, actions, 0).to(torch.float32)

    def _simulate(self, ctrl: Tensor) -> Tensor:
        self.sim.step(ctrl)
        # A copy, since the next step overwrites the mask.
        broken = self.sim.broken().clone()
        self.sim.mend_broken()
        return broken

    def _note(
        self, signals: Signals, outcome: StepOutcome, progress: Progress
    ) -> DeviceStepNotes:
        flags = self.tracker.update(signals, progress)
        label = self.tracker.end(signals, outcome, progress)
        self._judged_row = self.start_row
        self.tainted = self.tainted + ((self.sim.taint() != 0) & outcome.done).sum()
        return DeviceStepNotes(flags, outcome.ended, label)

    def _nothing(self) -> DeviceStepNotes:
        shape = (self.num_envs, len(event_columns()))
        flags = torch.zeros(shape, dtype=torch.bool, device=self.device)
        return DeviceStepNotes(flags, self._no, torch.full_like(self._worlds, -1))

    def _observe(
        self, known: dict[str, Tensor] | None = None, changed: Tensor | None = None
    ) -> dict[str, Tensor]:
        # The renderer remembers what it drew before.
        assert self.signals is not None
        return self.observer.observe(self.state, self.focus, self.signals, changed)

    def timed_methods(self) -> dict[str, list[tuple[Any, str]]]:
        """See `TaskLoop.timed_methods`."""
        renderer = self.observer.renderer
        return super().timed_methods() | {
            "labels": [(self.tracker, "update"), (self.tracker, "end")],
            "render": [] if renderer is None else [(renderer, "draw")],
            "observe": [(self.observer, "observe")],
            "reset": [(self, "_renew")],
        }

    # -- told on the host ------------------------------------------------------------------------------------------

    def records(self) -> list[dict[str, Any] | None]:
        """(W,) records of the subtasks that ended in the last step, like ``info["ended"]`` of the cpu backend."""
        rows = to_numpy(self._judged_row).tolist()
        return self.tracker.records([self.pool.plans[row] for row in rows])

    def episode_spec(self, world: int) -> Mapping[str, Any]:
        """Description of a world's episode, see `describe_episode`; "instructions" are in the order of the plan."""
        row = int(self.start_row[world])
        return describe_episode(
            self.pool.episodes[row], self.pool.plans[row], self.config, self._narrator
        )

    def check_taint(self) -> None:
        """Refuse results with faults of the simulation since the environment was made; for evaluation.

        Raises:
            UsageError: a buffer of the engine overflowed (with a size for the option ``buffers``), or actions were not
                finite.
        """
        self.sim.check_overflow()
        if bad := int(self.bad_actions):
            raise wrong_value(
                "actions", f"{bad} others", "finite", "They counted as 0 in their worlds."
            )
