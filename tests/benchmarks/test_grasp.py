"""Grasped objects stay in the moving hand."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from benchmarks.grasp import BENCH_OBJECTS, GraspBench, grasp_table
from mjhab.robots.fetch.model import FINGER_LINKS, TCP_LINK
from tests.refusals import refused


@pytest.fixture(scope="module")
def table() -> list[dict[str, object]]:
    return grasp_table(seconds=10.0, seed=0)


def test_nothing_is_dropped(table: list[dict[str, object]]) -> None:
    assert [row["object"] for row in table] == list(BENCH_OBJECTS)
    assert not [row["object"] for row in table if row["dropped"]]
    assert list(table[0]) == [
        "object",
        "slip_mm",
        "rotation_deg",
        "grasp_share",
        "dropped",
        "force_n",
    ]


def test_slip_and_rotation_stay_small(table: list[dict[str, object]]) -> None:
    for row in table:
        assert float(str(row["slip_mm"])) < 25.0, row
        assert float(str(row["rotation_deg"])) < 15.0, row


def test_the_grasp_test_holds_most_of_the_time(table: list[dict[str, object]]) -> None:
    for row in table:
        assert float(str(row["grasp_share"])) > (
            0.8 if row["object"] == "024_bowl" else 0.98
        ), row


def test_the_same_seed_gives_the_same_row() -> None:
    first, second = (
        grasp_table(seconds=1.0, seed=3, objects=("010_potted_meat_can",))
        for _ in range(2)
    )
    assert first == second


def test_unknown_object_is_refused() -> None:
    with refused("bench object", "apple", expected="013_apple"):
        grasp_table(objects=("apple",))


def test_a_box_that_friction_pulls_at_45_degrees_counts_as_grasped() -> None:
    """The grasp test looks at contact normals: how strongly the box is pulled along the pads does not matter."""
    bench = GraspBench("004_sugar_box")
    for _ in range(20):
        bench.step(bench.rest, 0.0, 0.0)
    norms, grasped = bench.finger_forces()
    assert grasped
    # Out of the hand, along the fingers: friction on each pad becomes as large as its normal force.
    pull = bench.data.body(TCP_LINK).xmat.reshape(3, 3)[:, 0] * norms.sum()
    bench.data.body(bench.object).xfrc_applied[:3] = pull
    for _ in range(5):
        bench.step(bench.rest, 0.0, 0.0)
        _, grasped = bench.finger_forces()
        assert grasped
    normal, friction = finger_contact_forces(bench)
    assert (friction > 0.8 * normal).all(), (
        "the whole contact force leans by 40 degrees or more"
    )


def finger_contact_forces(bench: GraspBench) -> tuple[np.ndarray, np.ndarray]:
    """Sums (2,) of the normal forces and of the friction forces [N] between the [l, r] finger and the object."""
    model = bench.model
    data = bench.data
    normal = np.zeros(2)
    friction = np.zeros((2, 3))
    for index, contact in enumerate(data.contact[: data.ncon]):
        bodies = [model.body(model.geom_bodyid[geom]).name for geom in contact.geom]
        for side, finger in enumerate(FINGER_LINKS):
            if finger in bodies and bench.object in bodies:
                local = np.zeros(6)
                mujoco.mj_contactForce(model, data, index, local)
                frame = contact.frame.reshape(3, 3)
                normal[side] += local[0]
                friction[side] += frame[1] * local[1] + frame[2] * local[2]
    return normal, np.linalg.norm(friction, axis=1)


def test_friction_of_every_pair_is_that_of_the_original() -> None:
    """0.3 between all things; 1.15 with a pad, the average of its 2.0 and their 0.3, which the original takes."""
    bench = GraspBench("004_sugar_box")
    for _ in range(10):
        bench.step(bench.rest, 0.0, 0.0)
    model = bench.model
    data = bench.data
    bodies = model.geom_bodyid[data.contact.geom[: data.ncon]]
    fingers = [model.body(finger).id for finger in FINGER_LINKS]
    with_pad = np.isin(bodies, fingers).any(axis=1)
    assert with_pad.any()
    np.testing.assert_allclose(data.contact.friction[: data.ncon][with_pad, 0], 1.15)
    others = ~np.isin(model.geom_bodyid, fingers)
    np.testing.assert_allclose(model.geom_friction[others, 0], 0.3)
    assert (model.geom_priority[others] == 0).all()
