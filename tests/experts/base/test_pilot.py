"""Steering along a way: it is what the simulated drive follows, step by step."""

from __future__ import annotations

import numpy as np
import pytest

from mjhab.core.timing import STEP_SECONDS
from mjhab.experts.arm.gentle import FIRM
from mjhab.experts.base.pilot import MAX_SPEED_M_S, Pilot, simulate

CORNER = np.array([[0.0, 0.0], [1.0, 0.2], [1.3, 1.2]])


@pytest.mark.parametrize("care", [None, FIRM])
def test_a_simulated_drive_ends_at_the_end_of_the_way(limits) -> None:
    poses = simulate(np.array([0.0, 0.0, 2.0]), CORNER, 0.5, 1, 0.2, limits)
    assert np.linalg.norm(poses[-1, :2] - CORNER[-1]) < 0.05
    assert abs(poses[-1, 2] - 0.5) < 0.1
    steps = np.linalg.norm(np.diff(poses[:, :2], axis=0), axis=1)
    assert steps.max() <= MAX_SPEED_M_S * STEP_SECONDS + 1e-9
    if limits is not None:
        assert np.abs(np.diff(poses[:, 2])).max() <= limits.spin * STEP_SECONDS + 1e-9


def test_a_pilot_asks_for_what_the_simulation_drove() -> None:
    pose = np.array([0.0, 0.0, 0.3])
    poses = simulate(pose, CORNER, 0.5, 1, 0.2)
    pilot = Pilot(CORNER, 0.5, 1, 0.2)
    done = [pilot.step(pose)[2] for pose in poses]
    assert done[-1] and not any(done[:-1])


def test_a_base_that_is_there_only_turns() -> None:
    forward, turn, done = Pilot(np.zeros((2, 2)), 1.0, 1, 0.2).step(np.zeros(3))
    assert forward == 0.0 and turn > 0.0 and not done
