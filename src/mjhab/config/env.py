"""Configuration of the environments: frozen, with defaults, checked where it is made."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, ClassVar

from mjhab.config.perturbing import PerturbationPlan, axes_text, parse_axes
from mjhab.config.profiles import (
    DEFAULT_PROFILE,
    FREE_OPTIONS,
    SPAWN_RULES,
    Profile,
    profile_named,
)
from mjhab.core.conventions.names import AXES, JOINT_ANGLES, Conventions
from mjhab.core.errors import UsageError, missing_field, unknown_name, wrong_value
from mjhab.core.typed.bounds import SEED, Bound
from mjhab.core.typed.flags import Flag, Keyed
from mjhab.core.typed.options import take_options
from mjhab.robots.registry import DEFAULT_ROBOT, robot_named
from mjhab.robots.robot import Robot
from mjhab.scenes.pack_source import HOME_SUFFIXES, Assets, PackRequest, pack_request
from mjhab.scenes.shading import RASTER, Shading, shading_of
from mjhab.scenes.spec import HANDLE_POINTS, JOINT_DYNAMICS
from mjhab.sim.backends import BACKENDS, check_device
from mjhab.tasks.household.registry import TASKS
from mjhab.tasks.household.spec import TaskSpec
from mjhab.tasks.scoring import REWARD_FORMULAS, REWARD_NORMALISERS, RewardOptions
from mjhab.tasks.subtasks.registry import SUBTASKS
from mjhab.tasks.subtasks.spec import SubtaskSpec
from mjhab.tasks.thresholds import STILLNESS, SubtaskConfig

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
STILL_FINGERS = "still"
COMMANDED_FINGERS = "commanded"
TELEPORT_FINGERS = (STILL_FINGERS, COMMANDED_FINGERS)
OF_PROFILE: Any = None
"""Default of the options whose value the profile determines."""
PERTURBING = ("perturb", "randomise")
"""Options that perturb episodes."""
LIMITS = tuple(part.name for part in dataclasses.fields(SubtaskConfig))
"""Names of the limits of a kind of subtask, which overrides may change."""


@dataclass(frozen=True)
class EnvConfig:
    """Options of an environment: robot, homes, task, observations, actions, rewards, episodes and backend.

    None stands for the default of every option. A binding profile such as "ms_hab" refuses other values of the options
    that it decides about, but for ``horizon`` and ``frame_stack``.
    """

    trains: ClassVar[bool] = False
    """Whether it is a configuration of `make_train`."""

    profile: Annotated[str, Flag(metavar="mjhab|ms_hab")] = DEFAULT_PROFILE
    """Values of many options at once, see `profiles.Profile`: ms_hab is the environment of the MS-HAB paper (see
    docs/environments.md). It gives values to the options that are those of the profile by default, and to the horizon
    if that is 0."""
    robot: str = DEFAULT_ROBOT
    """The robot, see `mjhab robots list`."""
    task: str = "set_table"
    """What to do: set_table, tidy_house, prepare_groceries or one of a plugin."""
    subtask: Annotated[str, Flag(shown="default: the whole task")] = ""
    """One subtask alone, from spawned starts and to its horizon, such as pick (`mjhab envs list` names all); "" for the
    whole task, a chain of subtasks."""
    target: Annotated[str, Flag(shown="default: all of them")] = ""
    """With a subtask: the object or link to act on, e.g. 024_bowl or kitchen_counter/drawer3; "" or "all" for any."""
    num_envs: Annotated[int, Flag("worlds"), Bound(1, 10_000_000)] = 1
    """Number of parallel worlds. Changes the speed, never the results."""
    split: Annotated[str, Flag(metavar="train|val|test")] = "train"
    """Which homes to draw from: train, val or test."""
    home: Annotated[
        str, Flag(metavar="NAME|PATTERN|FILE", shown="default: all of the split")
    ] = ""
    """Only this home, or the homes that fit a pattern such as 'v3_sc0_*', in turn (see: mjhab homes list); or a home
    file."""
    assets: Annotated[Assets, Flag(metavar="builtin|FOLDER", kind=PackRequest)] = (
        "builtin"
    )
    """Asset pack: builtin, the name of another pack, or the folder of one; in Python also a `PackRequest`."""
    extra_objects: tuple[str, ...] = ()
    """Types of further objects, one slot each behind those of the task's roster. A target that is another object of the
    pack gets a slot, too."""
    seed: Annotated[int, SEED] = 0
    """Seed of the run; seed and index determine an episode. In an evaluation the global generators of Python, numpy and
    torch begin from it, too, for policies that draw from them."""
    threads: Annotated[int, Bound(most=1024)] = 0
    """Threads of physics and rendering; 0 takes all cores. Changes the speed, never the results."""
    obs_mode: Annotated[str, Flag("obs", "MODE")] = "state"
    """Observation mode: state, proprioception, depth, rgb, rgbd, seg, pointcloud, or several joined by +, see
    `envs.observations.modes`."""
    cameras: tuple[str, ...] = OF_PROFILE
    """Names of the robot's cameras, or one name; by default those of the profile, else all."""
    camera_size: Annotated[int | tuple[int, int], Bound(1, 4096)] = 128
    """Pixels of the camera images: their side, or height and width."""
    shader: Annotated[str, Flag(metavar="raster|path")] = RASTER
    """How colours are drawn: by the rasterizer, or as in a photograph by a path tracer (extra ``photo``, backend cpu).
    Depth and segmentation are those of the rasterizer, whose geometry is traced."""
    shading: Annotated[
        Mapping[str, int | float | bool | str], Keyed("OPTION", "VALUE")
    ] = field(default_factory=dict)
    """Options of shader path: samples (paths per pixel, 4), light (midday or evening), variant (scalar_rgb, llvm_ad_rgb
    or cuda_ad_rgb) and denoise (true), see `scenes.shading.Shading`."""
    obs_keys: Annotated[str, Flag(hidden=True)] = FLAT
    """Keys of observations: "flat" as in ``obs["extra/is_grasped"]``, "nested" as in ``obs["extra"]["is_grasped"]``, or
    "whole": the state as one vector, ``obs["state"]``, without its parts. Recorders take flat keys, wrappers flat or
    whole."""
    frame_stack: Annotated[int, Flag(hidden=True), Bound(1, 256)] = OF_PROFILE
    """Frames that `wrappers.FrameStack` stacks; 1 leaves the number to the wrapper's argument."""
    control_mode: Annotated[str, Flag("control", "MODE")] = "pd_joint_delta_pos"
    """Control mode of the actions, e.g. pd_ee_delta_pose, see `controllers.make_controller`."""
    base: Annotated[str, Flag(metavar="forward|holonomic")] = "forward"
    """How the base drives: forward and turning, or holonomic, to the sides, too."""
    stationary: tuple[str, ...] = OF_PROFILE
    """Groups of joints that do not follow their actions."""
    reward_mode: Annotated[str, Flag("reward", "MODE")] = ""
    """The reward: pointer, sparse, dense, normalized_dense or none; "" is pointer for a whole task, sparse for one
    subtask."""
    reward_scales: Annotated[
        Mapping[str, Mapping[str, float]], Keyed("SUBTASK.TERM", "NUMBER")
    ] = field(default_factory=dict)
    """Changes of the scales of single dense reward terms, as {"pick": {"reach": 4.0}}."""
    reward_formula: Annotated[str, Flag(metavar="bounded|published")] = OF_PROFILE
    """How dense reward terms are computed, see `tasks.scoring.RewardOptions`."""
    reward_normaliser: Annotated[str, Flag(metavar="attainable|published")] = OF_PROFILE
    """What normalized_dense divides by, see `tasks.scoring.RewardOptions`."""
    stillness: Annotated[str, Flag(metavar="absolute|published")] = OF_PROFILE
    """Whether a joint that moves backwards counts as moving (absolute) or as still (published), see
    `TaskConfig.stillness`."""
    horizon: Annotated[int, Flag(shown="default: that of the profile")] = 0
    """Control steps of every subtask; 0 for those of the profile."""
    continuous: bool | None = None
    """One subtask runs to its horizon and success may come and go; False ends it at success or failure. None: True for
    one subtask, False for a whole task."""
    overrides: Annotated[Mapping[str, Any], Keyed("THRESHOLD")] = field(
        default_factory=dict
    )
    """Other values of `tasks.thresholds.TaskConfig`, as {"goal_type": "cylinder", "pick.force_limit": 2000}."""
    force_limits: bool = OF_PROFILE
    """Whether the limits on the cumulative force are in force."""
    episode_pool: int = 0
    """0 gives every reset an arrangement of objects of its own; n draws one of n, so that a long training finds them in
    the cache. Where the robot starts is drawn anew each time all the same."""
    open_start: Annotated[float, Flag(metavar="SHARE"), Bound(most=1)] = 0.0
    """Share of the resets of Open that find a drawer already 20 % of the way to open."""
    spawn_rule: Annotated[str, Flag(metavar="front_box|published")] = OF_PROFILE
    """Start positions of Pick and Place at a drawer or fridge, and start posture of the arm in Place, see
    `profiles.Profile`."""
    spawns: Annotated[str, Flag(metavar="FILE.npz")] = ""
    """With a subtask: use the start states of this file (see: mjhab spawns make)."""
    handle_points: Annotated[str, Flag(metavar="ours|published")] = OF_PROFILE
    """What observations and rewards of Open and Close take for the handle: "ours", the point at which our collision
    geometry is gripped, or "published", the point that the original's plans name (3 to 4 cm off). Built-in furniture
    and the fridge's lower door have no published points and keep ours."""
    object_axes: Annotated[str, Flag(metavar="object|scan")] = OF_PROFILE
    """Axes of the pose of the observed object: "object", along the sides of a box, or "scan", those of its YCB scan,
    which the original observes."""
    joint_angles: Annotated[str, Flag(metavar="wrapped|unwrapped")] = OF_PROFILE
    """Angles of joints without limits: "wrapped" to within half a turn, in observations and where the distance from
    rest is judged, or "unwrapped", counted on over every turn, as the original does."""
    joint_dynamics: Annotated[str, Flag(metavar="ours|published")] = OF_PROFILE
    """Damping, dry friction, stops and range of the joints of furniture: "ours", or "published", those of the URDFs
    (0.01 and 0.01, stops that do not bounce), which built-in furniture has, too, since it stands in for ReplicaCAD.
    With "published" a door that a wall stops keeps its range and meets the wall, see `layout.joints`. What was
    recorded without it had "ours"."""
    perturb: Annotated[
        str | Mapping[str, int], Flag(metavar="AXIS:LEVEL,...", kind=str)
    ] = ""
    """Perturb every episode, such as camera:3,light:2: levels 1 to 5 of camera, light, colours, layout, start, language
    and noise, or all:2 for every one of them (see docs/perturbations.md). What is not perturbed stays as it is."""
    randomise: Annotated[
        str | Mapping[str, int], Flag(metavar="AXIS:LEVEL,...", kind=str)
    ] = ""
    """Domain randomisation: the same axes, at a level that is drawn for every episode, from 0 to the one that is
    named."""
    autoreset: Annotated[str, Flag(hidden=True)] = "same_step"
    """What happens after an episode's end: "same_step", "next_step" or "disabled"."""
    episodes_file: Annotated[str, Flag(metavar="FILE")] = ""
    """A file in the HAB format (.json or .json.gz) whose i-th episode is episode i, in the home it names; "" to
    generate episodes."""
    navigate: Annotated[str, Flag(metavar="teleport|drive")] = "teleport"
    """In a whole task: teleport puts the robot near every goal, as in the paper; drive leaves driving to the policy,
    and arm and grasp count. Navigate alone is always driven."""
    teleport_fingers: Annotated[str, Flag(hidden=True)] = STILL_FINGERS
    """Fingers of an empty hand in the control step of a teleport: "still" in the rest posture, as where a subtask is
    drawn alone, or "commanded", which follow the last command of the subtask before, so that the next one begins while
    they move. What was recorded without it had "commanded"."""
    render_mode: Annotated[str | None, Flag(hidden=True)] = ""
    """"rgb_array" makes ``render()`` give human views."""
    backend: Annotated[str, Flag(metavar="cpu|warp|auto")] = "cpu"
    """Simulation backend: "cpu"; "warp" for the environments on a GPU, `device.DeviceEnv`; "auto" is warp where
    there is CUDA."""
    device: Annotated[str, Flag(metavar="DEVICE")] = ""
    """Device of backend warp: "" for the first GPU; "cpu" is slow, for tests. Backend cpu takes no other than these."""
    starts: Annotated[int, Flag(hidden=True)] = 0
    """With backend warp: how many precomputed starts worlds draw from; 0: by the number of worlds."""
    buffers: Annotated[Mapping[str, int], Keyed("NAME", "N")] = field(
        default_factory=dict
    )
    """With backend warp: other sizes of the engine's buffers, see `BufferSizes`."""

    def __post_init__(self) -> None:
        # Easily mixed up with the spawn rule; the check of types below would only say that a text is no number.
        if isinstance(self.starts, str):
            raise wrong_value(
                "starts",
                self.starts,
                "the number of starts that the warp backend keeps",
                f"Where the robot starts is spawn_rule: {', '.join(SPAWN_RULES)}.",
            )
        # One name alone is taken as well; a tuple of its letters is what the check of types would make of it.
        if isinstance(self.cameras, str):
            object.__setattr__(self, "cameras", (self.cameras,))
        # Before all that reads values: from here on each has the type of its annotation, and None has become the
        # default.
        take_options(self)
        # One form of the same wish, so that records and configurations of equal runs are equal.
        if self.target == "all":
            object.__setattr__(self, "target", "")
        # Before the assets are resolved: a home that is a file replaces them.
        self._take_home_file()
        object.__setattr__(self, "assets", pack_request(self.assets).as_json())
        robot = robot_named(self.robot)
        # Before the names are checked: the profile gives those options their values.
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
        _known("fingers in teleports", self.teleport_fingers, TELEPORT_FINGERS)
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
            raise wrong_value(
                "continuous",
                True,
                "left out without a subtask: in a chain, success is what brings the next subtask",
            )
        if self.episodes_file:
            for name in ("spawns", "extra_objects"):
                if getattr(self, name):
                    raise wrong_value(
                        name,
                        getattr(self, name),
                        "left out with episodes_file, which has objects and places of its own",
                    )
        self._take_perturbations()
        # Said here and not in the first step: a robot without fingers fails a Pick only when it grasps.
        for name in (self.subtask,) if self.subtask else task.subtasks:
            robot.require(SUBTASKS[name].joint_groups, f"subtask {name!r}")
        self._check_backend()

    def _take_perturbations(self) -> None:
        """Write the axes of perturbations in their one form, a text.

        Raises:
            UsageError: there is no such axis or level, or one is asked for by both options.
        """
        # Texts and mappings that mean the same must give the same record and the same hash of a run.
        axes = {name: parse_axes(getattr(self, name), name) for name in PERTURBING}
        for name in PERTURBING:
            object.__setattr__(self, name, axes_text(axes[name]))
        for axis in set(axes["perturb"]) & set(axes["randomise"]):
            raise UsageError(
                f"{axis!r} is in perturb and in randomise: its level is fixed or drawn.",
                option="perturb",
                given=axis,
            )

    @property
    def perturbations(self) -> PerturbationPlan:
        """Which axes are perturbed."""
        return PerturbationPlan(*(parse_axes(getattr(self, name)) for name in PERTURBING))

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
        # Two packs for one environment would contradict each other, and neither is the obvious one.
        if self.assets != "builtin":
            raise wrong_value(
                "assets",
                self.assets,
                f"left out: home {self.home!r} is a file, which is a pack of its own",
            )
        object.__setattr__(self, "assets", self.home)
        # All homes of the file: its name is no name of a home.
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
            # The horizon has an own mark for "not given", because None stands for the default of an option.
            missing = given is OF_PROFILE or (name == "horizon" and given == 0)
            if missing:
                object.__setattr__(self, name, value)
            elif (
                profile.binding
                and name not in FREE_OPTIONS
                # Configurations that were read from JSON hold lists in place of tuples.
                and (tuple(given) if isinstance(given, list) else given) != value
            ):
                raise _contradiction(profile, name, value, given)
        if profile.binding:
            # Overrides reach the same limits as options do; without this a result could bear the paper's name with
            # other rules.
            for name, value in self.overrides.items():
                limit = name.partition(".")[2]
                if limit in LIMITS and limit not in FREE_OPTIONS:
                    raise _contradiction(profile, name, "that of the paper", value)

    def _check_subtask(self, task: TaskSpec, subtask: SubtaskSpec) -> None:
        if subtask.name not in task.subtasks:
            having = [name for name in TASKS if subtask.name in TASKS[name].subtasks]
            raise wrong_value(
                "subtask",
                subtask.name,
                tuple(task.subtasks),
                f"{subtask.name!r} belongs to: {', '.join(having) or 'no task'}.",
                f"task {task.name!r}",
            )
        if self.reward_mode == "pointer":
            raise wrong_value(
                "reward_mode",
                self.reward_mode,
                "one for a single subtask, such as 'sparse'",
                "It counts the subtasks of a chain.",
            )

    def _check_backend(self) -> None:
        for name in ("starts", "buffers"):
            if self.backend == "cpu" and getattr(self, name):
                raise wrong_value(
                    name, getattr(self, name), "left out with backend 'cpu'"
                )
        check_device(self.backend, self.device)
        if self.path_shading is not None and self.backend != "cpu":
            raise UsageError(
                f"shader {self.shader!r} draws with backend 'cpu' (got {self.backend!r}); its variant cuda_ad_rgb "
                "takes the GPU there."
            )

    @property
    def path_shading(self) -> Shading | None:
        """The options of the path tracer, None for the rasterizer."""
        return shading_of(self.shader, self.shading)

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
            raise missing_field(
                "subtask",
                "SubtaskTrain environment",
                f"Valid names: {', '.join(SUBTASKS)}.",
            )


def _contradiction(profile: Profile, name: str, value: Any, given: Any) -> UsageError:
    """The error for an option that a profile does not leave free."""
    advice = (
        f"Leave out {name}, or the profile: {DEFAULT_PROFILE!r} leaves all options free."
    )
    return wrong_value(name, given, repr(value), advice, f"profile {profile.name!r}")


def _known(what: str, name: str, valid: tuple[str, ...]) -> None:
    if name not in valid:
        raise unknown_name(what, name, valid)
