"""A student that begins with what another one knows, with more views, other targets or another chunk."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import torch
from torch import Tensor

from mjhab.learning.configs import StudentConfig
from mjhab.learning.networks import Trunk
from mjhab.learning.observation.parts import conditioning_parts
from mjhab.learning.observation.spec import ObservationSpec
from mjhab.learning.students.bc import BehaviourCloning
from mjhab.learning.students.heads import make_student
from mjhab.learning.students.members import Member, take_over
from mjhab.learning.students.routed import RoutedTrunk


def carried(
    member: Member,
    config: StudentConfig,
    layout: ObservationSpec,
    route: int = 0,
    like: BehaviourCloning | int = 0,
) -> BehaviourCloning:
    """A plain student of another layout that acts as a member does on what both know.

    What is new begins without influence: views, targets, the sentence. Further actions of a longer chunk begin as the
    last one of the member's.

    Args:
        member: of the same network, state and actions; its views are among those of the new student.
        config: of the new student, with the algorithm "bc". layout: of the new student.
        route: of a joined policy, that on which the member is to act: it is told this for every kind of subtask.
        like: whose encoders the images have that are new to the member; or the seed of random ones.
    """
    known = isinstance(like, BehaviourCloning)
    made = make_student(config, layout, 0 if known else like)
    assert isinstance(made, BehaviourCloning)
    assert isinstance(made.trunk, Trunk)
    weight, bias = member.normalized_head
    width = len(layout.actions)
    last = len(bias) // width - 1
    # The last action again and again where the new chunk is longer.
    steps = [min(step, last) for step in range(config.chunk)]
    rows = [step * width + action for step in steps for action in range(width)]
    encoders = Member(like if known else made).encoders
    with torch.no_grad():
        take_over(made.trunk, member, _codes(member, layout, route), encoders)
        made.head.weight.copy_(weight[rows])
        made.head.bias.copy_(bias[rows])
        made.action_normalizer.load_state_dict(
            member.student.action_normalizer.state_dict()
        )
    return made


def _codes(member: Member, layout: ObservationSpec, route: int) -> Tensor:
    """What the member is told for each number of the new student's code, (T, R)."""
    new = _names(layout)
    trunk = member.student.trunk
    if isinstance(trunk, RoutedTrunk):
        table = torch.zeros(len(trunk.routes), len(new))
        # Exactly one of the kinds is told at a time.
        table[route] = torch.tensor([float(name.startswith("subtask/")) for name in new])
        return table
    old = _names(member.student.layout)
    same = [[float(a == b) for b in new] for a in old]
    return torch.tensor(same).reshape(len(old), len(new))


def _names(layout: ObservationSpec) -> Sequence[str]:
    """A name for each number of a layout's code."""
    entries = itertools.chain.from_iterable(
        part.entries(layout) for part in conditioning_parts(layout.inputs)
    )
    return [f"{name}{number}" for name, width in entries for number in range(width)]
