"""A shard of each schema version, written by the version of mjhab that had it, is read as one of today.

``shards/schema_N.h5`` holds two episodes of eight steps of Pick by a random policy: schema 1 a bowl in profile mjhab,
schemas 2 to 4 a sugar box, whose scan has a heading, in profile ms_hab. A new schema version adds one.
"""

from __future__ import annotations

import shutil
from pathlib import Path

import h5py
import numpy as np
import pyarrow.parquet as pq
import pytest
from scipy.spatial.transform import Rotation

from mjhab.core.conventions.names import OBJECT_AXES, SCAN_AXES
from mjhab.data.export.lerobot.parts import FilmTools
from mjhab.data.select.dataset import WindowDataset
from mjhab.data.select.query import Filter
from mjhab.data.select.relabel import relabel_shards
from mjhab.data.select.sets import merge, select
from mjhab.data.store.checking import check
from mjhab.data.store.hdf5 import dataset, group, read_arrays
from mjhab.data.store.reading import RecordedEpisode, open_shard
from mjhab.data.store.run_entries import SCAN_YAWS
from mjhab.data.store.schema import OLDEST, VERSION
from mjhab.render.film import FilmWriter, join_films
from tests.data.export.exporting import to_lerobot, to_maniskill

SHARDS = Path(__file__).parent / "shards"
VERSIONS = range(OLDEST, VERSION + 1)
STEPS = 8
POSES = (slice(24, 31), slice(31, 38))
"""Columns of the state with the pose of the tcp and that of the object: position, quaternion wxyz."""


@pytest.fixture(params=VERSIONS, ids=lambda version: f"schema_{version}")
def version(request: pytest.FixtureRequest) -> int:
    return request.param


@pytest.fixture
def shard(version: int, tmp_path: Path) -> Path:
    """A copy, so that nothing that a test does reaches the file of the repository."""
    return Path(shutil.copy(SHARDS / f"schema_{version}.h5", tmp_path))


def stored(shard: Path) -> dict[str, dict[str, np.ndarray]]:
    """The datasets of every episode as they are in the file, by name and path."""
    with h5py.File(shard, "r", locking=False) as file:
        episodes = group(file, "episodes")
        return {str(name): read_arrays(group(episodes, str(name))) for name in episodes}


def as_of_now(state: np.ndarray, episode: RecordedEpisode) -> np.ndarray:
    """The observed states (N+1, 42) of a version as the present one tells them, by scipy."""
    state = state.copy()
    heading = 0.0
    if episode.schema == 2:
        heading = episode.run.layout[SCAN_YAWS]["004_sugar_box"]
        assert heading != 0.0
    for columns, yaw in zip(POSES, (0.0, heading), strict=True):
        w, x, y, z = state[:, columns][:, 3:].T
        turn = Rotation.from_quat(np.stack([x, y, z, w], 1))
        turn *= Rotation.from_rotvec([0.0, 0.0, yaw])
        x, y, z, w = turn.as_quat(canonical=True).T
        state[:, columns.start + 3 : columns.stop] = np.stack([w, x, y, z], 1)
    return state


def test_there_is_a_shard_of_each_version() -> None:
    names = {f"schema_{version}.h5" for version in VERSIONS}
    assert {path.name for path in SHARDS.iterdir()} == names


def test_everything_is_read_as_it_was_recorded(shard: Path, version: int) -> None:
    raw = stored(shard)
    axes = {1: OBJECT_AXES}.get(version, SCAN_AXES)
    with open_shard(shard) as opened:
        assert [episode.record.index for episode in opened] == [0, 1]
        for episode in opened:
            assert episode.schema == version
            assert (episode.steps, episode.actors) == (STEPS, ("random",))
            assert episode.conventions.object_axes == axes
            (subtask,) = episode.record.subtasks
            assert (subtask.kind, subtask.label) == ("pick", "mobility_failure")
            arrays = raw[episode.name]
            assert set(episode.paths) == set(arrays)
            for path in set(arrays) - {"record", "obs/state"}:
                np.testing.assert_array_equal(episode.array(path), arrays[path])
            state = episode.array("obs/state")
            wanted = as_of_now(arrays["obs/state"], episode)
            np.testing.assert_allclose(state, wanted, atol=1e-6)
            assert episode.array("actions_intended").shape == (STEPS, 13)
            assert not episode.array("actor").any()
            assert (
                episode.initial()["sim"]["qpos"].shape == arrays["states/qpos"][0].shape
            )


def test_checks_filters_and_labels_take_it(shard: Path, version: int) -> None:
    report = check(shard)
    assert report.clean and dict(report.schemas) == {version: 2}
    found = select(shard, Filter("label == 'mobility_failure' and index == 1"))
    assert len(found.matched) == 1
    again = relabel_shards(shard)
    assert (again.episodes, again.subtasks, again.changes) == (2, 2, ())


def test_exports_and_windows_give_what_is_read(shard: Path, tmp_path: Path) -> None:
    with open_shard(shard) as opened:
        episodes = list(opened)
        states = [episode.array("obs/state") for episode in episodes]
        actions = [episode.array("actions") for episode in episodes]
    windows = WindowDataset(shard)
    assert len(windows) == 2 * STEPS
    np.testing.assert_array_equal(windows[STEPS - 1]["state"][0], states[0][-2])

    # A file per target; the last episode is the last of the last file.
    *_, file = to_maniskill(shard, tmp_path / "maniskill").files
    with h5py.File(file) as exported:
        last = group(exported, f"traj_{len(exported) - 1}")
        pose = dataset(last, "obs/extra/tcp_pose_wrt_base")
        np.testing.assert_array_equal(pose[()], states[1][:, POSES[0]])

    out = tmp_path / "lerobot"
    done = to_lerobot(shard, out, FilmTools(FilmWriter, join_films))
    assert (done.episodes, done.frames) == (2, 2 * STEPS)
    (table,) = (pq.read_table(path) for path in (out / "data").rglob("*.parquet"))
    told = np.stack(table["action"].to_numpy())
    np.testing.assert_array_equal(told, np.concatenate(actions))


def test_shards_of_all_versions_are_merged_unchanged(tmp_path: Path) -> None:
    merged = tmp_path / "merged.h5"
    sources = [SHARDS / f"schema_{version}.h5" for version in VERSIONS]
    copies = [Path(shutil.copy(path, tmp_path)) for path in sources]
    merge(copies, merged)
    report = check(merged)
    assert report.clean and dict(report.schemas) == dict.fromkeys(VERSIONS, 2)
    raw = stored(merged)
    for path in copies:
        for name, arrays in stored(path).items():
            for key, values in arrays.items():
                np.testing.assert_array_equal(raw[name][key], values)
