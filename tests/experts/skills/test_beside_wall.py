"""Closing a door that stands open at a wall: whole episodes, and the room that the hand takes between door and wall."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import mjhab
from mjhab.core.boxes import Boxes, sphere_box_distance
from mjhab.envs.parts.world_view import JointedLink, WorldView
from mjhab.envs.sequential import SequentialTaskEnv
from mjhab.experts import make_expert
from mjhab.experts.arm import motion
from mjhab.experts.planning.link_motions import Frame
from mjhab.experts.skills.doors import beside_wall, closing
from mjhab.experts.skills.doors.arc import from_angle
from mjhab.scenes.pack_source import PackRequest
from tests.real_data import real_data

DOOR = "fridge/top_door"
ONE = np.ones(1, dtype=bool)


def closing_env(**options: Any) -> SequentialTaskEnv:
    return mjhab.make(
        task="set_table",
        subtask="close",
        target=DOOR,
        profile="ms_hab",
        num_envs=1,
        threads=1,
        autoreset="disabled",
        **options,
    )


@pytest.fixture(scope="module")
def replica_cad() -> SequentialTaskEnv:
    folder = PackRequest(str(real_data("replica_cad")), stage="stand-in")
    return closing_env(assets=folder, split="val")


@pytest.fixture(scope="module")
def corner() -> SequentialTaskEnv:
    return closing_env(home="builtin_m3_20", split="val")


def play(env: SequentialTaskEnv, episode: int) -> tuple[dict, list[str], list[float]]:
    """Record of an episode, its phases, and the forces of the fingers on the door in every control step."""
    policy = make_expert(env)
    obs, info = env.reset(seed=1, options={"episode": [episode], "reset_mask": ONE})
    policy.reset(ONE)
    phases: list[str] = []
    forces = []
    while info["ended"][0] is None:
        action = policy.act(obs, info)
        phases += [name for name in policy.phases(0) if name not in phases]
        obs, _, _, _, info = env.step(action)
        assert not info["taint"][0]
        forces.append(float(env.view(0).finger_forces(DOOR).sum()))
    return info["ended"][0], phases, forces


@pytest.mark.parametrize(
    ("where", "episode"), [("replica_cad", 0), ("replica_cad", 5), ("corner", 0)]
)
def test_a_door_at_a_wall_is_pulled_from_it_and_shut(
    where: str, episode: int, request: pytest.FixtureRequest
) -> None:
    ended, phases, forces = play(request.getfixturevalue(where), episode)
    assert ended["success_once"], ended
    assert "reach past the edge of the door" in phases
    assert "push the door shut" in phases
    # The hand is not wedged in: the published limit on Close is 10,000 N in all.
    assert ended["cumulative_force"] < 500.0
    assert 1.0 < max(forces) < 500.0


def test_there_is_no_room_for_the_ordinary_motion_at_the_wall(
    replica_cad: SequentialTaskEnv,
) -> None:
    replica_cad.reset(seed=1, options={"episode": [0], "reset_mask": ONE})
    view = replica_cad.view(0)
    link = view.home.links[DOOR]
    assert view.link_q(DOOR) == pytest.approx(1.74, abs=0.001)
    assert closing.from_outside(view, link) is None
    bar = link.handle_pose(view.link_q(DOOR))[0]
    room = sphere_box_distance(bar[None], view.home.boxes).min()
    assert room < link.handle.thickness / 2 + motion.OPENED_M


def test_there_is_a_motion_for_a_door_that_leans_on_the_wall(
    replica_cad: SequentialTaskEnv, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where Open leaves it: it swings on until its handle meets the wall; 57 of 82 SetTables ended there."""
    replica_cad.reset(seed=1, options={"episode": [0], "reset_mask": ONE})
    view = replica_cad.view(0)
    link = view.home.links[DOOR]
    monkeypatch.setattr(WorldView, "link_q", lambda self, name: 1.76)
    path = beside_wall.from_edge(view, link)
    assert path is not None
    assert path.values[0] == pytest.approx(1.77)


def test_a_door_with_room_behind_is_closed_as_ever(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def refuse(view: WorldView, link: JointedLink) -> None:
        raise AssertionError("there is room behind this door")

    monkeypatch.setattr(beside_wall, "from_edge", refuse)
    env = closing_env(split="train")
    ended, phases, _ = play(env, 0)
    assert ended["success_once"] and "reach behind the door" in phases
    env.close()


@pytest.mark.parametrize(("where", "angle"), [("replica_cad", 1.75), ("corner", 1.9)])
def test_fingers_touch_the_door_and_leave_the_wall_room(
    where: str, angle: float, request: pytest.FixtureRequest
) -> None:
    """Exact boxes of palm and fingers, where the robot's motions are checked with spheres."""
    env = request.getfixturevalue(where)
    env.reset(seed=1, options={"episode": [0], "reset_mask": ONE})
    view = env.view(0)
    link = view.home.links[DOOR]
    now = view.link_q(DOOR)
    plain = JointedLink(DOOR, link.spec, np.array([0.0, 0.0, link.origin[2]]), np.eye(3))
    found, angles = from_angle(
        view.robot,
        beside_wall.edge_motions(view.robot, plain, angle),
        beside_wall.edge_angles(angle),
        now,
    )
    assert len(found)
    q = Frame.of(link).base(found.q[0])
    hands = zip(*view.robot.chain.tip_pose(q), strict=True)
    # At the last way point the hand presses the closed door.
    for now, (pos, rot) in list(zip(angles, hands, strict=True))[:-1]:
        palm, fingers = hand_boxes(view, pos, rot)
        door = link.boxes(float(now))
        to_door = [depth(part, door) for part in (fingers, palm)]
        # Way points are exact; between them the cut first one is 3 mm off the arc.
        assert -0.004 < to_door[0] < 0.004 and to_door[1] > 0.0, (now, to_door)
    first = hand_boxes(view, *(part[0] for part in view.robot.chain.tip_pose(q[:1])))
    assert min(depth(part, view.home.boxes) for part in first) > 0.008


def hand_boxes(
    view: WorldView, pos: np.ndarray, rot: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 3) all over palm and closed fingers, at a pose of the tcp."""
    sizes = view.robot.gripper
    low, high = sizes.palm_x
    across, up = sizes.palm_half
    palm = grid((low, high), across, up)
    tip, half = sizes.finger
    fingers = grid((-tip, tip), sizes.thickness, half)
    return pos + palm @ rot.T, pos + fingers @ rot.T


def grid(x: tuple[float, float], y: float, z: float) -> np.ndarray:
    axes = np.linspace(*x, 40), np.linspace(-y, y, 9), np.linspace(-z, z, 9)
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def depth(points: np.ndarray, boxes: Boxes) -> float:
    """Least signed distance [m] of points (N, 3) to boxes."""
    return float(sphere_box_distance(points, boxes).min())
