"""LeRobot exports: files, schemas, numbers and films against the source. `make test-lerobot` asks lerobot itself."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import h5py
import imageio_ffmpeg
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import mjhab
from mjhab.core.rotations import quat_rotate
from mjhab.data.export.conventions import CONVENTIONS
from mjhab.data.export.lerobot.export import Exported
from mjhab.data.export.lerobot.features import FPS, Choice
from mjhab.data.export.lerobot.parts import FilmTools
from mjhab.data.export.lerobot.stats import aggregate, image_stats, vector_stats
from mjhab.data.export.outside import Outside
from mjhab.data.select.clouds import Clouds
from mjhab.data.select.describing import state_names, subtask_words
from mjhab.data.select.own_state import base_velocity, split_state
from mjhab.data.select.query import Filter
from mjhab.data.store.images import ImageFormat
from mjhab.data.store.places import episodes
from mjhab.data.store.reading import RecordedEpisode
from mjhab.render.film import FilmWriter, join_films
from tests.data.export.exporting import to_lerobot, to_maniskill
from tests.data.fake_world import SIZE, FakeEnv
from tests.data.make import chains_and_picks, record
from tests.refusals import refused

RGB = "observation.images.fetch_head"
DEPTH = "observation.depth.fetch_head"


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return chains_and_picks(tmp_path_factory.mktemp("source"))


def export(source: Path, out: Path, version: str = "3.0", **options: Any) -> Exported:
    films = FilmTools(lambda path, fps: FilmWriter(path, fps, 10, 2), join_films)
    return to_lerobot(source, out, films, version=version, **options)


@pytest.fixture(scope="module")
def exported(source: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("out") / "set"
    done = export(source, out)
    steps = [episode.steps for episode in episodes(source)]
    assert (done.episodes, done.frames) == (5, sum(steps)) and set(done.images) == {
        RGB,
        DEPTH,
    }
    return out


def frames_of(path: Path) -> np.ndarray:
    reader = imageio_ffmpeg.read_frames(str(path))
    width, height = next(reader)["size"]
    return np.stack(
        [np.frombuffer(frame, np.uint8).reshape(height, width, 3) for frame in reader]
    )


def check_rows(table: Any, episode: RecordedEpisode, number: int, first: int) -> None:
    count = episode.steps
    state = split_state(episode)
    for key, parts in (("state", state.own), ("environment_state", state.task)):
        joined = np.concatenate(list(parts.values()), axis=1)[:count]
        np.testing.assert_array_equal(
            np.stack(table[f"observation.{key}"].to_numpy()), joined
        )
    np.testing.assert_array_equal(
        np.stack(table["action"].to_numpy()), episode.array("actions")
    )
    np.testing.assert_allclose(
        table["timestamp"].to_numpy(), np.arange(count) / 20, atol=1e-6
    )
    np.testing.assert_array_equal(
        table["index"].to_numpy(), np.arange(first, first + count)
    )
    assert set(table["episode_index"].to_pylist()) == {number}
    assert (
        table["next.success"].to_pylist()
        == episode.array("reward/success").astype(bool).tolist()
    )
    assert table["next.done"].to_pylist() == [False] * (count - 1) + [True]
    depth = np.array(table[DEPTH].to_pylist())
    assert depth.shape == (count, SIZE, SIZE)
    np.testing.assert_array_equal(
        depth[-1], episode.frame("fetch_head", "depth", count - 1)[..., 0]
    )


def test_v30_tables_hold_the_source(source: Path, exported: Path) -> None:
    info = json.loads((exported / "meta/info.json").read_text())
    assert (
        info["codebase_version"] == "v3.0"
        and info["fps"] == FPS == 20
        and info["robot_type"] == "fetch"
    )
    meta = pq.read_table(
        exported / "meta/episodes/chunk-000/file-000.parquet"
    ).to_pylist()
    data = pq.read_table(exported / "data/chunk-000/file-000.parquet")
    assert set(data.column_names) == {
        k for k, f in info["features"].items() if f["dtype"] != "video"
    }
    assert (
        str(data.schema.field("action").type) == "fixed_size_list<element: float>[13]"
        and info["total_episodes"] == 5
    )
    for number, (row, episode) in enumerate(zip(meta, episodes(source), strict=True)):
        first = row["dataset_from_index"]
        last = row["dataset_to_index"]
        assert (row["episode_index"], row["length"], row["source"]) == (
            number,
            episode.steps,
            episode.name,
        )
        check_rows(data.slice(first, last - first), episode, number, first)
        np.testing.assert_allclose(
            row["stats/action/max"], episode.array("actions").max(axis=0)
        )
    assert meta[-1]["dataset_to_index"] == len(data) == info["total_frames"]


def test_v30_tasks_and_subtasks_are_named(source: Path, exported: Path) -> None:
    tasks = pq.read_table(exported / "meta/tasks.parquet")
    assert tasks["__index_level_0__"].to_pylist() == [
        "set the table: put the bowl at its goal",
        "pick up the bowl",
    ]
    pandas = json.loads(tasks.schema.metadata[b"pandas"])
    assert pandas["index_columns"] == ["__index_level_0__"]
    names = pq.read_table(exported / "meta/subtasks.parquet")[
        "__index_level_0__"
    ].to_pylist()
    assert names[:2] == ["open the drawer of the kitchen counter", "pick up the bowl"]
    data = pq.read_table(exported / "data/chunk-000/file-000.parquet")
    said = [names[i] for i in data["subtask_index"].to_pylist()]
    for episode in episodes(source):
        plan = subtask_words(episode.record)
        active = episode.array("subtasks/active")[: episode.steps]
        mine = said[: episode.steps]
        said = said[episode.steps :]
        assert mine == [plan[i] for i in active]


def test_v30_film_shows_the_frames_at_their_times(source: Path, exported: Path) -> None:
    path = exported / f"videos/{RGB}/chunk-000/file-000.mp4"
    shown = frames_of(path).astype(int)
    meta = pq.read_table(
        exported / "meta/episodes/chunk-000/file-000.parquet"
    ).to_pylist()
    assert len(shown) == meta[-1]["dataset_to_index"]
    for row, episode in zip(meta, episodes(source), strict=True):
        start = row[f"videos/{RGB}/from_timestamp"]
        assert row[f"videos/{RGB}/to_timestamp"] - start == pytest.approx(
            episode.steps / FPS
        )
        wanted = np.stack(
            [episode.frame("fetch_head", "rgb", t) for t in range(episode.steps)]
        ).astype(int)
        got = shown[round(start * FPS) :][: episode.steps]
        assert np.abs(got - wanted).mean() < 8
        assert np.abs(got.mean(axis=(1, 2)) - wanted.mean(axis=(1, 2))).max() < 8


def test_v21_has_a_file_per_episode(source: Path, tmp_path: Path) -> None:
    export(source, tmp_path / "set", "2.1")
    info = json.loads((tmp_path / "set/meta/info.json").read_text())
    assert (info["codebase_version"], info["total_chunks"], info["total_videos"]) == (
        "v2.1",
        1,
        5,
    )
    first = 0
    for number, episode in enumerate(episodes(source)):
        place = {"episode_chunk": 0, "episode_index": number, "video_key": RGB}
        check_rows(
            pq.read_table(tmp_path / "set" / info["data_path"].format(**place)),
            episode,
            number,
            first,
        )
        film = tmp_path / "set" / info["video_path"].format(**place)
        assert imageio_ffmpeg.count_frames_and_secs(str(film))[0] == episode.steps
        first += episode.steps
    lines = {
        name: (tmp_path / f"set/meta/{name}.jsonl").read_text().splitlines()
        for name in ("tasks", "subtasks", "episodes", "episodes_stats")
    }
    assert json.loads(lines["tasks"][1]) == {"task_index": 1, "task": "pick up the bowl"}
    stats = json.loads(lines["episodes_stats"][4])["stats"]
    assert set(stats["action"]) == {"min", "max", "mean", "std", "count"} and np.shape(
        stats[RGB]["mean"]
    ) == (3, 1, 1)


def test_choice_filter_and_bad_input(source: Path, tmp_path: Path) -> None:
    done = export(
        source,
        tmp_path / "a",
        where=Filter("subtask == 'pick'"),
        choice=Choice(rgb=False, depth=False),
    )
    assert (done.episodes, done.images) == (2, ()) and not (
        tmp_path / "a/videos"
    ).exists()
    assert json.loads((tmp_path / "a/meta/info.json").read_text())["video_path"] is None
    with refused(where=tmp_path):
        export(source, tmp_path / "a")
    with refused(said="no episode passes"):
        export(source, tmp_path / "b", where=Filter("steps > 1000"))
    with refused("LeRobot version", "3", expected="3.0", said="Valid names: 2.1, 3.0"):
        export(source, tmp_path / "b", "3")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/letter.txt").write_text("dear")
    with refused(where="mine", said="does not hold an export"):
        export(source, tmp_path / "mine", overwrite=True)
    assert (tmp_path / "mine/letter.txt").exists() and not (tmp_path / "b").exists()


def test_an_export_appears_whole_or_not_at_all(source: Path, tmp_path: Path) -> None:
    (tmp_path / ".set.part").mkdir()
    (tmp_path / ".set.part/left").write_text(
        "by a process that was killed before it had begun"
    )
    export(source, tmp_path / "set", choice=Choice(rgb=False))
    assert not (tmp_path / "set/left").exists()
    export(
        source, tmp_path / "set", choice=Choice(rgb=False, depth=False), overwrite=True
    )
    assert [path.name for path in tmp_path.iterdir()] == ["set"]
    assert (
        DEPTH not in json.loads((tmp_path / "set/meta/info.json").read_text())["features"]
    )


def test_episodes_that_differ_are_refused(source: Path, tmp_path: Path) -> None:
    record(tmp_path / "plain.h5", [7], FakeEnv())
    with refused(where="plain.h5", said="in observation"):
        to_lerobot(
            [source, tmp_path / "plain.h5"],
            tmp_path / "set",
            FilmTools(FilmWriter, join_films),
        )
    assert not list(tmp_path.glob(".*")) and not (tmp_path / "set").exists()


SEG = "observation.segmentation.fetch_head"
NAMES = ["background", "floor", "wall", "fridge/top_door"]


@pytest.mark.parametrize("version", ["3.0", "2.1"])
def test_segmentation_goes_along_with_its_names_and_the_pose_of_its_camera(
    version: str, tmp_path: Path
) -> None:
    record(
        tmp_path / "a.h5",
        [1, 2],
        FakeEnv(images=True, segments=NAMES),
        images=ImageFormat(),
    )
    done = export(tmp_path / "a.h5", tmp_path / "set", version)
    assert set(done.images) == {RGB, DEPTH, SEG}
    features = json.loads((tmp_path / "set/meta/info.json").read_text())["features"]
    assert (features[SEG]["dtype"], features[SEG]["shape"]) == ("int32", [SIZE, SIZE])
    assert json.loads((tmp_path / "set/meta/segments.json").read_text()) == NAMES
    assert "fetch_head" in json.loads((tmp_path / "set/meta/cameras.json").read_text())
    rows = pa.concat_tables(
        pq.read_table(path) for path in sorted((tmp_path / "set/data").rglob("*.parquet"))
    )
    first = 0
    for episode in episodes(tmp_path / "a.h5"):
        count = episode.steps
        own = rows.slice(first, count)
        first += count
        seen = np.array(own[SEG].to_pylist())
        wanted = [episode.frame("fetch_head", "seg", t)[..., 0] for t in range(count)]
        np.testing.assert_array_equal(seen, wanted)
        assert len(np.unique(seen)) == len(NAMES)
        poses = episode.array("obs/sensor_param/fetch_head/cam2world_gl")[:count]
        np.testing.assert_array_equal(
            np.array(own["camera_pose.fetch_head"].to_pylist()), poses
        )
    card = (tmp_path / "set/README.md").read_text()
    assert all(
        words in card for words in ("w, x, y, z", "x right, y up", "meta/segments.json")
    )
    conventions = json.loads((tmp_path / "set/meta/conventions.json").read_text())
    assert conventions == CONVENTIONS and all(
        f"- {t}: " in card for t in ("camera", "mount")
    )


def test_segmentation_is_left_out_on_demand(tmp_path: Path) -> None:
    record(
        tmp_path / "a.h5", [1], FakeEnv(images=True, segments=NAMES), images=ImageFormat()
    )
    done = export(tmp_path / "a.h5", tmp_path / "set", choice=Choice(seg=False))
    assert (
        set(done.images) == {RGB, DEPTH}
        and not (tmp_path / "set/meta/segments.json").exists()
    )


@pytest.mark.parametrize(
    ("segments", "seg", "written"),
    [
        (NAMES, True, {"cameras", "segments"}),
        (NAMES, False, {"cameras"}),
        ((), True, set()),
    ],
)
def test_the_card_names_the_files_that_are_there(
    segments: Sequence[str], seg: bool, written: set[str], tmp_path: Path
) -> None:
    env = FakeEnv(images=True, segments=segments)
    record(tmp_path / "a.h5", [1], env, images=ImageFormat())
    export(tmp_path / "a.h5", tmp_path / "set", choice=Choice(seg=seg))
    card = (tmp_path / "set/README.md").read_text()
    assert "Conventions:" in card
    for name in ("cameras", "segments"):
        path = f"meta/{name}.json"
        assert (path in card) == (tmp_path / "set" / path).exists() == (name in written)


def test_poses_of_cameras_go_with_their_images(tmp_path: Path) -> None:
    for index, names in enumerate((NAMES, ())):
        env = FakeEnv(images=True, segments=names)
        record(tmp_path / f"{index}.h5", [index], env, images=ImageFormat())
    none = Choice(rgb=False, depth=False, seg=False)
    assert export(tmp_path, tmp_path / "out/set", choice=none).episodes == 2


def test_ids_that_mean_other_things_are_refused(tmp_path: Path) -> None:
    for index, (name, names) in enumerate((("a", NAMES), ("b", NAMES[::-1]))):
        env = FakeEnv(images=True, segments=names)
        record(tmp_path / f"{name}.h5", [index], env, images=ImageFormat())
    with refused(said="b.h5 mean other things"):
        export(tmp_path, tmp_path / "out/set")


def check_clouds(episode: RecordedEpisode, height: float) -> None:
    """Points of clouds are those that the environment sees, with their colours; the same ones every time."""
    clouds = Clouds(episode, 200, height)
    first, points = clouds.at(0), clouds.at(1)
    seen = episode.array("obs/pointcloud/xyz")[1]
    colours = episode.array("obs/pointcloud/rgb")[1] / 255
    for point in points:
        near = np.linalg.norm(seen - point[:3], axis=1) < 0.003
        assert near.any() and np.abs(colours[near] - point[3:]).max(axis=1).min() < 1e-6
    assert len(np.unique(points, axis=0)) == 200
    np.testing.assert_array_equal(Clouds(episode, 200, height).at(0), first)


def test_pixels_of_the_floor_lie_on_the_floor_by_what_the_export_says(
    tmp_path: Path,
) -> None:
    env = mjhab.make(
        task="set_table",
        subtask="pick",
        home="builtin_m0_00",
        num_envs=1,
        threads=1,
        obs_mode="rgbd+seg+pointcloud",
        camera_size=24,
        autoreset="disabled",
    )
    record(tmp_path / "a.h5", [0], env, images=ImageFormat(), max_steps=2)
    export(tmp_path / "a.h5", tmp_path / "set", choice=Choice(points=50))
    rows = pq.read_table(tmp_path / "set/data/chunk-000/file-000.parquet")
    assert np.array(rows["observation.pointcloud"].to_pylist()).shape == (2, 50, 6)
    (episode,) = episodes(tmp_path / "a.h5")
    check_clouds(episode, env.layout.robot.base_height)
    height = env.layout.robot.base_height
    outside = Outside(base_height=lambda _: height)
    done = to_maniskill(tmp_path / "a.h5", tmp_path / "h5", points=50, outside=outside)
    with h5py.File(done.files[0]) as file:
        trajectory: Any = file["traj_0"]
        clouds = trajectory["obs/pointcloud"][()]
        np.testing.assert_array_equal(
            trajectory["base_velocity"][()], base_velocity(episode)
        )
    assert clouds.shape == (3, 50, 6) and clouds.dtype == np.float32
    expected = Clouds(episode, 50, height)
    np.testing.assert_array_equal(clouds, [expected.at(t) for t in range(3)])
    names = json.loads((tmp_path / "set/meta/segments.json").read_text())
    camera = json.loads((tmp_path / "set/meta/cameras.json").read_text())["fetch_head"]
    depth, seg, pose = (
        np.array(rows[f"{key}.fetch_head"][1].as_py())
        for key in ("observation.depth", "observation.segmentation", "camera_pose")
    )
    v, u = np.nonzero(seg == names.index("floor"))
    assert len(v) > 20
    z = depth[v, u] / 1000
    (fx, _, cx), (_, fy, cy), _ = camera["intrinsic"]
    points = np.stack([(u + 0.5 - cx) / fx * z, (v + 0.5 - cy) / fy * z, z])
    points *= np.array([[1.0], [-1.0], [-1.0]])  # the axes of OpenCV to those of "camera"
    world = pose[:3, :3] @ points + pose[:3, 3:]
    np.testing.assert_allclose(world[2], 0.0, atol=0.005)
    # The camera looks along its -z axis, which is the x axis of the link that carries it.
    np.testing.assert_allclose(
        quat_rotate(np.array(camera["quat"]), np.array([0.0, 0.0, -1.0])),
        [1, 0, 0],
        atol=1e-9,
    )


def test_statistics_of_parts_are_those_of_the_whole() -> None:
    rng = np.random.default_rng(0)
    pieces = [rng.normal(loc=i, size=(20 + 10 * i, 3)) for i in range(3)]
    whole = vector_stats(np.concatenate(pieces))
    parts = aggregate([{"a": vector_stats(p)} for p in pieces])["a"]
    for name in ("min", "max", "mean", "std", "count"):
        np.testing.assert_allclose(parts[name], whole[name])
    image = image_stats(np.full((4, 5, 6, 3), [0, 51, 255], np.uint8))
    assert image["mean"].shape == (3, 1, 1) and image[
        "mean"
    ].ravel().tolist() == pytest.approx([0.0, 0.2, 1.0])
    assert image["count"].tolist() == [4]


def test_words_and_names() -> None:
    names = state_names(
        {
            "agent/qpos": 12,
            "extra/tcp_pose_wrt_base": 7,
            "extra/is_grasped": 1,
            "other/new": 2,
        },
        {},
    )
    assert len(names) == len(set(names)) == 22
    assert (
        names[0] == "qpos.torso_lift"
        and names[15] == "tcp_pose_wrt_base.qw"
        and names[-1] == "new.1"
    )
