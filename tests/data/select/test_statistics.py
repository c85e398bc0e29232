"""Files of statistics: read as written, and one line for what is none."""

import json
from pathlib import Path

import numpy as np
import pytest

from mjhab.data.select.statistics import Statistics
from tests.refusals import refused


def saved(path: Path) -> Path:
    numbers = {"action": np.arange(3.0)}
    Statistics(
        mean=numbers, std=numbers, low=numbers, high=numbers, fingerprint="abc"
    ).save(path)
    return path


def test_statistics_are_read_as_written(tmp_path: Path):
    found = Statistics.load(saved(tmp_path / "s.npz"))
    assert found.fingerprint == "abc"
    np.testing.assert_array_equal(found.mean["action"], np.arange(3.0))


@pytest.mark.parametrize(
    "head", [[], None, {"format": "other", "of": "abc"}, {"format": "mjhab-statistics-1"}]
)
def test_another_head_is_refused(tmp_path: Path, head: object):
    path = tmp_path / "s.npz"
    np.savez(path, head=np.frombuffer(json.dumps(head).encode(), np.uint8))
    with refused(where="s.npz", said="file of statistics"):
        Statistics.load(path)


@pytest.mark.parametrize("keep", [0, 10, 200])
def test_a_cut_file_is_refused(tmp_path: Path, keep: int):
    path = saved(tmp_path / "s.npz")
    path.write_bytes(path.read_bytes()[:keep])
    with refused(where="s.npz", said="file of statistics"):
        Statistics.load(path)
