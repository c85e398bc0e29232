"""One table of observations: key, shape, unit, frame, function (mshab/envs/sequential_task.py).

The concatenation of the six state entries is ``state`` (W, S), see `state_dim`. Entries that the active subtask does
not use are zero, so that one policy interface serves all subtasks. With the mode "proprioception" ``state`` holds what
the robot's own sensors measure instead. Rows of the robot's cameras follow when images are asked for.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any

import numpy as np
from gymnasium import spaces

from mjhab.config.ranges import range_of
from mjhab.core.arrays import Array, constant, count, device_of, empty, namespace, zeros
from mjhab.core.errors import UsageError, unknown_name
from mjhab.core.joints import BASE_XY, BASE_YAW
from mjhab.core.rotations import quat_canonical
from mjhab.envs.spaces import ordered_dict
from mjhab.robots.robot import Robot
from mjhab.tasks.subtasks.registry import SUBTASKS
from mjhab.tasks.subtasks.spec import SubtaskSpec


@dataclass(frozen=True, eq=False)
class ObsContext:
    """What observations are computed from. W worlds; poses are xyz + wxyz in the frame of the base link.

    ``tcp_pose`` (W, 7) of the tool centre; ``obj_pose`` (W, 7) of the active subtask's object and ``goal_pos`` (W, 3),
    zero where the subtask has none; ``is_grasped`` (W,).
    """

    robot_q: Array
    robot_qd: Array
    tcp_pose: Array
    obj_pose: Array
    goal_pos: Array
    is_grasped: Array


@dataclass(frozen=True, eq=False)
class Views:
    """What camera rows are computed from. W worlds, C cameras asked for, in order.

    ``robot``: whose cameras they are; ``images``: "depth" (W, C, H, W) float32 [m], 0 where nothing is hit, "rgb"
    (W, C, H, W, 3) uint8, "seg" (W, C, H, W) int32; ``pos`` (W, C, 3) [m] and ``mat`` (W, C, 3, 3): cameras in the
    world, x right, y up, z backwards; ``base`` (W, 3): x, y [m], yaw [rad] of the base; ``intrinsic`` (C, 3, 3) [px].
    """

    robot: Robot
    images: Mapping[str, Array]
    pos: Array
    mat: Array
    base: Array
    intrinsic: Array


def pose_in_base(base: Array, height: float, pose: Array) -> Array:
    """World poses (..., W, 7) in the frame of the base link, with canonical quaternions.

    ``base`` (W, 3): x, y [m], yaw [rad]; ``height`` [m]: of the base link above the floor.

    The sign that a quaternion of the simulator has depends on how often the base or the object has turned round.
    """
    # The base turns about z only: half of the quaternion product is zero and left out.
    xp = namespace(base)
    yaw = base[:, BASE_YAW]
    c = xp.cos(yaw)
    s = xp.sin(yaw)
    ch = xp.cos(0.5 * yaw)
    sh = xp.sin(0.5 * yaw)
    x = pose[..., 0] - base[:, 0]
    y = pose[..., 1] - base[:, 1]
    qw = pose[..., 3]
    qx = pose[..., 4]
    qy = pose[..., 5]
    qz = pose[..., 6]
    out = empty(pose.shape, pose)
    out[..., 0] = c * x + s * y
    out[..., 1] = c * y - s * x
    out[..., 2] = pose[..., 2] - height
    out[..., 3] = ch * qw + sh * qz
    out[..., 4] = ch * qx + sh * qy
    out[..., 5] = ch * qy - sh * qx
    out[..., 6] = ch * qz - sh * qw
    out[..., 3:] = quat_canonical(out[..., 3:])
    return out


@dataclass(frozen=True)
class ObsEntry:
    """One observation. ``compute`` returns (W, *shape), from an ObsContext (state rows) or Views (camera rows)."""

    key: str
    shape: tuple[int, ...]
    unit: str
    frame: str
    compute: Callable[[Any], Array]
    meaning: str = ""
    dtype: type[np.generic] = np.float32
    low: float = -np.inf
    high: float = np.inf

    @property
    def space(self) -> spaces.Box:
        """Space of one world."""
        return spaces.Box(self.low, self.high, self.shape, self.dtype)  # type: ignore[arg-type]


OBJECT_KEY = "extra/obj_pose_wrt_base"
GOAL_KEY = "extra/goal_pos_wrt_base"
GRASP_KEY = "extra/is_grasped"
_OBJECT_IN = {
    "object": "its object",
    "link": "the object behind the link",
    "way": "the object in the hand, zero without one",
}
_GOAL_IN = {
    "object": "where its object goes",
    "link": "the handle",
    "way": "where the way leads",
}
_GRASPED_IN = {
    "object": "its object",
    "link": "the handle",
    "way": "the object in the hand",
}
"""What the rows of the task are, by what a subtask is about (`SubtaskSpec.about`)."""


def task_meanings(kinds: Sequence[str]) -> dict[str, str]:
    """What the rows of the task mean in some kinds of subtasks, by key; from `SubtaskSpec.shows` and ``about``.

    Raises:
        UsageError: there is no such subtask.
    """
    specs = [SUBTASKS[kind] for kind in kinds]
    return {
        key: f"{_listed(about, [s for s in specs if part in (*s.shows, '')], specs)} ({numbers}); "
        "zero once the plan is finished"
        for key, numbers, part, about in (
            (OBJECT_KEY, "position, quaternion with w >= 0", "object", _OBJECT_IN),
            (GOAL_KEY, "position", "goal", _GOAL_IN),
            (GRASP_KEY, "1 while both fingers hold it", "", _GRASPED_IN),
        )
    }


def _listed(
    about: Mapping[str, str], shown: Sequence[SubtaskSpec], all_kinds: Sequence[SubtaskSpec]
) -> str:
    """ "Pick, Place: its object; Open: the handle; zero in Navigate"."""
    by_meaning: dict[str, list[str]] = {}
    for spec in shown:
        by_meaning.setdefault(about[spec.about], []).append(spec.name.capitalize())
    told = [f"{', '.join(names)}: {meaning}" for meaning, names in by_meaning.items()]
    hidden = [spec.name.capitalize() for spec in all_kinds if spec not in shown]
    if hidden:
        told.append(f"zero in {', '.join(hidden)}")
    return "; ".join(told)


def joint_rows(robot: Robot) -> tuple[ObsEntry, ...]:
    """Rows of the joints of a robot, without those of its base."""
    upper = robot.columns.upper
    count = upper.stop - upper.start
    groups = [group for group in ("torso", "head", "arm", "fingers") if robot.group(group)]
    frame = f"joint: {', '.join(groups)}"
    return (
        ObsEntry(
            "agent/qpos",
            (count,),
            "m, rad",
            frame,
            lambda c: c.robot_q[:, upper],
            "joint positions without the base",
        ),
        ObsEntry(
            "agent/qvel",
            (count,),
            "m/s, rad/s",
            frame,
            lambda c: c.robot_qd[:, upper],
            "joint velocities without the base",
        ),
    )


def task_rows(robot: Robot) -> tuple[ObsEntry, ...]:
    """Rows of the tool centre and of what the active subtask is about."""
    base = robot.base_link
    return (
        ObsEntry(
            "extra/tcp_pose_wrt_base",
            (7,),
            "m, wxyz",
            base,
            lambda c: c.tcp_pose,
            f"{robot.tcp}: position, quaternion with w >= 0",
        ),
        ObsEntry(
            OBJECT_KEY,
            (7,),
            "m, wxyz",
            base,
            lambda c: c.obj_pose,
            "object of the active subtask, w >= 0; zero once the plan is finished",
        ),
        ObsEntry(
            GOAL_KEY,
            (3,),
            "m",
            base,
            lambda c: c.goal_pos,
            "goal of the active subtask; zero once the plan is finished",
        ),
        ObsEntry(
            GRASP_KEY,
            (1,),
            "0 or 1",
            "-",
            lambda c: c.is_grasped[:, None],
            "what the active subtask is about is grasped; zero once the plan is finished",
        ),
    )


def base_velocity_row(robot: Robot) -> ObsEntry:
    """Row of the velocity of the base, as its odometry tells it."""
    return ObsEntry(
        BASE_VELOCITY_KEY,
        (3,),
        "m/s, rad/s",
        robot.base_link,
        _base_velocity,
        "velocity of the base: forward, to the left, yaw rate",
    )


@lru_cache(maxsize=16)
def state_table(robot: Robot, own: bool = False) -> tuple[ObsEntry, ...]:
    """The entries of ``state``, in order; ``own``: those of the mode "proprioception"."""
    tcp, *task = task_rows(robot)
    if own:
        return (*joint_rows(robot), base_velocity_row(robot), tcp)
    return (*joint_rows(robot), tcp, *task)


def state_dim(robot: Robot, own: bool = False) -> int:
    """Numbers in ``state``; ``own``: in the mode "proprioception"."""
    return sum(entry.shape[0] for entry in state_table(robot, own))


def unsensed_table(robot: Robot) -> tuple[ObsEntry, ...]:
    """The entries of ``state`` that no sensor of the robot measures: object, goal, grasp."""
    own = {entry.key for entry in state_table(robot, own=True)}
    return tuple(entry for entry in state_table(robot) if entry.key not in own)


STATE_KEY = "state"
BASE_VELOCITY_KEY = "agent/base_vel"
PROPRIOCEPTION = "proprioception"
CAMERA_OUTPUTS = ("depth", "rgb", "seg")
POINTCLOUD = "pointcloud"
OBS_MODES: dict[str, tuple[str, ...]] = {
    "state": (),
    PROPRIOCEPTION: (),
    "depth": ("depth",),
    "rgb": ("rgb",),
    "rgbd": ("depth", "rgb"),
    "seg": ("seg",),
    POINTCLOUD: (POINTCLOUD,),
}
"""Observation modes and the images that each adds to the state; joined by "+" they add up, as in "rgbd+seg".
"proprioception" replaces the state by what the robot's own sensors tell, as in "proprioception+rgbd"."""
DEPTH_SCALE = 1000.0
"""Depth images are int16 millimetres, 0 where nothing is hit."""
DEPTH_MAX = int(np.iinfo(np.int16).max)
MIN_SIZE = 8
"""Smallest image side [px]."""


def camera_key(camera: str, output: str) -> str:
    """Key of one camera image in the observation."""
    return f"sensor_data/{camera}/{output}"


def param_key(camera: str, param: str) -> str:
    """Key of one parameter of a camera in the observation."""
    return f"sensor_param/{camera}/{param}"


def mode_outputs(mode: str) -> tuple[str, ...]:
    """What an observation mode adds to the state, e.g. "rgbd+seg" -> ("depth", "rgb", "seg").

    Raises:
        UsageError: a part that is no mode.
    """
    wanted = set[str]()
    for part in mode.split("+"):
        if part not in OBS_MODES:
            raise unknown_name("observation mode", part, OBS_MODES)
        wanted.update(OBS_MODES[part])
    return tuple(name for name in (*CAMERA_OUTPUTS, POINTCLOUD) if name in wanted)


def own_state_only(mode: str) -> bool:
    """Whether an observation mode hides what no sensor of the robot measures: object, goal and grasp."""
    return PROPRIOCEPTION in mode.split("+")


def camera_names(robot: Robot, cameras: str | Sequence[str]) -> tuple[str, ...]:
    """Names of cameras of a robot, checked, each once, in the order given.

    Raises:
        UsageError: a name that is no camera, or none at all.
    """
    names = (cameras,) if isinstance(cameras, str) else tuple(dict.fromkeys(cameras))
    for name in names:
        robot.camera(name)
    if not names:
        raise UsageError(
            f"cameras must name at least one camera of: {', '.join(robot.camera_names)}; got none."
        )
    return names


def image_size(size: int | Sequence[int]) -> tuple[int, int]:
    """(height, width) [px] of a size that is one number or a pair.

    Raises:
        UsageError: not whole numbers, not one or two of them, below MIN_SIZE, or above the range of "camera_size".
    """
    _, most = range_of("camera_size")
    sides = tuple(size) if isinstance(size, Sequence) else (size, size)
    if len(sides) != 2 or any(
        not isinstance(side, int | np.integer) or not MIN_SIZE <= side <= most for side in sides
    ):
        raise UsageError(
            f"camera size must be one whole number or (height, width), each {MIN_SIZE} to {most}; got {size!r}."
        )
    return int(sides[0]), int(sides[1])


def intrinsic_matrix(robot: Robot, camera: str, size: tuple[int, int]) -> np.ndarray:
    """(3, 3) float64 pinhole matrix [px] of a camera at (height, width); pixel centres lie at + 0.5."""
    height, width = size
    fovy = robot.camera(camera).fovy
    focal = 0.5 * height / np.tan(0.5 * fovy)
    return np.array([[focal, 0.0, 0.5 * width], [0.0, focal, 0.5 * height], [0.0, 0.0, 1.0]])


def camera_table(
    robot: Robot, outputs: Sequence[str], cameras: Sequence[str], size: tuple[int, int]
) -> tuple[ObsEntry, ...]:
    """The rows of the cameras for ``outputs`` of `mode_outputs`; none for no outputs."""
    rows: list[ObsEntry] = []
    for c, camera in enumerate(cameras if outputs else ()):
        rows += [
            _image_row(c, camera, output, size) for output in outputs if output in CAMERA_OUTPUTS
        ]
        rows += _param_rows(c, camera)
    if POINTCLOUD in outputs:
        rows += _cloud_rows(robot, len(cameras) * size[0] * size[1])
    return tuple(rows)


def table_space(state: Sequence[ObsEntry], cameras: Sequence[ObsEntry]) -> spaces.Dict:
    """Observation space of one world: the rows of ``state_table``, of ``camera_table``, and their ``state``."""
    box: dict[str, spaces.Space] = {entry.key: entry.space for entry in (*state, *cameras)}
    width = sum(entry.shape[0] for entry in state)
    box[STATE_KEY] = spaces.Box(-np.inf, np.inf, (width,), np.float32)
    return ordered_dict(box)


def describe(
    state: Sequence[ObsEntry], cameras: Sequence[ObsEntry], kinds: Sequence[str]
) -> list[dict[str, Any]]:
    """The rows of ``table_space`` for people and machines: key, shape, dtype, unit, frame, meaning.

    ``kinds``: subtasks that the rows of the task are explained for.

    Raises:
        UsageError: there is no such subtask.
    """
    meanings = task_meanings(kinds)
    rows = [
        {
            "key": entry.key,
            "shape": list(entry.shape),
            "dtype": np.dtype(entry.dtype).name,
            "unit": entry.unit,
            "frame": entry.frame,
            "meaning": meanings.get(entry.key, entry.meaning),
        }
        for entry in (*state, *cameras)
    ]
    meaning = "the rows " + ", ".join(entry.key for entry in state) + " in this order"
    rows.append(
        {
            "key": STATE_KEY,
            "shape": [sum(entry.shape[0] for entry in state)],
            "dtype": "float32",
            "unit": "mixed",
            "frame": "mixed",
        }
        | {"meaning": meaning}
    )
    return rows


def _image_row(index: int, camera: str, output: str, size: tuple[int, int]) -> ObsEntry:
    compute = partial(_image, index=index, output=output)
    key = camera_key(camera, output)
    frame = "image, rows from the top"
    if output == "rgb":
        return ObsEntry(key, (*size, 3), "sRGB", frame, compute, "colour", np.uint8, 0, 255)
    if output == "depth":
        meaning = "distance along the optical axis, 0 where nothing is hit"
        return ObsEntry(key, (*size, 1), "mm", frame, compute, meaning, np.int16, 0, DEPTH_MAX)
    meaning = "segmentation id, see `segmentation_names`; 0 where nothing is hit"
    most = np.iinfo(np.int32).max
    return ObsEntry(key, (*size, 1), "id", frame, compute, meaning, np.int32, 0, most)


def _param_rows(index: int, camera: str) -> list[ObsEntry]:
    def row(
        name: str, shape: tuple[int, ...], unit: str, frame: str, compute: Callable, meaning: str
    ) -> ObsEntry:
        return ObsEntry(
            param_key(camera, name), shape, unit, frame, partial(compute, index=index), meaning
        )

    return [
        row(
            "intrinsic_cv",
            (3, 3),
            "px",
            "camera: x right, y down, z forward",
            _intrinsic_cv,
            "pinhole matrix; pixel centres lie at + 0.5",
        ),
        row(
            "extrinsic_cv",
            (3, 4),
            "m",
            "camera: x right, y down, z forward",
            _extrinsic_cv,
            "world to camera",
        ),
        row(
            "cam2world_gl",
            (4, 4),
            "m",
            "world",
            _cam2world_gl,
            "camera (x right, y up, z backwards) to world",
        ),
    ]


def _cloud_rows(robot: Robot, points: int) -> list[ObsEntry]:
    most = np.iinfo(np.int32).max
    order = "of every pixel: cameras in the order asked for, rows from the top"
    return [
        ObsEntry(
            f"{POINTCLOUD}/xyz",
            (points, 3),
            "m",
            robot.base_link,
            _cloud_xyz,
            f"position {order}; zero where nothing is hit (seg 0)",
        ),
        ObsEntry(
            f"{POINTCLOUD}/rgb",
            (points, 3),
            "sRGB",
            "-",
            partial(_cloud_image, output="rgb"),
            f"colour {order}",
            np.uint8,
            0,
            255,
        ),
        ObsEntry(
            f"{POINTCLOUD}/seg",
            (points, 1),
            "id",
            "-",
            partial(_cloud_image, output="seg"),
            f"segmentation id {order}",
            np.int32,
            0,
            most,
        ),
    ]


def _base_velocity(context: ObsContext) -> Array:
    yaw = context.robot_q[:, BASE_YAW]
    xp = namespace(yaw)
    c = xp.cos(yaw)
    s = xp.sin(yaw)
    velocity = context.robot_qd[:, BASE_XY]
    ahead = c * velocity[:, 0] + s * velocity[:, 1]
    left = c * velocity[:, 1] - s * velocity[:, 0]
    return xp.stack([ahead, left, context.robot_qd[:, BASE_YAW]], axis=1)


def _image(views: Views, index: int, output: str) -> Array:
    image = views.images[output][:, index]
    if output == "rgb":
        return image
    if output == "seg":
        return image[..., None]
    xp = namespace(image)
    mm = image * DEPTH_SCALE
    xp.round(mm, out=mm)
    xp.minimum(mm, constant((float(DEPTH_MAX),), mm), out=mm)
    return xp.astype(mm, xp.int16)[..., None]


def _intrinsic_cv(views: Views, index: int) -> Array:
    xp = namespace(views.intrinsic)
    return xp.tile(xp.astype(views.intrinsic[index], xp.float32), (len(views.pos), 1, 1))


def _extrinsic_cv(views: Views, index: int) -> Array:
    xp = namespace(views.mat)
    rot = xp.permute_dims(_turned(views.mat[:, index]), (0, 2, 1))
    move = -xp.einsum("wij,wj->wi", rot, views.pos[:, index])
    return xp.astype(xp.concat([rot, move[..., None]], axis=2), xp.float32)


def _turned(mat: Array) -> Array:
    """Rotations (..., 3, 3) of cameras with the axes of OpenCV: those of MuJoCo with y and z turned round."""
    return mat * constant((1.0, -1.0, -1.0), mat)


def _cam2world_gl(views: Views, index: int) -> Array:
    xp = namespace(views.mat)
    out = xp.zeros((len(views.pos), 4, 4), dtype=xp.float32, device=device_of(views.mat))
    out[:, :3, :3] = views.mat[:, index]
    out[:, :3, 3] = views.pos[:, index]
    out[:, 3, 3] = 1.0
    return out


def _cloud_xyz(views: Views) -> Array:
    depth = views.images["depth"]
    xp = namespace(depth)
    f32 = namespace(depth).float32
    yaw = views.base[:, BASE_YAW]
    c = xp.cos(yaw)
    s = xp.sin(yaw)
    zero = zeros(yaw.shape, yaw)
    to_base = xp.stack(
        [xp.stack([c, s, zero]), xp.stack([-s, c, zero]), xp.stack([zero, zero, zero + 1.0])]
    )
    to_base = xp.permute_dims(to_base, (2, 0, 1))
    origin = xp.concat([views.base[:, BASE_XY], zero[:, None] + views.robot.base_height], axis=1)
    rot = to_base[:, None] @ views.mat
    pos = xp.einsum("wij,wcj->wci", to_base, views.pos - origin[:, None])
    # Points in the camera (x right, y down, z forward) and 1, all 0 where nothing is hit, times a 4x3 matrix.
    seen = empty((*depth.shape, 4), depth)
    col = count(depth.shape[3], depth) + 0.5
    row = count(depth.shape[2], depth)[:, None] + 0.5
    for k, matrix in enumerate(views.intrinsic):
        seen[:, k, ..., 0] = depth[:, k] * xp.astype((col - matrix[0, 2]) / matrix[0, 0], f32)
        seen[:, k, ..., 1] = depth[:, k] * xp.astype((row - matrix[1, 2]) / matrix[1, 1], f32)
    seen[..., 2] = depth
    seen[..., 3] = depth > 0.0
    move = xp.concat([xp.permute_dims(_turned(rot), (0, 1, 3, 2)), pos[:, :, None]], axis=2)
    points = xp.reshape(seen, (*depth.shape[:2], -1, 4)) @ xp.astype(move, f32)
    return xp.reshape(points, (len(depth), -1, 3))


def _cloud_image(views: Views, output: str) -> Array:
    image = views.images[output]
    return image.reshape(len(image), -1, 3 if output == "rgb" else 1)


def state_observation(table: Sequence[ObsEntry], context: ObsContext) -> dict[str, Array]:
    """Every entry of a `state_table` and their concatenation, float32, (W, ...); the entries are views of it."""
    xp = namespace(context.robot_q)
    state = xp.astype(xp.concat([entry.compute(context) for entry in table], axis=1), xp.float32)
    obs = {}
    column = 0
    for entry in table:
        obs[entry.key] = state[:, column : column + entry.shape[0]]
        column += entry.shape[0]
    obs[STATE_KEY] = state
    return obs
