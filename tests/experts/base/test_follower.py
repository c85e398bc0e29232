"""Following a path: it is what the simulated drive follows, step by step."""

from __future__ import annotations

import numpy as np
import pytest

from mjhab.core.timing import STEP_SECONDS
from mjhab.experts.base.follower import Follower, PathSegment, simulate, turns
from mjhab.experts.base.limits import (
    DRIVE_FREE,
    DRIVE_HELD,
    FIRM,
    MAX_SPEED_M_S,
    UNLIMITED,
    CommandLimits,
)

CORNER = PathSegment(np.array([[0.0, 0.0], [1.0, 0.2], [1.3, 1.2]]), 1, 0.5)
BACK = PathSegment(np.array([[1.3, 1.2], [0.8, 1.0]]), -1, 0.4)


@pytest.mark.parametrize("limits", [UNLIMITED, FIRM, DRIVE_FREE, DRIVE_HELD])
@pytest.mark.parametrize("segments", [[CORNER], [CORNER, BACK]])
def test_a_simulated_drive_ends_at_the_end_of_the_path(
    segments: list[PathSegment], limits: CommandLimits
) -> None:
    poses = simulate(np.array([0.0, 0.0, 2.0]), segments, 0.2, limits)
    assert np.linalg.norm(poses[-1, :2] - segments[-1].points[-1]) < 0.07
    assert abs(poses[-1, 2] - segments[-1].yaw) < 0.1
    steps = np.linalg.norm(np.diff(poses[:, :2], axis=0), axis=1)
    assert steps.max() <= min(limits.speed, MAX_SPEED_M_S) * STEP_SECONDS + 1e-9
    assert np.abs(np.diff(poses[:, 2])).max() <= limits.spin * STEP_SECONDS + 1e-9


@pytest.mark.parametrize("segments", [[CORNER], [*turns(np.zeros(2), 0.3, 3.0), CORNER]])
def test_a_follower_asks_for_what_the_simulation_drove(
    segments: list[PathSegment],
) -> None:
    pose = np.array([0.0, 0.0, 0.3])
    poses = simulate(pose, segments, 0.2)
    follower = Follower(segments, 0.2)
    done = []
    for pose in poses:
        follower.step(pose)
        done.append(follower.arrived)
    assert done[-1] and not any(done[:-1])
    assert follower.segment is None


def test_a_base_that_is_there_only_turns() -> None:
    follower = Follower([PathSegment(np.zeros((2, 2)), 1, 1.0)], 0.2)
    forward, turn = follower.step(np.zeros(3))
    assert forward == 0.0 and turn > 0.0 and not follower.arrived


def test_no_segments_are_no_drive() -> None:
    assert len(simulate(np.zeros(3), [], 0.2)) == 1 and Follower([], 0.2).arrived
