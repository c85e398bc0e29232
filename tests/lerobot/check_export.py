"""Load an exported data set with the real lerobot package and compare frames with the shards it was made from.

    make test-lerobot                       # records, exports and checks a set
    python check_export.py EXPORT SHARDS    # in an environment that has lerobot

It runs apart from the test suite: lerobot needs other versions of numpy and torch than mjhab.
"""

from __future__ import annotations

import io
import json
import sys
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset  # pyright: ignore[reportMissingImports]
from PIL import Image

FPS = 20
MOST_ERROR = 8.0
"""Mean error of a film's pixels, of 255: 4:2:0 colour and x264 cost about 3 at 128 x 128."""
OTHERS = (-10, -1, 1, 10)
"""Neighbours that a frame must not fit better than its own."""


ERRORS: list[float] = []


def source_of(shards: Path, name: str) -> Any:
    """The group of an episode in the shards, read with h5py alone."""
    for path in sorted(shards.rglob("*.h5")):
        file: Any = h5py.File(path, "r", locking=False)
        if name in file["episodes"]:
            return file["episodes"][name]
    raise LookupError(name)


def image(group: Any, camera: str, output: str, t: int) -> np.ndarray:
    """A stored image, decoded."""
    stored = group[f"images/{camera}/{output}"]
    ends = [0, *stored["ends"][()]]
    return np.asarray(
        Image.open(io.BytesIO(stored["bytes"][ends[t] : ends[t + 1]].tobytes()))
    )


def check_frame(data: LeRobotDataset, row: int, group: Any, t: int) -> None:
    """Compare everything of a row with state t of its source."""
    item = data[row]
    assert abs(float(item["timestamp"]) - t / FPS) < 1e-5, (item["timestamp"], t)
    state = set(np.round(group["obs/state"][t], 5).tolist())
    told = [
        *item["observation.state"].tolist(),
        *item["observation.environment_state"].tolist(),
    ]
    # Both together are the recorded state and, with it, the velocity of the base.
    assert state <= set(np.round(np.array(told, np.float32), 5).tolist())
    np.testing.assert_allclose(item["action"], group["actions"][t], atol=1e-6)
    assert bool(item["next.success"]) == bool(group["reward/success"][t])
    for key in data.features:
        camera = key.rpartition(".")[2]
        if key.startswith("observation.depth."):
            np.testing.assert_array_equal(item[key], image(group, camera, "depth", t))
        if key.startswith("observation.segmentation."):
            np.testing.assert_array_equal(item[key], image(group, camera, "seg", t))
        if key.startswith("camera_pose."):
            poses = group[f"obs/sensor_param/{camera}/cam2world_gl"]
            np.testing.assert_array_equal(item[key], poses[t])
        if key.startswith("observation.images."):
            shown = item[key].numpy().transpose(1, 2, 0) * 255
            states = [
                t,
                *(t + by for by in OTHERS if 0 <= t + by < len(group["obs/state"])),
            ]
            errors = [
                float(np.abs(shown - image(group, camera, "rgb", state)).mean())
                for state in states
            ]
            assert errors[0] < MOST_ERROR, (
                f"{key} at {t}: mean error {errors[0]:.1f} of 255"
            )
            assert errors[0] <= min(errors[1:]) + 0.05, (
                f"{key} at {t} is another frame: {errors}"
            )
            ERRORS.append(errors[0])


def main(export: Path, shards: Path) -> None:
    """Check the first, a middle and the last row of every episode."""
    data = LeRobotDataset("mjhab/check", root=export, video_backend="pyav")
    rows = episodes(data, export)
    assert sum(length for _, length, _ in rows) == len(data) == data.num_frames
    for first, length, name in rows:
        group = source_of(shards, name)
        assert length == group.attrs["steps"]
        for t in (0, length // 2, length - 1):
            check_frame(data, first + t, group, t)
    kinds = (
        "observation.images.",
        "observation.depth.",
        "observation.segmentation.",
        "camera_pose.",
    )
    assert all(any(key.startswith(kind) for key in data.features) for kind in kinds)
    names = json.loads((export / "meta/segments.json").read_text())
    item = data[0]
    seen = np.unique(next(value for key, value in item.items() if "segmentation" in key))
    assert len(seen) > 2 and seen.max() < len(names) and "floor" in names
    window = LeRobotDataset(
        "mjhab/check",
        root=export,
        video_backend="pyav",
        delta_timestamps={
            "action": [0, 1 / FPS, 2 / FPS],
            "observation.state": [-1 / FPS, 0],
        },
    )
    assert window[0]["action"].shape == (3, item["action"].shape[0])
    error = f", mean error of film pixels {np.mean(ERRORS):.2f} of 255" if ERRORS else ""
    print(
        f"ok: {len(rows)} episodes, {len(data)} frames{error}; {item['task']!r}, {item.get('subtask')!r}"
    )


def episodes(data: LeRobotDataset, export: Path) -> list[tuple[int, int, str]]:
    """First row, number of rows and source of every episode."""
    version = json.loads((export / "meta/info.json").read_text())["codebase_version"]
    if version == "v3.0":
        return [
            (e["dataset_from_index"], e["length"], e["source"])
            for e in data.meta.episodes
        ]
    first = 0
    rows = []
    for entry in data.meta.episodes.values():
        rows.append((first, entry["length"], entry["source"]))
        first += entry["length"]
    return rows


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
