"""Configuration of the environments: frozen, with defaults, checked where it is made."""

from __future__ import annotations

import contextlib
import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from numbers import Real
from pathlib import Path
from typing import Any, ClassVar

from mjhab.config.profiles import (
    DEFAULT_PROFILE,
    FREE,
    SPAWN_RULES,
    Profile,
    profile_named,
)
from mjhab.config.ranges import whole_number
from mjhab.core.conventions.names import AXES, JOINT_ANGLES, WRAPPED, Conventions
from mjhab.core.errors import UsageError, unknown_name
from mjhab.core.typed.options import take_types
from mjhab.robots.registry import DEFAULT_ROBOT, robot_named
from mjhab.robots.robot import Robot
from mjhab.scenes.pack_source import HOME_SUFFIXES, Assets, pack_request
from mjhab.scenes.spec import HANDLE_POINTS, JOINT_DYNAMICS
from mjhab.sim.backends import BACKENDS, check_device
from mjhab.tasks.household.registry import TASKS
from mjhab.tasks.household.spec import TaskSpec
from mjhab.tasks.rewards.scoring import REWARD_FORMULAS, REWARD_NORMALISERS, RewardOptions
from mjhab.tasks.subtasks.registry import SUBTASKS
from mjhab.tasks.subtasks.spec import SubtaskSpec
from mjhab.tasks.thresholds import STILLNESS, SubtaskConfig, TaskConfig

SPLITS = ("train", "val", "test")
AUTORESET_MODES = ("same_step", "next_step", "disabled")
RENDER_MODES = ("", "rgb_array")
FLAT = "flat"
NESTED = "nested"
WHOLE = "whole"
OBS_KEYS = (FLAT, NESTED, WHOLE)
DENSE_MODES = ("dense", "normalized_dense")
REWARD_MODES = ("pointer", "sparse", *DENSE_MODES, "none")
NAVIGATE_MODES = ("teleport", "drive")
OF_PROFILE: Any = None
"""Default of the options whose value the profile determines."""
WHOLE_NUMBERS = (
    "num_envs",
    "seed",
    "threads",
    "horizon",
    "episode_pool",
    "starts",
    "frame_stack",
)
"""Options that are whole numbers, see `config.ranges`."""
_LIMITS = tuple(part.name for part in dataclasses.fields(SubtaskConfig))


@dataclass(frozen=True)
class EnvConfig:
    """Options of an environment: robot, homes, task, observations, actions, rewards, episodes and backend.

    None stands for the default of every option.

    profile: name of a `profiles.Profile`. It gives values to the options whose default is OF_PROFILE, and to
    ``horizon`` if that is 0; after construction the fields hold these values. "ms_hab" refuses other values of these
    options but for ``horizon`` and ``frame_stack``.
    robot: name of a robot, see `mjhab robots list`. task: HAB task. subtask: "" for the whole chain, or one
    kind of it, done alone to its horizon. target: restricts ``subtask`` (or the draw of targets) to an object type or a
    link; "" or "all" for any. split, home: homes to draw from, or one home by name (or a pattern such as ``v3_sc1_*``),
    or a home file. assets: a pack by name or path, or a `PackRequest`; kept as what its ``as_json`` gives. seed: of the
    episodes. threads: 0 takes all cores. extra_objects: types of further objects, one slot each behind those of the
    task's roster; a target that is another object of the pack gets a slot, too. obs_mode: "state", or images too, see
    `observing.OBS_MODES`. cameras: names of the robot's cameras, or one name; camera_size: pixels, one number or
    (height, width).
    obs_keys: "flat" as in ``obs["extra/is_grasped"]``, "nested" as in ``obs["extra"]["is_grasped"]``, or "whole": the
    state as one vector, ``obs["state"]``, without its parts; recorders take flat keys, wrappers flat or whole.
    frame_stack: frames that `wrappers.FrameStack` stacks; 1 leaves the number to the
    wrapper's argument. control_mode, base, stationary: see `controllers.make_controller`. reward_mode: one of
    REWARD_MODES; "" is the pointer for a chain,
    sparse for one subtask. reward_scales: changes of the scales of single dense reward terms, as {"pick": {"reach":
    4.0}}. reward_formula, reward_normaliser: see `tasks.rewards.scoring.RewardOptions`. stillness: "absolute" or
    "published", see `TaskConfig.stillness`. horizon: control steps of every subtask, 0 for those of the profile.
    continuous: one subtask runs to its horizon and success may come and go; False ends it at success or failure; None:
    True for one subtask, False for a chain. overrides: other values of `tasks.thresholds.TaskConfig`, as {"goal_type":
    "cylinder", "pick.force_limit": 2000}. force_limits: False lifts the limits on the cumulative force. episode_pool: 0
    gives every reset an arrangement of its own; n draws one of n, so that a long training finds them in the cache
    (where the robot starts is drawn anew each time all the same). open_start: share of the resets of Open that find a
    drawer already 20 % of the way to open. spawn_rule: "front_box" or "published", see `profiles.Profile`. spawns: file
    of precomputed starts (`mjhab spawns make`). autoreset: what happens after an episode's end. handle_points: what
    observations and rewards of Open and Close take for the handle: "ours", the point at which our collision geometry is
    gripped, or "published", the point that the original's plans name (3 to 4 cm off). Built-in furniture and the
    fridge's lower door have no published points and keep ours. object_axes: axes of the pose of the observed object:
    "object", along the sides of a box, or "scan", those of its YCB scan, which the original observes. joint_angles: of
    joints without limits: "wrapped" to within half a turn, in observations and where the distance from rest is judged,
    or "unwrapped", counted on over every turn, as the original does.
    joint_dynamics: damping, dry friction, stops and range of the joints of furniture: "ours", or "published", those of
    the URDFs (0.01 and 0.01, stops that do not bounce), which built-in furniture has, too, since it stands in for
    ReplicaCAD; with "published" a door that a wall stops keeps its range and meets the wall, see `layout.joints`. What
    was recorded without it had "ours". episodes_file: a file in the HAB format whose i-th
    episode is episode i, in the home it names; "" to generate. navigate: of a chain: "teleport" puts the robot near
    every goal, as the paper does; "drive" leaves the way to the policy, and arm and grasp count. Navigate alone is
    always driven. render_mode: "rgb_array" makes ``render()`` give human views. backend: "cpu"; "warp" for the
    environments on a GPU, `device.DeviceEnv`; "auto" is warp where there is CUDA. device, starts, buffers: of backend
    warp: the device ("" for the first GPU; "cpu" is slow, for tests; backend cpu takes no other than these two); how
    many precomputed starts worlds draw from (0: by num_envs); other sizes of the engine's buffers (`BufferSizes`).
    """

    trains: ClassVar[bool] = False
    """Whether it is a configuration of `make_train`."""

    profile: str = DEFAULT_PROFILE
    robot: str = DEFAULT_ROBOT
    task: str = "set_table"
    subtask: str = ""
    target: str = ""
    num_envs: int = 1
    split: str = "train"
    home: str = ""
    assets: Assets = "builtin"
    extra_objects: tuple[str, ...] = ()
    seed: int = 0
    threads: int = 0
    obs_mode: str = "state"
    cameras: tuple[str, ...] = OF_PROFILE
    camera_size: int | tuple[int, int] = 128
    obs_keys: str = FLAT
    frame_stack: int = OF_PROFILE
    control_mode: str = "pd_joint_delta_pos"
    base: str = "forward"
    stationary: tuple[str, ...] = OF_PROFILE
    reward_mode: str = ""
    reward_scales: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    reward_formula: str = OF_PROFILE
    reward_normaliser: str = OF_PROFILE
    stillness: str = OF_PROFILE
    horizon: int = 0
    continuous: bool | None = None
    overrides: Mapping[str, Any] = field(default_factory=dict)
    force_limits: bool = OF_PROFILE
    episode_pool: int = 0
    open_start: float = 0.0
    spawn_rule: str = OF_PROFILE
    spawns: str = ""
    handle_points: str = OF_PROFILE
    object_axes: str = OF_PROFILE
    joint_angles: str = OF_PROFILE
    joint_dynamics: str = OF_PROFILE
    autoreset: str = "same_step"
    episodes_file: str = ""
    navigate: str = "teleport"
    render_mode: str | None = ""
    backend: str = "cpu"
    device: str = ""
    starts: int = 0
    buffers: Mapping[str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if isinstance(self.starts, str):
            raise UsageError(
                f"starts is the number of starts that the warp backend keeps, got {self.starts!r}; where the robot "
                f"starts is spawn_rule: {', '.join(SPAWN_RULES)}."
            )
        if isinstance(self.cameras, str):
            object.__setattr__(self, "cameras", (self.cameras,))
        take_types(self)
        if self.target == "all":
            object.__setattr__(self, "target", "")
        self._take_home_file()
        object.__setattr__(self, "assets", pack_request(self.assets).as_json())
        robot = robot_named(self.robot)
        self._take_profile(profile_named(self.profile), robot)
        _known("split", self.split, SPLITS)
        _known("autoreset mode", self.autoreset, AUTORESET_MODES)
        _known("reward mode", self.reward_mode, ("", *REWARD_MODES))
        _known("kind of observation keys", self.obs_keys, OBS_KEYS)
        _known("handle points", self.handle_points, HANDLE_POINTS)
        _known("axes of objects", self.object_axes, AXES)
        _known("kind of joint angles", self.joint_angles, JOINT_ANGLES)
        _known("joint dynamics", self.joint_dynamics, JOINT_DYNAMICS)
        _known("navigate mode", self.navigate, NAVIGATE_MODES)
        _known("render mode", self.render_mode or "", RENDER_MODES)
        _known("backend", self.backend, BACKENDS)
        _known("stillness", self.stillness, STILLNESS)
        _known("spawn rule", self.spawn_rule, SPAWN_RULES)
        _known("reward formula", self.reward_formula, REWARD_FORMULAS)
        _known("reward normaliser", self.reward_normaliser, REWARD_NORMALISERS)
        task = TASKS[self.task]
        if self.subtask:
            self._check_subtask(task, SUBTASKS[self.subtask])
        elif self.continuous:
            raise UsageError(
                "continuous=True needs a subtask: in a chain, success is what brings the next subtask."
            )
        if self.episodes_file:
            for name in ("spawns", "extra_objects"):
                if getattr(self, name):
                    raise UsageError(
                        f"episodes_file and {name} exclude each other: a file of episodes has objects and places of "
                        "its own."
                    )
        for name in (self.subtask,) if self.subtask else task.subtasks:
            robot.require(SUBTASKS[name].joint_groups, f"subtask {name!r}")
        self._check_numbers()

    def of_profile(self) -> dict[str, Any]:
        """The profile's name and the values in force of the options that depend on it, for the record of a run."""
        names = profile_named(self.profile).options(self.subtask, trains=self.trains)
        return {name: getattr(self, name) for name in ("profile", *names)}

    def _take_home_file(self) -> None:
        """Turn a home that is a file into the pack of that file, all homes of which are used.

        Raises:
            UsageError: assets are given, too.
        """
        if Path(self.home).suffix not in HOME_SUFFIXES:
            return
        if self.assets != "builtin":
            raise UsageError(
                f"home {self.home!r} is a file, which is a pack of its own: leave out assets (got {self.assets!r})."
            )
        object.__setattr__(self, "assets", self.home)
        object.__setattr__(self, "home", "*")

    def _take_profile(self, profile: Profile, robot: Robot) -> None:
        """Give the options that depend on the profile their values.

        Raises:
            UsageError: one was given a value that contradicts a binding profile.
        """
        values = profile.options(self.subtask, trains=self.trains)
        values["cameras"] = (
            robot.camera_names if profile.cameras is None else profile.cameras
        )
        for name, value in values.items():
            given = getattr(self, name)
            missing = given is OF_PROFILE or (name == "horizon" and given == 0)
            if missing:
                object.__setattr__(self, name, value)
            elif (
                profile.binding
                and name not in FREE
                and (tuple(given) if isinstance(given, list) else given) != value
            ):
                raise _contradiction(profile, name, value, given)
        if profile.binding:
            for name, value in self.overrides.items():
                limit = name.partition(".")[2]
                if limit in _LIMITS and limit not in FREE:
                    raise _contradiction(profile, name, "that of the paper", value)

    def _check_subtask(self, task: TaskSpec, subtask: SubtaskSpec) -> None:
        if subtask.name not in task.subtasks:
            having = [name for name in TASKS if subtask.name in TASKS[name].subtasks]
            raise UsageError(
                f"task {task.name!r} has no subtask {subtask.name!r}; it has {', '.join(task.subtasks)}. "
                f"{subtask.name!r} belongs to: {', '.join(having) or 'no task'}."
            )
        if self.reward_mode == "pointer":
            raise UsageError(
                "reward_mode 'pointer' counts the subtasks of a chain; a single one takes 'sparse'."
            )

    def _check_numbers(self) -> None:
        for name in ("starts", "buffers"):
            if self.backend == "cpu" and getattr(self, name):
                raise UsageError(
                    f"{name} is an option of backend 'warp'; leave it out with backend 'cpu'."
                )
        check_device(self.backend, self.device)
        size = self.camera_size
        for pixels in size if isinstance(size, tuple) else (size,):
            whole_number("camera_size", pixels)
        for name in WHOLE_NUMBERS:
            whole_number(name, getattr(self, name))
        if not 0.0 <= self.open_start <= 1.0:
            raise UsageError(
                f"open_start is a share of resets between 0 and 1, got {self.open_start!r}"
            )

    @property
    def reward(self) -> str:
        """The reward mode in force."""
        return self.reward_mode or ("sparse" if self.subtask else "pointer")

    @property
    def reward_options(self) -> RewardOptions:
        """How dense rewards are computed."""
        return RewardOptions(
            self.reward_scales, self.reward_formula, self.reward_normaliser
        )

    @property
    def conventions(self) -> Conventions:
        """How observations tell poses of objects and angles of joints."""
        return Conventions(self.object_axes, self.joint_angles)

    @property
    def teleports(self) -> bool:
        """Whether the environment does the navigation of a chain."""
        return not self.subtask and self.navigate == "teleport"

    @property
    def has_flat_keys(self) -> bool:
        """Whether observations have flat keys and the parts of the state, as recorders take them."""
        return self.obs_keys == FLAT

    @property
    def runs_to_horizon(self) -> bool:
        """Whether an episode goes on after success (continuous evaluation)."""
        return bool(self.subtask) if self.continuous is None else self.continuous


@dataclass(frozen=True)
class TrainConfig(EnvConfig):
    """Configuration of the SubtaskTrain environments: EnvConfig with the defaults of training.

    Episodes come from a pool of 1,000, the reward is dense and at most 1, one reset in ten of an Open finds the drawer
    ajar (mshab/envs/open.py: without it learning does not start), and Navigate is driven and judged whole.
    """

    trains: ClassVar[bool] = True

    subtask: str = "pick"
    reward_mode: str = "normalized_dense"
    episode_pool: int = 1000
    open_start: float = 0.1

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.subtask:
            raise UsageError(
                f"a SubtaskTrain environment needs a subtask: {', '.join(SUBTASKS)}"
            )


def task_config(config: EnvConfig, robot: Robot) -> TaskConfig:
    """The thresholds in force for a robot: those of the paper, changed by the options of ``config``.

    Raises:
        UsageError: an override names no threshold, or its value has the wrong type.
    """
    base = TaskConfig(
        rest_qpos=robot.rest_qpos,
        joints=robot.columns,
        ee_rest_pos=robot.tool_at_rest,
        base_height=robot.base_height,
        continuous=config.runs_to_horizon,
        ignore_arm=config.teleports,
        stillness=config.stillness,
        endless=robot.endless if config.joint_angles == WRAPPED else (),
    )
    limits = {name: _limits(config, name) for name in SUBTASKS}
    changes: dict[str, Any] = {}
    for name, value in config.overrides.items():
        _override(base, changes, limits, name, value)
    return dataclasses.replace(base, **changes, limits=limits)


def _limits(config: EnvConfig, name: str) -> SubtaskConfig:
    """Horizon and force limit of a kind of subtask under the options of ``config``."""
    limits = SUBTASKS[name].limits
    train_horizon = SUBTASKS[name].train_horizon
    if config.trains and train_horizon is not None:
        limits = dataclasses.replace(limits, horizon=train_horizon)
    if config.horizon:
        limits = dataclasses.replace(limits, horizon=config.horizon)
    if not config.force_limits:
        limits = dataclasses.replace(limits, force_limit=math.inf)
    return limits


def _override(
    base: TaskConfig,
    changes: dict[str, Any],
    limits: dict[str, SubtaskConfig],
    name: str,
    value: Any,
) -> None:
    """Put one override into ``changes`` or ``limits``, checked against the type of the present value."""
    group, _, part = name.partition(".")
    owner: Any = limits.get(group) if part else base
    apart = ("limits", "rest_qpos", "joints", "continuous", "stillness", "endless")
    plain = [f.name for f in dataclasses.fields(base) if f.name not in apart]
    nested = [f"{kind}.{limit}" for kind in SUBTASKS for limit in _LIMITS]
    if name == "stillness":
        raise UsageError(
            f"stillness is an option of its own, not one of the overrides: give stillness={value!r}."
        )
    if name not in (*plain, *nested):
        raise unknown_name("task-config override", name, (*plain, *nested))
    present = getattr(owner, part or name)
    if isinstance(present, tuple) and isinstance(value, list):
        # Configurations that were recorded as JSON hold lists.
        value = tuple(value)
    new: Any = ()
    with contextlib.suppress(TypeError, ValueError):
        new = type(present)(value) if not isinstance(present, bool) else value
    good = isinstance(value, bool) == isinstance(present, bool) and new == value
    # A number may be as low as 0, or as its default, such as -1 for "without limit".
    if isinstance(present, int | float) and good:
        good = new >= min(0, present)
    if isinstance(present, tuple) and good:
        numbers = all(isinstance(n, Real) and math.isfinite(n) for n in new)
        good = numbers and len(new) == len(present)
    if not good:
        raise UsageError(f"override {name} must be like {present!r}, got {value!r}")
    if part:
        limits[group] = dataclasses.replace(owner, **{part: new})
    else:
        changes[name] = new


def _contradiction(profile: Profile, name: str, value: Any, given: Any) -> UsageError:
    """The error for an option that a profile does not leave free."""
    return UsageError(
        f"profile {profile.name!r} has {name} {value!r}, which {name}={given!r} contradicts. Leave out {name}, or the "
        f"profile: {DEFAULT_PROFILE!r} leaves all options free."
    )


def _known(what: str, name: str, valid: tuple[str, ...]) -> None:
    if name not in valid:
        raise unknown_name(what, name, valid)
