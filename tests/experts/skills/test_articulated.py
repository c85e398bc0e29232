"""Opening and closing drawers and doors: whole episodes with the expert, and the geometry its motions rest on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from mjhab.core.boxes import sphere_box_distance
from mjhab.envs import make
from mjhab.envs.parts.world_view import JointedLink, WorldView, home_shapes
from mjhab.envs.sequential import SequentialTaskEnv
from mjhab.experts import make_expert
from mjhab.experts.arm import motion
from mjhab.experts.planning import link_motions
from mjhab.experts.skills import drawer
from mjhab.experts.skills.doors import arc, motions, sweeping
from mjhab.robots.fetch.robot import ROBOT
from mjhab.tasks.style import Styles

DRAWER = "kitchen_counter/drawer3"
DOOR = "fridge/top_door"


def play(
    subtask: str,
    target: str,
    episode: int,
    *words: str,
    look: Callable[[WorldView], object] = bool,
) -> dict:
    """The record of one episode's subtask, run to its horizon by the expert; ``look`` is called after every step."""
    env = make(
        task="set_table", subtask=subtask, target=target, num_envs=1, autoreset="disabled"
    )
    policy = make_expert(env, Styles.parse(words))
    obs, info = env.reset(
        seed=0, options={"episode": [episode], "reset_mask": np.ones(1, dtype=bool)}
    )
    policy.reset(np.ones(1, dtype=bool))
    while info["ended"][0] is None:
        obs, _, _, _, info = env.step(policy.act(obs, info))
        look(env.view(0))
    return {**info["ended"][0], "state": env.state_digest(0)}


@pytest.mark.parametrize(
    ("subtask", "target", "episode"),
    [("open", DRAWER, 5), ("close", DRAWER, 6), ("open", DOOR, 13), ("close", DOOR, 13)],
)
def test_expert_succeeds(subtask: str, target: str, episode: int) -> None:
    ended = play(subtask, target, episode)
    assert ended["success_once"], ended
    assert ended["cumulative_force"] < 5000.0


@pytest.mark.parametrize(("target", "episode"), [(DRAWER, 5), (DOOR, 13)])
def test_a_handle_that_is_pulled_counts_as_held(target: str, episode: int) -> None:
    """Friction on the pads, which is large while the robot pulls, does not turn the contact forces."""
    env = make(
        task="set_table", subtask="open", target=target, num_envs=1, autoreset="disabled"
    )
    policy = make_expert(env)
    one = np.ones(1, dtype=bool)
    obs, info = env.reset(seed=0, options={"episode": [episode], "reset_mask": one})
    policy.reset(one)
    held: list[bool] = []
    while info["ended"][0] is None:
        obs, _, _, _, info = env.step(policy.act(obs, info))
        fingers = env.state.finger_force[0, :, env.focus.columns[0, 0]]
        if (np.linalg.norm(fingers, axis=1) >= env.task_config.grasp_force).all():
            held.append(bool(info["is_grasped"][0]))
    assert len(held) > 10 and np.mean(held) >= 0.95


@pytest.mark.parametrize("episode", [3, 13])
def test_a_door_stays_where_it_is_let_go_of(episode: int) -> None:
    angles: list[float] = []
    ended = play(
        "open", DOOR, episode, look=lambda view: angles.append(view.link_q(DOOR))
    )
    assert (
        ended["success_once"]
        and max(angles) - angles[-1] < 0.02 < max(angles) - angles[0]
    )


def test_a_door_is_pushed_all_the_way_or_thrown_as_asked() -> None:
    """Pushed, the hand is at the door until it is shut; thrown, it is well behind before."""

    def behind(*words: str) -> tuple[dict, float]:
        far = [0.0]

        def look(view: WorldView) -> None:
            q = view.link_q(DOOR)
            if 0.05 < q < 0.5:
                door_now = view.home.links[DOOR].boxes(q)
                far[0] = max(
                    far[0],
                    float(sphere_box_distance(motion.tcp(view)[0][None], door_now).min()),
                )

        ended = play("close", DOOR, 13, *words, look=look)
        return ended, far[0]

    (pushed, near) = behind("close=push")
    (thrown, far) = behind("close=throw")
    (plain, _) = behind()
    assert pushed["success_once"] and thrown["success_once"]
    assert near < 0.06 < 0.15 < far, (near, far)
    assert thrown["state"] == plain["state"] != pushed["state"]


def test_a_door_is_swept_shut_with_the_arm_at_rest() -> None:
    """Nothing has to be folded afterwards: it takes fewer control steps than to throw the door."""
    off: list[float] = []

    def look(view: WorldView) -> None:
        off.append(motion.joint_gap(view, motion.rest_goal(view)))

    def steps(ended: dict) -> int:
        return next(step for step, name in ended["events"] if name == "success")

    swept = play("close", DOOR, 13, "close=sweep", look=look)
    assert swept["success_once"] and swept["cumulative_force"] < 2000.0
    assert max(off) < 0.3, max(off)
    assert steps(swept) < steps(play("close", DOOR, 13)) - 20


def test_a_drawer_is_shut_with_its_handle_held_where_that_is_asked_for() -> None:
    def widths(*words: str) -> tuple[dict, np.ndarray]:
        found = []
        last = [0.0]

        def look(view: WorldView) -> None:
            q = view.link_q(DRAWER)
            if last[0] - q > 0.002:
                found.append(view.q[-2:].sum())
            last[0] = q

        return play("close", DRAWER, 6, *words, look=look), np.array(found)

    (held, around) = widths("close=grasp")
    (pushed, fist) = widths("close=push")
    (plain, _) = widths()
    assert held["success_once"] and pushed["success_once"]
    assert fist.max() < 0.003 < 0.01 < around.min(), (fist, around)
    assert pushed["state"] == plain["state"]


@pytest.fixture(scope="module")
def env() -> SequentialTaskEnv:
    return make(
        task="set_table", subtask="open", target=DRAWER, num_envs=1, autoreset="disabled"
    )


def plan_link(env: SequentialTaskEnv, name: str) -> JointedLink:
    link = home_shapes(env.layout, env.layout.pack.homes[0].name).links[name]
    return JointedLink(
        link.id, link.spec, np.array([0.0, 0.0, link.origin[2]]), np.eye(3)
    )


def test_pull_stances_hold_the_bar(env: SequentialTaskEnv) -> None:
    link = plan_link(env, DRAWER)
    found = link_motions.cached(ROBOT, link, "pull", drawer._pull_motions)
    pos, rot = ROBOT.chain.tip_pose(found.q[:, 1])
    handle, bar, out = link.handle_pose(0.0)
    assert len(found) > 20
    assert np.abs(pos - handle).max() < 5e-3
    assert np.abs(rot[:, :, 0] + out).max() < 0.05  # points at the drawer
    assert np.abs(rot[:, :, 1] @ bar).max() < 0.05  # fingers above and below


def test_pull_stances_follow_the_arc(env: SequentialTaskEnv) -> None:
    link = plan_link(env, DOOR)
    found = link_motions.cached(ROBOT, link, "pull", motions.pull_motions)
    angles = motions.pull_angles(link)
    assert len(found) > 20
    assert angles[-1] > 0.75 * link.range[1]
    for k in range(1, len(angles)):
        pos, _ = ROBOT.chain.tip_pose(found.q[:, k])
        assert np.abs(pos - link.handle_pose(angles[k])[0])[:, :2].max() < 5e-3


def test_hand_gets_in_behind_an_open_door(env: SequentialTaskEnv) -> None:
    link = plan_link(env, DOOR)
    found = link_motions.cached(ROBOT, link, "push_open", motions.push_open)
    angles = motions.push_angles(link, half=False)
    assert len(found) > 20
    hand = motion.spheres(ROBOT).only(("wrist_roll_link", "gripper_link"))
    assert hand.clearance(found.q[:, 0], link.boxes(link.range[1])).min() > 0.03
    pos, _ = ROBOT.chain.tip_pose(found.q[:, 0])
    origin, rot = link.pose(angles[0])
    assert (
        ((pos - origin) @ rot)[:, 0] > link.boxes(0.0).center[0, 0]
    ).all()  # on its outside


def test_motions_belong_to_one_piece_of_furniture(env: SequentialTaskEnv) -> None:
    link = plan_link(env, DRAWER)
    handle = replace(link.handle, half_length=link.handle.half_length + 0.01)
    other = JointedLink(link.id, replace(link.spec, handle=handle), link.origin, link.rot)
    none = link_motions.LinkMotions(np.zeros((0, 1, 15)), np.zeros(0), np.zeros(0))
    link_motions.cached(ROBOT, link, "pull", drawer._pull_motions)
    assert len(link_motions.cached(ROBOT, other, "pull", lambda *_: none)) == 0


@pytest.mark.parametrize("speed", [0.3, 0.8, 1.5])
def test_thrown_door_coasts(speed: float) -> None:
    way = 0.0
    dt = 1e-4
    v = speed
    while v > 0:
        way += v * dt
        v -= (v + arc.COAST_STOP_RAD_S) / arc.COAST_TIME_S * dt
    assert arc.coasts(speed) == pytest.approx(way, abs=1e-3)
    assert arc.coasts(-speed) == 0.0


def test_frame_round_trip(env: SequentialTaskEnv) -> None:
    link = home_shapes(env.layout, env.layout.pack.homes[-1].name).links[DOOR]
    frame = link_motions.Frame.of(link)
    pose = np.array([0.7, -0.4, 2.0])
    world = frame.base(pose)
    c = np.cos(frame.yaw)
    s = np.sin(frame.yaw)
    assert np.allclose(np.array([[c, s], [-s, c]]) @ (world[:2] - frame.origin), pose[:2])
    handle = JointedLink(
        link.id, link.spec, np.array([0.0, 0.0, link.origin[2]]), np.eye(3)
    ).handle_pose(0.4)[0]
    assert np.allclose(frame.point(handle[:2]), link.handle_pose(0.4)[0][:2])


def test_withdrawn_hand_moves_straight_back(env: SequentialTaskEnv) -> None:
    q = link_motions.cached(
        ROBOT, plan_link(env, DRAWER), "pull", drawer._pull_motions
    ).q[:, 1]
    moved = arc.withdrawn(ROBOT, q, 0.05)
    (start, rot) = ROBOT.chain.tip_pose(q)
    (end, _) = ROBOT.chain.tip_pose(moved)
    done = np.abs(moved - q).max(axis=1) > 0
    assert done.mean() > 0.8
    assert np.allclose(start - end, 0.05 * rot[:, :, 0] * done[:, None], atol=5e-3)


def test_quickest_seeds_are_kept() -> None:
    row = np.array([1, 0, 0, 0, 1])
    travel = np.array([5.0, 3.0, 1.0, 2.0, 4.0])
    assert link_motions._quickest(row, travel, 2).tolist() == [
        True,
        False,
        True,
        True,
        True,
    ]


@pytest.mark.parametrize("angle", [1.8, 2.3])
def test_sweeps_come_from_outside_and_end_at_the_closed_door(
    env: SequentialTaskEnv, angle: float
) -> None:
    link = plan_link(env, DOOR)
    found = sweeping.sweeps(ROBOT, link, angle)
    arm = motion.spheres(ROBOT)
    clear = arm.clearance(found.q[:, 0], link.boxes(angle))
    near = arm.clearance(found.q[:, -1], link.boxes(0.0))
    assert len(found) and (clear > 0.0).all() and (near < 0.05).all()
    assert (found.q[..., 3:] == ROBOT.rest[3:]).all()
    _, _, out = link.handle_pose(angle)
    assert ((found.q[:, 0, :2] @ out[:2]) > 0.0).all()
