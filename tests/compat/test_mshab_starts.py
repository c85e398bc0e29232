"""Task plans and spawns of mjhab in MS-HAB's files: read again, they are the starts of the pool."""

from __future__ import annotations

import dataclasses
import json
import pickle
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

import mjhab
from mjhab.cli.main import main
from mjhab.compat.mshab.files.making import make_plans
from mjhab.compat.mshab.files.matching import object_name
from mjhab.compat.mshab.files.navigable import FOLDER, read_map
from mjhab.compat.mshab.files.plan_requests import PlanRequest
from mjhab.compat.mshab.files.plan_starts import PlanStarts, plan_starts
from mjhab.compat.mshab.files.plans import MsHabTaskPlan, PlanData, plan_data_from_file
from mjhab.compat.mshab.files.spawn_data import (
    read_grasp_poses,
    read_spawn_data,
    write_spawn_data,
)
from mjhab.compat.mshab.files.subtasks import CloseSubtask, PickSubtask
from mjhab.compat.mshab.worlds import starting
from mjhab.compat.mshab.worlds.arguments import read_arguments
from mjhab.config.env import EnvConfig
from mjhab.config.thresholds import task_config
from mjhab.data.imports.ms_hab_layout import object_id
from mjhab.episodes.source import EpisodeSource, open_setting
from mjhab.episodes.starts import Start
from mjhab.sim.mujoco.cpu import CpuSimulator
from mjhab.tasks.household.registry import TASKS, chain
from tests.real_data import real_data
from tests.refusals import refused

pytestmark = pytest.mark.usefixtures("few_carry_postures")

FLOAT32 = 2e-6
"""Numbers of spawn files are float32: 5e-7 m at 10 m, added up."""
EPISODES = 2
TABLE = "set_table"


def made(folder: Path, task: str, **options: Any) -> Path:
    config = EnvConfig(profile="ms_hab", task=task, split="val", **options)
    make_plans(config, folder, EPISODES)
    return folder


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Plans of SetTable in built-in homes."""
    return made(tmp_path_factory.mktemp("table"), TABLE)


def plans_of(root: Path, task: str, kind: str, name: str = "all") -> PlanData:
    place = root / "task_plans" / task / (kind or "sequential") / "val"
    return plan_data_from_file(place / f"{name}.json")


def spawns_of(root: Path, task: str, kind: str) -> Path | None:
    return root / "spawn_data" / task / kind / "val" / "spawn_data.pt" if kind else None


def request_of(folder: Path, task: str, kind: str, **changes: Any) -> PlanRequest:
    data = plans_of(folder, task, kind)
    request = PlanRequest(data.plans, data.dataset, kind, spawns_of(folder, task, kind))
    return dataclasses.replace(request, **changes)


def source(**options: Any) -> EpisodeSource:
    config = EnvConfig(**options)
    setting = open_setting(config)
    thresholds = task_config(config, setting.layout.robot)
    sim = CpuSimulator(setting.layout, 1, 1)
    return EpisodeSource(sim, config, thresholds, setting.file)


def index_of(plan: MsHabTaskPlan) -> int:
    """Index of the episode of a plan."""
    return int(str(plan.init_config_name).rpartition("_")[2].removesuffix(".json"))


def pairs(starts: PlanStarts, **options: Any) -> list[tuple[Start, Start]]:
    """Starts of plans and those of the generated episodes at the same position."""
    ours = source(**starts.options)
    pool = source(profile="ms_hab", split="val", **options)
    found = []
    for i, row in enumerate(starts.rows):
        start = ours.start(ours.episode(0, i))
        episode = pool.episode(0, index_of(starts.plans[row.plan]))
        if options["subtask"]:
            whole = chain(episode.task, episode.targets, episode.home)
            other = pool.starts.start_at(episode, whole, start.position)
        else:
            other = pool.start(episode)
        found.append((start, other))
    return found


def check_equal(root: Path, task: str, kind: str, **assets: Any) -> int:
    starts = plan_starts(request_of(root, task, kind, **assets))
    both = pairs(starts, task=task, subtask=kind, **assets)
    for start, other in both:
        assert start.home == other.home and start.position == other.position
        assert start.plan == other.plan
        np.testing.assert_allclose(start.qpos, other.qpos, atol=FLOAT32, rtol=0)
    return len(both)


@pytest.mark.parametrize(
    ("kind", "plans"),
    [("pick", 2), ("place", 2), ("navigate", 6), ("open", 2), ("close", 2), ("", 1)],
)
def test_starts_of_set_table(table: Path, kind: str, plans: int) -> None:
    assert check_equal(table, TABLE, kind) == plans * EPISODES


@pytest.mark.parametrize(
    ("task", "kinds"),
    [
        ("tidy_house", {"pick": 5, "place": 5, "navigate": 10}),
        ("prepare_groceries", {"pick": 3, "place": 3, "navigate": 6}),
    ],
)
def test_starts_of_other_tasks(tmp_path: Path, task: str, kinds: dict[str, int]) -> None:
    made(tmp_path, task)
    for kind, plans in kinds.items():
        assert check_equal(tmp_path, task, kind) == plans * EPISODES


def test_starts_in_replica_cad(tmp_path: Path) -> None:
    assets = str(real_data("replica_cad").parent)
    config = EnvConfig(profile="ms_hab", task=TABLE, split="val", assets=assets)
    make_plans(config, tmp_path, 1, ("pick", "close"))
    assert check_equal(tmp_path, TABLE, "pick", assets=assets) == 2
    assert check_equal(tmp_path, TABLE, "close", assets=assets) == 2
    plans = plans_of(tmp_path, TABLE, "pick").plans
    assert str(plans[0].build_config_name).startswith("v3_sc3_staging_")


def test_episodes_of_a_file_may_use_fewer_objects(table: Path, tmp_path: Path) -> None:
    rows = [json.loads(path.read_text()) for path in sorted(table.rglob("episode_*"))]
    can = next(each for each in rows[1]["rigid_objs"] if "master_chef" in each[0])
    rows[1]["rigid_objs"].remove(can)
    file = tmp_path / "published.json"
    file.write_text(json.dumps({"episodes": rows}))
    config = EnvConfig(profile="ms_hab", task=TABLE, split="val", episodes_file=str(file))
    make_plans(config, tmp_path, 2, ("pick",))
    for index, row in enumerate(rows):
        own = json.loads((tmp_path / f"val/set_table/episode_{index}.json").read_text())
        assert len(own["rigid_objs"]) == len(row["rigid_objs"])
    starts = plan_starts(request_of(tmp_path, TABLE, "pick"))
    ours = source(**starts.options)
    layout = ours.layout
    used = [layout.used_slots(ours.episode(0, i).object_pose).sum() for i in range(4)]
    assert used == [len(rows[i]["rigid_objs"]) for i in (0, 0, 1, 1)]
    spawns = read_spawn_data(spawns_of(tmp_path, TABLE, "pick") or tmp_path)
    for i, entry in enumerate(spawns.values()):
        start = ours.start(ours.episode(0, i))
        columns = CpuSimulator(layout, 1, 1).addresses.robot_q
        posture = np.delete(start.qpos[columns], [0, 1, 2])
        np.testing.assert_allclose(posture, entry["robot_qpos"][0, 3:], atol=FLOAT32)


def test_the_pools_own_choice_is_among_them(table: Path) -> None:
    """`start` of a pool, which draws the position itself, is one of the starts of the files."""
    starts = plan_starts(request_of(table, TABLE, "pick"))
    ours = source(**starts.options)
    pool = source(profile="ms_hab", split="val", task=TABLE, subtask="pick")
    for index in range(EPISODES):
        wanted = pool.start(pool.episode(0, index)).qpos
        rows = [
            i
            for i, row in enumerate(starts.rows)
            if index_of(starts.plans[row.plan]) == index
        ]
        distances = [
            np.abs(ours.start(ours.episode(0, i)).qpos - wanted).max() for i in rows
        ]
        assert min(distances) < FLOAT32 and max(distances) > 0.01


def test_an_environment_begins_with_them(table: Path) -> None:
    starts = plan_starts(request_of(table, TABLE, "place"))
    env = mjhab.make(num_envs=2, autoreset="disabled", **starts.options)
    rows = [starts.of(3), starts.of(0)]
    obs, info = env.reset(options={"episode": rows})
    ours = source(**starts.options)
    for world, row in enumerate(rows):
        start = ours.start(ours.episode(0, row))
        np.testing.assert_array_equal(env.sim.qpos[world], start.qpos)
        assert info["episode_spec"][world]["home"] == starts.home_of(
            starts.rows[row].plan
        )
    assert obs["extra/is_grasped"].shape == (2, 1)
    # Held by the pads: it stays in the hand.
    for _ in range(3):
        obs, *_ = env.step(np.zeros((2, 13), np.float32) - np.eye(13)[7])
    assert obs["extra/is_grasped"].all()
    env.close()


def test_files_have_the_layout_of_the_original(table: Path) -> None:
    names = sorted(
        path.name for path in (table / "task_plans/set_table/open/val").iterdir()
    )
    assert names == ["all.json", "fridge.json", "kitchen_counter.json"]
    names = sorted(
        path.name for path in (table / "task_plans/set_table/pick/val").iterdir()
    )
    assert names == ["013_apple.json", "024_bowl.json", "all.json"]
    assert [p.name for p in (table / "task_plans/set_table/navigate/val").iterdir()] == [
        "all.json"
    ]
    (bowls,) = {
        object_name(plan.subtasks[0].obj_id)[:8]  # type: ignore[attr-defined]
        for plan in plans_of(table, TABLE, "pick", "024_bowl").plans
    }
    assert bowls == "024_bowl"
    data = torch.load(
        table / "spawn_data/set_table/pick/val/spawn_data.pt", weights_only=True
    )
    assert list(data) == [f"set_table-pick-val-{n}-0" for n in range(4)]
    entry = data["set_table-pick-val-0-0"]
    assert {name: tuple(value.shape) for name, value in entry.items()} == {
        "robot_pos": (1, 3),
        "robot_qpos": (1, 15),
        "articulation_qpos": (1, 7),
        "obj_raw_pose": (1, 7),
    }
    assert {value.dtype for value in entry.values()} == {torch.float32}
    assert entry["robot_pos"][0, 2] == pytest.approx(0.02)
    assert entry["robot_qpos"][0, :2].tolist() == [0.0, 0.0]
    joints, poses = read_grasp_poses(
        table / "grasp_poses/set_table/013_apple/grasp_poses.pt"
    )
    assert joints.shape == (len(poses), 15) and len(poses) > 0
    assert (np.linalg.norm(poses[:, :3], axis=1) < 0.15).all()


def test_whole_tasks_have_the_subtasks_of_the_original(table: Path) -> None:
    kinds = [each.type for each in plans_of(table, TABLE, "").plans[0].subtasks]
    legs = ["open", "pick", "place", "close"] * 2
    assert kinds == [kind for leg in legs for kind in ("navigate", leg)]
    assert kinds == list(TASKS[TABLE].kinds)


def positions(start: Start) -> np.ndarray:
    """Joints of robot and furniture, and positions of objects, without quaternions: these have two signs."""
    objects = 29
    joints, poses = np.split(start.qpos, [len(start.qpos) - 7 * objects])
    return np.concatenate([joints, poses.reshape(objects, 7)[:, :3].ravel()])


def test_files_of_others_are_settled(table: Path, tmp_path: Path) -> None:
    """Without our settled state an episode is settled by simulation, near to where ours lies."""
    for path in table.rglob("episode_*.json"):
        row = json.loads(path.read_text())
        row["info"] = {"object_labels": row["info"]["object_labels"]}
        other = tmp_path / path.relative_to(table)
        other.parent.mkdir(parents=True, exist_ok=True)
        other.write_text(json.dumps(row))
    starts = plan_starts(request_of(table, TABLE, "pick", root=tmp_path))
    for start, other in pairs(starts, task=TABLE, subtask="pick"):
        assert start.position == other.position
        apart = np.abs(positions(start) - positions(other)).max()
        assert 1e-7 < apart < 0.02
    whole = plan_starts(request_of(table, TABLE, "", root=tmp_path))
    assert len(whole.rows) == EPISODES


def test_what_a_plan_removes_is_parked(table: Path, tmp_path: Path) -> None:
    """Spawn data of the original do not tell where the object of ``remove_obj_id`` is."""
    spawns = read_spawn_data(table / "spawn_data/set_table/close/val/spawn_data.pt")
    bare = {
        uid: {n: v for n, v in entry.items() if n != "placed_obj_raw_pose"}
        for uid, entry in spawns.items()
    }
    path = tmp_path / "spawn_data.pt"
    write_spawn_data(path, bare)
    starts = plan_starts(request_of(table, TABLE, "close", spawn_file=path))
    ours = source(**starts.options)
    (subtask,) = starts.plans[0].subtasks
    assert isinstance(subtask, CloseSubtask)
    slot = ours.layout.object_names.index(object_name(subtask.remove_obj_id))
    start = ours.start(ours.episode(0, 0))
    address = ours.starts.sim.addresses.object_q[slot]
    np.testing.assert_array_equal(
        start.qpos[address : address + 7], ours.layout.parked_poses[slot]
    )


def test_several_spawns_of_a_plan_are_rows_of_their_own(
    table: Path, tmp_path: Path
) -> None:
    spawns = read_spawn_data(table / "spawn_data/set_table/open/val/spawn_data.pt")
    first = next(iter(spawns))
    spawns[first] = {name: np.tile(v, (3, 1)) for name, v in spawns[first].items()}
    spawns[first]["robot_pos"][:, 0] += [0.0, 0.25, 0.5]  # type: ignore[index]
    path = tmp_path / "spawn_data.pt"
    write_spawn_data(path, spawns)
    starts = plan_starts(request_of(table, TABLE, "open", spawn_file=path))
    assert [starts.spawns(plan) for plan in range(4)] == [3, 1, 1, 1]
    assert [starts.of(0, 2), starts.of(1)] == [2, 3]
    ours = source(**starts.options)
    base = [ours.start(ours.episode(0, i)).qpos[0] for i in range(3)]
    np.testing.assert_allclose(np.diff(base), 0.25, atol=FLOAT32)
    with refused("plan and spawn", (1, 1), "6 starts"):
        starts.of(1, 1)


def test_navigate_counts_its_way_by_the_maps_of_its_homes(
    table: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    data = plans_of(table, TABLE, "navigate")
    given = {
        "task_plans": data.plans,
        "scene_builder_cls": data.dataset,
        "spawn_data_fp": spawns_of(table, TABLE, "navigate"),
        "require_build_configs_repeated_equally_across_envs": False,
    }
    worlds: Any = starting.open_setting(read_arguments("navigate", given)).worlds
    worlds.reset(options={"episode": [0]})
    scene = str(data.plans[0].build_config_name)
    found = read_map(table / FOLDER, scene)
    assert found is not None
    at, _ = found.nearest(worlds.state.robot_q[0, :2])
    goal, apart = found.nearest(worlds.focus.active.goal_pos[0, :2])
    assert worlds.goal_distance()[0] == pytest.approx(found.ways[at, goal] + apart)
    worlds.close()
    starts = plan_starts(request_of(table, TABLE, "navigate"))
    assert len({plan.build_config_name for plan in starts.plans}) > 1
    shutil.copytree(table / FOLDER, tmp_path / FOLDER)
    for path in (tmp_path / FOLDER).glob(f"{scene.removesuffix('.json')}*"):
        path.unlink()
    other: Any = SimpleNamespace(num_envs=1, nav="its own")
    starting.count_ways_by_maps(other, dataclasses.replace(starts, root=tmp_path))
    assert f"1 of 2 homes have none ({scene})" in caplog.text
    assert other.nav == "its own"


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    line = ["episodes", "plans", "--task", TABLE, "--split", "val", "--count", "1"]
    line += ["--subtasks", "open", "sequential", "--out", str(tmp_path), "--json"]
    assert main(line) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["plans"] == 3 and facts["episodes"] == 1 and facts["left_out"] == 0
    names = [str(Path(name).relative_to(tmp_path)) for name in facts["files"]]
    assert sorted(names) == [
        "spawn_data/set_table/open/val/spawn_data.pt",
        "task_plans/set_table/open/val/all.json",
        "task_plans/set_table/open/val/fridge.json",
        "task_plans/set_table/open/val/kitchen_counter.json",
        "task_plans/set_table/sequential/val/all.json",
    ]
    assert all(Path(name).is_file() for name in facts["files"])
    assert main(line) == 2 and "--overwrite" in capsys.readouterr().err
    assert main([*line, "--overwrite"]) == 0


# -- what is refused ---------------------------------------------------------------------------------------------------


def test_plans_of_homes_that_are_not_there(table: Path) -> None:
    data = plans_of(table, TABLE, "open")
    plan = dataclasses.replace(
        data.plans[0], build_config_name="v3_sc3_staging_04.scene_instance.json"
    )
    request = request_of(table, TABLE, "open", assets="builtin", root=table)
    with refused("build_config_name", "v3_sc3_staging_04", "builtin", said="1 of the 1"):
        plan_starts(dataclasses.replace(request, plans=[plan]))


def test_plans_of_objects_that_are_not_there(table: Path, tmp_path: Path) -> None:
    for path in table.rglob("episode_*.json"):
        other = tmp_path / path.relative_to(table)
        other.parent.mkdir(parents=True, exist_ok=True)
        other.write_text(path.read_text().replace("002_master_chef_can.", "099_drill."))
    with refused(said="099_drill"):
        plan_starts(request_of(table, TABLE, "open", root=tmp_path))
    request = request_of(table, TABLE, "pick")
    plan = request.plans[0]
    other_plan = dataclasses.replace(plan, subtasks=[PickSubtask("099_drill-0")])
    other_plan.subtasks[0].uid = plan.subtasks[0].uid
    with refused("pick", "obj_id 099_drill-0", "024_bowl_", where="task_plans[0]"):
        plan_starts(dataclasses.replace(request, plans=[other_plan], root=table))


def test_plans_of_another_subtask_or_data_set(table: Path) -> None:
    request = request_of(table, TABLE, "pick")
    with refused("task_plans[0].subtasks", ["pick"], "'place'"):
        plan_starts(dataclasses.replace(request, subtask="place"))
    mixed = [*request.plans, *plans_of(table, TABLE, "").plans]
    with refused("task_plans[4].subtasks", expected="['pick']"):
        plan_starts(dataclasses.replace(request, plans=mixed, subtask=""))
    with refused("task_plans", []):
        plan_starts(dataclasses.replace(request, plans=[]))
    with refused("data set of task plans", "Kitchen"):
        plan_starts(dataclasses.replace(request, dataset="Kitchen"))
    with refused("subtasks", expected="those of set_table"):
        part = dataclasses.replace(request, subtask="", spawn_file=None)
        plan_starts(dataclasses.replace(part, root=table))


def test_episodes_that_are_not_there(table: Path, tmp_path: Path) -> None:
    with refused(where="episode_0.json", said="mjhab episodes plans"):
        plan_starts(request_of(table, TABLE, "pick", root=tmp_path))
    request = request_of(table, TABLE, "pick")
    plan = dataclasses.replace(request.plans[0], init_config_name="../../episode.json")
    with refused(said="outside"):
        plan_starts(dataclasses.replace(request, plans=[plan], root=table))


def test_spawns_that_are_not_there(table: Path) -> None:
    request = request_of(table, TABLE, "pick")
    with refused("spawn_data_fp"):
        plan_starts(dataclasses.replace(request, spawn_file=None))
    other = spawns_of(table, TABLE, "open")
    with refused(where="spawn_data.pt", said="set_table-pick-val-0-0"):
        plan_starts(dataclasses.replace(request, spawn_file=other))


def _good() -> dict[str, Any]:
    return {"robot_pos": torch.zeros(1, 3), "robot_qpos": torch.zeros(1, 15)}


@pytest.mark.parametrize(
    ("content", "option", "said"),
    [
        ([1, 2], "spawn data", "list"),
        ({}, "spawn data", "mapping"),
        ({"a": 3}, "spawn data", "a"),
        ({"a": {"robot_pos": torch.zeros(1, 3)}}, "", "no robot_qpos"),
        ({"a": {**_good(), "robot_qpos": 3}}, "a.robot_qpos", "int"),
        ({"a": {**_good(), "robot_qpos": torch.zeros(1, 9)}}, "shape of a", "Fetch"),
        ({"a": {**_good(), "obj_raw_pose": torch.zeros(7)}}, "shape of a", "(7,)"),
        ({"a": {**_good(), "obj_raw_pose": torch.zeros(2, 7)}}, "", "different numbers"),
        ({"a": {**_good(), "robot_pos": torch.full((1, 3), torch.nan)}}, "", "finite"),
    ],
)
def test_spawn_files_of_another_layout(
    tmp_path: Path, content: Any, option: str, said: str
) -> None:
    path = tmp_path / "spawn_data.pt"
    torch.save(content, path)
    with refused(option, where="spawn_data.pt", said=said):
        read_spawn_data(path)


class Evil:
    def __reduce__(self) -> Any:
        return (Path.touch, (Path("/tmp/mjhab-was-executed"),))


def test_a_pickle_that_needs_more_than_tensors(tmp_path: Path) -> None:
    path = tmp_path / "spawn_data.pt"
    torch.save({"a": {**_good(), "note": Evil()}}, path)
    with refused(said="nothing in it was executed"):
        read_spawn_data(path)
    path.write_bytes(pickle.dumps({"a": Evil()}))
    with refused(said="cannot be read as spawn data"):
        read_spawn_data(path)
    assert not Path("/tmp/mjhab-was-executed").exists()
    with refused(said="does not exist"):
        read_spawn_data(tmp_path / "none.pt")
    path.write_bytes(b"nothing")
    with refused(said="cannot be read"):
        read_grasp_poses(path)
    torch.save({"success_qpos": torch.zeros(1, 15)}, path)
    with refused("grasps"):
        read_grasp_poses(path)


def test_joints_of_another_piece_of_furniture(table: Path, tmp_path: Path) -> None:
    spawns = read_spawn_data(table / "spawn_data/set_table/pick/val/spawn_data.pt")
    path = tmp_path / "spawn_data.pt"
    first = dict(next(iter(spawns.values())))
    uid = next(iter(spawns))
    for joints, option in (
        (np.zeros((1, 3)), "joints of 'kitchen_counter' in articulation_qpos"),
        (np.full((1, 7), 9.0), "articulation_qpos of kitchen_counter/drawer1_top"),
    ):
        write_spawn_data(path, {**spawns, uid: {**first, "articulation_qpos": joints}})
        with refused(option, where="task_plans[0]"):
            plan_starts(request_of(table, TABLE, "pick", spawn_file=path))
    write_spawn_data(path, {**spawns, uid: {**first, "obj_raw_pose": np.zeros((1, 7))}})
    with refused("quaternion of a pose", where="task_plans[0]"):
        plan_starts(request_of(table, TABLE, "pick", spawn_file=path))


def test_a_damaged_settled_state(table: Path, tmp_path: Path) -> None:
    for path in table.rglob("episode_*.json"):
        row = json.loads(path.read_text())
        row["info"]["settled"]["object_pose"] = row["info"]["settled"]["object_pose"][:3]
        other = tmp_path / path.relative_to(table)
        other.parent.mkdir(parents=True, exist_ok=True)
        other.write_text(json.dumps(row))
    with refused(said="settled state is damaged"):
        plan_starts(request_of(table, TABLE, "open", root=tmp_path))


def test_names_of_objects() -> None:
    assert object_name("024_bowl-12") == "024_bowl_:0012"
    assert object_id("024_bowl_:0012") == "024_bowl-12"
    assert object_name(None) == ""
    for name in ("bowl", "-1", "024_bowl-x"):
        with refused("obj_id", name):
            object_name(name)
