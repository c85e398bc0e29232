from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from mjhab.experts.base.limits import (
    FIRM,
    WEAK,
    WEAK_FAST,
    CommandLimits,
    eased,
    limits_for,
)


def view_with(**objects: tuple[float, float]) -> Any:
    """A view with objects of a mass [kg] so far [m] from the hand."""
    pose = {
        name: np.array([1.0, 2.0, 1.0 - far, 1, 0, 0, 0])
        for name, (_, far) in objects.items()
    }
    return SimpleNamespace(
        tcp_pose=np.array([1.0, 2.0, 1.0, 1, 0, 0, 0]),
        object_names=tuple(objects),
        object_pose=pose.__getitem__,
        object_type=lambda name: SimpleNamespace(mass=objects[name][0]),
    )


@pytest.mark.parametrize(
    ("objects", "limits"),
    [
        ({}, FIRM),
        ({"box": (0.5, 0.05)}, WEAK),
        ({"box": (0.5, 0.02)}, FIRM),
        ({"bowl": (0.15, 0.08)}, FIRM),
    ],
)
def test_a_heavy_object_held_far_from_its_centre_is_driven_with_tighter_limits(
    objects, limits
):
    assert limits_for(view_with(**objects)) == limits


def test_fast_mode_limits_what_is_heavy_less():
    heavy = view_with(box=(0.5, 0.05))
    light = view_with(bowl=(0.15, 0.08))
    assert (
        limits_for(heavy, fast=True) == WEAK_FAST and limits_for(light, fast=True) == FIRM
    )
    assert WEAK.change < WEAK_FAST.change < FIRM.change and WEAK.spin <= WEAK_FAST.spin


def test_only_the_object_in_the_hand_counts():
    assert limits_for(view_with(apple=(0.07, 0.01), box=(0.5, 1.5))) == FIRM


@pytest.mark.parametrize("limits", [FIRM, WEAK])
def test_speeds_change_by_little_and_turns_end_sooner_than_they_begin(
    limits: CommandLimits,
):
    assert eased((1.0, 3.0), (0.0, 0.0), limits) == pytest.approx(
        (limits.rise, limits.change)
    )
    assert eased((0.0, 0.0), (1.0, 1.0), limits) == pytest.approx(
        (1.0 - limits.brake, 1.0 - limits.fall)
    )
    assert eased((0.0, -3.0), (0.0, -limits.spin), limits) == pytest.approx(
        (0.0, -limits.spin)
    )
    assert eased((0.0, 3.0), (0.0, -1.0), limits)[1] == pytest.approx(-1.0 + limits.fall)
