"""The networks that `learning.assigned.join` joins."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from mjhab.core.errors import fault
from mjhab.core.typed.options import read_record
from mjhab.learning.checkpoint import Checkpoint, student_of
from mjhab.learning.configs import BC
from mjhab.learning.networks import Trunk
from mjhab.learning.observation.parts import SubtaskConditioning, code_of
from mjhab.learning.observation.sentences import encode_sentence
from mjhab.learning.runs.specs import Scene
from mjhab.learning.students.bc import BehaviourCloning
from mjhab.learning.students.members import (
    Member,
    inputs_alone,
    layout_alone,
    network_alone,
)
from mjhab.learning.students.routed import RoutedTrunk


@dataclass(frozen=True)
class Asked:
    """A request of which the sentences are known.

    scene: where a policy learned it. target: the type of its target. sentences: with which it is asked for.
    """

    scene: Scene
    target: str
    sentences: tuple[str, ...]


def unasked(member: Member) -> Tensor:
    """What a member is told where others act, (T,): zeros."""
    trunk = member.student.trunk
    if isinstance(trunk, RoutedTrunk):
        return torch.zeros(len(trunk.routes))
    return torch.zeros(member.student.layout.conditioning_width)


def code(member: Member, asked: Asked) -> Tensor:
    """What a member is told when it is asked for something, (T,)."""
    trunk = member.student.trunk
    if isinstance(trunk, RoutedTrunk):
        return torch.eye(len(trunk.routes))[_route(trunk, asked)]
    told = SubtaskConditioning(asked.scene.subtask, asked.target, "")
    return torch.from_numpy(code_of(told, member.student.layout))


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


def scenes_of(file: str | Path, saved: Checkpoint) -> list[Scene]:
    """Where a policy was trained.

    Raises:
        UsageError: its checkpoint does not say.
    """
    about = saved.about
    try:
        return [
            read_record(Scene, told, "scene")
            for told in (about.get("scene"), *about.get("also", ()))
        ]
    except (TypeError, ValueError) as error:
        raise fault(file, f"does not say what it was trained for ({error}).") from error


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
        "inputs": (inputs_alone(mine.inputs), inputs_alone(others.inputs)),
        "network": (network_alone(mine.network), network_alone(others.network)),
        "number of executed actions": (mine.execute, others.execute),
        "layout": (layout_alone(saved.layout), layout_alone(wanted.layout)),
    }
    wrong = [name for name, (its, theirs) in told.items() if its != theirs]
    if wrong:
        raise fault(
            path,
            f"cannot be joined with {first}: it has another {' and '.join(wrong)}.",
        )
    return student
