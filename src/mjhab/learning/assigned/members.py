"""The networks that `learning.assigned.join` joins."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import torch
from torch import Tensor, nn

from mjhab.core.errors import fault
from mjhab.learning.checkpoint import Checkpoint, student_of
from mjhab.learning.configs import BC, VIEWS, InputConfig, NetworkConfig
from mjhab.learning.networks import Trunk
from mjhab.learning.observation.parts import SubtaskConditioning, code_of, image_keys
from mjhab.learning.observation.sentences import encode_sentence
from mjhab.learning.observation.spec import ObservationSpec
from mjhab.learning.runs.specs import Scene
from mjhab.learning.students.bc import BehaviourCloning
from mjhab.learning.students.routed import RoutedTrunk

VIEW_NAMES = {views: name for name, views in VIEWS.items()}


@dataclass(frozen=True)
class Asked:
    """A request of which the sentences are known.

    scene: where a policy learned it. target: the type of its target. sentences: with which it is asked for.
    """

    scene: Scene
    target: str
    sentences: tuple[str, ...]


@dataclass(frozen=True)
class Member:
    """A network to join: that of one policy, or the one that acts on some requests in a policy joined before.

    student: whose network it is. expert: its number in a joined policy; None of a plain one.
    """

    student: BehaviourCloning
    expert: int | None = None

    @property
    def trunk(self) -> Trunk:
        """Encoder and layers of the network."""
        trunk = self.student.trunk
        if self.expert is None:
            return cast("Trunk", trunk)
        return cast("Trunk", cast("RoutedTrunk", trunk).experts[self.expert])

    @property
    def views(self) -> str:
        """Which views of the cameras it sees, one of VIEWS."""
        if self.expert is not None:
            return self.student.config.network.experts[self.expert]
        inputs = self.student.config.inputs
        return VIEW_NAMES[inputs.whole_views, inputs.target_views]

    @property
    def encoders(self) -> dict[str, nn.Module]:
        """The encoders of the images that it sees, by key of the observation."""
        keys = keys_of(self.student.config.inputs, self.views)
        return dict(zip(keys, self.trunk.encoder.encoders, strict=True))

    @property
    def head(self) -> tuple[Tensor, Tensor]:
        """Weights (rows, H) and biases (rows,) of its last layer, which gives actions that are not normalized."""
        student = self.student
        scale = student.action_normalizer.scale.repeat(student.config.chunk)
        mean = student.action_normalizer.mean.repeat(student.config.chunk)
        weight, bias = student.head.weight, student.head.bias
        if self.expert is not None:
            width = 1 + self.trunk.width
            mine = weight[:, self.expert * width : (self.expert + 1) * width]
            # Column 0 is the bias of the expert; training gives the shared one values as well.
            weight, bias = mine[:, 1:], mine[:, 0] + bias
        return weight * scale[:, None], bias * scale + mean

    @property
    def unasked(self) -> Tensor:
        """What it is told where others act, (T,): zeros."""
        trunk = self.student.trunk
        if isinstance(trunk, RoutedTrunk):
            return torch.zeros(len(trunk.routes))
        return torch.zeros(self.student.layout.conditioning_width)

    def code(self, asked: Asked) -> Tensor:
        """What it is told when it is asked for something, (T,)."""
        trunk = self.student.trunk
        if isinstance(trunk, RoutedTrunk):
            return torch.eye(len(trunk.routes))[_route(trunk, asked)]
        told = SubtaskConditioning(asked.scene.subtask, asked.target, "")
        return torch.from_numpy(code_of(told, self.student.layout))


def keys_of(inputs: InputConfig, views: str) -> tuple[str, ...]:
    """Keys of the images of a network that sees some views, one of VIEWS."""
    whole, target = VIEWS[views]
    seen = dataclasses.replace(inputs, whole_views=whole, target_views=target)
    return image_keys(seen)


def _route(trunk: RoutedTrunk, asked: Asked) -> int:
    """The route that most sentences of a request find in a joined policy."""
    vectors = torch.stack([torch.tensor(encode_sentence(s)) for s in asked.sentences])
    return int(trunk.route(vectors).mode().values)


def member_for(student: BehaviourCloning, asked: Asked) -> Member:
    """The network that acts on a request in a policy."""
    trunk = student.trunk
    if not isinstance(trunk, RoutedTrunk):
        return Member(student)
    return Member(student, trunk.routes[_route(trunk, asked)])


def readable(files: Sequence[str], saved: Sequence[Checkpoint]) -> list[BehaviourCloning]:
    """The policies of checkpoints that can be joined.

    Raises:
        UsageError: one is of another kind, or differs from the first one in what it sees or in its network.
    """
    return [
        _student(Path(file), one, files[0], saved[0])
        for file, one in zip(files, saved, strict=True)
    ]


def _student(
    path: Path, saved: Checkpoint, first: str, wanted: Checkpoint
) -> BehaviourCloning:
    student = student_of(path, saved)
    if not (
        isinstance(student, BehaviourCloning)
        and isinstance(student.trunk, Trunk | RoutedTrunk)
    ):
        raise fault(
            path,
            f"cannot be joined: it is a student of {saved.config.algorithm} with the encoder "
            f"{saved.config.network.encoder}; give students of {BC}, dagger or ppo.",
        )
    inputs = saved.config.inputs
    if isinstance(student.trunk, Trunk) and (not inputs.condition or inputs.sentence):
        raise fault(
            path,
            "cannot be joined: give students with inputs.condition=true and inputs.sentence=false, or joined ones.",
        )
    # Compared with the first one: members act by one head and one layout.
    mine, others = saved.config, wanted.config
    told = {
        "inputs": (_comparable(mine.inputs), _comparable(others.inputs)),
        "network": (_alone(mine.network), _alone(others.network)),
        "number of executed actions": (mine.execute, others.execute),
        "layout": (_apart_from_tasks(saved), _apart_from_tasks(wanted)),
    }
    wrong = [name for name, (its, theirs) in told.items() if its != theirs]
    if wrong:
        raise fault(
            path,
            f"cannot be joined with {first}: it has another {' and '.join(wrong)}.",
        )
    return student


def _comparable(inputs: InputConfig) -> InputConfig:
    # Each member looks at its own views, and is told in its own way what it is to do.
    return dataclasses.replace(
        inputs, whole_views=True, target_views=True, condition=False, sentence=True
    )


def _alone(network: NetworkConfig) -> NetworkConfig:
    return dataclasses.replace(network, experts=(), routes=())


def _apart_from_tasks(saved: Checkpoint) -> ObservationSpec:
    inputs = _comparable(saved.layout.inputs)
    # Targets and kinds are what members differ in by purpose.
    return dataclasses.replace(saved.layout, targets=(), kinds=(), inputs=inputs)
