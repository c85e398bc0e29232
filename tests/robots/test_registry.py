"""Robots by name: what one must have, what is refused; nothing outside `robots` names or numbers a joint."""

from __future__ import annotations

import dataclasses
import json
import math
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import mjhab
from mjhab.cli.main import main
from mjhab.config.env import EnvConfig
from mjhab.core.errors import MjhabError, UsageError
from mjhab.robots.fetch.robot import ROBOT
from mjhab.robots.parts import Body, Finger, TreeLink
from mjhab.robots.registry import DEFAULT_ROBOT, ROBOTS, register_robot, robot_named
from mjhab.robots.robot import Robot
from mjhab.scenes.roles import OPEN_SURFACE
from mjhab.tasks.household.registry import TASKS, register_task
from mjhab.tasks.household.spec import TargetRule, TaskSpec
from mjhab.tasks.plan import Subtask
from mjhab.tasks.subtasks.pick import PICK
from mjhab.tasks.subtasks.registry import SUBTASKS, number_of, register_subtask
from tests.refusals import refused

HEAD = ROBOT.cameras[0]
STIFF = ROBOT.stiff_gains
SOURCE = Path(mjhab.__file__).parent
FETCH_WORDS = re.compile(
    r"fetch|gripper_link|_flex_|_roll_joint|_pan_joint|_tilt_joint|torso_lift",
    re.IGNORECASE,
)
"""What only the robot Fetch has: its name and its joints."""
DATA_STRINGS = re.compile(
    r"assets fetch\b|AssetsFetchOptions|Sub\(\"fetch\"\)"  # the command that downloads data sets
    r"|robots/fetch/fetch\.py"  # a source that is cited
    r"|\"fetch_head/depth\"|show fetch`"  # examples in the words of help
)
"""Where the word is no name of ours for the robot."""
JOINT_NUMBERS = re.compile(
    r"(robot_qd?|rest_qpos|REST_QPOS)\[[^\]]*[:\s]\d|(view\.q|rest_qpos)\[[^\]]*\d|\b(3:13|13:15|13:)\]"
)
"""A number where a column of joint positions belongs."""
PUBLISHED = (
    "compat/mshab/",  # names that MS-HAB's scripts import and read
    "data/imports/ms_hab_layout.py",  # names of the actions in MS-HAB's files
    "data/store/older/schemas.py",  # names of the joints in shards that do not name theirs
    "paper/ms_hab/network.py",  # names of the cameras in MS-HAB's checkpoints
)
"""Files with strings of published data: they stay when the robot's own names change."""
DOWNLOADS = ("assets/", "cli/worlds/assets.py", "cli/commands.py")
"""Files that fetch data sets, or name the command that does."""


@pytest.fixture
def removed() -> Iterator[list[str]]:
    """Names of robots to take back after a test."""
    names: list[str] = []
    yield names
    for name in names:
        ROBOTS.remove(name)


def test_fetch_is_the_first_robot_and_the_default() -> None:
    assert ROBOTS.names()[0] == DEFAULT_ROBOT == "fetch" and robot_named() is ROBOT
    assert ROBOT.action.dim == 13 and ROBOT.columns.posture == slice(3, 13)


def test_two_robots_of_one_name_are_refused(removed: list[str]) -> None:
    twin = dataclasses.replace(ROBOT, name="twin")
    assert register_robot(twin) is robot_named("twin")
    removed.append("twin")
    with refused("robot", "twin", expected="registered once"):
        mjhab.register_robot(twin)
    with refused("robot", "fetch", expected="registered once"):
        register_robot(ROBOT)


def test_an_unknown_robot_is_named() -> None:
    with refused("robot", "fecth", expected="fetch"):
        mjhab.make(robot="fecth", task="set_table")


def changed(**groups: tuple[str, ...]) -> Robot:
    """Fetch with other groups of joints and the joints that are left."""
    own = {**ROBOT.groups, **groups}
    own = {group: joints for group, joints in own.items() if joints}
    joints = tuple(
        joint for joint in ROBOT.joints if any(joint in row for row in own.values())
    )
    rest = tuple(ROBOT.rest_qpos[ROBOT.joints.index(joint)] for joint in joints)
    return dataclasses.replace(
        ROBOT, name="changed", groups=own, joints=joints, rest_qpos=rest, fingers=()
    )


def test_a_subtask_says_which_joint_groups_a_robot_lacks(removed: list[str]) -> None:
    register_robot(changed(fingers=(), head=()))
    removed.append("changed")
    with refused("joint group 'fingers'"):
        mjhab.make(robot="changed", task="set_table")


def test_a_subtask_may_need_other_joint_groups(removed: list[str]) -> None:
    register_robot(changed(head=()))
    removed.append("changed")
    EnvConfig(task="set_table", robot="changed")
    nod = dataclasses.replace(PICK, name="nod", joint_groups=("head",))
    place = (OPEN_SURFACE,)
    rule = TargetRule(
        place, place, chain=lambda target: [Subtask(number_of("nod"), target.obj)]
    )
    register_subtask(nod)
    register_task(TaskSpec("look", ("look around",), (rule,)))
    try:
        EnvConfig(task="look")
        with refused("joint group 'head'"):
            EnvConfig(task="look", robot="changed")
        with refused("joint group", "legs", where="subtask 'nod'"):
            dataclasses.replace(nod, joint_groups=("legs",))
    finally:
        TASKS.remove("look")
        SUBTASKS.remove("nod")


@pytest.mark.parametrize(
    ("change", "option"),
    [
        ({"groups": {**ROBOT.groups, "legs": ()}}, "joint group"),
        ({"groups": {**ROBOT.groups, "head": ()}}, "groups"),
        ({"joints": ROBOT.joints[::-1]}, "joints"),
        (
            {"joints": (*ROBOT.joints[:12], *ROBOT.joints[13:], ROBOT.joints[12])},
            "joints",
        ),
        ({"rest_qpos": ROBOT.rest_qpos[:5]}, "rest_qpos"),
        ({"gains": {}}, "gains"),
        ({"gains": {**ROBOT.gains, "arm": 1000.0}}, "gains of 'arm'"),
        ({"stiff_gains": None}, "gains of 'stiff_gains'"),
        ({"elbow": "elbow_flex"}, "joint of the arm"),
        ({"cameras": ("fetch_head",)}, "cameras[0]"),
        ({"cameras": (HEAD, HEAD)}, "cameras[1]"),
        (
            {"cameras": (dataclasses.replace(HEAD, fovy=90.0),)},
            "fovy of camera 'fetch_head'",
        ),
    ],
)
def test_a_robot_that_cannot_be_is_refused(change: dict, option: str) -> None:
    with refused(option, where="robot 'fetch'"):
        dataclasses.replace(ROBOT, **change)


@pytest.mark.parametrize("value", [None, 5, "x", ["a"]])
@pytest.mark.parametrize("field", dataclasses.fields(Robot), ids=lambda f: f.name)
def test_fields_of_another_type_are_told_in_one_line(
    field: dataclasses.Field[Any], value: object
) -> None:
    try:
        robot = dataclasses.replace(ROBOT, **{field.name: value})
        _ = robot.body
    except UsageError as error:
        assert "\n" not in str(error)
        return
    # What is left stands for a default, or is of the type of the field.
    assert (field.name, value) in (
        ("name", "x"),
        ("base_height", 5),
        ("ee_rest_pos", None),
        ("limits", None),
        ("materials", None),
    )


@pytest.mark.parametrize(
    ("change", "option"),
    [
        ({"joints": 5}, "joints"),
        ({"groups": {**ROBOT.groups, "arm": 5}}, "group 'arm'"),
        ({"load_body": "body"}, "load_body"),
        ({"base_height": math.nan}, "base_height"),
        (
            {"gains": {**ROBOT.gains, "arm": dataclasses.replace(STIFF, kp="1")}},
            "kp",
        ),
        (
            {"cameras": (dataclasses.replace(HEAD, fovy=None),)},
            "fovy",
        ),
        (
            {"limits": dataclasses.replace(ROBOT.limits, gripper=0.05)},
            "gripper",
        ),
    ],
)
def test_parts_of_another_type_are_named(change: dict[str, Any], option: str) -> None:
    with refused(option, where="robot 'fetch'"):
        dataclasses.replace(ROBOT, **change)


def test_lists_stand_for_tuples() -> None:
    groups = {group: list(joints) for group, joints in ROBOT.groups.items()}
    robot = dataclasses.replace(
        ROBOT,
        joints=list(ROBOT.joints),
        groups=groups,
        rest_qpos=list(ROBOT.rest_qpos),
        cameras=list(ROBOT.cameras),
    )
    assert robot.digest == ROBOT.digest


def with_tree(
    change: Callable[[tuple[TreeLink, ...]], tuple[TreeLink, ...]],
) -> dict[str, Any]:
    """Fetch's body with another tree."""
    body = dataclasses.replace(ROBOT.body, tree=change(ROBOT.body.tree))
    return {"load_body": lambda: body}


@pytest.mark.parametrize(
    ("change", "option", "part"),
    [
        ({"tcp": "gripper"}, "link", "tcp"),
        ({"base_link": "bas"}, "parent of link 'r_wheel_link' of load_body", ""),
        ({"base_link": "torso_lift_link"}, "base_link", ""),
        ({"arm_root": "torso"}, "link", "arm_root"),
        ({"force_links": ("hand",)}, "link", "force_links"),
        ({"trunk_links": ("hand",)}, "link", "trunk_links"),
        ({"distal_links": ("hand",)}, "link", "distal_links"),
        ({"arm_links": ("hand",)}, "link", "arm_links"),
        ({"wrist_links": ("hand",)}, "link", "wrist_links"),
        (
            {"fingers": (Finger("thumb", (0.0, 1.0, 0.0)),) * 2},
            "link",
            "fingers",
        ),
        (
            {"cameras": (dataclasses.replace(HEAD, body="haed_camera_link"),)},
            "link",
            "body of camera 'fetch_head'",
        ),
        (
            {
                "force_links": ("estop_link",),
                "load_body": lambda: dataclasses.replace(ROBOT.body, collision={}),
            },
            "",
            "odd",
        ),
        ({"load_body": lambda: None}, "what load_body returns", ""),
        (with_tree(lambda tree: tree[:-1]), "link", "load_body: Body.collision"),
        (with_tree(lambda tree: (*tree, tree[-1])), "link of load_body", ""),
        (
            with_tree(lambda tree: tuple(dataclasses.replace(r, joint="") for r in tree)),
            "joint of load_body",
            "joints",
        ),
        (
            {"load_body": lambda: dataclasses.replace(ROBOT.body, collision=None)},
            "collision",
            "load_body: Body",
        ),
        (
            with_tree(
                lambda tree: (dataclasses.replace(tree[0], limits=None), *tree[1:])
            ),
            "limits",
            "",
        ),
        (
            with_tree(lambda tree: (dataclasses.replace(tree[0], axis="z"), *tree[1:])),
            "axis",
            "",
        ),
        (
            {"load_body": lambda: dataclasses.replace(ROBOT.body, inertials={})},
            "load_body: Body.inertials",
            "",
        ),
        (
            {"rest_qpos": (*ROBOT.rest_qpos[:3], 2.0, *ROBOT.rest_qpos[4:])},
            "rest_qpos of joint 'torso_lift_joint'",
            "",
        ),
    ],
)
def test_links_that_do_not_fit_are_told_when_they_are_needed(
    change: dict[str, Any], option: str, part: str
) -> None:
    robot = dataclasses.replace(ROBOT, name="odd", **change)
    with refused(option, where=part) as caught:
        _ = robot.body
    assert "robot 'odd'" in caught.value.where


def test_robots_are_listed_for_machines(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["robots", "list", "--json"]) == 0
    found = json.loads(capsys.readouterr().out.splitlines()[-1])["robots"]
    sizes = {"name": "fetch", "dofs": 15, "action_dim": 13, "state_dim": 42}
    assert found[0] == {**sizes, "available": True, "missing": ""}
    assert [robot["name"] for robot in found] == list(ROBOTS)


def test_a_robot_without_its_files_is_listed_as_not_available(
    capsys: pytest.CaptureFixture[str],
) -> None:
    def load_body() -> Body:
        raise MjhabError("its meshes are missing; run: pip install meshes")

    ROBOTS.add("bare", dataclasses.replace(ROBOT, name="bare", load_body=load_body))
    try:
        assert main(["robots", "list", "--json"]) == 0
        rows = json.loads(capsys.readouterr().out.splitlines()[-1])["robots"]
        (bare,) = [row for row in rows if row["name"] == "bare"]
        assert not bare["available"] and bare["missing"].endswith("pip install meshes")
        assert main(["robots", "list"]) == 0
        assert "run: pip install meshes" in capsys.readouterr().out
    finally:
        ROBOTS.remove("bare")


def test_a_robot_is_shown(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["robots", "show", "fetch", "--json"]) == 0
    found = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert found["cameras"] == ["fetch_head", "fetch_hand"] and len(found["joints"]) == 15
    torso = found["joints"][3]
    assert torso["group"] == "torso" and torso["unit"] == "m" and torso["high"] == 0.38615
    assert main(["robots", "show", "fecth"]) == 2


def code_lines() -> Iterator[tuple[str, int, str]]:
    """File, number and text of every line of source outside `robots` and the example of a robot."""
    for file in sorted(SOURCE.rglob("*.py")):
        name = file.relative_to(SOURCE).as_posix()
        if not name.startswith(("robots/", "examples/robot/")):
            for number, line in enumerate(
                file.read_text(encoding="utf-8").splitlines(), 1
            ):
                yield name, number, line


def test_nobody_else_names_the_robot_or_its_joints() -> None:
    found = [
        f"{name}:{number}: {line}"
        for name, number, line in code_lines()
        if FETCH_WORDS.search(DATA_STRINGS.sub("", line))
        and not name.startswith((*DOWNLOADS, *PUBLISHED))
    ]
    assert not found, "\n".join(found)


def test_nobody_else_numbers_a_joint() -> None:
    found = [
        f"{name}:{number}: {line}"
        for name, number, line in code_lines()
        if JOINT_NUMBERS.search(line)
    ]
    assert not found, "\n".join(found)
