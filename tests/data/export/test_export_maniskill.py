"""Exports in MS-HAB's layout, read the way its training scripts read them."""

from __future__ import annotations

import itertools
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import h5py
import numpy as np
import pytest

from mjhab.compat.mshab.worlds.arguments import read_arguments
from mjhab.core.rotations import quat_rotate
from mjhab.data.export import maniskill
from mjhab.data.export.conventions import CONVENTIONS
from mjhab.data.export.maniskill_states import JointNote, Root
from mjhab.data.imports.ms_hab import import_ms_hab
from mjhab.data.select.until import Until
from mjhab.data.store.places import episodes
from mjhab.data.store.reading import RecordedEpisode
from mjhab.tasks.subtasks.pick import PICK
from tests.data.export.exporting import from_nothing, to_maniskill
from tests.data.fake_world import SIZE, FakeEnv
from tests.data.make import record, record_pictures
from tests.refusals import refused

FAILED = 8
"""Index of an episode of the fake environment that fails; the next ones succeed."""


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("source")
    record_pictures(folder / "picks.h5", range(3))
    record(folder / "opens.h5", range(2), FakeEnv(subtask="open"))
    record(folder / "chains.h5", [0], FakeEnv())
    return folder


def joined(group: Any, count: int) -> np.ndarray:
    """The state as mshab/train_bc.py joins it: members in the order in which HDF5 lists them."""
    parts = [
        group["obs"][name][key][:count]
        for name in ("agent", "extra")
        for key in group["obs"][name]
    ]
    return np.concatenate(
        [part[:, None] if part.ndim == 1 else part for part in parts], axis=1
    )


def test_layout_and_contents(source: Path, tmp_path: Path) -> None:
    done = to_maniskill(source, tmp_path / "out")
    names = sorted(str(path.relative_to(tmp_path / "out")) for path in done.files)
    assert names == [
        "set_table/open/kitchen_counter.h5",
        "set_table/pick/024_bowl.h5",
        "set_table/sequential_task/all.h5",
    ]
    assert (done.episodes, done.without_depth) == (6, 3)
    said = json.loads((tmp_path / "out/set_table/pick/024_bowl.json").read_text())
    assert said["conventions"] == CONVENTIONS
    assert (
        said["source_type"] == "mjhab"
        and said["env_info"]["env_id"] == "PickSubtaskTrain-v0"
    )
    with h5py.File(tmp_path / "out/set_table/pick/024_bowl.h5") as file:
        assert (
            sorted(file) == ["traj_0", "traj_1", "traj_2"] and len(said["episodes"]) == 3
        )
        by_id = {each["episode_id"]: each for each in said["episodes"]}
        for number, episode in enumerate(episodes(source / "picks.h5")):
            check(file[f"traj_{number}"], episode, number, by_id[number])


def test_states_and_info_are_those_of_maniskill(source: Path, tmp_path: Path) -> None:
    stand = (1.0, 2.0, 0.5, 1.0, 0.0, 0.0, 0.0)
    joints = {"drawer3": JointNote(-1.0, 0.0, 0.5)}
    known = {
        "kitchen_counter": Root(stand, joints),
        "fetch": Root((0.0, 0.0, 0.02, 1.0, 0.0, 0.0, 0.0)),
    }
    done = to_maniskill(source / "opens.h5", tmp_path / "out", roots=lambda *_: known)
    episode = next(iter(episodes(source / "opens.h5")))
    q, v = episode.array("states/qpos"), episode.array("states/qvel")
    count = episode.steps + 1
    with h5py.File(done.files[0]) as file:
        group: Any = file["traj_0"]
        bowl = group["env_states/actors/024_bowl-0"][()]
        assert bowl.shape == (count, 13) and bowl.dtype == np.float32
        np.testing.assert_allclose(bowl[:, :3], q[:, 2:5], rtol=1e-6)
        np.testing.assert_allclose(bowl[:, 7:10], v[:, 2:5], rtol=1e-6)
        world = quat_rotate(q[:, 5:9], v[:, 5:8])
        np.testing.assert_allclose(bowl[:, 10:], world, rtol=1e-5, atol=1e-6)
        counter = group["env_states/articulations/kitchen_counter-0"][()]
        assert counter.shape == (count, 15)
        np.testing.assert_array_equal(counter[:, :7], np.tile(stand, (count, 1)))
        assert not counter[:, 7:13].any()
        # The bowl is a free body before it, with a number more in qpos than in qvel.
        np.testing.assert_allclose(counter[:, 13], -q[:, 9], rtol=1e-6)
        np.testing.assert_allclose(counter[:, 14], -v[:, 8], rtol=1e-6)
        assert group["env_states/articulations/fetch"].shape == (count, 13 + 2 * 3)
        told = {name: values[()] for name, values in group["info"].items()}
    assert {len(values) for values in told.values()} == {count}
    checks = episode.table("signals/checks")
    for name, ours in (("articulation_open", "opened"), ("is_grasped", "is_grasped")):
        np.testing.assert_array_equal(told[name], checks[ours].astype(bool))
    forces = episode.table("signals/forces")
    np.testing.assert_allclose(told["robot_force"], forces["robot_force"], rtol=1e-6)
    np.testing.assert_allclose(told["handle_active_joint_qpos"], -q[:, 9], rtol=1e-6)
    assert set(told["handle_active_joint_qmin"]) == {-0.5}
    assert set(told["handle_active_joint_qmax"]) == {0.0}
    assert set(told["subtask_type"]) <= {3, 100}
    np.testing.assert_array_equal(
        told["success"][1:], episode.array("reward/success").astype(bool)
    )


def test_arguments_of_the_environment_are_those_of_ms_hab(
    source: Path, tmp_path: Path
) -> None:
    done = to_maniskill(source, tmp_path / "out")
    for path in done.files:
        made = json.loads(path.with_suffix(".json").read_text())["env_info"]
        subtask = "" if "Sequential" in made["env_id"] else path.parent.name
        asked = read_arguments(subtask, made["env_kwargs"])
        assert asked.num_envs == 1 and asked.tells_events
        assert asked.scene_builder_cls == "ReplicaCADSetTableVal"
        pictures = path.parent.name == "pick"
        assert asked.obs_mode == ("rgb+depth" if pictures else "state")


def test_turns_of_the_hand_are_those_of_maniskills_mode() -> None:
    actions = np.random.default_rng(0).uniform(-0.5, 0.5, (4, 12)).astype(np.float32)
    for mode in ("pd_joint_delta_pos", "pd_ee_delta_pose", "pd_ee_delta_pose_maniskill"):
        run = SimpleNamespace(config={"env": {"control_mode": mode}})
        episode: Any = SimpleNamespace(run=run)
        turned = maniskill._turned_hand(episode, actions)
        changed = np.flatnonzero(np.abs(turned - actions).max(axis=0) > 0.01).tolist()
        assert changed == ([3, 4, 5] if mode == "pd_ee_delta_pose" else [])
        if changed:
            np.testing.assert_allclose(turned[:, 3:6], -actions[:, 3:6], atol=0.02)


def test_maniskills_reader_can_keep_the_successful_ones(tmp_path: Path) -> None:
    """It reads "success", and cannot begin with an episode that it leaves out."""
    source = tmp_path / "picks.h5"
    record(source, [FAILED, 9, 10], FakeEnv(subtask="pick"))
    done = to_maniskill(source, tmp_path / "out")
    told = json.loads(done.files[0].with_suffix(".json").read_text())["episodes"]
    good = [each["success"] for each in told]
    assert good == sorted(good, reverse=True) and len(set(good)) == 2
    assert [each["episode_id"] for each in told] != list(range(len(told)))
    with h5py.File(done.files[0]) as file:
        for each in told:
            success = np.asarray(file[f"traj_{each['episode_id']}/success"])
            assert each["success"] == each["success_at_end"] == success[-1]
    imported = import_ms_hab(done.files[0], tmp_path / "imported")
    pairs = zip(episodes(source), episodes(imported.shard), strict=True)
    for before, after in pairs:
        assert before.record.index == after.record.index
        np.testing.assert_array_equal(before.array("actions"), after.array("actions"))


def test_metadata_end_with_the_exported_part(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept = 7
    monkeypatch.setattr(Until, "steps", lambda self, success: kept)
    done = to_maniskill(source / "picks.h5", tmp_path / "out", until=Until(2))
    told = json.loads(done.files[0].with_suffix(".json").read_text())["episodes"]
    imported = import_ms_hab(done.files[0], tmp_path / "imported")
    whole = list(episodes(source / "picks.h5"))
    assert any(episode.record.success_at_end for episode in whole)
    for each, before, after in zip(told, whole, episodes(imported.shard), strict=True):
        assert each["elapsed_steps"] == after.steps == kept < before.steps
        old = before.record
        new = after.record
        assert len(from_nothing(before)) > len(new.events)
        assert new.events == tuple(e for e in from_nothing(before) if e[0] <= kept)
        assert new.force == pytest.approx(old.force[:kept], abs=0.1)
        assert not each["success_once"] and not each["success_at_end"]
        assert (each["fail"], each["ending"]) == (False, "cut")
        assert each["label"] == old.subtasks[-1].label
        assert not after.terminated


def test_overwrite_replaces_exports_alone(source: Path, tmp_path: Path) -> None:
    out = tmp_path / "runs"
    shards = out / "set_table/pick"
    shards.mkdir(parents=True)
    record(shards / "024_bowl.h5", range(1), FakeEnv(subtask="pick"))
    before = (shards / "024_bowl.h5").read_bytes()
    with refused(said="024_bowl.h5 is not of one"):
        to_maniskill(source, out, overwrite=True)
    for inside in (out, out / "set"):
        with refused("out"):
            to_maniskill(out, inside, overwrite=True)
    assert [path.name for path in out.iterdir()] == ["set_table"]
    # Data of MS-HAB itself have a JSON file beside them, too.
    (shards / "024_bowl.json").write_text('{"source_type": "rl"}')
    with refused(said="024_bowl.h5 is not of one"):
        to_maniskill(source, out, overwrite=True)
    assert (shards / "024_bowl.h5").read_bytes() == before
    (out / "set_table").rename(tmp_path / "set_table")
    (out / "notes").mkdir()
    with refused(where="runs", said="no trajectory files"):
        to_maniskill(source, out, overwrite=True)
    to_maniskill(source, tmp_path / "out")
    assert to_maniskill(source, tmp_path / "out", overwrite=True).episodes == 6


def check(
    group: Any, episode: RecordedEpisode, number: int, info: dict[str, Any]
) -> None:
    count = episode.steps
    record_ = episode.record
    np.testing.assert_array_equal(group["actions"], episode.array("actions"))
    for name in ("terminated", "truncated", "success", "fail"):
        assert group[name].shape == (count,) and group[name].dtype == bool
    assert group["rewards"].dtype == np.float32
    assert (
        bool(group["terminated"][-1])
        == episode.terminated
        != bool(group["truncated"][-1])
    )
    np.testing.assert_allclose(joined(group, count + 1), episode.array("obs/state"))
    images = group["obs/sensor_data/fetch_head"]
    assert (
        images["rgb"].shape == (count + 1, SIZE, SIZE, 3)
        and images["rgb"].compression_opts == 5
    )
    assert (
        images["depth"].shape == (count + 1, SIZE, SIZE, 1)
        and images["depth"].dtype == np.int16
    )
    np.testing.assert_array_equal(
        images["depth"][count], episode.frame("fetch_head", "depth", count)
    )
    assert group["obs/sensor_param/fetch_head/intrinsic_cv"].shape == (count + 1, 3, 3)
    assert group["obs/extra/is_grasped"].dtype == bool
    assert (info["episode_id"], info["elapsed_steps"], info["label"]) == (
        number,
        count,
        record_.subtasks[-1].label,
    )
    assert info["success_once"] == record_.success_once
    assert info["legacy_label"] == record_.subtasks[-1].legacy_label
    theirs = {"excessive_collisions": "exceeded_cumulative_force_limit"}
    published = PICK.published
    assert published is not None
    found = from_nothing(episode)
    assert found != list(record_.events)
    counted = [theirs.get(e, e) for _, e in found if e in published.events]
    assert info["events"] == [e for e, _ in itertools.groupby(counted)]
    verbose = [[step - 1, theirs.get(e, e), None] for step, e in found]
    assert [each for each in info["events_verbose"] if each[1] != "collision"] == verbose
    collisions = [each for each in info["events_verbose"] if each[1] == "collision"]
    met = {
        step: force
        for steps, _, forces in collisions
        for step, force in zip(steps, forces, strict=True)
    }
    assert met == {step: force for step, force in enumerate(record_.force) if force > 0}


def test_groups_keep_the_order_of_the_state(source: Path, tmp_path: Path) -> None:
    env = FakeEnv(subtask="pick")
    plain = env._observe

    def more(*args: Any) -> dict[str, np.ndarray]:
        obs = plain(*args)
        grasped = obs.pop("extra/is_grasped")
        obs.pop("state")
        obs["extra/tcp_pose_wrt_base"] = np.tile(
            np.arange(7, dtype=np.float32), (len(grasped), 1)
        )
        obs["extra/goal_pos_wrt_base"] = np.zeros((len(grasped), 3), np.float32)
        obs["extra/is_grasped"] = grasped
        obs["state"] = np.concatenate(list(obs.values()), axis=1)
        return obs

    env._observe = env.observer.observe = more  # type: ignore[method-assign]
    record(tmp_path / "a.h5", [0], env)
    done = to_maniskill(tmp_path / "a.h5", tmp_path / "out")
    with h5py.File(done.files[0]) as file:
        assert list(cast("h5py.Group", file["traj_0/obs/extra"])) == [
            "tcp_pose_wrt_base",
            "goal_pos_wrt_base",
            "is_grasped",
        ]  # type: ignore[arg-type]
        assert joined(file["traj_0"], 3)[0, 4:11].tolist() == list(range(7))
