"""The control step of the HAB tasks in W worlds, the same for numpy on the host and torch on a device.

Order of one control step: action, controllers, 5 substeps, measure, success, progress, reward, label events, finished
worlds (final observation, reset), next subtasks, observe. Measuring changes nothing; a reset of some worlds leaves
every bit of the others.

Masks (W,) bool select the worlds that begin the next subtask, end or become invalid. On numpy, work that no world needs
is skipped (`core.arrays.may_hold`). On a device all work is done in every step, because reading a mask on the host
would wait for the device.
"""

from __future__ import annotations

import dataclasses
import operator
from collections.abc import Mapping
from typing import Any

from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from mjhab.config.env import NESTED, STILL_FINGERS, EnvConfig
from mjhab.config.thresholds import task_config
from mjhab.core.arrays import (
    Array,
    as_like,
    count,
    device_of,
    may_hold,
    namespace,
    where_rows,
)
from mjhab.core.conventions.names import WRAPPED, Conventions
from mjhab.core.errors import UsageError, unknown_name, wrong_value
from mjhab.envs.backend import BackendWorlds, StepEvents
from mjhab.envs.episode_length import with_episode_length
from mjhab.envs.observations.modes import STATE_KEY
from mjhab.envs.observations.state import state_observation
from mjhab.envs.parts.plan_tables import Focus, look_up
from mjhab.envs.parts.reporting import CHECKERS
from mjhab.envs.parts.rewarding import GoalDistance, Rewarder, RewardInputs, RewardRules
from mjhab.envs.parts.sensing import Sensing
from mjhab.envs.spaces import (
    ObservationSpace,
    action_space,
    batched,
    keyed_space,
    nested,
)
from mjhab.robots.controllers import make_controller
from mjhab.robots.controllers.controller import Controller
from mjhab.robots.registry import robot_named
from mjhab.sim.protocol import TAINTS, SimState
from mjhab.tasks import progress as progress_rules
from mjhab.tasks.household.registry import TASKS
from mjhab.tasks.measure import measure
from mjhab.tasks.progress import Progress, StepOutcome
from mjhab.tasks.signals import Signals, WorldState
from mjhab.tasks.subtasks.registry import properties

_checkers = operator.attrgetter(*CHECKERS)


class TaskLoop(BackendWorlds):
    """Base class of the vector environments of all backends: W worlds of the HAB tasks that step together.

    A subclass sets the attributes of `BackendWorlds` and implements its methods. Arrays (W, ...) that were returned are
    never modified afterwards.

    The attributes ``state``, ``signals``, ``progress`` and ``focus`` describe the present state. ``outcome_signals``
    holds the signals from which success was computed in the last step. It differs from ``signals`` in worlds that
    began a subtask in that step, where it belongs to the subtask before.

    Args:
        config: options of the environment.
        like: an array of the simulator's library, device and float type.
    """

    def __init__(self, config: EnvConfig, like: Array) -> None:
        self.config = config
        self._spec: EnvSpec | None = None
        self.num_envs = config.num_envs
        robot = robot_named(config.robot)
        self.task_config = task_config(config, robot)
        self.controller: Controller = make_controller(
            config.control_mode,
            config.num_envs,
            robot=robot,
            base=config.base,
            stationary=config.stationary,
            like=like,
        )
        # Who observes angles within half a turn commands them so, too.
        self.controller.shortest = config.joint_angles == WRAPPED
        self._like = like
        self._xp = namespace(like)
        self._worlds = count(self.num_envs, like)
        self._no = self._worlds < 0
        """(W,) bool, False everywhere: the mask of no world."""

    @property
    def spec(self) -> EnvSpec | None:
        """What ``gymnasium.make_vec`` made it of, with ``max_episode_steps``; None without it."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        self._spec = with_episode_length(spec, self.config)

    def _make_parts(self, nav_distance: GoalDistance) -> None:
        """Make `Sensing` and `Rewarder`; ``sim`` must be set.

        Args:
            nav_distance: function for the length (W,) [m] of the path to the goal of Navigate.
        """
        config = self.config
        self.layout = self.sim.layout
        self.sensing = self._sensing_class()(
            self.layout,
            self.sim.addresses,
            self.num_envs,
            self._like,
            config.handle_points,
            config.conventions,
        )
        alone = config.subtask
        rules = RewardRules(
            self.task_config,
            config.reward,
            config.reward_options,
            nav_distance,
            [alone] if alone else TASKS[config.task].subtasks,
        )
        self._way = nav_distance
        self.rewarder = Rewarder(
            self.num_envs, rules, self.layout, self.sensing, self._like
        )

    def _sensing_class(self) -> type[Sensing]:
        return Sensing

    def _set_spaces(self, observation: ObservationSpace, **metadata: Any) -> None:
        """Set the attributes of Gymnasium's interface; ``observation``: space of one world, with flat keys."""
        autoreset = AutoresetMode[self.config.autoreset.upper()]
        self.metadata = {"autoreset_mode": autoreset, "render_fps": 20, **metadata}
        # An attribute of Gymnasium's own vector environments; torchrl's GymWrapper reads it instead of the metadata.
        self.autoreset_mode = autoreset
        self.render_mode = self.config.render_mode or None
        self.single_observation_space = keyed_space(observation, self.config)
        self._keys = tuple(self.single_observation_space.spaces)
        self.observation_space = batched(self.single_observation_space, self.num_envs)
        self.single_action_space = action_space(self.controller)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.action_table = self.controller.table
        self.taint_names = TAINTS

    def _init_worlds(self) -> None:
        """Initialise the attributes of worlds that were never reset; ``sim`` and ``tables`` must be set."""
        whole = self._xp.int64
        # Arrays that do not share memory: on numpy, restoring a state writes into them.
        self.count = as_like([0] * self.num_envs, self._like, whole)
        self.nan_resets = as_like([0] * self.num_envs, self._like, whole)
        """``count`` (W,): episodes begun. ``nan_resets`` (W,): times that a world's state became NaN or infinite."""
        self.fallback = self._no
        self.success = self._no
        self.fail = self._no
        self.due = self._no
        """(W,) bool each. ``fallback``: no valid start pose was found for the episode. ``success``, ``fail``: outcome
        of the last step. ``due``: the next step resets the world (autoreset "next_step")."""
        self.reward_terms: dict[str, Array] = {}
        self.joint_start = as_like([0.0] * self.num_envs, self._like)
        self.grip = as_like([1.0] * self.num_envs, self._like, self._xp.float32)
        """``joint_start`` (W,): joint position [m or rad] of the active link when its subtask began. ``grip`` (W,):
        gripper entry of the last action."""
        self.signals: Signals | None = None
        self.outcome_signals: Signals | None = None
        self.state: SimState = self.sim.state()
        # A world that was never reset is treated as one whose episode has ended.
        begun = progress_rules.start(self.tables.arrays, self.task_config)
        self.follow(dataclasses.replace(begun, done=~self._no))

    def follow(self, progress: Progress) -> None:
        """Set ``progress`` and look up ``focus`` again, after pointers or plans have changed."""
        self.progress: Progress = progress
        self.focus: Focus = look_up(self.tables, progress.pointer, self.task_config)

    def timed_methods(self) -> dict[str, list[tuple[Any, str]]]:
        """Methods that `mjhab bench env` times: stage of a control step to its (object, method name) pairs."""
        return {
            "physics": [(self.sim, "step")],
            "measure": [(self, "_sense"), (self, "_measure")],
            "reward": [(self.rewarder, "step")],
        }

    # -- reset -----------------------------------------------------------------------------------------------------

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[dict, dict]:
        """Start episodes; the subclasses define the meaning of seeds and episode numbers.

        Args:
            seed: seed of the episodes from now on; None keeps the present one.
            options: "reset_mask" (W,) bool: worlds to reset (default all); "episode": numbers of the episodes that
                the worlds in the mask get, in order of worlds.

        Raises:
            UsageError: unknown option, shapes or types that do not fit, or the first reset begins no episode. Nothing
                has changed then.
        """
        if not isinstance(options, Mapping | None):
            raise wrong_value(
                "options", options, "a mapping such as {'reset_mask': mask}"
            )
        options = dict(options or {})
        mask = self._array(options.pop("reset_mask", ~self._no))
        wanted = options.pop("episode", None)
        if options:
            raise unknown_name(
                "reset option", next(iter(options)), ("reset_mask", "episode")
            )
        if tuple(mask.shape) != (self.num_envs,) or mask.dtype != self._no.dtype:
            got = (tuple(mask.shape), mask.dtype)
            raise wrong_value("reset_mask", got, f"bool of shape ({self.num_envs},)")
        if self.signals is None and not may_hold(mask):
            raise UsageError("the first reset must begin an episode in some world")
        # Checked before anything changes.
        episodes = None if wanted is None else self._chosen_episodes(wanted, mask)
        self._reseed(seed, mask)
        seen_before = self.signals is not None
        changed = self._renew(mask, self._no, episodes)
        obs = self._observe(changed=changed if seen_before else None)
        return self._keyed(obs), self.info()

    def observe(self) -> dict[str, Any]:
        """Observations (W, ...) of the present state, for instance after `set_state`, which returns none.

        Raises:
            UsageError: `reset` was never called.
        """
        if self.signals is None:
            raise UsageError(
                "there is nothing to observe before the first reset: call env.reset()."
            )
        return self._keyed(self._observe())

    def _keyed(self, obs: dict[str, Array]) -> dict[str, Any]:
        """Observations with the keys of ``config.obs_keys``: flat, nested dicts, or the state as a whole."""
        if self.config.has_flat_keys:
            return obs
        if self.config.obs_keys == NESTED:
            return nested(obs)
        return {key: obs[key] for key in self._keys}

    def _array(self, values: Any) -> Array:
        """Convert values to an array of the backend's library and device; the dtype is kept."""
        return self._xp.asarray(values, device=device_of(self._like))

    def _renew(self, fresh: Array, moved: Array, episodes: Array | None = None) -> Array:
        """Begin episodes in the worlds ``fresh``, and the next subtask in the worlds ``moved``.

        Args:
            fresh: (W,) bool.
            moved: (W,) bool.
            episodes: (W,) int64 index of the episode that each fresh world begins; the next one of each if None.

        Returns:
            (W,) bool, worlds whose physics state was changed.
        """
        moved = moved & ~fresh
        if may_hold(fresh):
            self._restart(fresh, self._next_episodes() if episodes is None else episodes)
        changed = self._place(fresh, moved)
        if may_hold(changed):
            self.state = self.sim.state()
            self.controller.reset(changed, self.state)
        entering = fresh | moved
        if may_hold(entering):
            self._enter_subtask(entering)
        return changed

    def _restart(self, fresh: Array, episodes: Array) -> None:
        """Set progress and outcome of the worlds ``fresh`` to the start of ``episodes``; `_place` sets the physics."""
        xp = self._xp
        self._adopt(fresh, episodes)
        self.count = self.count + fresh
        tables = self.tables.arrays
        self.follow(
            progress_rules.reset_rows(self.progress, fresh, tables, self.task_config)
        )
        self.success = self.success & ~fresh
        self.fail = self.fail & ~fresh
        self.due = self.due & ~fresh
        # Place begins with the object in the closed hand (-1), most others with an open one (1).
        (holding,) = properties(tables.kind[:, 0], "starts_holding")
        held = xp.astype(holding, self.grip.dtype)
        self.grip = xp.where(fresh, 1.0 - 2.0 * held, self.grip)

    def _enter_subtask(self, mask: Array) -> None:
        """Begin the subtask at the pointer of the worlds in ``mask``: joint start, signals, labels, reward memory."""
        now = self.sensing.joint_now(self.state, self.focus)
        self.joint_start = self._xp.where(mask, now, self.joint_start)
        world = self._sense()
        signals = self._measure(world, self.progress)
        self.signals = (
            signals if self.signals is None else where_rows(mask, signals, self.signals)
        )
        self.outcome_signals = (
            self.signals if self.outcome_signals is None else self.outcome_signals
        )
        self.tracker.begin(mask, self.signals, self.progress)
        self.rewarder.begin(mask, self._reward_inputs(world, signals, self.progress))

    # -- step ------------------------------------------------------------------------------------------------------

    def step(self, actions: Any) -> tuple[dict, Any, Any, Any, dict]:
        """Advance every world by one control step of 50 ms.

        Args:
            actions: (W, A), clipped to the action space.

        Returns:
            Observations (W, ...), rewards (W,), terminated (W,) bool, truncated (W,) bool, info (see `_info`).

        Raises:
            UsageError: wrong shape or type, or ``reset`` was not called before.
        """
        if self.signals is None:
            raise UsageError(
                "step() came before reset(): call env.reset(seed=...) first."
            )
        broken = self._advance_physics(self._checked(actions))
        world = self._sense()
        progress = progress_rules.accumulate(
            self.progress, world.robot_force, world.fingers_force
        )
        signals = self._measure(world, progress)
        if may_hold(broken):
            progress, signals = progress_rules.give_up(broken, progress, signals)
        tables = self.tables.arrays
        new, outcome = progress_rules.advance(progress, signals, tables, self.task_config)
        inputs = self._reward_inputs(world, signals, new)
        reward, self.reward_terms = self.rewarder.step(inputs)
        events = self._note(signals, outcome, progress)
        self.progress = new
        if may_hold(outcome.advanced):
            self.follow(new)
        self.signals = signals
        self.outcome_signals = signals
        self.success = outcome.success
        self.fail = outcome.fail
        return self._finish(events, reward, outcome)

    def _advance_physics(self, actions: Array) -> Array:
        """Advance physics by one control step; returns the mask of `_simulate`."""
        if self.config.teleports:
            actions = self._held_still(actions)
        self.grip = actions[:, self.controller.gripper]
        broken = self._simulate(self.controller.ctrl(actions, self.state))
        self.nan_resets = self.nan_resets + broken
        self.state = self.sim.state()
        return broken

    def _held_still(self, actions: Array) -> Array:
        """Actions (W, A) in which worlds that navigate by teleport keep their joint positions and what they hold.

        For the fingers of an empty hand see ``teleport_fingers`` of `EnvConfig`.
        """
        teleporting = self.focus.navigates
        if not may_hold(teleporting):
            return actions
        grip = self.grip
        if self.config.teleport_fingers == STILL_FINGERS:
            assert self.signals is not None
            # Contact of what must be carried, held well or not.
            grip = self._xp.where(
                self.signals.contact, grip, self.controller.present_grip(self.state)
            )
        still = self.controller.still(self.state, grip)
        return self._xp.where(teleporting[:, None], still, actions)

    def _sense(self) -> WorldState:
        return self.sensing.world_state(
            self.state, self.tables, self.focus, self.joint_start
        )

    def _measure(self, world: WorldState, progress: Progress) -> Signals:
        return measure(
            world, self.tables.arrays, progress, self.task_config, self.focus.active
        )

    def _reward_inputs(
        self, world: WorldState, signals: Signals, progress: Progress
    ) -> RewardInputs:
        return RewardInputs(self.state, world, signals, self.focus, progress)

    def _finish(
        self, events: StepEvents, reward: Array, outcome: StepOutcome
    ) -> tuple[dict, Array, Array, Array, dict]:
        """Reset finished worlds according to the autoreset mode, begin next subtasks; returns the result of `step`."""
        mode = self.config.autoreset
        terminated: Array = outcome.place_broken
        if not self.config.runs_to_horizon:
            terminated = terminated | outcome.success | outcome.force_exceeded
        terminated = terminated & outcome.done
        truncated = outcome.done & ~terminated
        fresh = self._no
        seen: dict[str, Array] | None = None
        final: dict[str, Any] = {}
        if mode == "same_step" and may_hold(outcome.done):
            fresh = outcome.done
            seen = self._observe()
            final = {"final_info": self._info(events)}
            final["final_obs"] = self._keyed(seen)
            final |= {"_final_obs": fresh, "_final_info": fresh}
        elif mode == "next_step":
            # Gymnasium: the step after an episode's end is the reset; its action is ignored and its reward is 0.
            fresh = self.due
            reward = self._xp.where(fresh, 0.0, reward)
        if mode != "disabled" or not self.config.subtask:
            moved = outcome.advanced & ~outcome.done
            changed = self._renew(fresh, moved)
        else:
            changed = fresh
        if mode == "next_step":
            self.due = outcome.done
        obs = self._observe() if seen is None else self._observe(seen, changed)
        return self._keyed(obs), reward, terminated, truncated, self._info(events) | final

    def goal_distance(self) -> Array:
        """(W,) length of the path to the goal of Navigate [m], as the dense reward of this environment counts it."""
        signals = self.signals
        assert signals is not None
        return self._way(self._reward_inputs(self._sense(), signals, self.progress))

    def link_state(self) -> Array:
        """(W, 5) state of the active subtask's link, see `Sensing.link_state`; it is not part of observations."""
        return self.sensing.link_state(self.state, self.focus)

    def state_as(self, conventions: Conventions) -> Array:
        """``obs["state"]`` (W, S) of the present state in other conventions, bit by bit as if they were the options.

        Policies that were trained with other ones than those of ``config`` take it. `reset` must have been called.
        """
        signals = self.signals
        assert signals is not None
        context = self.sensing.context(self.state, self.focus, signals, conventions)
        return state_observation(self.observer.state_rows, context)[STATE_KEY]

    def info(self) -> dict[str, Any]:
        """`info` of the present state, without events; `reset` must have been called."""
        return self._info(self._nothing())

    def _info(self, events: StepEvents) -> dict[str, Any]:
        """Make the dict `info`: arrays (W,), which later steps do not modify, and the entries of ``events``.

        Keys: "pointer", "kind" of the active subtask, "steps_left", "robot_force" [N] without the fingers,
        "finger_force" [N] of both fingers, by whatever they touch, "cumulative_force" [N x steps] of the robot's,
        "success", "fail", "taint" (bits of `taint_names`), "nan_resets" so far, "spawn_fallback", the CHECKERS,
        "reward_terms" (name to (W,)). The entries of ``events`` belong to the episode that was stepped, which under
        "same_step" may have ended; all others describe the present state.
        """
        signals = self.signals
        progress = self.progress
        assert signals is not None
        info: dict[str, Any] = {
            "pointer": progress.pointer,
            "kind": self.focus.kind,
            "steps_left": progress.steps_left,
            "robot_force": signals.robot_force,
            "finger_force": self.state.finger_net.sum(1),
            "cumulative_force": signals.cumulative_force,
            "success": self.success,
            "fail": self.fail,
            "taint": self.sim.taint(),
            "nan_resets": self.nan_resets,
            "spawn_fallback": self.fallback,
            "reward_terms": self.reward_terms,
        }
        info.update(zip(CHECKERS, _checkers(signals), strict=True))
        info.update(events.entries())
        return info
