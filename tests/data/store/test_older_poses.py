"""Shards of schema 1 have quaternions of either sign among their observations: they are read as canonical ones."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from mjhab.data.select.dataset import WindowDataset
from mjhab.data.store.checking import check
from mjhab.data.store.hdf5 import dataset, group
from mjhab.data.store.reading import RecordedEpisode, open_shard
from tests.data.export.exporting import to_maniskill
from tests.data.fake_world import FakeEnv
from tests.data.make import make_older, record


class PoseEnv(FakeEnv):
    """A world whose observations hold poses, with canonical quaternions."""

    def _observe(self, *_: Any) -> dict[str, np.ndarray]:
        obs = super()._observe()
        obs.pop("state")
        for k, name in enumerate(("tcp", "obj")):
            pose = np.array(
                [world.qpos[7 * k : 7 * k + 7] for world in self.worlds], np.float32
            )
            pose[:, 3] = np.abs(pose[:, 3])
            obs[f"extra/{name}_pose_wrt_base"] = pose
        obs["state"] = np.concatenate(list(obs.values()), axis=1)
        return obs


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The same episodes as schema 2, and as schema 1 with signs drawn at random."""
    folder = tmp_path_factory.mktemp("poses")
    new = folder / "new.h5"
    old = folder / "old.h5"
    for path in (new, old):
        record(path, range(3), PoseEnv())
    rng = np.random.default_rng(0)
    with h5py.File(old, "r+") as file:
        for name in group(file, "episodes"):
            state = dataset(group(file, f"episodes/{name}"), "obs/state")
            values = state[()]
            for start in (5 + 3, 5 + 7 + 3):
                values[:, start : start + 4] *= rng.choice([-1.0, 1.0], len(values))[
                    :, None
                ]
            assert (values != state[()]).any()
            state[...] = values
    make_older(old)
    return new, old


def states(episode: RecordedEpisode) -> dict[str, np.ndarray]:
    return {
        key: episode.observation(key)
        for key in ("state", "extra/tcp_pose_wrt_base", "extra/obj_pose_wrt_base")
    }


def test_old_shards_are_read_as_canonical(shards: tuple[Path, Path]) -> None:
    new, old = shards
    assert check(old).clean
    with open_shard(new) as a, open_shard(old) as b:
        for one, other in zip(a, b, strict=True):
            for key, values in states(one).items():
                np.testing.assert_array_equal(states(other)[key], values)
            np.testing.assert_array_equal(
                one.array("states/qpos"), other.array("states/qpos")
            )


def test_windows_statistics_and_exports_of_old_and_new_agree(
    shards: tuple[Path, Path], tmp_path: Path
) -> None:
    one, other = (WindowDataset(path) for path in shards)
    for i in (0, len(one) // 2, len(one) - 1):
        np.testing.assert_array_equal(one[i]["state"], other[i]["state"])
    np.testing.assert_array_equal(
        one.statistics.mean["state"], other.statistics.mean["state"]
    )
    found = []
    for path in shards:
        done = to_maniskill(path, tmp_path / path.stem)
        with h5py.File(done.files[0]) as file:
            found.append(
                dataset(group(file, "traj_0"), "obs/extra/obj_pose_wrt_base")[()]
            )
    np.testing.assert_array_equal(*found)
    assert (found[0][:, 3] >= 0).all()
