"""The mean of the weights of policies that began alike: often better than each, and it forgets less."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch

from mjhab.core.arithmetic.sums import ordered_sum
from mjhab.core.errors import fault
from mjhab.learning.assigned.members import scenes_of
from mjhab.learning.assigned.spec import PolicyMeanSpec
from mjhab.learning.checkpoint import load_checkpoint, save_student, student_of
from mjhab.learning.runs.request import fitting
from mjhab.learning.students.bc import BehaviourCloning
from mjhab.learning.students.student import Student


@dataclass(frozen=True)
class MeanPolicy:
    """What `mean` has made. shares: of each policy, their sum is 1."""

    file: Path
    bytes: int
    shares: tuple[float, ...]


def mean(spec: PolicyMeanSpec) -> MeanPolicy:
    """Write the checkpoint whose weights and normalizers are the mean of those of several.

    Raises:
        UsageError: a file cannot be read, or does not fit the first one.
    """
    first = spec.policies[0]
    saved, *others = [load_checkpoint(path) for path in spec.policies]
    scenes = scenes_of(first, saved)
    made = student_of(first, saved)
    students: list[Student] = [made]
    # The encoders of images that another does not see have no mean but themselves.
    like = made if isinstance(made, BehaviourCloning) else 0
    for path, other in zip(spec.policies[1:], others, strict=True):
        found, differs = fitting(path, other, saved.config, saved.layout, scenes, like)
        if found is None:
            raise fault(path, f"has another {differs} than {first}: they have no mean.")
        students.append(found)
    given = spec.shares or (1.0,) * len(students)
    whole = ordered_sum(given)
    shares = tuple(share / whole for share in given)
    weights = [student.state_dict() for student in students]
    factors = torch.tensor(shares)
    made.load_state_dict(
        {
            name: torch.tensordot(factors, torch.stack([one[name] for one in weights]), 1)
            for name in weights[0]
        }
    )
    about = {
        **saved.about,
        "algorithm": "mean",
        "shares": list(shares),
        "members": [dict(one.about) for one in (saved, *others)],
    }
    save_student(spec.out, made, about)
    return MeanPolicy(spec.out, spec.out.stat().st_size, shares)
