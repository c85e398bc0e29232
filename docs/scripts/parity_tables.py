"""Table of what MS-HAB's scripts see here beside the original: same, converted (how), different (why).

Entries are read from the code; an entry without a verdict here, or a verdict without an entry, is an error.
"""

from __future__ import annotations

from collections.abc import Iterator

from result_files import table

from mjhab.data.imports.ms_hab_layout import INFO_CHECKS
from mjhab.robots.controllers import make_controller
from mjhab.tasks.subtasks.registry import SUBTASKS

SAME = "same"
CONVERTED = "converted"
DIFFERENT = "different"
KINDS = ("pick", "place", "navigate", "open", "close")
Verdict = tuple[str, str]
"""Same, converted or different; and how."""

OBSERVATIONS: dict[str, Verdict] = {
    "agent/qpos": (SAME, "12 joints without base; angles of endless joints counted on"),
    "agent/qvel": (SAME, "12 joints without base"),
    "extra/tcp_pose_wrt_base": (CONVERTED, "gripper_link; our quaternions have w >= 0"),
    "extra/obj_pose_wrt_base": (
        CONVERTED,
        "turned to the axes of the scan; w >= 0; zeros where the original has zeros",
    ),
    "extra/goal_pos_wrt_base": (
        SAME,
        "handles at the point that the plans name; built-in furniture has none and gives the middle of the bar, 3 to 4 "
        "cm off",
    ),
    "extra/is_grasped": (SAME, "bool (W,); 0.5 N of both fingers within 30 degrees"),
    "sensor_param/*/intrinsic_cv": (SAME, "2.0 rad high, square pixels"),
    "sensor_param/*/extrinsic_cv": (SAME, "world to camera, OpenCV axes"),
    "sensor_param/*/cam2world_gl": (SAME, "camera to world, OpenGL axes"),
    "sensor_data/*/depth": (
        DIFFERENT,
        "int16, mm, 0 where nothing is hit, as there; of our meshes: shells of handles and walls differ by centimetres",
    ),
    "sensor_data/*/rgb": (
        DIFFERENT,
        "uint8; colours and light are those of our renderer",
    ),
    "sensor_data/*/segmentation": (
        DIFFERENT,
        "int16; ids are ours, in the order of our bodies",
    ),
}
"""Entries of the observation ``rgb+depth+segmentation``; * is a camera, fetch_head before fetch_hand."""
CONTROL: dict[str, Verdict] = {
    "pd_joint_delta_pos": (
        SAME,
        "all 13 dimensions below; target is the measured joint plus the change",
    ),
    "pd_ee_delta_pose": (
        DIFFERENT,
        "ours turns as documented, by a rotation vector. Scripts of MS-HAB and `pd_ee_delta_pose_maniskill` turn as "
        "ManiSkill does: angles about x, y, z, backwards (ManiSkill#1469). `export maniskill` converts the numbers",
    ),
    "pd_ee_target_delta_pose": (DIFFERENT, "as pd_ee_delta_pose"),
}
"""Control modes."""
INFO: dict[str, Verdict] = {
    "success, fail": (
        SAME,
        "a whole task also ends when the object of a finished Place leaves its goal",
    ),
    "subtask, subtask_type": (SAME, "type 100 when all are done"),
    "subtasks_steps_left, elapsed_steps": (
        SAME,
        "the first subtask has one step less, as there",
    ),
    "robot_force, robot_cumulative_force": (
        SAME,
        "sum over links of the norm of the net contact normals, last of 5 substeps; not of the fingers",
    ),
    "robot_target_pairwise_force": (
        SAME,
        "sum of the norms of the forces of both fingers",
    ),
    "handle_active_joint_qpos, qmin, qmax": (SAME, "Open, Close"),
    "distance_from_goal": (
        CONVERTED,
        "around furniture by the navigable positions that came with the plans; without them on our grid of 5 cm",
    ),
    "is_grasped": (SAME, "is_grasped; 30 degrees"),
    "obj_at_goal": (SAME, "at_goal; sphere of 0.15 m, cylinder or zone"),
    "oriented_correctly": (SAME, "oriented; 0.5 rad"),
    "navigated_close": (
        DIFFERENT,
        "near; 2 m, and before Open and Close the area in front of the furniture, as there. Drives to an object in an "
        "open drawer or fridge have that area, too; there they have none",
    ),
    "articulation_open": (SAME, "opened; strictly more than 0.75 (door) or 0.9 (drawer)"),
    "articulation_closed": (SAME, "closed; strictly less than 0.01"),
    "ee_rest": (SAME, "ee_rest; 0.05 m"),
    "robot_rest": (
        SAME,
        "robot_rest; 0.2 rad, torso 0.01 m, 0.6 holding; whole turns count",
    ),
    "is_static": (
        SAME,
        "is_static; a defect that is kept: a joint that moves backwards counts as still",
    ),
    "cumulative_force_within_limit": (SAME, "force_ok; strictly less"),
}
"""Entries of info."""
REWARD: dict[str, Verdict] = {
    "navigate/approach": (
        CONVERTED,
        "as distance_from_goal: with navigable positions as there, which leaves out the way from the robot to its "
        "nearest vertex",
    ),
}
"""Terms that are not the same."""
_REWARD_SAME = (SAME, "formula and scale of the published code")
EVENTS: dict[str, Verdict] = {
    "contact": (SAME, "force of the fingers above 0 N, where MuJoCo's contacts have any"),
}
"""Events that need a word."""
DEFECTS: dict[str, Verdict] = {
    "is_static without absolute value": (SAME, "reproduced: success depends on it"),
    "angles counted on over whole turns": (SAME, "reproduced: rest depends on it"),
    "force count never reset in a single subtask": (
        SAME,
        "reproduced: success may come again",
    ),
    "horizon one step shorter": (SAME, "reproduced"),
    "a partial reset adds force and time to other worlds": (
        DIFFERENT,
        "not reproduced: worlds are independent",
    ),
    "a partial reset overwrites the frames of all worlds": (
        DIFFERENT,
        "not reproduced: worlds are independent",
    ),
    "fridge goals take the wrong shelf for zones": (
        DIFFERENT,
        "not reproduced: the surface below the goal; only goal_type zone",
    ),
    "rest of Navigate where only some parallel worlds carry an object": (
        DIFFERENT,
        "not reproduced: there worlds without one are judged by 0.6 rad without torso and those with one by 0.2, in "
        "all other batches as here",
    ),
    "trajectories of whole tasks end a step early": (
        SAME,
        "reproduced: the step in which the last finished subtask was done is not written",
    ),
    "bowl taken out of the home at Close": (
        CONVERTED,
        "reproduced with the original's spawn data; our own put it at its goal",
    ),
    "labels by the length of the list of events": (
        CONVERTED,
        "`legacy_label` beside ours",
    ),
}
"""Defects of the original that numbers depend on, and what profile ms_hab does."""


def rows() -> Iterator[tuple[str, str, str, str]]:
    """Kind, entry, verdict and how, of everything.

    Raises:
        ValueError: a name is judged that does not exist, or a check of info is not judged.
    """
    for name, (verdict, how) in OBSERVATIONS.items():
        yield "observation", name, verdict, how
    for entry in make_controller("pd_joint_delta_pos").table:
        how = f"{entry.low:g} to {entry.high:g} {entry.unit}, {entry.frame}"
        yield "action", entry.name, SAME, how
    for name, (verdict, how) in CONTROL.items():
        yield "control mode", name, verdict, how
    missing = [name for name in INFO_CHECKS if name not in INFO]
    if missing:
        raise ValueError(f"no verdict on info {missing}")
    for name, (verdict, how) in INFO.items():
        yield "info", name, verdict, how
    judged = set(REWARD)
    for kind in KINDS:
        spec = SUBTASKS[kind]
        reward = spec.reward
        assert reward is not None
        for term in reward.terms:
            key = f"{kind}/{term.name}"
            verdict, how = REWARD.get(key, _REWARD_SAME)
            judged.discard(key)
            yield "reward", key, verdict, f"{term.scale:g} when {term.when}; {how}"
        yield "reward", f"{kind}, divided by", SAME, f"{reward.published:g}"
        for event in spec.events:
            verdict, how = EVENTS.get(event, (SAME, "order within a step as published"))
            yield "event", f"{kind}/{event}", verdict, how
        published = spec.published
        known = published.columns if published is not None else ()
        for rule in spec.label_rules:
            named = (
                "a column of the paper's table" if rule.label in known else "no column"
            )
            how = f"decided by signals, not by the list of events; {named}; `legacy_label` is the published code's"
            yield "label", f"{kind}/{rule.label}", CONVERTED, how
    if judged:
        raise ValueError(f"verdicts on terms that do not exist: {sorted(judged)}")
    for name, (verdict, how) in DEFECTS.items():
        yield "defect", name, verdict, how


def parity_table() -> str:
    """All entries as one table."""
    made = list(rows())
    counts = {
        verdict: sum(row[2] == verdict for row in made)
        for verdict in (SAME, CONVERTED, DIFFERENT)
    }
    told = ", ".join(f"{count} {verdict}" for verdict, count in counts.items())
    listed = [[kind, f"`{name}`", verdict, how] for kind, name, verdict, how in made]
    return f"{table(('kind', 'entry', 'here', 'how'), listed)}\n\n{len(made)} entries: {told}."


TABLES = {"ms_hab_parity": parity_table}
