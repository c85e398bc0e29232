"""Compiled loops of a control step that no other test looks at by themselves."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from mjhab.core.kernels.control_step import is_sound

WORLDS = 3
LEAST = -0.02


@given(seed=st.integers(0, 2**32 - 1), faults=st.sets(st.sampled_from("dwq")))
def test_a_step_is_sound_without_depth_warnings_and_odd_numbers(
    seed: int, faults: set[str]
) -> None:
    rng = np.random.default_rng(seed)
    sensors = rng.normal(0.0, 0.001, (WORLDS, 5))
    warned = rng.integers(0, 3, (WORLDS, 4), dtype=np.int32)
    warnings = warned.copy()
    qpos = rng.normal(0.0, 1e3, (WORLDS, 6))
    world = int(rng.integers(WORLDS))
    if "d" in faults:
        sensors[world, 2] = -0.021
    if "w" in faults:
        warnings[world, rng.integers(4)] += 1
    if "q" in faults:
        qpos[world, rng.integers(6)] = rng.choice((np.nan, np.inf, -np.inf))
    # Other sensors may read what they like.
    sensors[:, 3] = -1.0
    assert is_sound(sensors, 2, LEAST, warnings, warned, qpos) == (not faults)
