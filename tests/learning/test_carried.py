"""Students that begin with what others know."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from mjhab.learning.configs import InputConfig, StudentConfig
from mjhab.learning.observation.sentences import encode_sentence
from mjhab.learning.observation.spec import ObservationSpec
from mjhab.learning.students.bc import BehaviourCloning
from mjhab.learning.students.carried import carried
from mjhab.learning.students.members import Member
from mjhab.learning.students.routed import RoutedTrunk
from tests.learning.small import SIZE, condition_of
from tests.learning.test_join import (
    FOVEAL,
    WHOLE,
    WORLDS,
    acts,
    joined_students,
    learn_routes,
    random_member,
    routes,
)

BOTH = dataclasses.replace(WHOLE, whole_views=True, target_views=True)
MORE = ("013_apple", "kitchen_counter/drawer3", "024_bowl")
"""Targets of the new student: another one, and the known ones in another order."""


def _wanted(
    start: BehaviourCloning, inputs: InputConfig, chunk: int
) -> tuple[StudentConfig, ObservationSpec]:
    network = dataclasses.replace(start.config.network, experts=(), routes=())
    config = dataclasses.replace(
        start.config, inputs=inputs, chunk=chunk, network=network
    )
    return config, dataclasses.replace(start.layout, inputs=inputs, targets=MORE)


def _seen(layout: ObservationSpec) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """What all students measure, and their images by key."""
    random = np.random.default_rng(0)
    images = {
        key: random.integers(0, 256, (WORLDS, SIZE, SIZE), np.uint8)
        for key in layout.image_keys
    }
    return random.normal(size=(WORLDS, layout.measured_width)), images


def _images(layout: ObservationSpec, seen: dict[str, np.ndarray]) -> np.ndarray:
    return np.stack([seen[key] for key in layout.image_keys], 1)


def _told(student: BehaviourCloning, measured: np.ndarray, *asked: str) -> np.ndarray:
    code = condition_of(student.layout, *asked)
    return np.hstack([measured, np.tile(code, (len(measured), 1))])


@pytest.mark.parametrize("chunk", [2, 6])
@pytest.mark.parametrize("sentence", [False, True])
def test_a_student_acts_as_before_with_more_views_targets_and_another_chunk(
    chunk: int, sentence: bool
) -> None:
    start = random_member(1, FOVEAL)
    known = start.config.chunk
    assert 2 < known < 6
    inputs = dataclasses.replace(BOTH, sentence=sentence)
    made = carried(Member(start), *_wanted(start, inputs, chunk))
    measured, seen = _seen(made.layout)
    asked = ("pick", "024_bowl", "pick up the bowl")
    before = acts(start, _told(start, measured, *asked[:2]), _images(start.layout, seen))
    after = acts(made, _told(made, measured, *asked), _images(made.layout, seen))
    assert after.shape[1] == chunk
    for step in range(chunk):
        # A longer chunk goes on with the last known action.
        assert np.abs(after[:, step] - before[:, min(step, known - 1)]).max() < 1e-5
    # The target that it knows still matters.
    with_target = _told(made, measured, "pick", "kitchen_counter/drawer3", asked[2])
    assert (
        np.abs(acts(made, with_target, _images(made.layout, seen)) - after).max() > 1e-3
    )


def test_a_network_of_a_joined_student_acts_alone_as_on_its_route() -> None:
    whole = joined_students(random_member(1, FOVEAL), random_member(2, WHOLE))
    trunk = learn_routes(whole)
    assert isinstance(trunk, RoutedTrunk)
    for number, route in enumerate(routes()):
        member = Member(whole, trunk.routes[number])
        made = carried(member, *_wanted(whole, BOTH, 2), number)
        measured, seen = _seen(made.layout)
        said = np.tile(encode_sentence(route.sentences[0]), (WORLDS, 1))
        wanted = acts(whole, np.hstack([measured, said]), _images(whole.layout, seen))
        # The network on the route was told no target, so that none matters.
        for target in MORE:
            told = _told(made, measured, route.scene.subtask, target)
            done = acts(made, told, _images(made.layout, seen))
            assert np.abs(done - wanted).max() < 1e-5


def test_a_student_without_images_is_carried_over_to_other_targets() -> None:
    blind = InputConfig(cameras=(), image_size=0, whole_views=False)
    start = random_member(1, blind)
    made = carried(Member(start), *_wanted(start, blind, 2))
    measured, _ = _seen(made.layout)
    none = np.zeros((WORLDS, 0, 0, 0), np.uint8)
    before = acts(start, _told(start, measured, "pick", "024_bowl"), none)
    after = acts(made, _told(made, measured, "pick", "024_bowl"), none)
    assert np.abs(after - before[:, :2]).max() < 1e-5
