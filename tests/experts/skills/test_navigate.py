"""Driving to where the next thing is done: the search over position and heading, and real drives."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt

import mjhab.envs as envs
from mjhab.core.rotations import wrap
from mjhab.envs.sequential import SequentialTaskEnv
from mjhab.experts import make_expert
from mjhab.experts.base.floorplan import SLICES_M, Arm, Floorplan
from mjhab.experts.base.follower import PathSegment, simulate
from mjhab.experts.base.lattice import YAWS, Lattice
from mjhab.experts.base.limits import DRIVE_FREE
from mjhab.experts.skills import navigate
from mjhab.tasks.plan import Subtask
from mjhab.tasks.style import Styles
from tests.refusals import refused

CELL = 0.05
REACH = 0.6
THICK = 0.05
NEEDED = 0.29
FRIDGE = "fridge/top_door"
Map = np.ndarray


def floorplan(taken: Map) -> Floorplan:
    """A plan of walls that reach up to the ceiling, for an arm that is a ball `REACH` ahead of the base's centre."""
    gap = np.asarray(distance_transform_edt(~taken)) * CELL - CELL / 2
    walls = np.repeat(taken[None], len(SLICES_M), axis=0)
    arm = Arm(np.array([[REACH, 0.0]]), np.array([THICK]), np.array([[5, 5]]))
    return Floorplan(
        np.zeros(2),
        CELL,
        gap - NEEDED,
        np.repeat(gap[None], len(SLICES_M), axis=0),
        walls,
        arm,
        NEEDED,
    )


def ending_at(lattice: Lattice, xy: tuple[float, float]) -> np.ndarray:
    """Prices for which a way may end within 10 cm of a point, with any heading."""
    near = np.linalg.norm(lattice.points - np.array(xy), axis=-1) < 0.1
    return np.where(np.repeat(near[None], 16, axis=0), 0.0, np.inf)


def driven(segments: list[PathSegment], pose: np.ndarray) -> np.ndarray:
    return simulate(pose, segments, 0.1, DRIVE_FREE)


def two_rooms() -> Map:
    """Rooms of 3 m by 4 m, side by side in x, joined by a doorway of 0.9 m at the upper end of the wall."""
    taken = np.zeros((124, 80), dtype=bool)
    taken[[0, -1]] = taken[:, [0, -1]] = taken[62, :58] = taken[62, 76:] = True
    return taken


def test_way_leads_through_the_doorway_and_nothing_touches():
    plan = floorplan(two_rooms())
    lattice = Lattice(plan)
    pose = np.array([1.5, 1.0, 0.0])
    found = lattice.search(pose, ending_at(lattice, (4.6, 1.0)))
    assert found is not None
    track = driven(found[1], pose)
    assert np.linalg.norm(track[-1, :2] - [4.6, 1.0]) < 0.15
    crossing = track[np.argmin(np.abs(track[:, 0] - 62.5 * CELL))]
    assert (
        58 * CELL + 0.285 < crossing[1] < 76 * CELL - 0.285
    )  # the base fits between the posts
    tip = track[:, :2] + REACH * np.stack(
        [np.cos(track[:, 2]), np.sin(track[:, 2])], axis=1
    )
    cells = np.floor(tip / CELL).astype(int)
    assert not two_rooms()[
        cells[:, 0], cells[:, 1]
    ].any()  # nor does the arm go through the wall
    assert plan.clearance(track).min() > -0.03


def test_no_way_through_a_wall():
    taken = two_rooms()
    taken[62] = True
    lattice = Lattice(floorplan(taken))
    assert (
        lattice.search(np.array([1.5, 1.0, 0.0]), ending_at(lattice, (4.6, 1.0))) is None
    )


def test_robot_backs_out_of_a_passage_too_narrow_to_turn_in():
    taken = np.zeros((120, 80), dtype=bool)
    taken[[0, -1]] = taken[:, [0, -1]] = True
    taken[60:, :31] = taken[60:, 49:] = (
        True  # a blind alley of 0.9 m: the base fits, the arm cannot swing round
    )
    plan = floorplan(taken)
    lattice = Lattice(plan)
    pose = np.array([4.5, 2.0, 0.0])
    found = lattice.search(pose, ending_at(lattice, (1.5, 2.0)))
    assert found is not None
    inside = [segment for segment in found[1] if segment.points[0, 0] > 3.1]
    assert inside and all(segment.direction == -1 for segment in inside)
    assert plan.clearance(driven(found[1], pose)).min() > -0.03


def test_rooms_of_all_cells_agree_with_the_room_of_poses():
    plan = floorplan(two_rooms())
    clearance = plan.clearances(YAWS)
    for h, i, j in [(0, 40, 40), (3, 58, 30), (8, 66, 60), (13, 20, 70)]:
        pose = np.array([(i + 0.5) * CELL, (j + 0.5) * CELL, YAWS[h]])
        # The arm of a whole map goes from cell to cell.
        assert abs(plan.clearance(pose[None])[0] - clearance[h, i, j]) < 0.75 * CELL


@pytest.mark.parametrize("start, end", [(0.1, 3.0), (3.0, -3.0), (-1.0, -2.9)])
def test_facing_is_by_the_short_way(start: float, end: float):
    pose = np.array([1.5, 2.0, start])
    (segment,) = navigate.turns(pose[:2], start, float(wrap(end - start)))[-1:]
    assert abs(wrap(segment.yaw - end)) < 1e-9


# -- in homes ----------------------------------------------------------------------------------------------------------


def build(task: str, subtask: str = "navigate", **more: str) -> SequentialTaskEnv:
    return envs.make(
        task=task, subtask=subtask, num_envs=1, autoreset="disabled", threads=1, **more
    )


def active(env: SequentialTaskEnv) -> Subtask:
    subtask = env.view(0).subtask
    assert subtask is not None
    return subtask


def drive(
    env: SequentialTaskEnv, episode: int, steps: int, halfway=None, style=()
) -> dict:
    """Let the expert drive; returns how it ended. ``halfway(env)`` is called once in the middle of the way."""
    obs, info = env.reset(seed=0, options={"episode": [episode]})
    policy = make_expert(env, Styles.parse(style))
    policy.reset(np.ones(1, bool))
    start = env.state.robot_q[0, :2].copy()
    moves = []
    force = 0.0
    for step in range(steps):
        before = env.state.robot_q[0, :2].copy()
        obs, _, _, _, info = env.step(policy.act(obs, info))
        moves.append(float(np.linalg.norm(env.state.robot_q[0, :2] - before)))
        force += float(info["robot_force"][0])
        if step == 40 and halfway is not None:
            halfway(env)
        if env.success[0] or env.progress.pointer[0]:
            break
    return {
        "success": bool(env.success[0]),
        "moves": np.array(moves),
        "start": start,
        "force": force,
    }


def test_drives_around_walls_and_faces_the_goal():
    env = build("set_table")
    ended = drive(env, 10, 400)
    q = env.state.robot_q[0]
    goal = env.focus.active.goal_pos[0]
    assert ended["success"] and ended["force"] == 0.0
    assert ended["moves"].sum() > 1.3 * np.linalg.norm(
        q[:2] - ended["start"]
    )  # not straight
    assert ended["moves"].max() < 0.1
    assert np.linalg.norm(q[:2] - goal[:2]) <= 2.0
    assert abs(wrap(np.arctan2(*(goal[:2] - q[:2])[::-1]) - q[2])) <= 0.5
    x_min, x_max, y_min, y_max = env.boxes[0][active(env).link]
    assert x_min <= q[0] <= x_max and y_min <= q[1] <= y_max


def test_keeps_what_it_holds():
    env = build("tidy_house")
    ended = drive(env, 5, 400)
    assert active(env).must_hold and ended["success"]
    assert ended["moves"].sum() > 2.0
    assert env.view(0).signal("is_grasped")


@pytest.mark.parametrize("watches", [True, False])
def test_plans_anew_when_a_door_opens_in_its_way(
    monkeypatch: pytest.MonkeyPatch, watches: bool
):
    """By looking; and without it, by running into the door, which is pushed aside or gone round."""
    env = build("set_table")
    met = []
    plan_trajectory = navigate.plan_trajectory

    def spy(*args):
        met.append(len(args[4]))
        return plan_trajectory(*args)

    def open_the_door(env: SequentialTaskEnv) -> None:
        qpos = env.sim.qpos[0].copy()
        qpos[env.sim.addresses.link_q[env.layout.link_ids.index(FRIDGE)]] = 1.2
        env.sim.write_qpos(0, qpos)
        env.state = env.sim.state()

    monkeypatch.setattr(navigate, "plan_trajectory", spy)
    monkeypatch.setattr(
        navigate, "DOOR_MOVED", navigate.DOOR_MOVED if watches else np.inf
    )
    ended = drive(env, 2, 400, open_the_door)
    assert active(env).link == FRIDGE and ended["success"]
    assert met == [0, 0] if watches else met in ([0], [0, 1])
    assert (ended["force"] == 0.0) == watches


def test_chain_may_be_driven():
    env = build("tidy_house", "", navigate="drive")
    assert not env.task_config.ignore_arm
    ended = drive(env, 0, 400)
    assert env.progress.pointer[0] == 1
    assert ended["moves"].sum() > 1.0 and ended["moves"].max() < 0.1
    assert env.view(0).signal("robot_rest")


@pytest.mark.parametrize(
    ("task", "style", "opens"),
    [
        ("tidy_house", (), False),
        ("tidy_house", ("hand=open",), True),
        ("set_table", ("hand=open",), False),
    ],
)
def test_the_empty_hand_is_at_rest_or_open_on_the_way_to_an_object(
    task: str, style: tuple[str, ...], opens: bool
) -> None:
    env = build(task, "", navigate="drive")
    drive(env, 0, 400, style=style)
    assert env.progress.pointer[0] == 1
    fingers = list(env.layout.robot.finger_columns)
    wide = [env.layout.robot.joint_limits[fingers[0]][1]] * 2
    wanted = wide if opens else env.layout.robot.rest[fingers]
    np.testing.assert_allclose(env.state.robot_q[0, fingers], wanted, atol=2e-3)
    assert np.abs(env.state.robot_qd[0, fingers]).max() < 0.01


def test_chain_teleports_unless_told_otherwise():
    away = {}
    for mode in ("teleport", "drive"):
        env = build("tidy_house", "", navigate=mode)
        env.reset(seed=0, options={"episode": [0]})
        away[mode] = np.linalg.norm(
            env.state.robot_q[0, :2] - env.focus.active.goal_pos[0, :2]
        )
    assert away["teleport"] <= 2.0 < away["drive"]
    assert build("tidy_house", "").task_config.ignore_arm
    with refused("navigate mode", "fly", expected="teleport"):
        build("tidy_house", "", navigate="fly")


def test_a_place_behind_furniture_is_a_long_way_round():
    env = envs.make(
        task="tidy_house",
        num_envs=1,
        split="val",
        home="builtin_m3_08",
        autoreset="disabled",
        threads=1,
    )
    env.reset(seed=0, options={"episode": [0]})
    view = env.view(0)
    # A chair between a table and a wall: the floor to its left is reached from the far side of the table only.
    seat = np.array([6.76, 5.21, 0.49])
    below = np.array([6.42, 3.68])
    beside = np.array([6.25, 4.95])
    points = np.stack([below, beside])[:, None]
    way = navigate.detours(view, navigate.Aim(seat, 0.95, 2.0, None), points)[:, 0]
    assert way[0] > 5.0 and way[1] == 0.0
    # What is opened has an area of its own before it.
    area = np.array([0.0, 1.0, 0.0, 1.0])
    assert not navigate.detours(view, navigate.Aim(seat, 0.95, 2.0, area), points).any()
