"""Files of arrays that others wrote: bounded before they are unpacked."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import numpy as np
import pytest

from mjhab.core.files.arrays import open_arrays
from tests.refusals import refused


def read(path: Path, name: str = "a", most_mb: float = 1.0) -> np.ndarray:
    with open_arrays(path, "test file", most_mb) as arrays:
        return arrays[name]


def test_arrays_are_read_by_name(tmp_path: Path):
    path = tmp_path / "a.npz"
    np.savez_compressed(path, a=np.arange(6).reshape(2, 3), text=np.array("é"))
    with open_arrays(path, "test file", 1.0) as arrays:
        assert set(arrays) == {"a", "text"} and "b" not in arrays
        np.testing.assert_array_equal(arrays["a"], np.arange(6).reshape(2, 3))
        assert str(arrays["text"]) == "é"
    with refused(where="a.npz", said="array 'b' is missing; this is no test file"):
        read(path, "b")


def test_more_than_the_limit_is_not_unpacked(tmp_path: Path):
    path = tmp_path / "a.npz"
    np.savez_compressed(path, a=np.zeros(2**18))
    assert path.stat().st_size < 10_000
    with refused(where="a.npz", said="hold more than the 1 MB that are read"):
        read(path)
    assert read(path, most_mb=3.0).shape == (2**18,)


def test_all_arrays_together_stay_below_the_limit(tmp_path: Path):
    path = tmp_path / "a.npz"
    np.savez_compressed(path, a=np.zeros(2**16), b=np.zeros(2**16))
    with (
        refused(where="a.npz", said="hold more than"),
        open_arrays(path, "test file", 0.75) as arrays,
    ):
        assert len(arrays["a"]) == 2**16
        assert len(arrays["b"]) == 0


@pytest.mark.parametrize("shape", [(10**12, 3), (-1, 3), (7,), ()])
def test_a_header_that_states_another_size_takes_no_memory(
    shape: tuple[int, ...], tmp_path: Path
):
    stream = io.BytesIO()
    head = {"descr": "<f4", "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(stream, head)
    path = tmp_path / "a.npz"
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("a.npy", stream.getvalue() + bytes(100))
    with refused(where="a.npz", said="has another size than its shape"):
        read(path)


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04", b"x" * 100])
def test_what_is_no_file_of_arrays_is_one_line(content: bytes, tmp_path: Path):
    path = tmp_path / "a.npz"
    path.write_bytes(content)
    with refused(where="a.npz", said="damaged"):
        read(path)


def test_python_objects_are_not_loaded(tmp_path: Path):
    path = tmp_path / "a.npz"
    np.savez(path, allow_pickle=True, a=np.array([{}]))  # type: ignore[arg-type]
    with refused(where="a.npz", said="damaged"):
        read(path)
