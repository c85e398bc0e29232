"""Dialect roboarena (roboarena: roboarena/policy_server.py).

``endpoint`` says "infer" or "reset", the answer is an array (H, A) or the text `RESET_DONE`. The greeting tells which
images are wanted. The keys of observations are those of DROID (droid/franka/robot.py, droid/misc/transformations.py).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np

from mjhab.core.rotations import euler_xyz, mat_from_quat
from mjhab.serving.dialects.dialect import OWN, Ask, Incoming
from mjhab.serving.dialects.parts import (
    described,
    mapping,
    numbers_of,
    own_parts,
    present,
)
from mjhab.serving.packing import ProtocolError


class RoboArena:
    """Dialect roboarena."""

    name: ClassVar[str] = "roboarena"
    batches: ClassVar[bool] = False
    remembers: ClassVar[bool] = True
    begin_answered = True

    def greeting(self, own: Mapping[str, Any]) -> dict[str, Any]:
        return {
            "image_resolution": None,
            "needs_wrist_camera": True,
            "n_external_cameras": 1,
            "needs_stereo_camera": False,
            "needs_session_id": True,
            "action_space": "mjhab",
            OWN: dict(own),
        }

    def begin(self, session: str) -> dict[str, Any] | None:
        return {"endpoint": "reset", "session_id": session}

    def request(
        self, asks: Sequence[Ask], metadata: Mapping[str, Any], batch: bool
    ) -> dict[str, Any]:
        (ask,) = asks
        images: dict[str, Any] = {}
        if metadata.get("n_external_cameras", 1):
            # roboarena counts external cameras from 0, DROID and the evaluation clients of roboarena from 1.
            images["observation/exterior_image_0_left"] = ask.external
            images["observation/exterior_image_1_left"] = ask.external
        if metadata.get("needs_wrist_camera", True):
            images["observation/wrist_image_left"] = ask.wrist
        return present(images) | {
            "endpoint": "infer",
            "session_id": ask.session,
            "observation/joint_position": ask.arm,
            "observation/cartesian_position": cartesian_position(ask.tcp),
            "observation/gripper_position": np.array([ask.gripper], np.float32),
            "observation/state": ask.state,
            "prompt": ask.prompt,
            **own_parts(asks, batch=False),
        }

    def actions(self, answer: Any, batch: int) -> np.ndarray:
        if not isinstance(answer, np.ndarray):
            raise ProtocolError(
                f"the answer is {described(answer)}, and roboarena has an array (H, A)"
            )
        return numbers_of(answer, 2)[None]

    def read(self, message: Any) -> Incoming:
        # A copy, as a key is taken out of it.
        request = dict(mapping(message))
        endpoint = request.pop("endpoint", None)
        if endpoint not in ("infer", "reset"):
            raise ProtocolError(
                f'the key "endpoint" must be "infer" or "reset", not {endpoint!r}'
            )
        return Incoming(endpoint == "reset", request)

    def answer(self, chunks: np.ndarray, incoming: Incoming, infer_ms: float) -> Any:
        return chunks[0]


def cartesian_position(pose: np.ndarray) -> np.ndarray:
    """DROID's form of a pose (7,), position [m] and quaternion wxyz: position and xyz Euler angles (6,) [m, rad]."""
    pose = np.asarray(pose, np.float64)
    # A quaternion in float32 is a little longer or shorter than 1.
    turn = pose[3:] / np.linalg.norm(pose[3:])
    angles = np.asarray(euler_xyz(mat_from_quat(turn)))
    return np.concatenate([pose[:3], angles]).astype(np.float32)
