"""LeRobot exports as policies ask for them: splits, states, skills, wordings, clouds, lossless colours, long films."""

from __future__ import annotations

import io
import json
import re
import subprocess
from pathlib import Path
from typing import Any

import imageio_ffmpeg
import numpy as np
import pyarrow.parquet as pq
import pytest
from PIL import Image

from mjhab.data.export.lerobot import files as layout
from mjhab.data.export.lerobot.features import Choice
from mjhab.data.export.lerobot.parts import FilmTools
from mjhab.data.record.recorder import Recorder
from mjhab.data.select.own_state import base_velocity
from mjhab.data.store.images import ImageFormat
from mjhab.data.store.places import episodes
from mjhab.data.store.shard import ShardWriter
from mjhab.evaluation.datasets.export import film_frames
from mjhab.evaluation.publishing.check import check_set
from mjhab.render.film import FilmWriter, join_films
from mjhab.rollout.loop import rollout
from tests.data.export.exporting import to_lerobot
from tests.data.fake_world import FakeEnv
from tests.data.make import record
from tests.data.store.test_annotations import Telling
from tests.refusals import refused

RGB = "observation.images.fetch_head"
HELD_OUT = "builtin_m1_00"
FILMS = FilmTools(
    lambda path, fps: FilmWriter(path, fps, 10, 2), join_films, {}, film_frames
)


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five episodes of a policy that tells its skills."""
    path = tmp_path_factory.mktemp("source") / "a.h5"
    env: Any = FakeEnv(subtask="pick", images=True, horizon=7)
    with ShardWriter(path) as writer:
        recorder = Recorder(writer, env, {"name": "random"}, images=ImageFormat())
        rollout(env, Telling(), range(5), 0, [recorder])
    return path


def rows_of(folder: Path) -> dict[str, Any]:
    return pq.read_table(folder / "data/chunk-000/file-000.parquet").to_pydict()


def test_splits_states_skills_and_wordings(source: Path, tmp_path: Path) -> None:
    choice = Choice(
        depth=False, colours="png", state="recorded", language=True, held_out=(HELD_OUT,)
    )
    to_lerobot(source, tmp_path / "set", FILMS, choice=choice)
    recorded = list(episodes(source))
    order = [e for e in recorded if e.record.home != HELD_OUT]
    count = len(order)
    order += [e for e in recorded if e.record.home == HELD_OUT]
    assert 0 < count < len(order)
    info = json.loads((tmp_path / "set/meta/info.json").read_text())
    assert info["splits"] == {"train": f"0:{count}", "val": f"{count}:{len(order)}"}
    rows = rows_of(tmp_path / "set")
    for name, path in (("observation.state", "obs/state"), ("action", "actions")):
        wanted = np.concatenate([e.array(path)[: e.steps] for e in order])
        np.testing.assert_array_equal(np.stack(rows[name]), wanted)
    assert "observation.environment_state" not in info["features"]
    wanted = np.concatenate([base_velocity(e)[: e.steps] for e in order])
    np.testing.assert_array_equal(np.stack(rows["base_velocity"]), wanted)
    assert info["features"]["base_velocity"]["names"] == ["forward", "left", "yaw"]
    skills = pq.read_table(tmp_path / "set/meta/skills.parquet").to_pydict()
    names = skills["__index_level_0__"]
    told = [names[k] for k in rows["skill_index"]]
    assert told[:7] == ["approach"] * 3 + ["lift"] * 4
    language = rows["language_persistent"][0]
    assert [(each["style"], each["content"]) for each in language] == [
        ("task_aug", "pick 024_bowl_:0000"),
        ("task_aug", "please pick"),
        ("subtask", "reach for the object"),
        ("subtask", "lift"),
    ]
    assert [round(each["timestamp"] * 20) for each in language] == [0, 0, 0, 3]
    meta = pq.read_table(tmp_path / "set/meta/episodes/chunk-000/file-000.parquet")
    assert json.loads(meta["skills"][0].as_py()) == [
        ["approach", "reach for the object", 0, 3],
        ["lift", "lift", 3, 7],
    ]
    card = (tmp_path / "set/README.md").read_text()
    for word in (
        "license: apache-2.0",
        "`language_persistent`",
        "val",
        "`base_velocity`",
        "LeRobotDataset(",
    ):
        assert word in card


def test_colours_without_loss(source: Path, tmp_path: Path) -> None:
    to_lerobot(source, tmp_path / "set", FILMS, choice=Choice(depth=False, colours="png"))
    info = json.loads((tmp_path / "set/meta/info.json").read_text())
    assert info["features"][RGB]["dtype"] == "image" and info["video_path"] is None
    shown = [
        np.asarray(Image.open(io.BytesIO(each["bytes"])))
        for each in rows_of(tmp_path / "set")[RGB]
    ]
    wanted = [
        e.frame("fetch_head", "rgb", t) for e in episodes(source) for t in range(e.steps)
    ]
    np.testing.assert_array_equal(np.stack(shown), np.stack(wanted))
    stats = json.loads((tmp_path / "set/meta/stats.json").read_text())[RGB]
    assert np.shape(stats["mean"]) == (3, 1, 1)


def test_quantiles_are_those_of_all_rows(source: Path, tmp_path: Path) -> None:
    to_lerobot(source, tmp_path / "set", FILMS, choice=Choice(rgb=False, depth=False))
    stats = json.loads((tmp_path / "set/meta/stats.json").read_text())
    actions = np.concatenate([e.array("actions") for e in episodes(source)])
    for name, share in (("q01", 0.01), ("q50", 0.5), ("q99", 0.99)):
        np.testing.assert_allclose(
            stats["action"][name], np.quantile(actions, share, axis=0)
        )
    # Columns that never change have one value everywhere, and no spread.
    constant = stats["task_index"]
    assert constant["std"] == [0.0]
    assert {constant[name][0] for name in ("min", "max", "mean", "q01", "q99")} == {0.0}


def test_files_are_listed_and_roll_over(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(layout, "VIDEO_MB", 0.0005)
    monkeypatch.setattr(layout, "DATA_MB", 0.002)
    out = tmp_path / "set"
    to_lerobot(source, out, FILMS, choice=Choice(depth=False))
    tables = sorted((out / "data").rglob("*.parquet"))
    films = sorted((out / "videos").rglob("*.mp4"))
    assert len(tables) > 1 and len(films) > 1
    meta = pq.read_table(out / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    for row, episode in zip(meta, episodes(source), strict=True):
        place = f"chunk-000/file-{row['data/file_index']:03d}.parquet"
        rows = pq.read_table(out / "data" / place)
        assert row["episode_index"] in rows["episode_index"].to_pylist()
        place = f"chunk-000/file-{row[f'videos/{RGB}/file_index']:03d}.mp4"
        shown = list(film_frames(out / "videos" / RGB / place))
        first = round(row[f"videos/{RGB}/from_timestamp"] * 20)
        wanted = episode.frame("fetch_head", "rgb", 0).astype(int)
        assert np.abs(shown[first].astype(int) - wanted).mean() < 8
    assert check_set(out) == []
    films[0].write_bytes(films[0].read_bytes()[:-1])
    (wrong,) = check_set(out)
    assert films[0].relative_to(out).as_posix() in wrong
    assert "dB" in (out / "README.md").read_text()


def test_times_of_a_film_of_many_parts_are_those_of_its_frames(tmp_path: Path) -> None:
    """No part shifts those after it: times are counted from frames, not summed up from durations."""
    lengths = (3, 7, 2)
    grey = iter(range(10, 250, 15))
    levels = [[next(grey) for _ in range(length)] for length in lengths]
    parts = []
    for number, each in enumerate(levels):
        parts.append(tmp_path / f"{number}.mp4")
        with FilmWriter(parts[-1], 20, 10, 2) as film:
            for level in each:
                film.add(np.full((16, 16, 3), level, np.uint8))
    join_films(parts * 40, tmp_path / "all.mp4")
    shown = [frame.mean() for frame in film_frames(tmp_path / "all.mp4")]
    assert len(shown) == 40 * 12
    np.testing.assert_allclose(
        shown, [level for each in levels for level in each] * 40, atol=3
    )
    command = [
        imageio_ffmpeg.get_ffmpeg_exe(),
        "-loglevel",
        "error",
        "-i",
        tmp_path / "all.mp4",
    ]
    done = subprocess.run(
        [*map(str, command), "-f", "framemd5", "-"],
        capture_output=True,
        text=True,
        check=True,
    )
    unit = re.search(r"#tb 0: (\d+)/(\d+)", done.stdout)
    assert unit is not None
    scale = int(unit[1]) / int(unit[2])
    lines = [line for line in done.stdout.splitlines() if not line.startswith("#")]
    times = [int(line.split(",")[2]) * scale for line in lines]
    np.testing.assert_allclose(times, np.arange(40 * 12) / 20, atol=1e-4)


def test_clouds_need_images(tmp_path: Path) -> None:
    record(tmp_path / "a.h5", [0], FakeEnv())
    with refused(where="a.h5", said="render rgbd"):
        to_lerobot(tmp_path / "a.h5", tmp_path / "set", FILMS, choice=Choice(points=8))
    assert not (tmp_path / "set").exists()


def test_names_of_options(tmp_path: Path) -> None:
    from mjhab.evaluation.datasets.specs import LerobotSpec, ReplaySpec

    out = tmp_path / "x"
    with refused("colours", given="jpeg", expected="png"):
        LerobotSpec.of("a", out=out, colours="jpeg")
    with refused("state", given="all", expected="recorded"):
        LerobotSpec.of("a", out=out, state="all")
    with refused(given="pd_joint_vel", expected="pd_joint_pos"):
        LerobotSpec.of("a", out=out, actions="pd_joint_vel")
    with refused("actions", given="pd_joint_pos"):
        ReplaySpec.of("a", render="rgb", out=tmp_path / "b.h5", actions="pd_joint_pos")
    splits = tmp_path / "splits.json"
    splits.write_text('{"val": {"homes": "kitchen"}}')
    with refused(where=splits, said="no homes"):
        LerobotSpec.of("a", out=out, splits=splits)
    splits.write_text('{"val": {"homes": ["kitchen"]}}')
    assert LerobotSpec.of("a", out=out, splits=splits).held_out() == ("kitchen",)
