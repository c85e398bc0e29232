"""`filming.FilmCrew`: worlds that are filmed together look as those filmed alone."""

from __future__ import annotations

import dataclasses

import numpy as np

import mjhab
from mjhab.evaluation.filming import FilmCrew

SIZE = (64, 36)


def test_worlds_are_drawn_together_as_alone_and_diverged_ones_are_black() -> None:
    env = mjhab.make(task="set_table", num_envs=3, threads=2, seed=3)
    _, info = env.reset()
    crew, other = FilmCrew(*SIZE), FilmCrew(*SIZE)
    together = crew.shoot(env, [0, 2], info)
    for world, frame in zip((0, 2), together, strict=True):
        (alone,) = other.shoot(env, [world], info)
        np.testing.assert_array_equal(frame, alone)
        assert frame.shape == (36, 64, 3) and frame.std() > 10.0
    body_pos = env.state.body_pos.copy()
    body_pos[2] = np.nan
    env.state = dataclasses.replace(env.state, body_pos=body_pos)
    first, second = crew.shoot(env, [0, 2], info)
    np.testing.assert_array_equal(first, together[0])
    assert not second.any()
