"""What ``mjhab bench interact`` simulates: a home with its stage and articulations, one surface with five objects, a
robot before it, and 200 recorded actions that sweep the arm through the objects. All worlds are alike.

After the paper's benchmark (mshab/utils/bench, MS-HAB paper Sec. 4): stage, articulations and YCB objects, no
other furniture. Its file of actions belongs to the Habitat 2.0 assets, so the actions are our own;
``python -m benchmarks.interact_recipe`` makes them again.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.resources import files

import numpy as np

from mjhab.core.errors import UsageError
from mjhab.core.joints import BASE, BASE_XY
from mjhab.layout.layout import Layout, yaw_quat
from mjhab.layout.receptacles import PlacedReceptacle, placed_receptacles
from mjhab.robots.registry import robot_named
from mjhab.scenes.freespace import NAVMESH_BASE_RADIUS_M, free_map
from mjhab.scenes.pack_source import Assets
from mjhab.scenes.packs import open_pack
from mjhab.scenes.spec import Home, Pack
from mjhab.sim.mujoco.cpu import CpuSimulator
from mjhab.sim.mujoco.settle import settle

OBJECTS = (
    "005_tomato_soup_can",
    "004_sugar_box",
    "010_potted_meat_can",
    "002_master_chef_can",
    "003_cracker_box",
)
"""From the robot's right to its left. The original's trajectory touches five objects, too (MS-HAB paper Sec. 4)."""
ANGLES = (-0.44, -0.22, 0.0, 0.22, 0.44)
"""Where they stand, as angles [rad] about the axis of the shoulder."""
SHOULDER_X = 0.033
RADIUS = 0.75
"""The axis before the centre of the base, and the distance of the objects from it [m]."""
STAND = 0.45
"""From the centre of the base to the usable part of the surface [m]."""
START_QPOS = (
    0.0,
    0.0,
    0.0,
    0.15,
    0.0,
    -0.45,
    0.562,
    -1.08,
    0.1,
    0.935,
    -0.001,
    1.573,
    0.005,
    0.015,
    0.015,
)
"""Robot before a surface at SURFACE_HEIGHT, in the order of its joints (mshab's interact_scene_builder.py);
at another height the torso differs."""
SURFACE_HEIGHT = 0.75
TORSO_RANGE = (0.0, 0.386)
DEPTH = 0.36
HALF_WIDTH = 0.42
"""Least depth and half-width of the surface [m]."""
STEPS = 200
STIFF_BODY_MODE = "pd_joint_delta_pos_stiff_body"
"""As the original: what the arm does must not move head and torso."""
ACTION_FILE = "interact_actions.csv"


@dataclass(frozen=True, eq=False)
class InteractScene:
    """Layout with one home, and the state (nq,) that every world starts from; ``robot`` (J,) of it."""

    layout: Layout
    qpos: np.ndarray
    robot: np.ndarray

    @property
    def home(self) -> str:
        """Name of the home."""
        return self.layout.pack.homes[0].name


def interact_actions(scene: InteractScene) -> np.ndarray:
    """(200, A) float32 actions of STIFF_BODY_MODE: the recorded arm, head and torso held, all others zero."""
    text = files("mjhab.bench.interact").joinpath(ACTION_FILE).read_text(encoding="utf-8")
    arm = np.loadtxt(
        text.splitlines(), delimiter=",", comments="#", dtype=np.float32, ndmin=2
    )
    return with_body(scene, arm)


def with_body(scene: InteractScene, arm: np.ndarray) -> np.ndarray:
    """(T, A) float32 actions that move the arm by ``arm`` (T, 7) and hold head and torso."""
    actions = np.pad(
        arm.astype(np.float32),
        ((0, 0), (0, scene.layout.robot.action.dim - arm.shape[1])),
    )
    robot = scene.layout.robot
    actions[:, robot.action.body] = scene.robot[list(robot.body_columns)]
    return actions


def interact_scene(assets: Assets = "builtin") -> InteractScene:
    """The scene in the first home of a pack that has a fit surface, and free floor before it.

    Raises:
        UsageError: no home has one, or the pack lacks one of OBJECTS.
    """
    pack = open_pack(assets)
    missing = [name for name in OBJECTS if name not in pack.objects]
    if missing:
        raise UsageError(
            f"bench interact needs the objects {', '.join(missing)}, which {assets} lacks."
        )
    for home in pack.homes:
        for stripped, surface, base in _places(pack, home):
            return _arrange(dataclasses.replace(pack, homes=(stripped,)), surface, base)
    raise UsageError(
        f"no home of {assets} has a table or counter for bench interact: {DEPTH} m deep, {2 * HALF_WIDTH} m wide, "
        f"0.6 to 0.98 m high, with room for the robot before it."
    )


def _places(
    pack: Pack, home: Home
) -> Iterator[tuple[Home, PlacedReceptacle, np.ndarray]]:
    """Surfaces of a home without its other furniture, and base poses (x, y, yaw) before them."""
    for surface in placed_receptacles(
        Layout(dataclasses.replace(pack, homes=(home,)), ()), home
    ):
        if (
            surface.link
            or surface.kind != "open"
            or not TORSO_RANGE[0] <= _torso(surface) <= TORSO_RANGE[1]
        ):
            continue
        own = [
            p
            for p in home.props
            if p.template == surface.template and _near(p.pos, surface.pos)
        ]
        stripped = dataclasses.replace(home, props=tuple(own))
        # Of the home without its other furniture, as it will be simulated.
        floor = free_map(stripped, pack)
        for base in _bases(surface):
            if floor.clearance_at(base[BASE_XY]) >= NAVMESH_BASE_RADIUS_M:
                yield stripped, surface, base


def _near(a: tuple[float, ...], b: tuple[float, ...]) -> bool:
    return bool(np.hypot(a[0] - b[0], a[1] - b[1]) < 2.0)


def _torso(surface: PlacedReceptacle) -> float:
    return START_QPOS[robot_named().torso_columns[0]] + surface.pos[2] - SURFACE_HEIGHT


def _bases(surface: PlacedReceptacle) -> Iterator[np.ndarray]:
    """Base poses (x, y, yaw) before the sides of a surface that are long enough."""
    for turn in (0.0, np.pi / 2, np.pi, -np.pi / 2):
        deep, wide = surface.half if turn in (0.0, np.pi) else surface.half[::-1]
        if 2 * deep >= DEPTH and wide >= HALF_WIDTH:
            out = surface.yaw + turn
            place = np.array(surface.pos[:2]) + (deep + STAND) * np.array(
                [np.cos(out), np.sin(out)]
            )
            yield np.array([*place, (out + 2 * np.pi) % (2 * np.pi) - np.pi])


def _arrange(pack: Pack, surface: PlacedReceptacle, base: np.ndarray) -> InteractScene:
    layout = Layout(pack, OBJECTS)
    sim = CpuSimulator(layout, 1, 1)
    model = sim.model(pack.homes[0].name)
    a = sim.addresses
    qpos = model.qpos0.copy()
    x, y, yaw = base
    for slot, angle in enumerate(ANGLES):
        ahead = SHOULDER_X + RADIUS * np.cos(angle)
        left = RADIUS * np.sin(angle)
        start = a.object_q[slot]
        qpos[start : start + 7] = [
            x + ahead * np.cos(yaw) - left * np.sin(yaw),
            y + ahead * np.sin(yaw) + left * np.cos(yaw),
            # The original drops them from 1 cm; here they start at rest.
            surface.pos[2] + layout.objects[slot].half[2] + 0.002,
            # Turned with the arc, so that every object shows the arm the same side.
            *yaw_quat(yaw + angle),
        ]
    # Before the robot is put there, so that the objects settle without it.
    qpos = settle(model, a, qpos)[0]
    robot = np.array(START_QPOS)
    robot[BASE] = base
    robot[layout.robot.torso_columns[0]] = _torso(surface)
    qpos[a.robot_q] = robot
    return InteractScene(layout, qpos, robot)
