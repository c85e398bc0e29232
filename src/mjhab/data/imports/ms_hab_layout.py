"""Names in MS-HAB's own data files (mshab/envs/wrappers/record.py, mshab/utils/label_dataset.py), and their events."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from mjhab.data.store.run_entries import check_entries
from mjhab.rollout.records import MAX_COUNT, Event
from mjhab.tasks.labelling.legacy import extend
from mjhab.tasks.subtasks.registry import number_of

TRAJECTORY = "traj_"
"""Prefix of a trajectory's group; the "episode_id" of the JSON file follows."""
TRUTHS = frozenset({"is_grasped"})
"""Boolean observations of shape (N+1,), without a column axis."""
SOURCE_TYPE = "mjhab"
""""source_type" in the files that mjhab exports."""
COLLISION = "collision"
CONTROL_MODE = "pd_joint_delta_pos"
"""The control mode of all of MS-HAB's data; "control_mode" in the JSON file."""
ACTIONS = (
    "shoulder_pan_joint",
    "shoulder_lift_joint",
    "upperarm_roll_joint",
    "elbow_flex_joint",
    "forearm_roll_joint",
    "wrist_flex_joint",
    "wrist_roll_joint",
    "gripper",
    "head_pan_joint",
    "head_tilt_joint",
    "torso_lift_joint",
    "base_forward",
    "base_yaw",
)
"""Names of the 13 actions of MS-HAB's Fetch in `CONTROL_MODE`, as in mjhab's action table (mani_skill
agents/robots/fetch/fetch.py)."""
SCANNED_YAWS = {
    "003_cracker_box": 0.00349,
    "004_sugar_box": 0.03142,
    "008_pudding_box": -0.48171,
    "009_gelatin_box": -0.22864,
    "010_potted_meat_can": -0.04712,
}
"""Headings [rad] of the scans of YCB boxes, as `scenes.replica_cad.ycb` measures them; a test compares them."""
ENV = {
    "robot": "fetch",
    "base": "forward",
    "stationary": ["head"],
    "profile": "ms_hab",
    "stillness": "published",
    "spawn_rule": "published",
    "joint_dynamics": "published",
}
"""Options of mjhab's environment that stand for the one in which MS-HAB's data were made (mshab/envs/make.py)."""
_THEIRS = {
    "at_goal": "obj_at_goal",
    "left_goal": "obj_left_goal",
    "excessive_collisions": "exceeded_cumulative_force_limit",
}
_OURS = {theirs: ours for ours, theirs in _THEIRS.items()}


INFO_CHECKS = {
    "is_grasped": "is_grasped",
    "obj_at_goal": "at_goal",
    "oriented_correctly": "oriented",
    "navigated_close": "near",
    "articulation_open": "opened",
    "articulation_closed": "closed",
    "ee_rest": "ee_rest",
    "robot_rest": "robot_rest",
    "is_static": "is_static",
    "cumulative_force_within_limit": "force_ok",
}
"""Checks of `info` by their name there: our signal."""
_SPECIAL = {
    "place": ("obj_at_goal",),
    "navigate": ("oriented_correctly", "navigated_close"),
    "open": ("articulation_open",),
    "close": ("articulation_closed",),
}
_COMMON = ("ee_rest", "robot_rest", "is_static", "cumulative_force_within_limit")
PAIRWISE = "robot_target_pairwise_force"
INFO_FORCES = {
    "robot_force": "robot_force",
    "robot_cumulative_force": "cumulative_force",
    PAIRWISE: "target_force",
}
"""Forces of `info` by their name there: our signal."""
JOINT = (
    "handle_active_joint_qpos",
    "handle_active_joint_qmin",
    "handle_active_joint_qmax",
)
"""Entries of `info` about the joint of an Open or Close: position and range [m or rad]."""
FINISHED = 100
"""``subtask_type`` of a world whose plan is finished (mshab/envs/sequential_task.py)."""


EPISODE_KEYS = ("episode_id", "elapsed_steps", "label", "events_verbose")
"""Keys that the JSON file must have for every trajectory."""
_COUNTS = ("episode_id", "elapsed_steps", "episode_index")
_TEXTS = (
    "label",
    "legacy_label",
    "control_mode",
    "articulation_type",
    "target",
    "home",
    "split",
    "object_axes",
    "joint_angles",
    "ending",
)


def check_file(said: Mapping[str, Any]) -> None:
    """Check what a JSON file says of all trajectories.

    Raises:
        ValueError: an entry has another type than MS-HAB and mjhab write.
    """
    runs = said.get("runs", {})
    if not isinstance(runs, Mapping):
        raise ValueError("'runs' must be an object")
    for run in runs.values():
        check_entries(run)
    info = said.get("env_info")
    if info is not None and not isinstance(info, Mapping):
        raise ValueError("'env_info' must be an object")


def check_episode(number: int, metadata: Any) -> None:
    """Check what a JSON file says of a trajectory.

    Raises:
        ValueError: an entry is missing, or has another type than MS-HAB and mjhab write.
    """
    if not isinstance(metadata, Mapping):
        raise ValueError(f"episode {number} is no object")
    missing = [key for key in EPISODE_KEYS if key not in metadata]
    if missing:
        raise ValueError(
            f"episode {number} has no {', '.join(missing)}. Record with labels (label_episode=True), as "
            "mshab/utils/gen/gen_data.py does."
        )
    seeds = metadata.get("episode_seed", 0)
    numbers = [metadata[key] for key in _COUNTS if key in metadata]
    numbers += seeds if isinstance(seeds, list) else [seeds]
    for value in numbers:
        if (
            # JSON's true is an int to Python.
            isinstance(value, bool)
            or not isinstance(value, int)
            or not 0 <= value <= MAX_COUNT
        ):
            raise ValueError(
                f"episode {number}: {str(value)[:60]!r} is no whole number from 0"
            )
    for key in _TEXTS:
        if metadata.get(key) is not None and not isinstance(metadata[key], str):
            raise ValueError(
                f"episode {number}: {key} must be a text, not {str(metadata[key])[:60]!r}"
            )
    for key in ("events_verbose", "actors"):
        if not isinstance(metadata.get(key, []), list):
            raise ValueError(f"episode {number}: {key} must be a list")


def checks_of(kind: str) -> tuple[str, ...]:
    """Names of the checks of a kind of subtask in `info`, in order."""
    return ("is_grasped", *_SPECIAL.get(kind, ()), *_COMMON)


def dataset_name(task: str, split: str) -> str:
    """Name of the data set of a task and split: ``ReplicaCADSetTableVal``."""
    return f"ReplicaCAD{task.title().replace('_', '')}{split.capitalize()}"


def object_id(name: str) -> str:
    """Name of an object in task plans: ``024_bowl-0`` for ``024_bowl_:0000``."""
    kind, _, number = name.partition("_:")
    return f"{kind}-{int(number or 0)}"


def to_events(kind: str, events: Iterable[Event]) -> list[str]:
    """The "events" of an episode of one subtask: those that determine its label, without immediate repeats."""
    counted: list[str] = []
    extend(counted, number_of(kind), (name for _, name in events))
    return [_THEIRS.get(name, name) for name in counted]


def to_verbose(events: Iterable[Event], force: Sequence[float]) -> list[list[Any]]:
    """The "events_verbose" of an episode.

    Entries are [step, name, null], and [steps, "collision", forces [N]] for consecutive steps with a force on the robot
    and no other event. Steps count from 0, the step of the first action.
    """
    by_step: dict[int, list[str]] = {}
    for step, name in events:
        by_step.setdefault(step, []).append(_THEIRS.get(name, name))
    verbose: list[list[Any]] = []
    # Events may come after the last force of a cut episode.
    for step in range(1, max((len(force), *by_step)) + 1):
        verbose += [[step - 1, name, None] for name in by_step.get(step, ())]
        value = force[step - 1] if step <= len(force) else 0.0
        # MS-HAB lists steps with contact only.
        if value <= 0:
            continue
        # MS-HAB grows one entry until another event comes between, and its labels count entries.
        if verbose and verbose[-1][1] == COLLISION:
            verbose[-1][0].append(step - 1)
            verbose[-1][2].append(value)
        else:
            verbose.append([[step - 1], COLLISION, [value]])
    return verbose


def from_verbose(
    verbose: Iterable[Sequence[Any]], steps: int
) -> tuple[tuple[Event, ...], tuple[float, ...]]:
    """Events (with steps from 1) and the force [N] in every control step, from an "events_verbose"."""
    events: list[Event] = []
    force = [0.0] * steps
    for step, name, values in verbose:
        if name != COLLISION:
            events.append((int(step) + 1, _OURS.get(str(name), str(name))))
            continue
        for at, value in zip(step, values, strict=True):
            # A negative step would write to the end of the list without an error.
            if not 0 <= at < steps:
                raise ValueError(f"a force in step {at} of {steps}")
            force[int(at)] = float(value)
    return tuple(events), tuple(force)
