"""What a server of roboarena is sent: the keys of DROID as DROID defines them."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mjhab.serving.dialects.roboarena import RoboArena
from tests.serving.constant import an_ask

GREETING = {"n_external_cameras": 1, "needs_wrist_camera": True}
HALF = math.pi / 2


@pytest.mark.parametrize(
    "angles",
    [
        (0.0, 0.0, 0.0),
        (0.3, -0.7, 2.0),
        (math.pi, 0.0, 0.0),
        (math.pi, 0.4, -1.0),
        (0.0, HALF, 0.0),
        (0.5, HALF, 0.2),
        (0.5, -HALF, 0.2),
    ],
    ids=[
        "level",
        "any",
        "upside down",
        "upside down, turned",
        "down",
        "down, turned",
        "up",
    ],
)
def test_cartesian_position_is_that_of_droid(angles: tuple[float, float, float]) -> None:
    """droid/misc/transformations.py: position, and scipy's "xyz" angles, of quaternions xyzw there and wxyz here."""
    turn = Rotation.from_euler("xyz", angles)
    x, y, z, w = turn.as_quat()
    ask = dataclasses.replace(an_ask(), tcp=np.array([0.6, -0.1, 0.9, w, x, y, z]))
    sent = RoboArena().request([ask], GREETING, False)["observation/cartesian_position"]
    assert sent.shape == (6,) and sent.dtype == np.float32
    np.testing.assert_allclose(sent[:3], [0.6, -0.1, 0.9], rtol=1e-6)
    apart = Rotation.from_euler("xyz", sent[3:].astype(float)) * turn.inv()
    assert apart.magnitude() < 1e-6
    if abs(angles[1]) < HALF:
        np.testing.assert_allclose(
            np.exp(1j * sent[3:]), np.exp(1j * np.array(angles)), atol=1e-6
        )
    else:
        assert sent[5] == 0.0


@pytest.mark.parametrize(
    ("wanted", "external", "wrist"),
    [({}, True, True), (GREETING, True, True), ({"n_external_cameras": 0}, False, True)],
)
def test_images_have_the_names_of_roboarena_and_of_droid(
    wanted: dict[str, int], external: bool, wrist: bool
) -> None:
    sent = RoboArena().request([an_ask()], wanted, False)
    names = ("observation/exterior_image_0_left", "observation/exterior_image_1_left")
    assert [name in sent for name in names] == [external] * 2
    assert ("observation/wrist_image_left" in sent) == wrist
