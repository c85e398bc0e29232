"""Places of cameras from texts and numbers, and what is refused."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from mjhab.scenes.free_camera import free_camera, place_of
from tests.refusals import refused


def test_places_are_texts_or_numbers() -> None:
    assert np.array_equal(place_of("camera", "1,-2.5, 3e0"), [1.0, -2.5, 3.0])
    assert np.array_equal(place_of("camera", (1, 2, 3)), [1.0, 2.0, 3.0])
    found = free_camera("0,0,1", (0, 1, 1), 90.0)
    assert found is not None and np.isclose(found.fovy, np.pi / 2)
    assert free_camera(None, None, 55.0) is None
    turned = free_camera("0,0,1", None, 55.0)
    assert turned is not None and np.isnan(turned.target).all()


@pytest.mark.parametrize(
    "given", ["1,2", "1,2,3,4", "a,b,c", "", "nan,0,0", "1e9,0,0", (1, 2)]
)
def test_no_places(given: Any) -> None:
    with refused("camera", given):
        place_of("camera", given)


def test_what_a_camera_needs() -> None:
    with refused("camera", None):
        free_camera(None, "1,2,3", 55.0)
    with refused("look_at", "1,2,3"):
        free_camera("1,2,3", "1,2,3", 55.0)
