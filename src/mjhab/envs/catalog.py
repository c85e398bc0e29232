"""Environment ids and construction of environments."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any

import gymnasium

from mjhab.config.env import EnvConfig, TrainConfig
from mjhab.core.errors import UsageError, unknown_name, wrong_value
from mjhab.envs.conversion import keep_what_is_no_number
from mjhab.robots.registry import DEFAULT_ROBOT
from mjhab.sim.backends import check_device, resolve
from mjhab.tasks.household.registry import TASKS, task_with
from mjhab.tasks.subtasks.registry import SUBTASKS

if TYPE_CHECKING:
    from gymnasium.vector import VectorEnv

    from mjhab.envs.loop import TaskLoop
    from mjhab.envs.single import SingleEnv

SUBTASK_ID_ORDER = ("pick", "place", "open", "close", "navigate")
"""Order of the ids of mjhab's own subtasks; those of plugins follow."""


NO_FRAMESKIP = "unexpected keyword argument 'frameskip': a control step is always 50 ms; repeat actions instead."
"""Message of the TypeError at ``frameskip``: torchrl's GymEnv passes it, and on this text tries again without it."""


class UnexpectedArgument(UsageError, TypeError):
    """Refusal of an argument that other libraries expect to be a TypeError."""


_HOMES = (
    "Homes are named: split='train', home='...' (or a pattern of names), assets=PACK."
)
_EPISODES = "Episodes are drawn by seed and index: give task and subtask, or episodes_file='FILE' in the HAB format."
_VIEWS = "render_mode='rgb_array' gives human views; there is one way of drawing."
OPTIONS_ELSEWHERE = {
    "robot_uids": f"Here it is robot={DEFAULT_ROBOT!r}.",
    "sensor_configs": "Here it is camera_size=128 or (height, width), and cameras=('CAMERA', ...).",
    "shader_dir": "Here it is shader='raster' or, for ray-traced pictures, shader='path'.",
    "human_render_camera_configs": f"Leave it out: {_VIEWS}",
    "viewer_camera_configs": f"Leave it out: {_VIEWS}",
    "max_episode_steps": "Here it is horizon=N, the control steps of every subtask.",
    "task_plans": _EPISODES,
    "task_plan_fp": _EPISODES,
    "spawn_data_fp": "Starts are drawn by spawn_rule; spawns='FILE' of `mjhab spawns make` has precomputed ones.",
    "scene_builder_cls": _HOMES,
    "build_config_idxs": _HOMES,
    "init_config_idxs": _HOMES,
    "sim_backend": "Here it is backend='cpu' or 'warp'.",
    "render_backend": "Here it is backend='cpu' or 'warp', for physics and images.",
    "sim_config": "Physics is the same in all environments; only buffers=... has sizes.",
    "reconfiguration_freq": "Leave it out: any world takes any home at its reset.",
    "require_build_configs_repeated_equally_across_envs": "Leave it out: any world takes any home at its reset.",
    "add_event_tracker_info": "Leave it out: info['events'] and info['ended'] are always there.",
    "stationary_base": "Here it is stationary=('base',).",
    "stationary_torso": "Here it is stationary=('torso',).",
    "stationary_head": "Here it is stationary=('head',).",
}
"""Options of ManiSkill's and MS-HAB's environments, and what to give here."""


def env_ids() -> dict[str, dict[str, Any]]:
    """List every Gymnasium id with its options: "mjhab/<Task>-v1" and "mjhab/<Subtask>SubtaskTrain-v1".

    The ``task`` of a training environment defaults to the first one that has the subtask; an option overrides it.
    """
    chains = {f"mjhab/{_title(task)}-v1": {"task": task} for task in TASKS}
    trained = [
        name for name in SUBTASKS if any(name in TASKS[task].subtasks for task in TASKS)
    ]
    # A name that is not in the order stands behind it, and the sort keeps the order of registration among those.
    trained.sort(key=lambda name: (*SUBTASK_ID_ORDER, name).index(name))
    trains = {
        f"mjhab/{_title(name)}SubtaskTrain-v1": {"task": task_with(name), "subtask": name}
        for name in trained
    }
    return {**chains, **trains}


def plugin_of(env_id: str) -> str:
    """Name of the plugin that registered an environment, "" for mjhab itself."""
    options = env_ids()[env_id]
    subtask = options.get("subtask", "")
    return SUBTASKS.source(subtask) if subtask else TASKS.source(options["task"])


def _title(name: str) -> str:
    """ "set_table" as in an id: "SetTable"."""
    return "".join(part.capitalize() for part in name.split("_"))


def make(**options: Any) -> Any:
    """Build a vector environment of a household task, or of one of its subtasks for evaluation.

    Its reward is what evaluations count: "sparse" for one subtask, "pointer" for a whole task. A learner wants
    ``reward_mode="normalized_dense"``, the default of `make_train`; ``info["reward_mode"]`` tells which one is paid.

    Args:
        **options: fields of `EnvConfig`, which explains them.

            - what is done: profile, robot, task, subtask, target
            - where: split, home, assets, extra_objects, seed, episode_pool, spawns, spawn_rule, open_start,
              episodes_file
            - worlds: num_envs, threads, backend, device, starts, buffers, autoreset, joint_dynamics
            - observations: obs_mode, cameras, camera_size, shader, shading, obs_keys, frame_stack, handle_points,
              object_axes, joint_angles, render_mode
            - actions: control_mode, base, stationary
            - reward: reward_mode, reward_scales, reward_formula, reward_normaliser
            - what is perturbed: perturb, randomise
            - how it is judged: horizon, continuous, stillness, force_limits, overrides, navigate,
              teleport_fingers

    Returns:
        A `SequentialTaskEnv`, with backend warp a `DeviceEnv`.

    Raises:
        UsageError: unknown option or value; the message lists the valid ones.
    """
    return build(EnvConfig(**_known(options, EnvConfig)))


def make_train(**options: Any) -> Any:
    """Build a vector environment for the training of one subtask.

    Args:
        **options: fields of `TrainConfig`: those of `make`, with the defaults of training.

    Returns:
        A `SequentialTaskEnv`, with backend warp a `DeviceEnv`.

    Raises:
        UsageError: unknown option or value; the message lists the valid ones.
    """
    return build(TrainConfig(**_known(options, TrainConfig)))


def build(config: EnvConfig) -> TaskLoop:
    """Build the vector environment of a configuration."""
    backend = resolve(config.backend)
    check_device(backend, config.device)
    if backend == "warp":
        from mjhab.envs.device.env import DeviceEnv

        return DeviceEnv(config)
    from mjhab.envs.sequential import SequentialTaskEnv

    return SequentialTaskEnv(config)


def make_by_id(env_id: str, **options: Any) -> Any:
    """Build the vector environment of a Gymnasium id, e.g. ``"mjhab/SetTable-v1"``.

    Raises:
        UsageError: no such id, unknown option or value.
    """
    return build(config_by_id(env_id, **options))


def config_by_id(env_id: str, **options: Any) -> EnvConfig:
    """The configuration of a Gymnasium id with some options changed.

    Raises:
        UsageError: no such id, unknown option or value.
    """
    known = env_ids()
    if env_id not in known:
        raise unknown_name("environment id", env_id, known)
    # The ids of subtasks are those of training environments, as in the original.
    config = TrainConfig if "subtask" in known[env_id] else EnvConfig
    return config(**_known({**known[env_id], **options}, config))


def make_single(*, env_id: str, **options: Any) -> SingleEnv:
    """Build one world of a Gymnasium id as a plain `gymnasium.Env`; entry point of ``gymnasium.make``.

    Raises:
        UsageError: no such id, unknown option or value, or an option that one world cannot have.
    """
    from mjhab.envs.single import SingleEnv

    # A TypeError with this very text makes torchrl try again without it.
    if "frameskip" in options:
        raise UnexpectedArgument(NO_FRAMESKIP)
    fixed = {"num_envs": 1, "autoreset": "disabled", "backend": "cpu"}
    for name, value in fixed.items():
        # None stands for the default everywhere.
        if options.get(name) not in (None, value):
            raise wrong_value(
                name,
                options[name],
                f"{value!r} for one world as a plain gymnasium.Env",
                "gymnasium.make_vec takes others.",
            )
    return SingleEnv(config_by_id(env_id, **{**options, **fixed}))


def _make_vector(*, env_id: str, **options: Any) -> VectorEnv:
    return make_by_id(env_id, **options)


def _known(options: dict[str, Any], config: type[EnvConfig]) -> dict[str, Any]:
    names = [f.name for f in dataclasses.fields(config)]
    for name in options:
        if name not in names:
            raise unknown_name("environment option", name, names, OPTIONS_ELSEWHERE)
    return options


def register_envs() -> None:
    """Register the ids with ``gymnasium.make`` and ``gymnasium.make_vec``.

    The import of ``mjhab`` calls it after loading plugins. Call it again after registering a subtask or a task.
    """
    # Before any environment is made: Gymnasium's wrappers look the rules up when they convert.
    keep_what_is_no_number()
    for env_id in env_ids():
        # Called once more after a plugin has registered something; Gymnasium warns of an id that is there.
        if env_id not in gymnasium.registry:
            gymnasium.register(
                env_id,
                entry_point="mjhab.envs.catalog:make_single",
                vector_entry_point="mjhab.envs.catalog:_make_vector",
                kwargs={"env_id": env_id},
            )
