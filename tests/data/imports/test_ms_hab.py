"""Data of MS-HAB as shards: the round trip with our own export, files as the original writes them, bad files."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

import mjhab
from mjhab.cli.main import main
from mjhab.core.conventions.names import PUBLISHED
from mjhab.data.imports.ms_hab import ABSENT, import_ms_hab
from mjhab.data.imports.ms_hab_layout import ACTIONS, SCANNED_YAWS
from mjhab.data.imports.origin import Origin
from mjhab.data.record.verify import verify
from mjhab.data.select.dataset import Normalization, Window, WindowDataset
from mjhab.data.select.query import Filter
from mjhab.data.select.sets import select, stats
from mjhab.data.store.checking import check
from mjhab.data.store.older.object_axes import shown_objects
from mjhab.data.store.places import episodes
from mjhab.render.film import FilmWriter
from mjhab.reports.dataset import render_data_report
from mjhab.rollout.records import PlanEntry
from tests.data.export.exporting import from_nothing, to_maniskill
from tests.data.fake_world import FakeEnv
from tests.data.make import record, record_pictures
from tests.refusals import command, refused

STEPS = 6
SIDE = 8


def original(
    folder: Path,
    count: int = 3,
    subtask: str = "pick",
    name: str = "024_bowl",
    *,
    side: int = SIDE,
    **changes: Any,
) -> Path:
    """A file as mshab/envs/wrappers/record.py writes it, with other values in the JSON of episodes for ``changes``.

    side: of its images [px].
    """
    path = folder / "set_table" / subtask / f"{name}.h5"
    path.parent.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(0)
    told = []
    with h5py.File(path, "w") as file:
        for number in range(count):
            trajectory = file.create_group(f"traj_{number}", track_order=True)
            obs = trajectory.create_group("obs", track_order=True)
            agent, extra = (
                obs.create_group(part, track_order=True) for part in ("agent", "extra")
            )
            for key, width in (("qpos", 12), ("qvel", 12)):
                agent[key] = rng.normal(size=(STEPS + 1, width)).astype(np.float32)
            for key, width in (
                ("tcp_pose_wrt_base", 7),
                ("obj_pose_wrt_base", 7),
                ("goal_pos_wrt_base", 3),
            ):
                extra[key] = rng.normal(size=(STEPS + 1, width)).astype(np.float32)
            extra["is_grasped"] = np.arange(STEPS + 1) > 2
            for camera in ("fetch_head", "fetch_hand"):
                obs[f"sensor_param/{camera}/intrinsic_cv"] = np.tile(
                    np.eye(3, dtype=np.float32), (STEPS + 1, 1, 1)
                )
                depth = rng.integers(0, 9000, (STEPS + 1, side, side, 1)).astype(np.int16)
                obs.create_dataset(
                    f"sensor_data/{camera}/depth",
                    data=depth,
                    compression="gzip",
                    compression_opts=5,
                )
                obs[f"sensor_data/{camera}/rgb"] = rng.integers(
                    0, 256, (STEPS + 1, side, side, 3)
                ).astype(np.uint8)
            trajectory["actions"] = rng.uniform(-1, 1, (STEPS, 13)).astype(np.float32)
            trajectory["terminated"] = np.zeros(STEPS, bool)
            trajectory["truncated"] = np.arange(STEPS) == STEPS - 1
            trajectory["success"] = np.arange(STEPS) >= 4
            trajectory["fail"] = np.zeros(STEPS, bool)
            trajectory["rewards"] = rng.random(STEPS).astype(np.float32)
            verbose = [
                [1, "contact", None],
                [[1, 2], "collision", [12.34, 1500.0]],
                [2, "grasped", None],
            ]
            episode = {
                "episode_id": number,
                "episode_seed": [2024] * 4,
                "build_config_idx": 7,
                "task_plan_idx": 3,
                "init_config_idx": 1,
                "spawn_selection_idx": 2,
                "control_mode": "pd_joint_delta_pos",
                "elapsed_steps": STEPS,
                "label": "straightforward_success",
                "events": ["contact", "grasped", "success"],
                "events_verbose": [*verbose, [4, "success", None]],
                "articulation_type": None,
                "reset_kwargs": {},
                "success_once": True,
                "success_at_end": True,
                "fail": False,
            }
            told.append(episode | changes)
    env = {
        "env_id": f"{subtask.capitalize()}SubtaskTrain-v0",
        "env_kwargs": {},
        "max_episode_steps": STEPS,
    }
    said = {
        "env_info": env,
        "commit_info": {},
        "source_type": "RL",
        "source_desc": "policy",
        "episodes": told,
    }
    path.with_suffix(".json").write_text(json.dumps(said))
    return path


def rewrite(path: Path, **values: Any) -> None:
    beside = path.with_suffix(".json")
    beside.write_text(json.dumps(json.loads(beside.read_text()) | values))


def test_an_export_comes_back(tmp_path: Path) -> None:
    source = tmp_path / "picks.h5"
    record_pictures(source, range(4))
    files = to_maniskill(source, tmp_path / "exported").files
    done = import_ms_hab(files[0], tmp_path / "back")
    assert (done.episodes, done.frames, done.present) == (4, 80, 0)
    assert check(tmp_path / "back").clean
    for old, new in zip(episodes(source), episodes(tmp_path / "back"), strict=True):
        for path in (
            "actions",
            "obs/state",
            "obs/sensor_param/fetch_head/intrinsic_cv",
            "reward/success",
            "reward/fail",
        ):
            np.testing.assert_array_equal(new.array(path), old.array(path))
        assert new.columns("obs/state") == old.columns("obs/state")
        np.testing.assert_allclose(new.array("reward/total"), old.array("reward/total"))
        assert new.images == old.images
        for camera, output in old.images:
            for t in (0, old.steps):
                np.testing.assert_array_equal(
                    new.frame(camera, output, t), old.frame(camera, output, t)
                )
        assert (
            new.attributes["ending"] == old.attributes["ending"]
            and new.terminated == old.terminated
        )
        was = old.record
        now = new.record
        for name in (
            "seed",
            "index",
            "home",
            "task",
            "split",
            "subtask",
            "success_once",
            "fail",
            "steps",
            "force",
        ):
            assert getattr(now, name) == getattr(was, name), name
        assert now.events == tuple(from_nothing(old))
        for name in ("kind", "target", "label", "legacy_label", "start_step", "end_step"):
            assert getattr(now.subtasks[0], name) == getattr(was.subtasks[0], name), name
        assert (
            new.run.config["policy"] == {"name": "random"}
            and tuple(new.run.absent) == ABSENT
        )


def test_which_object_a_subtask_observes() -> None:
    box = "008_pudding_box_:0000"
    plan = (("navigate", box), ("open", "fridge/top_door"), ("pick", box))
    plan += (("navigate", f"goal of {box}"), ("place", box), ("close", "fridge/top_door"))
    kind = "008_pudding_box"
    shown = shown_objects([PlanEntry(*entry) for entry in plan])
    assert shown == ("", kind, kind, kind, kind, "")


def test_poses_of_boxes_keep_the_axes_of_their_scans_there_and_back(
    tmp_path: Path,
) -> None:
    key = "extra/obj_pose_wrt_base"
    path = original(tmp_path, 1, name="008_pudding_box")
    import_ms_hab(path, tmp_path / "shards")
    (episode,) = episodes(tmp_path / "shards")
    with h5py.File(path) as file:
        seen = np.array(file[f"traj_0/obs/{key}"])
    seen[seen[:, 3] < 0, 3:] *= -1
    assert episode.conventions == PUBLISHED
    np.testing.assert_array_equal(episode.observation(key), seen)
    assert episode.scan_yaws is not None
    assert set(episode.scan_yaws.tolist()) == {SCANNED_YAWS["008_pudding_box"]}
    (exported,) = to_maniskill(tmp_path / "shards", tmp_path / "exported").files
    told = json.loads(exported.with_suffix(".json").read_text())["episodes"]
    assert [(each["object_axes"], each["joint_angles"]) for each in told] == [
        ("scan", "unwrapped")
    ]
    with h5py.File(exported) as file:
        np.testing.assert_array_equal(np.array(file[f"traj_0/obs/{key}"]), seen)
    import_ms_hab(exported, tmp_path / "back")
    (back,) = episodes(tmp_path / "back")
    assert back.conventions == PUBLISHED
    np.testing.assert_array_equal(back.observation(key), seen)


def test_poses_without_known_headings_stay(tmp_path: Path) -> None:
    path = original(tmp_path, 1, name="008_pudding_box")
    rewrite(path, source_type="mjhab", runs={})
    import_ms_hab(path, tmp_path / "shards")
    (episode,) = episodes(tmp_path / "shards")
    with h5py.File(path) as file:
        seen = np.array(file["traj_0/obs/extra/obj_pose_wrt_base"])
    seen[seen[:, 3] < 0, 3:] *= -1
    np.testing.assert_array_equal(episode.observation("extra/obj_pose_wrt_base"), seen)


def test_a_file_of_the_original(tmp_path: Path) -> None:
    path = original(tmp_path)
    done = import_ms_hab(path, tmp_path / "shards")
    assert done.shard == tmp_path / "shards/set_table/pick/024_bowl.h5" and (
        done.episodes,
        done.frames,
    ) == (3, 18)
    with h5py.File(path) as file:
        for number, episode in enumerate(episodes(done.shard)):
            obs: Any = file[f"traj_{number}/obs"]
            extra = obs["extra"]
            poses = [np.array(extra[f"{name}_pose_wrt_base"]) for name in ("tcp", "obj")]
            for pose in poses:
                pose[pose[:, 3] < 0, 3:] *= -1
            parts = [
                obs["agent/qpos"],
                obs["agent/qvel"],
                *poses,
                extra["goal_pos_wrt_base"],
            ]
            state = np.concatenate(
                [*parts, np.array(extra["is_grasped"])[:, None]], axis=1
            )
            np.testing.assert_array_equal(
                episode.array("obs/state"), state.astype(np.float32)
            )
            assert (episode.observation("extra/obj_pose_wrt_base")[:, 3] >= 0).all()
            depth = np.array(obs["sensor_data/fetch_hand/depth"])
            np.testing.assert_array_equal(
                episode.observation("sensor_data/fetch_hand/depth"), depth
            )
            told = episode.record
            assert (told.seed, told.index, told.home, told.split) == (
                2024,
                number,
                "build_config_7",
                "train",
            )
            assert (
                told.subtasks[0].label
                == told.subtasks[0].legacy_label
                == "straightforward_success"
            )
            assert told.events == ((2, "contact"), (3, "grasped"), (5, "success"))
            assert (
                told.force == (0.0, 12.34, 1500.0, 0.0, 0.0, 0.0)
                and told.peak_force == 1500.0
            )
            assert episode.attributes["ending"] == "timeout" and episode.run.config[
                "policy"
            ] == {"name": "ms_hab rl"}
            with refused(said="without states/qpos. Its source lacks states/initial"):
                episode.array("states/qpos")
            with refused(said="imported from data without states/initial"):
                episode.initial()


def test_filters_statistics_reports_and_windows_work_on_it(tmp_path: Path) -> None:
    shards = import_ms_hab(original(tmp_path), tmp_path / "shards").shard.parents[2]
    where = (
        "label == 'straightforward_success' and first('grasped') == 3 "
        "and max_force > 1400 and policy == 'ms_hab rl'"
    )
    assert len(select(shards, Filter(where)).matched) == 3
    assert len(select(shards, Filter.preset("pick_published")).matched) == 3
    row = stats(shards)["rows"][0]
    assert (row["task"], row["subtask"], row["target"], row["success_once"]) == (
        "set_table",
        "pick",
        "024_bowl",
        1.0,
    )
    page = render_data_report(shards, FilmWriter)
    assert (
        "mjhab, published rules, straightforward_success: 3 of 3" in page
        and "data:video/mp4" in page
    )
    rules = "profile ms_hab, stillness published"
    assert f"{rules}; ours are of {rules}." in page
    windows = WindowDataset(
        shards,
        Window(history=2, chunk=4, images=("fetch_head/depth",)),
        normalization=Normalization("spread"),
    )
    assert (
        len(windows) == 18
        and windows[5]["state"].shape == (2, 42)
        and windows[5]["action"].shape == (4, 13)
    )
    again = to_maniskill(shards, tmp_path / "again")
    assert again.episodes == 3 and not again.without_depth


def test_what_needs_states_or_signals_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shards = tmp_path / "shards"
    import_ms_hab(original(tmp_path), shards)

    def never(run: Any) -> Any:
        raise AssertionError

    with refused(where="024_bowl.h5", said="imported from data without states"):
        verify(shards, never)
    record(shards / "ours.h5", range(2), FakeEnv(subtask="pick"))
    assert main(["label", str(shards), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["episodes"], told["changed"], told["without_signals"]) == (2, 0, 3)
    for episode in episodes(shards / "set_table"):
        with refused(said="It was imported from data without states to draw them from"):
            episode.frame("fetch_head", "seg", 0)


def test_the_run_of_an_import_is_that_of_the_source(tmp_path: Path) -> None:
    path = original(tmp_path, 1)
    env = mjhab.make(
        task="set_table",
        subtask="pick",
        target="024_bowl",
        profile="ms_hab",
        obs_mode="state",
    )
    assert tuple(entry.name for entry in env.action_table) == ACTIONS
    told = dataclasses.asdict(env.config)
    env.close()
    import_ms_hab(path, tmp_path / "shards")
    run = next(episodes(tmp_path / "shards")).run
    for name, value in run.config["env"].items():
        assert value == (
            list(told[name]) if isinstance(told[name], tuple) else told[name]
        ), name
    assert set(run.config["env"]) > {"robot", "base", "stationary", "profile"}
    with h5py.File(path, "r+") as file:
        del file["traj_0/actions"]
        file["traj_0/actions"] = np.zeros((STEPS, 11), np.float32)
    with refused(
        where="024_bowl.h5", said="actions of 11 numbers; pd_joint_delta_pos has 13"
    ):
        import_ms_hab(path, tmp_path / "other")


def test_an_import_goes_on_where_it_stopped(tmp_path: Path) -> None:
    path = original(tmp_path)
    told = json.loads(path.with_suffix(".json").read_text())["episodes"]
    tries = 0

    def begin(total: int) -> Any:
        assert total == 3

        def after() -> None:
            nonlocal tries
            tries += 1
            if tries == 2:
                raise KeyboardInterrupt

        return after

    with pytest.raises(KeyboardInterrupt):
        import_ms_hab(path, tmp_path / "shards", begin=begin)
    done = import_ms_hab(path, tmp_path / "shards")
    assert (done.episodes, done.present, len(told)) == (1, 2, 3)
    assert check(tmp_path / "shards").clean
    assert import_ms_hab(path, tmp_path / "shards").present == 3


def test_links_furniture_and_folders(tmp_path: Path) -> None:
    shards = tmp_path / "shards"
    path = original(
        tmp_path, 1, "close", "fridge", articulation_type="fridge", label="closed_success"
    )
    import_ms_hab(path, shards)
    lying = tmp_path / "lying.h5"
    path.rename(lying)
    path.with_suffix(".json").rename(lying.with_suffix(".json"))
    with refused(where="lying.h5", said="give --task"):
        import_ms_hab(lying, shards)
    import_ms_hab(lying, shards, Origin("tidy_house", "val"))
    found = {episode.record.task: episode.record for episode in episodes(shards)}
    assert {each.subtasks[0].target for each in found.values()} == {"fridge/top_door"}
    assert found["tidy_house"].split == "val" and found["set_table"].split == "train"
    with refused("task", "tidyhouse", expected="tidy_house"):
        Origin("tidyhouse")


def test_bad_files(tmp_path: Path) -> None:
    path = original(tmp_path, 1)
    out = tmp_path / "shards"

    def check_refused(said: str) -> None:
        with refused(where="024_bowl", said=said):
            import_ms_hab(path, out)
        assert not check(out).episodes if list(out.rglob("*.h5")) else True

    rewrite(path, env_info={"env_id": "SequentialTask-v0"})
    path.parent.rename(path.parents[1] / "sequential_task")
    path = tmp_path / "set_table/sequential_task/024_bowl.h5"
    check_refused("of SequentialTask-v0")
    rewrite(path, env_info={"env_id": "PickSubtaskTrain-v0"})
    good = path.with_suffix(".json").read_text()
    rewrite(path, episodes=[{"episode_id": 0, "elapsed_steps": STEPS}])
    check_refused("episode 0 has no label, events_verbose. Record with labels")
    rewrite(path, episodes={})
    check_refused("no list 'episodes'")
    path.with_suffix(".json").write_text("{")
    check_refused("not valid JSON")
    path.with_suffix(".json").write_text(
        good.replace(f'"elapsed_steps": {STEPS}', '"elapsed_steps": 9')
    )
    check_refused(f"traj_0 has {STEPS} actions, and the JSON says 9 steps")
    path.with_suffix(".json").write_text(
        good.replace('"episode_id": 0', '"episode_id": 4')
    )
    check_refused("has no traj_4")
    path.with_suffix(".json").write_text(good)
    with h5py.File(path, "r+") as file:
        del file["traj_0/terminated"]
        file["traj_0/terminated"] = np.zeros(0, bool)
    check_refused("terminated must be rows of numbers, not ")
    with h5py.File(path, "r+") as file:
        del file["traj_0/rewards"], file["traj_0/obs/extra"]
    check_refused("traj_0 has no rewards, obs/extra; it has obs, actions")
    path.with_suffix(".json").unlink()
    check_refused("has no 024_bowl.json beside it")
    with h5py.File(path, "w") as file:
        file["data"] = 1
    check_refused("It has: data")
    path.write_bytes(b"nothing")
    check_refused("not an HDF5 file")
    path.unlink()
    check_refused("does not exist")
    path = tmp_path / "a.h5"
    record(path, range(1), FakeEnv(subtask="pick"))
    with refused(where="a.h5", said="a shard of mjhab already"):
        import_ms_hab(path, out)


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    paths = [
        str(original(tmp_path, 2)),
        str(original(tmp_path, 1, "open", "fridge", articulation_type="fridge")),
    ]
    out = tmp_path / "shards"
    assert main(["data", "import", "ms_hab", *paths, "--out", str(out), "--json"]) == 0
    told = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert told == {"episodes": 3, "frames": 18, "present": 0, "lacks": list(ABSENT)}
    assert main(["data", "import", "ms_hab", paths[0], "--out", str(out)]) == 0
    assert (
        "0 episodes, 0 frames" in (said := capsys.readouterr().out)
        and "2 were there already" in said
    )
    with refused("format", "mshab", expected="ms_hab"):
        command("data", "import", "mshab", paths[0], "--out", str(out))
