"""Checkpoints: weights as safetensors with the resolved config as JSON in the file's metadata. No pickle is used.

A student file holds the weights of the policy. A training file also holds the state needed to continue training.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, TypeVar, cast

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from mjhab.core.errors import UsageError, fault
from mjhab.core.files.cache import write_atomic
from mjhab.core.files.reading import is_file, parse_json, reason
from mjhab.core.typed.options import read_record
from mjhab.core.version import __version__
from mjhab.learning.configs import StudentConfig, student_from_plain, to_plain
from mjhab.learning.observation.backbone import find_backbone
from mjhab.learning.observation.spec import ObservationSpec
from mjhab.learning.runs.run import STUDENT
from mjhab.learning.students.compact import compacted, expanded
from mjhab.learning.students.heads import make_student
from mjhab.learning.students.routed import secondary_weights
from mjhab.learning.students.student import Student

FORMAT = "mjhab-student-1"
SUFFIX = ".safetensors"
_HEAD = "mjhab"


@dataclass(frozen=True)
class Checkpoint:
    """Content of a checkpoint file. about: JSON data added by the writer, e.g. the number of updates."""

    config: StudentConfig
    layout: ObservationSpec
    about: Mapping[str, Any]
    tensors: Mapping[str, Tensor]

    @property
    def is_untrained(self) -> bool:
        """Whether its network was never updated, as far as the file tells."""
        # Older files tell the number of updates alone, and the oldest nothing.
        return not self.about.get("trained", self.about.get("step", 1))


def save_student(path: Path, student: Student, about: Mapping[str, Any]) -> None:
    """Write the weights of a student atomically."""
    save_tensors(path, student, student.state_dict(), about)


def save_compact(
    source: Path, target: Path, about: Mapping[str, Any] | None = None
) -> None:
    """Write a student file in about half of its size, see `compacted`.

    Args:
        source: the student file.
        target: the new file.
        about: in place of the source's.

    Raises:
        UsageError: see `load_student`.
    """
    saved = load_checkpoint(source)
    student = student_of(source, saved)
    metadata = saved.about if about is None else about
    tensors = compacted(student.state_dict(), secondary_weights(student))
    save_tensors(target, student, tensors, metadata)


def load_checkpoint(path: Path) -> Checkpoint:
    """Read a student file or a training file.

    Raises:
        UsageError: the file does not exist, is not such a checkpoint, or holds numbers that are not finite; or its
            backbone is not found.
    """
    if not is_file(path):
        raise fault(
            path, f"does not exist; give a checkpoint (*{SUFFIX}) of `mjhab train`."
        )
    try:
        with safe_open(path, "pt") as file:
            head = parse_json((file.metadata() or {}).get(_HEAD, "{}"))
            if not isinstance(head, dict) or head.get("format") != FORMAT:
                raise fault(path, f"not a checkpoint of `mjhab train` (format {FORMAT}).")
            stored = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dict)
            tensors = expanded(stored)
    except (SafetensorError, ValueError, OSError, RuntimeError) as error:
        raise fault(path, f"cannot be read as a checkpoint: {reason(error)}.") from error
    try:
        described = {
            name: read_record(dict[str, Any], head.get(name), name)
            for name in ("student", "layout")
        }
        config = student_from_plain(described["student"])
        layout = ObservationSpec.from_plain(config.inputs, described["layout"])
        about = read_record(dict[str, Any], head.get("about", {}), "about")
        # The config has its path and the layout its hash; one alone cannot be checked.
        if bool(config.inputs.backbone) != (layout.backbone is not None):
            raise ValueError("it tells of a backbone in one of two places alone")
    except UsageError as error:
        raise fault(path, str(error)) from error
    except ValueError as error:
        raise fault(path, f"damaged: its header is no student's ({error})") from error
    # Before a network is built, so that the message names the file and not a layer.
    check_finite(path, tensors)
    # The path in the file is that of the machine it was trained on.
    if layout.backbone:
        found = find_backbone(path, config.inputs.backbone, layout.backbone)
        config = replace(config, inputs=replace(config.inputs, backbone=found))
        layout = replace(layout, inputs=config.inputs)
    return Checkpoint(config, layout, about, tensors)


def load_student(path: Path) -> Student:
    """Load the student of a student file, ready for inference.

    Raises:
        UsageError: see `load_checkpoint` and `student_of`.
    """
    return student_of(path, load_checkpoint(path))


def student_of(path: Path, saved: Checkpoint) -> Student:
    """The student of a student file, ready for inference.

    Args:
        path: the file, for the message.
        saved: its content.

    Raises:
        UsageError: the file is a training file or holds the weights of another network.
    """
    # A header can ask for a network of any size; the weights in the file are what it costs.
    if _described_shapes(path, saved) != _shapes(saved.tensors):
        raise fault(
            path, f"does not hold the weights of a student alone. {_remedy(path)}"
        )
    student = make_student(saved.config, saved.layout)
    student.load_state_dict(dict(saved.tensors))
    return student.eval().requires_grad_(False)


def _described_shapes(path: Path, saved: Checkpoint) -> dict[str, tuple[int, ...]]:
    """Shapes of the weights of the network that a file describes, which takes no memory yet.

    Raises:
        UsageError: it describes none.
    """
    try:
        # Tensors without memory: shapes are all that is asked.
        with torch.device("meta"):
            return _shapes(make_student(saved.config, saved.layout).state_dict())
    # The file chooses the sizes; what torch says about those that do not fit together differs from layer to layer.
    except (
        RuntimeError,
        ValueError,
        TypeError,
        AssertionError,
        ArithmeticError,
    ) as error:
        raise fault(
            path, f"damaged: it describes no network ({reason(error)})."
        ) from error


def _shapes(tensors: Mapping[str, Tensor]) -> dict[str, tuple[int, ...]]:
    return {name: tuple(tensor.shape) for name, tensor in tensors.items()}


State = TypeVar("State")


def saved_state(path: Path, about: Mapping[str, Any], kind: type[State]) -> State:
    """The progress of a run that the header of its training file tells.

    Args:
        path: the file, for the message.
        about: of its header.
        kind: a dataclass; what the header tells besides its fields is left out.

    Raises:
        UsageError: a field does not fit.
    """
    known = {field.name for field in fields(cast(Any, kind))}
    try:
        return read_record(
            kind, {name: about[name] for name in known & set(about)}, "about"
        )
    except ValueError as error:
        raise fault(path, f"damaged: {error}") from error


@contextmanager
def restoring(path: Path) -> Iterator[None]:
    """Within this context tensors of a training file are put into the networks and optimizers of a run.

    Raises:
        UsageError: they do not fit.
    """
    try:
        yield
    # A RuntimeError of torch, and not the fault of the file.
    except torch.OutOfMemoryError:
        raise
    except (KeyError, ValueError, TypeError, RuntimeError) as error:
        raise fault(
            path,
            f"does not hold the state of this run ({reason(error)}); begin a new run.",
        ) from error


def _remedy(path: Path) -> str:
    """What to give instead of a file that is no student's: the student's beside it, if there is one."""
    beside = path.with_name(STUDENT)
    if beside != path and beside.is_file():
        return f"Give {beside}."
    return f"A training file serves to continue a run; give the {STUDENT} of a finished run of `mjhab train`."


def save_tensors(
    path: Path, student: Student, tensors: Mapping[str, Tensor], about: Mapping[str, Any]
) -> None:
    """Write tensors atomically, with the config and layout of their student."""
    head = {
        "format": FORMAT,
        "version": __version__,
        "student": to_plain(student.config),
        "layout": student.layout.to_plain(),
        "about": dict(about),
    }
    kept = {
        # Cloned, because safetensors refuses tensors that share memory.
        name: tensor.detach().contiguous().clone()
        for name, tensor in tensors.items()
    }
    # Not save_file: it makes files that nobody else can read, whatever the umask.
    content = save(kept, {_HEAD: json.dumps(head)})
    write_atomic(path, lambda temporary: temporary.write_bytes(content))


def check_finite(path: Path, tensors: Mapping[str, Tensor]) -> None:
    """Refuse weights of which a number is NaN or infinite: they make no action.

    Args:
        path: the file, for the message.
        tensors: its content by name.

    Raises:
        UsageError: a tensor is not finite; the message names the first one and counts its numbers.
    """
    for name, tensor in tensors.items():
        wrong = int((~tensor.isfinite()).sum())
        if wrong:
            raise fault(
                path,
                f"cannot act: {wrong:,} of the {tensor.numel():,} numbers of its tensor {name} are not finite "
                "(NaN or infinite). Give another checkpoint, such as one from before the training diverged.",
            )


def prefixed(part: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The tensors with "<part>/" in front of their names."""
    return {f"{part}/{name}": value for name, value in tensors.items()}


def part_of(part: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The tensors whose names start with "<part>/", without that prefix: the inverse of ``prefixed``."""
    before = f"{part}/"
    return {
        name.removeprefix(before): value
        for name, value in tensors.items()
        if name.startswith(before)
    }
