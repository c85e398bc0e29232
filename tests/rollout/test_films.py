"""Films: which frames are shot, and that a broken camera does not stop an evaluation."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mjhab.rollout.films import FILM_FPS, FilmSink
from mjhab.rollout.loop import rollout
from mjhab.rollout.policy import ZeroPolicy
from tests.rollout.fake_env import FakeEnv


class FakeFilm:
    def __init__(self, path: Path, fps: int, broken: bool = False) -> None:
        self.path = path
        self.fps = fps
        self.broken = broken
        self.frames: list[np.ndarray] = []
        self.state = "open"

    def add(self, frame: np.ndarray) -> None:
        if self.broken:
            raise OSError("the encoder is gone")
        self.frames.append(frame)

    def close(self) -> None:
        self.state = "closed"

    def abort(self) -> None:
        self.state = "aborted"


class Studio:
    def __init__(self, broken: bool = False) -> None:
        self.films: dict[str, FakeFilm] = {}
        self.broken = broken

    def open(self, path: Path, fps: int) -> FakeFilm:
        return self.films.setdefault(path.name, FakeFilm(path, fps, self.broken))

    def sink(self, *indices: int, every: int = 2) -> FilmSink:
        return FilmSink(
            indices, lambda index: Path(f"{index}.mp4"), self.open, every=every
        )


def test_wanted_episodes_are_filmed_every_second_step() -> None:
    studio = Studio()
    records = rollout(
        FakeEnv(3), ZeroPolicy(), range(6), seed=0, sinks=[studio.sink(0, 4)]
    )
    assert sorted(studio.films) == ["0.mp4", "4.mp4"]
    for index in (0, 4):
        film = studio.films[f"{index}.mp4"]
        assert film.state == "closed" and film.fps == FILM_FPS
        assert len(film.frames) == 1 + records[index].steps // 2
        assert film.frames[0].shape == (360, 480, 3) and film.frames[0].dtype == np.uint8


def test_broken_camera_stops_films_and_not_episodes() -> None:
    studio = Studio()
    sink = studio.sink(0, 1, 2)
    records = rollout(
        FakeEnv(2, broken_camera=True), ZeroPolicy(), range(4), seed=0, sinks=[sink]
    )
    assert records == rollout(FakeEnv(2), ZeroPolicy(), range(4), seed=0)
    assert sink.problem == "RuntimeError: no renderer works here"
    assert {film.state for film in studio.films.values()} == {"aborted"}


def test_broken_encoder_stops_films_and_not_episodes() -> None:
    studio = Studio(broken=True)
    sink = studio.sink(0, 1)
    assert len(rollout(FakeEnv(2), ZeroPolicy(), range(3), seed=0, sinks=[sink])) == 3
    assert sink.problem == "OSError: the encoder is gone"


def test_unfinished_films_are_aborted_on_interrupt() -> None:
    studio = Studio()
    env = FakeEnv(2)
    env.interrupt_at = 5
    with pytest.raises(KeyboardInterrupt):
        rollout(env, ZeroPolicy(), range(2), seed=0, sinks=[studio.sink(0, 1)])
    assert [film.state for film in studio.films.values()] == ["aborted", "aborted"]
