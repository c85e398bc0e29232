"""The parts of what a learned policy sees. Each says its entries, unit and normalization, and computes itself.

A part reads from a `StepSource`: the worlds of an environment in one control step (`encoder.LiveSource`), or the
control steps of a recorded episode (`recorded.RecordedSource`). So demonstrations, acting, take-overs and
reinforcement, on numpy and torch, see the same numbers. N is the number of rows: worlds or control steps.

A new input is a new part in VECTOR_PARTS or IMAGE_PARTS, and a field of `InputConfig` that switches it on.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from mjhab.core.arrays import Array, namespace
from mjhab.core.conventions.images import RGB, TARGET_DEPTH, TARGET_RGB, channels_of
from mjhab.core.conventions.names import Conventions
from mjhab.core.errors import UsageError, unknown_name
from mjhab.core.joints import BASE_X, BASE_Y, BASE_YAW
from mjhab.core.rotations import quat_rotate_inv
from mjhab.learning.configs import DEPTH, IMAGE_CONTENTS, InputConfig
from mjhab.learning.observation.backbone import BackboneSpec, frozen_features
from mjhab.learning.observation.depth import nearness, pooled
from mjhab.learning.observation.sentences import SENTENCE_WIDTH, encode_sentence

Entry = tuple[str, int]
"""Name and width of a section of a vector."""
IMAGE_KEY_PREFIX = "sensor_data/"
TCP_KEY = "extra/tcp_pose_wrt_base"
OBJECT_KEY = "extra/obj_pose_wrt_base"
GOAL_KEY = "extra/goal_pos_wrt_base"
"""Entries of the state that `TargetInHand` is computed from."""
NEAR_M = 0.1
CLOSE_M = 0.02
"""Distances at which `TargetInHand` saturates: of the last movement, and of the contact of the fingers."""


@dataclass(frozen=True)
class SubtaskConditioning:
    """What a policy can be told about a subtask. target: type of its target. sentence: its instruction."""

    kind: str
    target: str
    sentence: str = ""


class InputSpec(Protocol):
    """The part of a `spec.ObservationSpec` that the parts read."""

    @property
    def inputs(self) -> InputConfig: ...

    @property
    def state(self) -> Sequence[Entry]: ...

    @property
    def actions(self) -> Sequence[str]: ...

    @property
    def kinds(self) -> Sequence[str]: ...

    @property
    def targets(self) -> Sequence[str]: ...

    @property
    def conventions(self) -> Conventions: ...

    @property
    def backbone(self) -> BackboneSpec | None: ...


class StepSource(Protocol):
    """Where the parts read from; all arrays are of one library and device."""

    def state(self) -> Array:
        """State vector of the environment (N, S) float32, in the order and the conventions of the spec."""
        ...

    def base_motion(self) -> tuple[Array, Array]:
        """Positions and velocities (N, 3+) of joints that start with x, y [m] and yaw [rad] of the base."""
        ...

    def link_state(self) -> Array:
        """(N, 5) float32, see `Sensing.link_state`."""
        ...

    def previous_action(self) -> Array:
        """Action executed in the previous control step (N, A) float32 in [-1, 1]; zero in the first one."""
        ...

    def conditioning(self) -> Array:
        """Codes (N, T) float32 of the active subtasks, see `code_of`."""
        ...

    def aims_at_goal(self) -> Array:
        """(N, 1) bool: see `SubtaskSpec.aims_at_goal`, of the active subtask."""
        ...

    def image(self, camera: str, output: str) -> Array:
        """Images (N, height, width, channels) of an output of the environment."""
        ...


class VectorPart(ABC):
    """A part of the vector of one observation."""

    name: str
    """Field of `InputConfig` that switches the part on; "state", which is always there, has none."""
    unit: str
    normalized: bool = True
    """Whether the network normalizes it by the spread of the first demonstrations. Normalized parts come first."""

    def used(self, inputs: InputConfig) -> bool:
        """Whether a policy with these inputs has the part."""
        return bool(getattr(inputs, self.name))

    @abstractmethod
    def entries(self, spec: InputSpec) -> Sequence[Entry]:
        """Names and widths of its sections, in order."""

    @abstractmethod
    def encode(self, source: StepSource, spec: InputSpec) -> Array:
        """The part of every row, (N, width) float32."""


class ConditioningPart(VectorPart):
    """A part that depends on the active subtask alone: it is coded once per subtask, not in every control step."""

    normalized = False

    @abstractmethod
    def code(self, subtask: SubtaskConditioning, spec: InputSpec) -> np.ndarray:
        """The part for a subtask, (width,) float32."""

    def encode(self, source: StepSource, spec: InputSpec) -> Array:
        # The codes of all parts come joined, because a subtask is coded once for all of them.
        start = 0
        for part in conditioning_parts(spec.inputs):
            if part is self:
                break
            start += width_of(part, spec)
        return source.conditioning()[:, start : start + width_of(self, spec)]


class State(VectorPart):
    """The state vector of the environment, 42 numbers in the MS-HAB paper (App. A.3)."""

    name = "state"
    unit = "as each of its entries"

    def used(self, inputs: InputConfig) -> bool:
        return True

    def entries(self, spec: InputSpec) -> Sequence[Entry]:
        return spec.state

    def encode(self, source: StepSource, spec: InputSpec) -> Array:
        return source.state()


class BaseVelocity(VectorPart):
    """Forward speed and turning rate of the base, which the state of the paper lacks."""

    name = "base_velocity"
    unit = "m/s, rad/s"

    def entries(self, spec: InputSpec) -> Sequence[Entry]:
        return (("base/forward_speed", 1), ("base/turning_rate", 1))

    def encode(self, source: StepSource, spec: InputSpec) -> Array:
        return base_velocity(*source.base_motion())


class LinkState(VectorPart):
    """State of the active subtask's furniture link, which only a simulator knows."""

    name = "link_state"
    unit = "fraction of the range, rad/s or m/s, cosine and sine, 0 or 1"

    def entries(self, spec: InputSpec) -> Sequence[Entry]:
        return (
            ("link/opening", 1),
            ("link/speed", 1),
            ("link/heading", 2),
            ("link/nearly_closed", 1),
        )

    def encode(self, source: StepSource, spec: InputSpec) -> Array:
        return source.link_state()


class PreviousAction(VectorPart):
    """The action that was executed in the previous control step."""

    name = "previous_action"
    unit = "normalized action"

    def entries(self, spec: InputSpec) -> Sequence[Entry]:
        return tuple((f"previous_action/{name}", 1) for name in spec.actions)

    def encode(self, source: StepSource, spec: InputSpec) -> Array:
        return source.previous_action()


class TargetInHand(VectorPart):
    """The target of the active subtask relative to the tcp in the tcp's axes: v, tanh(v / 0.1 m), tanh(v / 0.02 m).

    It is a function of the state, so it is no privileged information. The state is divided by its spread of some 0.4 m,
    so that 5 mm are a hundredth of an input there; here they are a quarter.
    """

    name = "target_in_hand"
    unit = "m, tanh of 0.1 m, tanh of 0.02 m"

    def entries(self, spec: InputSpec) -> Sequence[Entry]:
        return (
            ("target_in_hand/position", 3),
            ("target_in_hand/near", 3),
            ("target_in_hand/close", 3),
        )

    def encode(self, source: StepSource, spec: InputSpec) -> Array:
        state = source.state()
        xp = namespace(state)
        # tanh of float32 differs in the last bit with the layout of the array; that of float64, rounded, does not.
        state = xp.astype(state, xp.float64)
        tcp = state[:, _section(spec, TCP_KEY)]
        target = xp.where(
            source.aims_at_goal(),
            state[:, _section(spec, GOAL_KEY)],
            # The pose of the object holds a quaternion behind its position.
            state[:, _section(spec, OBJECT_KEY)][:, :3],
        )
        to_target = quat_rotate_inv(tcp[:, 3:], target - tcp[:, :3])
        scales = [to_target, xp.tanh(to_target / NEAR_M), xp.tanh(to_target / CLOSE_M)]
        return xp.astype(xp.concat(scales, axis=1), xp.float32)


class FrozenFeatures(VectorPart):
    """Features of the cameras' colour images by a pretrained network, see `backbone.Backbone`.

    They stand in the vector, so that a training computes them once per image and not in every batch.
    """

    name = "backbone"
    unit = "as the network's"

    def entries(self, spec: InputSpec) -> Sequence[Entry]:
        features = spec.backbone.features if spec.backbone else 0
        return [(f"backbone/{camera}", features) for camera in spec.inputs.cameras]

    def encode(self, source: StepSource, spec: InputSpec) -> Array:
        inputs = spec.inputs
        if spec.backbone is None:
            raise ValueError("inputs with a backbone need a layout that describes it")
        rows = []
        for camera in inputs.cameras:
            images = source.image(camera, RGB)
            xp = namespace(images)
            # Larger cameras serve several policies; each sees what it was trained with.
            factor = images.shape[1] // inputs.image_size
            if factor > 1:
                channels = pooled(xp.moveaxis(images, -1, 1), factor)
                images = xp.moveaxis(channels, 1, -1)
            rows.append(frozen_features(inputs.backbone, spec.backbone, images))
        return namespace(rows[0]).concat(rows, axis=1)


class Condition(ConditioningPart):
    """One-hot of the kind of the active subtask and of the type of its target."""

    name = "condition"
    unit = "0 or 1"

    def entries(self, spec: InputSpec) -> Sequence[Entry]:
        return (
            *((f"subtask/{name}", 1) for name in spec.kinds),
            *((f"target/{name}", 1) for name in spec.targets),
        )

    def code(self, subtask: SubtaskConditioning, spec: InputSpec) -> np.ndarray:
        """Code a subtask.

        Raises:
            UsageError: the policy was not trained on this kind or target.
        """
        if subtask.kind not in spec.kinds:
            raise unknown_name("subtask of this student", subtask.kind, spec.kinds)
        if subtask.target not in spec.targets:
            raise unknown_name("target of this student", subtask.target, spec.targets)
        one_hot = np.zeros(len(spec.kinds) + len(spec.targets), np.float32)
        one_hot[list(spec.kinds).index(subtask.kind)] = 1.0
        one_hot[len(spec.kinds) + list(spec.targets).index(subtask.target)] = 1.0
        return one_hot


class Sentence(ConditioningPart):
    """The instruction of the active subtask as a bag of hashed words."""

    name = "sentence"
    unit = "count of words"

    def entries(self, spec: InputSpec) -> Sequence[Entry]:
        return (("sentence", SENTENCE_WIDTH),)

    def code(self, subtask: SubtaskConditioning, spec: InputSpec) -> np.ndarray:
        return encode_sentence(subtask.sentence)


class ImagePart(ABC):
    """A kind of images that a policy sees, one image of bytes of every camera."""

    views: str
    """Field of `InputConfig` that switches its kind of views on."""
    contents: str
    """What of `InputConfig.images` it is: "depth" or "rgb"."""
    output: str
    """Image output of the environment, see `envs.observations.modes`."""
    unit: str

    def used(self, inputs: InputConfig) -> bool:
        """Whether a policy with these inputs has the part."""
        return bool(
            inputs.cameras
            and inputs.image_size
            and self.contents in IMAGE_CONTENTS[inputs.images]
            and getattr(inputs, self.views)
        )

    def keys(self, inputs: InputConfig) -> tuple[str, ...]:
        """Keys of the images in the observation of an environment, one per camera."""
        return tuple(
            f"{IMAGE_KEY_PREFIX}{camera}/{self.output}" for camera in inputs.cameras
        )

    @abstractmethod
    def byte(self, image: Array) -> Array:
        """Images (N, height, width, channels) of the environment as bytes."""

    def encode(self, source: StepSource, spec: InputSpec) -> list[Array]:
        """Channels (N, height, width) uint8 of every camera's image, of one camera after the other."""
        images = [
            self.byte(source.image(camera, self.output)) for camera in spec.inputs.cameras
        ]
        return [image[..., k] for image in images for k in range(image.shape[-1])]


class WholeViews(ImagePart):
    """Depth images of the cameras as nearness: 255 at the lens, 0 far away (mshab/agents/bc)."""

    views = "whole_views"
    contents = DEPTH
    output = "depth"
    unit = "255 (1 - tanh(depth / 1 m))"

    def byte(self, image: Array) -> Array:
        return nearness(image)


class TargetViews(ImagePart):
    """Depth around the target of the active subtask, see `render.target_views`.

    Place and direction of a view are functions of the state, and a camera of the robot sees its pixels, so it is no
    privileged information.
    """

    views = "target_views"
    contents = DEPTH
    output = TARGET_DEPTH
    unit = "128 at the target's distance, 1 and 255 a quarter of it farther and nearer, 0 unseen"

    def byte(self, image: Array) -> Array:
        xp = namespace(image)
        return xp.astype(image, xp.uint8, copy=False)


class WholeColours(ImagePart):
    """Colour images of the cameras."""

    views = "whole_views"
    contents = RGB
    output = RGB
    unit = "sRGB"

    def byte(self, image: Array) -> Array:
        return image


class TargetColours(WholeColours):
    """Colours around the target of the active subtask, see `TargetViews`."""

    views = "target_views"
    output = TARGET_RGB


VECTOR_PARTS: tuple[VectorPart, ...] = (
    State(),
    BaseVelocity(),
    LinkState(),
    PreviousAction(),
    TargetInHand(),
    FrozenFeatures(),
    Condition(),
    Sentence(),
)
"""The parts of a vector in their order, which checkpoints depend on: the normalized ones first."""
IMAGE_PARTS: tuple[ImagePart, ...] = (
    WholeViews(),
    TargetViews(),
    WholeColours(),
    TargetColours(),
)
"""The parts of the images in the order of their channels, which checkpoints depend on."""


def parts_of(inputs: InputConfig) -> tuple[VectorPart, ...]:
    """The parts of the vector of a policy with these inputs."""
    return tuple(part for part in VECTOR_PARTS if part.used(inputs))


def image_parts(inputs: InputConfig) -> tuple[ImagePart, ...]:
    """The parts of the images of a policy with these inputs."""
    return tuple(part for part in IMAGE_PARTS if part.used(inputs))


def image_keys(inputs: InputConfig) -> tuple[str, ...]:
    """Keys of its images in the observation of an environment."""
    return tuple(key for part in image_parts(inputs) for key in part.keys(inputs))


def image_outputs(inputs: InputConfig) -> tuple[str, ...]:
    """The image outputs of an environment that a policy with these inputs needs."""
    outputs = [part.output for part in image_parts(inputs)]
    return tuple(dict.fromkeys([*outputs, *([RGB] if inputs.backbone else [])]))


def seen_keys(inputs: InputConfig) -> tuple[str, ...]:
    """Keys of the images of these outputs in the observation of an environment."""
    return tuple(
        f"{IMAGE_KEY_PREFIX}{camera}/{output}"
        for output in image_outputs(inputs)
        for camera in inputs.cameras
    )


def image_channels(inputs: InputConfig) -> tuple[int, ...]:
    """Number of channels of each of `image_keys`."""
    return tuple(
        channels_of(part.output) for part in image_parts(inputs) for _ in inputs.cameras
    )


def conditioning_parts(inputs: InputConfig) -> tuple[ConditioningPart, ...]:
    """Those that depend on the active subtask alone."""
    return tuple(part for part in parts_of(inputs) if isinstance(part, ConditioningPart))


def width_of(part: VectorPart, spec: InputSpec) -> int:
    """Width of a part."""
    return sum(width for _, width in part.entries(spec))


def code_of(subtask: SubtaskConditioning, spec: InputSpec) -> np.ndarray:
    """What a policy is told about a subtask, (T,) float32: the parts of `conditioning_parts`, in order.

    Raises:
        UsageError: the policy was not trained on this subtask or target.
    """
    codes = [part.code(subtask, spec) for part in conditioning_parts(spec.inputs)]
    return np.concatenate([np.zeros(0, np.float32), *codes])


def _section(spec: InputSpec, key: str) -> slice:
    """Columns of an entry of the state.

    Raises:
        UsageError: the state lacks it, as in the observation mode "proprioception".
    """
    start = 0
    for name, width in spec.state:
        if name == key:
            return slice(start, start + width)
        start += width
    raise UsageError(
        f"inputs.target_in_hand needs {key} in the state, which has {', '.join(name for name, _ in spec.state)}. "
        "Leave out this input, or take an observation mode with the task's state."
    )


def base_velocity(q: Array, qd: Array) -> Array:
    """Forward speed [m/s] and turning rate [rad/s] of the base, (N, 2) float32; numpy or torch, like ``q``.

    Args:
        q: (N, 3+) joint positions that start with x, y [m] and yaw [rad] of the base.
        qd: their velocities.
    """
    yaw = q[:, BASE_YAW]
    xp = namespace(q)
    # The base drives by two joints along the world's axes, and its policy by its own.
    forward = xp.cos(yaw) * qd[:, BASE_X] + xp.sin(yaw) * qd[:, BASE_Y]
    return xp.astype(xp.stack([forward, qd[:, BASE_YAW]], axis=1), xp.float32)
