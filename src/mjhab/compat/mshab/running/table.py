"""Modules and names that scripts import, and where mjhab has them."""

from __future__ import annotations

FOREIGN = ("mshab", "mani_skill", "sapien")
"""Packages whose modules are answered."""
_OURS = "mjhab.compat.mshab."
_WORLDS = _OURS + "worlds."
_WRAPPERS = _OURS + "wrappers."
_TOOLS = _OURS + "tools."


def _from(module: str, *names: str) -> dict[str, str]:
    """Names of one of our modules, as they are called there."""
    return {name: f"{module}:{name}" for name in names}


_PLANNER = _from(
    _OURS + "files.subtasks",
    "ArticulationConfig",
    "PickSubtask",
    "PickSubtaskConfig",
    "PlaceSubtask",
    "PlaceSubtaskConfig",
    "NavigateSubtask",
    "NavigateSubtaskConfig",
    "OpenSubtask",
    "OpenSubtaskConfig",
    "CloseSubtask",
    "CloseSubtaskConfig",
) | _from(_OURS + "files.plans", "PlanData", "plan_data_from_file")
_PLANNER |= {
    "Subtask": _OURS + "files.subtasks:MsHabSubtask",
    "SubtaskConfig": _OURS + "files.subtasks:MsHabSubtaskConfig",
    "TaskPlan": _OURS + "files.plans:MsHabTaskPlan",
}
_SEQUENTIAL_TASK = {"SequentialTaskEnv": _WORLDS + "kinds:MsHabSequentialTaskEnv"}
_ENVS = (
    _SEQUENTIAL_TASK
    | _from(
        _WORLDS + "kinds",
        "PickSubtaskTrainEnv",
        "PlaceSubtaskTrainEnv",
        "OpenSubtaskTrainEnv",
        "CloseSubtaskTrainEnv",
        "NavigateSubtaskTrainEnv",
    )
    | _from(_OURS + "files.plans", "plan_data_from_file")
)
_ACTION = _from(_WRAPPERS + "action", "FetchActionWrapper")
_OBSERVATION = _from(
    _WRAPPERS + "observation",
    "FetchDepthObservationWrapper",
    "StackedDictObservationWrapper",
) | {"FrameStack": _WRAPPERS + "observation:DepthFrameStack"}
_RECORD = _from(_WRAPPERS + "record", "RecordEpisode")
_STATISTICS = _from(_WRAPPERS + "statistics", "VectorRecordEpisodeStatistics")
_VECTOR = _from(_WRAPPERS + "vector", "ManiSkillVectorEnv")
_POSE = _from(_WORLDS + "pose", "vectorize_pose") | {"Pose": _WORLDS + "pose:PoseBatch"}
_VIEWS = {
    "Actor": _WORLDS + "views:ObjectView",
    "Articulation": _WORLDS + "views:ArticulationView",
    "Link": _WORLDS + "views:LinkView",
}
_FETCH = {"Fetch": _WORLDS + "views:AgentView"}
_TREES = _from(
    _TOOLS + "trees",
    "append_dict_array",
    "batch",
    "compute_angle_between",
    "flatten_dict_keys",
    "flatten_state_dict",
    "index_dict_array",
    "normalize_vector",
    "to_cpu_tensor",
    "to_numpy",
    "to_tensor",
    "torch_clone_dict",
    "unbatch",
)
_SEQUENTIAL = {
    "RecordEpisodeSequentialTask": _WRAPPERS + "record_chain:RecordEpisodeSequentialTask"
}

MANI_SKILL: dict[str, dict[str, str]] = {
    "mani_skill": _from(_OURS + "paths", "ASSET_DIR", "DEMO_DIR", "PACKAGE_ASSET_DIR")
    | _from(_OURS + "running.talk", "logger", "get_commit_info")
    | {"__version__": "mjhab.core.version:__version__"},
    "mani_skill.envs": {},
    "mani_skill.envs.sapien_env": {"BaseEnv": _WORLDS + "env:MsHabEnv"},
    "mani_skill.agents": {},
    "mani_skill.agents.robots": _FETCH,
    "mani_skill.agents.robots.fetch": _FETCH,
    "mani_skill.utils": {},
    "mani_skill.utils.common": _TREES,
    "mani_skill.utils.gym_utils": _from(
        _WRAPPERS + "vector", "find_max_episode_steps_value"
    ),
    "mani_skill.utils.io_utils": _from(
        _TOOLS + "json_files", "CustomJsonEncoder", "dump_json", "load_json"
    ),
    "mani_skill.utils.logging_utils": _from(_OURS + "running.talk", "logger"),
    "mani_skill.utils.structs": {**_VIEWS, "Pose": _POSE["Pose"]},
    "mani_skill.utils.structs.actor": {"Actor": _VIEWS["Actor"]},
    "mani_skill.utils.structs.articulation": {"Articulation": _VIEWS["Articulation"]},
    "mani_skill.utils.structs.link": {"Link": _VIEWS["Link"]},
    "mani_skill.utils.structs.pose": _POSE,
    "mani_skill.utils.structs.types": _from(_OURS + "running.talk", "Array", "Device"),
    "mani_skill.utils.visualization": {},
    "mani_skill.utils.visualization.misc": _from(
        _TOOLS + "pictures",
        "images_to_video",
        "put_info_on_image",
        "put_text_on_image",
        "tile_images",
    ),
    "mani_skill.utils.wrappers": _RECORD,
    "mani_skill.utils.wrappers.record": _RECORD,
    "mani_skill.vector": {},
    "mani_skill.vector.wrappers": {},
    "mani_skill.vector.wrappers.gymnasium": _VECTOR,
}
"""What is answered of ManiSkill."""

MSHAB: dict[str, dict[str, str]] = {
    "mshab.envs": _ENVS,
    "mshab.envs.make": _from(
        _OURS + "making", "EnvConfig", "make_env", "recursive_fix_env_kwargs"
    )
    | _ENVS,
    "mshab.envs.planner": _PLANNER,
    "mshab.envs.sequential_task": _SEQUENTIAL_TASK,
    "mshab.envs.subtask": _from(_WORLDS + "kinds", "SubtaskTrainEnv"),
    "mshab.envs.wrappers": _ACTION | _OBSERVATION | _RECORD | _SEQUENTIAL,
    "mshab.envs.wrappers.action": _ACTION,
    "mshab.envs.wrappers.observation": _OBSERVATION,
    "mshab.envs.wrappers.record": _RECORD,
    "mshab.envs.wrappers.record_seq_task": _SEQUENTIAL,
    "mshab.envs.wrappers.vector": _STATISTICS,
    "mshab.envs.wrappers.vector.record_episode_statistics": _STATISTICS,
} | {
    f"mshab.envs.{name}": _from(_WORLDS + "kinds", f"{name.capitalize()}SubtaskTrainEnv")
    for name in ("pick", "place", "open", "close", "navigate")
}
"""What is answered of MS-HAB: its environments and their wrappers, which reach into ManiSkill."""

WITHOUT_CHECKOUT: dict[str, dict[str, str]] = {
    "mshab": {},
    "mshab.utils": {},
    "mshab.utils.array": _from(
        _TOOLS + "arrays",
        "all_equal",
        "all_same_type",
        "recursive_deepcopy",
        "recursive_slice",
        "to_numpy",
        "to_tensor",
    ),
    "mshab.utils.label_dataset": _from(_TOOLS + "labels", "get_episode_label_and_events"),
}
"""What is answered besides if MS-HAB's own package is not beside the script; agents and training loops are not."""

SAPIEN: dict[str, dict[str, str]] = {
    "sapien": {"Pose": _OURS + "running.talk:SapienPose"},
    "sapien.physx": _from(_OURS + "running.talk", "is_gpu_enabled"),
}
"""What is answered of SAPIEN."""
