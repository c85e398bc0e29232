"""What a learned policy sees of a recorded episode."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mjhab.core.errors import UsageError, fault
from mjhab.core.joints import BASE
from mjhab.core.names import kind_of
from mjhab.data.record.targets import active_entries, aims_at_goal
from mjhab.data.store.images import decode
from mjhab.data.store.reading import RecordedEpisode
from mjhab.learning.observation.encoder import EncodedObs, encode
from mjhab.learning.observation.parts import (
    InputSpec,
    SubtaskConditioning,
    code_of,
    image_outputs,
)
from mjhab.learning.observation.state import recorded_state
from mjhab.tasks.instructions import without_teleport_mark


def encode_episode(
    episode: RecordedEpisode, spec: InputSpec, steps: int | None = None
) -> EncodedObs:
    """Encode the observations before the first ``steps`` control steps of an episode; all if None.

    Raises:
        UsageError: the episode lacks images, states or instructions that the policy sees.
    """
    return encode(RecordedSource(episode, spec, steps), spec)


class RecordedSource:
    """`parts.StepSource` of the control steps of a recorded episode."""

    def __init__(
        self, episode: RecordedEpisode, spec: InputSpec, steps: int | None = None
    ) -> None:
        self._episode = episode
        self._spec = spec
        self._steps = episode.steps if steps is None else steps

    def state(self) -> np.ndarray:
        return recorded_state(self._episode, self._spec.conventions)[: self._steps]

    def base_motion(self) -> tuple[np.ndarray, np.ndarray]:
        """Positions and velocities (N, 3) of the joints of the base.

        Raises:
            UsageError: the episode was imported from data without states.
        """
        episode = self._episode
        if lacks_states(episode):
            raise fault(
                f"episode {episode.name} of {episode.shard.path}",
                "was imported from data without states, which the "
                "velocity of the base is computed from; take a student without it: --preset paper, or --set "
                "inputs.base_velocity=false.",
            )
        columns = episode.run.layout["columns"]
        q = episode.array("states/qpos")[:, columns["robot_q"][BASE]]
        qd = episode.array("states/qvel")[:, columns["robot_v"][BASE]]
        return q[: self._steps], qd[: self._steps]

    def link_state(self) -> np.ndarray:
        """Refuse: a recording holds no state of links.

        Raises:
            UsageError: always.
        """
        raise UsageError(
            "recorded demonstrations hold no link_state; use a preset with images, or leave out the data: the "
            "expert then generates demonstrations in the environment."
        )

    def previous_action(self) -> np.ndarray:
        executed = self._episode.array("actions")
        # The executed action, not the intended one: it is what moved the robot, and what an acting policy is told.
        before = np.concatenate([np.zeros_like(executed[:1]), executed[:-1]])
        return before[: self._steps]

    def conditioning(self) -> np.ndarray:
        """Codes of the active subtasks.

        Raises:
            UsageError: the policy reads sentences, and the episode was recorded without instructions; or it was not
                trained on a subtask or target.
        """
        sentences = instructions_of(self._episode, self._spec)
        codes = [
            code_of(
                SubtaskConditioning(entry.kind, kind_of(entry.target), sentence),
                self._spec,
            )
            for entry, sentence in zip(self._episode.record.plan, sentences, strict=True)
        ]
        # Coded once per subtask and looked up for every step.
        return np.stack(codes)[active_entries(self._episode)[: self._steps]]

    def aims_at_goal(self) -> np.ndarray:
        return aims_at_goal(self._episode)[: self._steps, None]

    def image(self, camera: str, output: str) -> np.ndarray:
        """Images of a camera.

        Raises:
            UsageError: the episode has none, or in another size; the message says how to get them.
        """
        episode = self._episode
        if (camera, output) not in episode.images:
            raise _no_images(
                episode, self._spec, f"has no {output} images of {camera}", None
            )
        # Read at once: a read per frame would open the dataset some hundred times.
        files = episode.array(f"images/{camera}/{output}/bytes").tobytes()
        ends = episode.array(f"images/{camera}/{output}/ends").tolist()
        starts = [0, *ends]
        frames = [decode(files[starts[t] : ends[t]], output) for t in range(self._steps)]
        height, width = frames[0].shape[:2]
        size = self._spec.inputs.image_size
        if (height, width) != (size, size):
            raise _no_images(
                episode,
                self._spec,
                f"has {output} images of {width}x{height} px",
                (height, width),
            )
        return np.stack(frames)


def check_inputs(episode: RecordedEpisode, spec: InputSpec) -> None:
    """Refuse an episode that lacks the images or the instructions that a policy sees.

    Raises:
        UsageError: as `encode_episode`.
    """
    # One step tells as much as all of them.
    source = RecordedSource(episode, spec, 1)
    for output in image_outputs(spec.inputs):
        for camera in spec.inputs.cameras:
            source.image(camera, output)
    instructions_of(episode, spec)


def lacks_states(episode: RecordedEpisode) -> bool:
    """Whether the episode was imported from data without states, from which nothing can be computed anew."""
    return "states/initial" in episode.run.absent


def instructions_of(episode: RecordedEpisode, spec: InputSpec) -> Sequence[str]:
    """The instruction of every subtask of the plan; "" if the policy reads none.

    Raises:
        UsageError: the episode was recorded without instructions.
    """
    plan = episode.record.plan
    if not spec.inputs.sentence:
        return [""] * len(plan)
    sentences = episode.record.instructions
    if len(sentences) != len(plan) or not all(sentences):
        raise fault(
            f"episode {episode.name} of {episode.shard.path}",
            "was recorded without instructions, which a student with "
            "inputs.sentence=true learns from; leave out this input, or record new episodes: mjhab generate",
        )
    return [without_teleport_mark(sentence) for sentence in sentences]


def _no_images(
    episode: RecordedEpisode, spec: InputSpec, found: str, have: tuple[int, int] | None
) -> UsageError:
    """Make the error for images that are missing (``have`` None) or of another size (height, width) [px]."""
    size = spec.inputs.image_size
    cameras = " ".join(spec.inputs.cameras)
    outputs = "+".join(image_outputs(spec.inputs))
    refusal = f"episode {episode.name} of {episode.shard.path} {found}; the preset needs {size}x{size} px. "
    if not lacks_states(episode):
        return UsageError(
            f"{refusal}Render them from the recorded states: mjhab replay {episode.shard.path} --render {outputs} "
            f"--camera-size {size} --cameras {cameras} --out FILE.h5"
        )
    refusal += "It was imported from data without states, so its images cannot be rendered again; "
    if have and have[0] == have[1]:
        return UsageError(
            f"{refusal}train with images of its size: --set inputs.image_size={have[0]}"
        )
    with_depth = sorted(
        {camera for camera, output in episode.images if output == "depth"}
    )
    return UsageError(
        f"{refusal}train with the cameras it has depth of ({', '.join(with_depth) or 'none'}): --set inputs.cameras=..."
    )
