"""Arguments of MS-HAB's environments, as options of ours: mapped, told once that they mean nothing, or refused."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mjhab.compat.mshab.files.plans import MsHabTaskPlan
from mjhab.compat.mshab.files.subtasks import SUBTASK_CLASSES, MsHabSubtaskConfig
from mjhab.compat.mshab.worlds.limits import changed_configs, default_configs
from mjhab.compat.mshab.worlds.sensors import SIDE_PX, asked_pictures, is_ray_traced
from mjhab.core.errors import UsageError, fault, unknown_name, warn_once, wrong_value
from mjhab.core.typed.checks import check
from mjhab.robots.registry import DEFAULT_ROBOT

OBS_MODES: dict[str, tuple[str, ...]] = {
    "none": (),
    "state": (),
    "state_dict": (),
    "depth": ("depth",),
    "rgb": ("rgb",),
    "rgbd": ("rgb", "depth"),
    "rgb+depth": ("rgb", "depth"),
    "segmentation": ("seg",),
    "rgb+segmentation": ("rgb", "seg"),
    "depth+segmentation": ("depth", "seg"),
    "rgb+depth+segmentation": ("rgb", "depth", "seg"),
}
"""Observation modes of ManiSkill that are answered, and the pictures they show."""
REWARD_MODES = ("normalized_dense", "dense", "sparse", "none")
RENDER_MODES = ("rgb_array", "all", "sensors")
BACKENDS = {
    "auto": "cpu",
    "cpu": "cpu",
    "physx_cpu": "cpu",
    "gpu": "auto",
    "cuda": "auto",
    "physx_cuda": "auto",
    "warp": "warp",
}
"""Where physics runs, and our backend; a GPU that is not there is the CPU."""
_NO_MEANING = {
    "render_backend": "pictures are drawn where physics runs",
    "enable_shadow": "shadows are those of the way of drawing",
    "human_render_camera_configs": "human views have one camera",
    "viewer_camera_configs": "`mjhab view` has a camera of its own",
    "sim_config": "physics is the same in all environments",
    "parallel_in_single_scene": "every world is drawn alone",
    "enhanced_determinism": "episodes depend on their seeds alone, always",
    "invisible_goals_in_human_render": "human views show no goals",
}
"""Arguments that change nothing here, and why."""
_DECIDED = {
    "num_envs": "Give num_envs beside it.",
    "backend": "Give sim_backend.",
    "subtask": "The id of the environment says it.",
    "obs_mode": "Give obs_mode beside it.",
    "camera_size": "Give sensor_configs.",
    "control_mode": "Give control_mode beside it.",
    "reward_mode": "Give reward_mode beside it.",
    "horizon": "Give max_episode_steps, or task_cfgs.",
    "overrides": "Give task_cfgs.",
    "continuous": "ManiSkillVectorEnv(ignore_terminations=...) says it.",
    "autoreset": "ManiSkillVectorEnv(auto_reset=...) says it.",
    "stationary": "FetchActionWrapper says it.",
}
"""Options of `mjhab.make` that the layer decides, and where."""
_FIXED: dict[str, tuple[Any, str]] = {
    "robot_force_mult": (0.001, "the reward has the published weight of forces"),
    "robot_force_penalty_min": (0.2, "the reward has the published threshold of forces"),
    "target_randomization": (False, "objects start where the plan says"),
    "dist_fn": ("geodesic", "the reward of Navigate goes around the furniture"),
    "use_rot_rew": (True, "the reward of Navigate has its term for the heading"),
    "restrict_articulation_target_area": (True, "Navigate to furniture ends before it"),
}
"""Arguments of which one value is answered, and why no other."""


@dataclass
class Arguments:
    """What an environment was asked for.

    Attributes:
        subtask: "" for a whole task.
        num_envs: worlds.
        obs_mode: key of OBS_MODES. reward_mode: one of REWARD_MODES. control_mode: their name of it.
        render_mode: one of RENDER_MODES, or None.
        camera_size: (height, width) [px].
        ray_traced: whether the shader is one of those that trace rays: ``rt``, ``rt-fast``, ``rt-med``.
        backend: of `mjhab.make`.
        task_plans: plans to draw from; none: episodes of mjhab's generator.
        scene_builder_cls: data set of the plans, or its scene builder.
        spawn_data_fp: file of starts of the plans.
        equal_homes: ``require_build_configs_repeated_equally_across_envs``.
        random_homes: ``randomize_build_configs_per_env``.
        redraws_homes: a reset of all worlds draws homes anew.
        tells_events: ``add_event_tracker_info``.
        open_start: share of resets of Open that find the joint ajar.
        configs: limits by kind of subtask.
        mjhab_options: further options of `mjhab.make`.
    """

    subtask: str
    num_envs: int = 1
    obs_mode: str = "state"
    reward_mode: str = "normalized_dense"
    control_mode: str = "pd_joint_delta_pos"
    render_mode: str | None = None
    camera_size: tuple[int, int] = (SIDE_PX, SIDE_PX)
    ray_traced: bool = False
    backend: str = "cpu"
    task_plans: list[MsHabTaskPlan] = field(default_factory=list)
    scene_builder_cls: Any = ""
    spawn_data_fp: Path | None = None
    equal_homes: bool = True
    random_homes: bool = False
    redraws_homes: bool = False
    tells_events: bool = False
    open_start: float = 0.0
    configs: dict[str, MsHabSubtaskConfig] = field(default_factory=dict)
    mjhab_options: dict[str, Any] = field(default_factory=dict)


def read_arguments(subtask: str, given: Mapping[str, Any]) -> Arguments:
    """Read the keyword arguments of an environment.

    Raises:
        UsageError: an argument is unknown, or has a value that cannot be honoured; the message says what can.
    """
    made = Arguments(subtask, configs=default_configs(subtask))
    for name, value in given.items():
        if name in _NO_MEANING:
            if value:
                warn_once(f"{name} changes nothing in mjhab: {_NO_MEANING[name]}.")
        elif name in _FIXED:
            only, why = _FIXED[name]
            if value != only:
                raise wrong_value(name, value, repr(only), f"Here {why}.")
        elif name in _TAKEN:
            _TAKEN[name](made, value)
        else:
            raise unknown_name(
                "argument of MS-HAB's environments",
                name,
                (*_TAKEN, *_FIXED, *_NO_MEANING),
            )
    if made.random_homes and made.equal_homes:
        raise UsageError(
            "randomize_build_configs_per_env=True needs require_build_configs_repeated_equally_across_envs=False."
        )
    # Not by its taker: num_envs may stand behind it. The original's default builds one world anew in every reset.
    if given.get("reconfiguration_freq") is None:
        made.redraws_homes = made.num_envs == 1
    _check_plans(made)
    return made


def _check_plans(made: Arguments) -> None:
    """Refuse plans that do not fit the environment, or one another."""
    plans = made.task_plans
    if not plans:
        if made.spawn_data_fp is not None:
            raise UsageError(
                "spawn_data_fp needs task_plans, whose uids name the starts in it."
            )
        return
    for number, plan in enumerate(plans):
        if not plan.subtasks:
            raise wrong_value("subtasks", [], "one or more", where=f"plan {number}")
    kinds = [tuple(subtask.type for subtask in plan.subtasks) for plan in plans]
    if made.subtask and set(kinds) != {(made.subtask,)}:
        wrong = next(kind for kind in kinds if kind != (made.subtask,))
        raise wrong_value(
            "task_plans",
            ", ".join(wrong),
            f"plans of one {made.subtask} each",
            f"Take {_env_id(wrong)} for these plans.",
        )
    if len(set(kinds)) > 1:
        raise wrong_value(
            "task_plans",
            sorted(set(kinds))[:2],
            "plans with the same subtasks in the same order",
        )
    if made.subtask and made.spawn_data_fp is None:
        raise fault(
            _env_id((made.subtask,)),
            "with task_plans needs spawn_data_fp, the file of their starts; "
            "`mjhab episodes plans` writes both.",
        )


def _env_id(kinds: tuple[str, ...]) -> str:
    return (
        f"{kinds[0].capitalize()}SubtaskTrain-v0"
        if len(kinds) == 1 and kinds[0] in SUBTASK_CLASSES
        else "SequentialTask-v0"
    )


# -- single arguments --------------------------------------------------------------------------------------------------


def _name_of(
    attribute: str, kind: str, valid: tuple[str, ...]
) -> Callable[[Arguments, Any], None]:
    """Taker of a name in a closed list; None stands for the default."""

    def take(made: Arguments, value: Any) -> None:
        if value is None:
            return
        if value not in valid:
            raise unknown_name(kind, value, valid)
        setattr(made, attribute, value)

    return take


def _plain(attribute: str) -> Callable[[Arguments, Any], None]:
    """Taker of a value as it is; None stands for the default."""

    def take(made: Arguments, value: Any) -> None:
        if value is not None:
            setattr(made, attribute, value)

    return take


def _flag(attribute: str, argument: str) -> Callable[[Arguments, Any], None]:
    """Taker of True or False; None stands for the default."""

    def take(made: Arguments, value: Any) -> None:
        if value is not None:
            check(isinstance(value, bool), argument, value, "True or False")
            setattr(made, attribute, value)

    return take


def _take_robot(made: Arguments, value: Any) -> None:
    name = value[0] if isinstance(value, list | tuple) and len(value) == 1 else value
    if name not in (None, DEFAULT_ROBOT):
        raise wrong_value(
            "robot_uids",
            value,
            repr(DEFAULT_ROBOT),
            "Scripts of MS-HAB act on 13 numbers of this robot; for others see `mjhab robots list` and mjhab.make.",
        )


def _take_render_mode(made: Arguments, value: Any) -> None:
    if value == "human":
        raise wrong_value(
            "render_mode",
            value,
            RENDER_MODES,
            "There is no window; `mjhab view` shows worlds in a browser.",
        )
    _name_of("render_mode", "render mode", RENDER_MODES)(made, value)


def _take_backend(made: Arguments, value: Any) -> None:
    name = "auto" if value is None else str(value).partition(":")[0]
    if name not in BACKENDS:
        raise unknown_name("sim_backend", value, BACKENDS)
    made.backend = BACKENDS[name]


def _take_shader(made: Arguments, value: Any) -> None:
    if value is not None:
        made.ray_traced = is_ray_traced(value)


def _take_sensors(made: Arguments, value: Any) -> None:
    size, shader = asked_pictures(value)
    made.camera_size = size or made.camera_size
    _take_shader(made, shader)


def _take_configs(made: Arguments, value: Any) -> None:
    changed_configs(made.configs, value)


def _take_ajar(made: Arguments, value: Any) -> None:
    # mshab/envs/open.py: a tenth of the worlds.
    made.open_start = 0.1 if value else 0.0


def _take_reconfiguration(made: Arguments, value: Any) -> None:
    if value is not None:
        check(isinstance(value, int), "reconfiguration_freq", value, "a whole number")
    made.redraws_homes = bool(value)


def _take_spawns(made: Arguments, value: Any) -> None:
    made.spawn_data_fp = None if value is None else Path(value).expanduser()


def _take_plans(made: Arguments, value: Any) -> None:
    given = [] if value is None else value
    good = isinstance(given, list | tuple) and all(
        isinstance(plan, MsHabTaskPlan) for plan in given
    )
    advice = "plan_data_from_file(path).plans gives one."
    check(good, "task_plans", value, "a list of TaskPlan", advice)
    made.task_plans = list(given)


def _take_builder(made: Arguments, value: Any) -> None:
    good = value is None or isinstance(value, str) or hasattr(value, "__name__")
    check(good, "scene_builder_cls", value, "the name of a data set, or its class")
    made.scene_builder_cls = value or ""


def _take_own_options(made: Arguments, value: Any) -> None:
    """Options of `mjhab.make`; those that arguments here decide are refused."""
    given = {} if value is None else value
    check(isinstance(given, Mapping), "mjhab_options", value, "a mapping")
    for name in given:
        if name in _DECIDED:
            raise wrong_value(
                "mjhab_options", name, "options that no argument decides", _DECIDED[name]
            )
    made.mjhab_options = dict(given)


_TAKEN: dict[str, Callable[[Arguments, Any], None]] = {
    "num_envs": _plain("num_envs"),
    "obs_mode": _name_of("obs_mode", "obs_mode", tuple(OBS_MODES)),
    "reward_mode": _name_of("reward_mode", "reward_mode", REWARD_MODES),
    "control_mode": _plain("control_mode"),
    "render_mode": _take_render_mode,
    "robot_uids": _take_robot,
    "sim_backend": _take_backend,
    "shader_dir": _take_shader,
    "sensor_configs": _take_sensors,
    "task_plans": _take_plans,
    "scene_builder_cls": _take_builder,
    "spawn_data_fp": _take_spawns,
    "require_build_configs_repeated_equally_across_envs": _flag(
        "equal_homes", "require_build_configs_repeated_equally_across_envs"
    ),
    "randomize_build_configs_per_env": _flag(
        "random_homes", "randomize_build_configs_per_env"
    ),
    "reconfiguration_freq": _take_reconfiguration,
    "add_event_tracker_info": _flag("tells_events", "add_event_tracker_info"),
    "task_cfgs": _take_configs,
    "randomly_slightly_open_articulation": _take_ajar,
    "mjhab_options": _take_own_options,
}
"""Arguments that are honoured."""
