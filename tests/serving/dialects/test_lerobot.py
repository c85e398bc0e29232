"""Requests and answers in the dialect of LeRobot: the keys of its data sets."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from mjhab.serving.dialects.lerobot import LeRobot
from mjhab.serving.packing import ProtocolError
from tests.serving.constant import an_ask

IMAGES = "observation.images."


def test_a_request_has_the_keys_of_an_export() -> None:
    sent = LeRobot().request([an_ask()], {}, batch=False)
    assert set(sent) == {
        f"{IMAGES}boxy_head",
        f"{IMAGES}boxy_hand",
        "observation.state",
        "task",
    }
    assert sent["observation.state"].shape == (42,) and sent["task"] == "pick up the bowl"


def test_a_policy_names_three_images_of_which_the_third_is_black() -> None:
    names = ["base_0_rgb", "left_wrist_0_rgb", "right_wrist_0_rgb"]
    sent = LeRobot().request([an_ask()] * 2, {"cameras": names}, batch=True)
    images = [sent[IMAGES + name] for name in names]
    assert all(each.shape == images[0].shape == (2, 32, 32, 3) for each in images)
    assert (images[0] == 7).all() and (images[1] == 7).all() and not images[2].any()
    assert sent["task"] == ["pick up the bowl"] * 2
    (first,) = {
        key
        for key in LeRobot().request([an_ask()], {"cameras": names[:1]}, False)
        if IMAGES in key
    }
    assert first == IMAGES + names[0]
    with pytest.raises(ProtocolError, match="names 1 to 3 images, not 4"):
        LeRobot().request([an_ask()], {"cameras": [*names, "more"]}, batch=False)


def test_the_state_of_the_sensors_alone_leaves_the_rest_apart() -> None:
    ask = dataclasses.replace(
        an_ask(), sensed=np.ones(34, np.float32), unsensed=np.zeros(11, np.float32)
    )
    sent = LeRobot().request([ask], {}, batch=False)
    assert sent["observation.state"].shape == (34,)
    assert sent["observation.environment_state"].shape == (11,)


@pytest.mark.parametrize(
    ("action", "batch", "shape"),
    [
        (np.zeros((8, 13)), 1, (1, 8, 13)),
        (np.zeros((3, 8, 13)), 3, (3, 8, 13)),
        (np.zeros((1, 8, 13)), 1, (1, 8, 13)),
    ],
)
def test_an_answer_has_a_chunk_for_every_world(
    action: np.ndarray, batch: int, shape: tuple[int, ...]
) -> None:
    assert LeRobot().actions({"action": action}, batch).shape == shape


@pytest.mark.parametrize(
    ("answer", "told"),
    [
        ({"action": np.zeros((2, 8, 13))}, "actions for 2 worlds, not 3"),
        ({"action": np.zeros((3, 13))}, "actions for 1 worlds, not 3"),
        ({"action": np.zeros(13)}, "actions have 3 dimensions"),
        ({"actions": np.zeros((8, 13))}, "lerobot has a map with 'action'"),
    ],
)
def test_what_is_no_answer_is_told(answer: dict[str, Any], told: str) -> None:
    with pytest.raises(ProtocolError, match=told):
        LeRobot().actions(answer, 3)
