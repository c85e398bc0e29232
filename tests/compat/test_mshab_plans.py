"""Task plans in MS-HAB's files: read, written, and refused with file and field."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest

from mjhab.compat.mshab.files.plans import (
    MsHabTaskPlan,
    PlanData,
    plan_data_from_file,
    task_of_dataset,
    write_plan_data,
)
from mjhab.compat.mshab.files.subtasks import (
    ArticulationConfig,
    CloseSubtask,
    MsHabSubtask,
    MsHabSubtaskConfig,
    NavigateSubtask,
    OpenSubtask,
    OpenSubtaskConfig,
    PickSubtask,
    PlaceSubtask,
    PlaceSubtaskConfig,
)
from mjhab.data.imports.ms_hab_layout import dataset_name
from tests.refusals import refused

SQUARE = [[0.0, 0.0, 1.0], [1.0, 0.0, 1.0], [1.0, 1.0, 1.0], [0.0, 1.0, 1.0]]
DOOR = ArticulationConfig("fridge", "fridge-0", 2, 0)
SCENE = "v3_sc3_staging_00.scene_instance.json"
EPISODE = "val/set_table/episode_0.json"


def all_kinds() -> list[MsHabSubtask]:
    door = dataclasses.asdict(DOOR)
    handle = [0.09, -0.66, 0.2]
    apple = "013_apple-0"
    kinds: list[MsHabSubtask] = [
        PickSubtask("013_apple-0", DOOR),
        PlaceSubtask("013_apple-0", SQUARE, [0.5, 0.5, 1.0]),
        NavigateSubtask("013_apple-0", goal_pos=[1.0, 2.0, 3.0]),
        OpenSubtask(**door, obj_id=apple, articulation_relative_handle_pos=handle),
        CloseSubtask(
            **door, articulation_relative_handle_pos=handle, remove_obj_id=apple
        ),
    ]
    return kinds


def plan_file(folder: Path, *subtasks: Any, **changes: Any) -> Path:
    """A file of one plan of some subtasks, as JSON objects; ``changes`` of the file's fields."""
    plan = {
        "subtasks": list(subtasks),
        "build_config_name": SCENE,
        "init_config_name": EPISODE,
    }
    path = folder / "all.json"
    body = {"dataset": "ReplicaCADSetTableVal", "plans": [plan], **changes}
    path.write_text(json.dumps(body))
    return path


def test_what_is_written_is_read_again(tmp_path: Path) -> None:
    plans = [MsHabTaskPlan([subtask], SCENE, EPISODE) for subtask in all_kinds()]
    data = PlanData("ReplicaCADSetTableVal", plans)
    path = tmp_path / "deep" / "all.json"
    write_plan_data(path, data)
    assert plan_data_from_file(path) == data
    row = json.loads(path.read_text())["plans"][3]["subtasks"][0]
    # The names that scripts and other readers of these files look for.
    assert row == {
        "articulation_type": "fridge",
        "articulation_id": "fridge-0",
        "articulation_handle_link_idx": 2,
        "articulation_handle_active_joint_idx": 0,
        "type": "open",
        "uid": data.plans[3].subtasks[0].uid,
        "composite_subtask_uids": [data.plans[3].subtasks[0].uid],
        "obj_id": "013_apple-0",
        "articulation_relative_handle_pos": [0.09, -0.66, 0.2],
    }


def test_yaml_and_fields_that_are_not_known(tmp_path: Path) -> None:
    path = tmp_path / "plan.yml"
    path.write_text(
        "dataset: ReplicaCADTidyHouseTrain\nnote: by hand\nplans:\n"
        f"- build_config_name: {SCENE}\n  init_config_name: null\n  subtasks:\n"
        "  - {type: place, obj_id: 024_bowl-1, goal_pos: '1, 2.5,0.75', colour: red}\n"
    )
    (plan,) = plan_data_from_file(path).plans
    assert plan.init_config_name is None
    (place,) = plan.subtasks
    assert isinstance(place, PlaceSubtask)
    assert place.obj_id == "024_bowl-1" and place.goal_pos == [1.0, 2.5, 0.75]


def test_names_of_subtasks() -> None:
    one, two = PickSubtask("024_bowl-0"), PickSubtask("024_bowl-0")
    assert one.uid != two.uid and one.uid.startswith("pick_")
    assert one.composite_subtask_uids == [one.uid]
    one.composite_subtask_uids.append("more")
    assert two.composite_subtask_uids == [two.uid]


def test_limits_take_their_fields_and_leave_out_others() -> None:
    limits = PlaceSubtaskConfig().update({"obj_goal_thresh": 0.2, "colour": "red"})
    assert isinstance(limits, PlaceSubtaskConfig) and limits.obj_goal_thresh == 0.2
    assert not hasattr(limits, "colour")
    assert limits.robot_cumulative_force_limit == 7500 and limits.horizon == 200


def test_data_sets_have_names() -> None:
    assert dataset_name("prepare_groceries", "train") == "ReplicaCADPrepareGroceriesTrain"
    assert task_of_dataset("ReplicaCADSetTableVal") == ("set_table", "val")
    assert task_of_dataset("ReplicaCADTidyHouseTrainSceneBuilder") == (
        "tidy_house",
        "train",
    )
    with refused("data set of task plans", "Kitchen", "ReplicaCADSetTableVal"):
        task_of_dataset("Kitchen")


PICK = {"type": "pick", "obj_id": "024_bowl-0"}


@pytest.mark.parametrize(
    ("row", "option", "where"),
    [
        ({"type": "pick"}, "obj_id", "plans[0].subtasks[0]"),
        ({**PICK, "type": "push"}, "plans[0].subtasks[0].type", "all.json"),
        ({**PICK, "obj_id": 3}, "plans[0].subtasks[0].obj_id", "all.json"),
        (
            {**PICK, "articulation_config": {"articulation_type": "fridge"}},
            "articulation_id",
            "plans[0].subtasks[0].articulation_config",
        ),
        ("pick", "plans[0].subtasks[0]", "all.json"),
        ({**PICK, "uid": 3}, "plans[0].subtasks[0].uid", "all.json"),
    ],
)
def test_a_subtask_that_is_none(
    tmp_path: Path, row: Any, option: str, where: str
) -> None:
    with refused(option, where=where):
        plan_data_from_file(plan_file(tmp_path, row))
    with refused("a file of task plans", None, "its path"):
        plan_data_from_file(None)


def test_a_file_that_is_none_of_plans(tmp_path: Path) -> None:
    with refused("plans", 3, where="all.json"):
        plan_data_from_file(plan_file(tmp_path, plans=3))
    with refused("plans[0].subtasks", []):
        plan_data_from_file(plan_file(tmp_path))
    (tmp_path / "list.json").write_text("[]")
    with refused("a file of task plans", []):
        plan_data_from_file(tmp_path / "list.json")
    (tmp_path / "plan.txt").write_text("{}")
    with refused("a file of task plans", expected=".json, .yml"):
        plan_data_from_file(tmp_path / "plan.txt")
    with refused(said="cannot be read"):
        plan_data_from_file(tmp_path / "none.json")
    (tmp_path / "bad.yml").write_text("a: [")
    with refused(said="not valid YAML"):
        plan_data_from_file(tmp_path / "bad.yml")
    (tmp_path / "half.json").write_text('{"dataset": "x"}')
    with refused("plans", where="half.json"):
        plan_data_from_file(tmp_path / "half.json")


def test_values_that_limits_and_zones_cannot_have() -> None:
    skew = [[0, 0, 1], [1, 0, 1], [1, 2, 1], [0, 1, 1]]
    with refused("goal_rectangle_corners", skew, "rectangle"):
        PlaceSubtask("024_bowl-0", skew)
    with refused("goal_rectangle_corners", SQUARE[:3], "4 points"):
        PlaceSubtask("024_bowl-0", SQUARE[:3])
    PlaceSubtask("024_bowl-0", skew, validate_goal_rectangle_corners=False)
    with refused("horizon", 0):
        MsHabSubtaskConfig(0, horizon=0)
    with refused("goal_type", "ring", "zone"):
        PlaceSubtaskConfig(goal_type="ring")
    with refused("joint_qpos_open_thresh_frac", {}):
        OpenSubtaskConfig()
    with refused("joint_qpos_open_thresh_frac['fridge']", 7.0):
        OpenSubtaskConfig(joint_qpos_open_thresh_frac={"default": 0.9, "fridge": 7.0})
