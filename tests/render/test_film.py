"""Films decode to the frames that went in, and appear only when complete."""

from __future__ import annotations

from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest

from mjhab.core.errors import MjhabError
from mjhab.render.film import FilmWriter, join_films
from tests.refusals import refused


def decode(path):
    """Frames (T, H, W, 3) and metadata of an mp4."""
    reader = imageio_ffmpeg.read_frames(str(path))
    meta = next(reader)
    width, height = meta["size"]
    return np.array(
        [np.frombuffer(f, np.uint8).reshape(height, width, 3) for f in reader]
    ), meta


def write_film(path, images, fps=20.0):
    with FilmWriter(path, fps) as film:
        for image in images:
            film.add(image)
    return film.frames


def frames(count, height, width):
    """A white block that wanders over a red ground."""
    for t in range(count):
        image = np.zeros((height, width, 3), np.uint8)
        image[..., 0] = 160
        image[8:24, 4 + 2 * t : 20 + 2 * t] = 255
        yield image


@pytest.mark.parametrize("size", [(48, 64), (47, 63)])
def test_film_decodes_to_the_frames_that_went_in(tmp_path, size):
    path = tmp_path / "new" / "film.mp4"
    assert write_film(path, frames(12, *size), fps=20) == 12
    got, meta = decode(path)
    assert got.shape == (12, 48, 64, 3)
    assert (
        meta["codec"] == "h264"
        and meta["pix_fmt"].startswith("yuv420p")
        and meta["fps"] == pytest.approx(20)
    )
    want = np.array(list(frames(12, 48, 64)), int)
    assert np.abs(got.astype(int) - want).mean() < 12 and got.mean() > 50
    assert [p.name for p in path.parent.iterdir()] == ["film.mp4"]


def test_the_index_comes_first_so_that_browsers_can_start_early(tmp_path):
    write_film(tmp_path / "a.mp4", frames(4, 32, 32))
    data = (tmp_path / "a.mp4").read_bytes()
    assert data.index(b"moov") < data.index(b"mdat")


def test_a_colon_in_a_relative_path_is_no_protocol(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    parts = [Path("12:30/a.mp4"), Path("12:30/b's.mp4")]
    for part in parts:
        write_film(part, frames(3, 32, 32))
    join_films(parts, Path("12:30.mp4"))
    assert len(decode(tmp_path / "12:30.mp4")[0]) == 6


def test_an_error_leaves_no_file(tmp_path):
    with (
        pytest.raises(RuntimeError, match="stop"),
        FilmWriter(tmp_path / "a.mp4") as film,
    ):
        film.add(next(frames(1, 32, 32)))
        raise RuntimeError("stop")
    assert not list(tmp_path.iterdir())


def test_bad_frames_are_named(tmp_path):
    with (
        refused("film frame", expected="(H, W, 3) uint8"),
        FilmWriter(tmp_path / "a.mp4") as film,
    ):
        film.add(np.zeros((8, 8, 3)))
    with (
        refused("film frame", (32, 34)),
        FilmWriter(tmp_path / "a.mp4") as film,
    ):
        film.add(np.zeros((32, 32, 3), np.uint8))
        film.add(np.zeros((32, 34, 3), np.uint8))
    with (
        refused(where="a.mp4", said="at least one frame"),
        FilmWriter(tmp_path / "a.mp4"),
    ):
        pass
    assert not list(tmp_path.iterdir())


def test_ffmpeg_failures_carry_its_message(tmp_path):
    with (
        pytest.raises(MjhabError, match="ffmpeg could not write"),
        FilmWriter(tmp_path / "a.mp4", fps=-1.0) as film,
    ):
        for frame in frames(200, 256, 256):
            film.add(frame)
    assert not list(tmp_path.iterdir())
