"""What is kept of an episode: plain data that goes to JSON and back without loss."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from numbers import Integral, Real
from typing import Any

import numpy as np

from mjhab.core.names import check_name
from mjhab.core.seeding import EpisodeId
from mjhab.tasks.instructions import BY_TELEPORT, MAX_INSTRUCTION_CHARACTERS
from mjhab.tasks.plan import GOAL_OF

OPTIONAL = (
    "style",
    "instruction",
    "instructions",
    "error",
    "config_hash",
    "peak_finger_force",
    "teleported",
    "skipped_homes",
    "perturbation",
    "actors",
)
"""Fields of both records that are left out of a file where they are empty; older files lack them."""
Event = tuple[int, str]
"""Control step (the first step of an episode is 1) and the name of what happened in it."""

MAX_COUNT = 2**63 - 1
"""Largest seed, index or number of steps of a record."""


@dataclass(frozen=True)
class PlanEntry:
    """One subtask as it was asked for. ``goal``: where or what it aims at, in words or numbers of the env."""

    kind: str
    target: str
    goal: Any = None


@dataclass(frozen=True)
class SubtaskRecord:
    """How one subtask of an episode ended. Forces [N], ``cumulative_force`` [N x control steps].

    ``label`` is None where the kind has no label. Steps count from the start of the episode. The forces are those on
    the robot without its fingers, which the limits count; ``peak_finger_force`` is the largest on both fingers
    together, None in records of older versions. ``teleported``: the environment moved the robot to the goal, so that
    success says nothing about the policy.
    """

    index: int
    kind: str
    target: str
    label: str | None
    legacy_label: str | None
    success_once: bool
    success_at_end: bool
    start_step: int
    end_step: int
    peak_force: float
    cumulative_force: float
    events: tuple[Event, ...] = ()
    peak_finger_force: float | None = None
    teleported: bool = False

    @property
    def steps_to_success(self) -> int | None:
        """Control steps from the start of the subtask to its first success, None without success.

        Success that held from the start on has no event; it counts as one step.
        """
        if not self.success_once:
            return None
        found = (step for step, name in self.events if name == "success")
        return max(min(found, default=self.start_step + 1) - self.start_step, 1)

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> SubtaskRecord:
        """Build from an entry of ``info["ended"]`` or from JSON; numbers may be numpy scalars.

        Raises:
            KeyError: a field is missing.
            ValueError: a field has another type, or a count is negative.
        """
        return cls(
            index=_count("index", data["index"]),
            kind=str(data["kind"]),
            target=str(data["target"]),
            label=str(data["label"]) if data["label"] else None,
            legacy_label=str(data["legacy_label"]) if data["legacy_label"] else None,
            success_once=_truth("success_once", data["success_once"]),
            success_at_end=_truth("success_at_end", data["success_at_end"]),
            start_step=_count("start_step", data["start_step"]),
            end_step=_count("end_step", data["end_step"]),
            peak_force=round(_number("peak_force", data["peak_force"]), 3),
            cumulative_force=round(
                _number("cumulative_force", data["cumulative_force"]), 3
            ),
            events=_events(data["events"]),
            peak_finger_force=_peak(data.get("peak_finger_force")),
            teleported=_truth("teleported", data.get("teleported", False)),
        )


@dataclass(frozen=True)
class EpisodeRecord(EpisodeId):
    """One finished episode.

    ``subtasks`` holds the subtasks that ended; those never reached are absent. ``completed`` counts the subtasks of the
    plan that succeeded. ``force`` is the robot force [N] of every control step, to 0.1 N. ``taint`` names what the
    simulation flagged (then the episode's physics cannot be trusted). ``spawn_fallback``: no random start was valid and
    the nearest valid one was taken. ``final_state`` is a hash of the last state, bit by bit. ``seconds`` is wall time
    and takes no part in comparisons: everything else is a function of (seed, index). ``style``: how the policy was
    asked to act in this episode (fields of `tasks.style.Style`), empty where nothing was asked. ``instruction``: what
    the episode asks for as a sentence, ``instructions`` the same for each subtask of the plan (`tasks.instructions`);
    empty in records of older versions. ``error``: why the policy could not go on (`rollout.policy.Fallible`) and the
    episode ended, empty where it could. ``peak_force`` is that of ``force``, ``peak_finger_force`` [N] that of both
    fingers together, None in records of older versions. ``skipped_homes`` had no room for the episode, so that ``home``
    took their place. ``perturbation``: what was perturbed, by axis (`config.perturbing`), or empty. ``actors``: control
    steps of each who acted, where several did (`core.action_notes`), else empty. ``config_hash`` names the
    configuration of the run folder that the record belongs to (`store.config_hash`); it is empty outside of a run
    folder and in those of older versions, and takes no part in comparisons.
    """

    home: str
    task: str
    split: str
    subtask: str | None
    plan: tuple[PlanEntry, ...]
    subtasks: tuple[SubtaskRecord, ...]
    success_once: bool
    success_at_end: bool
    fail: bool
    steps: int
    completed: int
    events: tuple[Event, ...]
    peak_force: float
    cumulative_force: float
    force: tuple[float, ...]
    taint: tuple[str, ...]
    spawn_fallback: bool
    final_state: str
    seconds: float = field(default=0.0, compare=False)
    style: Mapping[str, Any] = field(default_factory=dict)
    instruction: str = ""
    instructions: tuple[str, ...] = ()
    error: str = ""
    config_hash: str = field(default="", compare=False)
    peak_finger_force: float | None = None
    skipped_homes: tuple[str, ...] = ()
    perturbation: Mapping[str, Any] = field(default_factory=dict)
    actors: Mapping[str, int] = field(default_factory=dict)

    @property
    def steps_to_success(self) -> int | None:
        """Control steps to the first success of the episode (of a whole task: to its end), None without success."""
        if not self.success_once:
            return None
        if not self.subtasks:
            found = (step for step, name in self.events if name == "success")
            return min(found, default=self.steps)
        # A whole task succeeds with its last subtask.
        last = self.subtasks[-1]
        needed = last.steps_to_success
        return self.steps if needed is None else last.start_step + needed

    def to_dict(self) -> dict[str, Any]:
        """Return plain data for ``json.dumps``; keys are the field names, without the OPTIONAL ones that are empty."""
        values = asdict(self)
        subtasks = tuple(_without_empty(subtask) for subtask in values["subtasks"])
        return _without_empty({**values, "subtasks": subtasks})

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> EpisodeRecord:
        """Read what ``to_dict`` wrote.

        Raises:
            ValueError: a field is missing or has another type; a subtask is not one of the plan; or a name has
                characters that `core.names.check_name` refuses, because names become parts of paths.
        """
        try:
            record = cls(**_values(data))
        except (KeyError, TypeError, AttributeError) as error:
            raise ValueError(
                f"it is no record of an episode ({type(error).__name__}: {error})"
            ) from error
        if not record.plan:
            raise ValueError("its plan has no subtask")
        for entry in record.subtasks:
            # Labels of a subtask that is not in the plan would be counted under a wrong name.
            if entry.index >= len(record.plan):
                raise ValueError(
                    f"it has subtask {entry.index} of a plan of {len(record.plan)}"
                )
        _check_names(record)
        return record


def skip_counts(skipped: Iterable[Sequence[str]]) -> dict[str, int]:
    """Count in how many episodes each home was skipped, sorted by name; ``skipped``: the homes of every episode."""
    return dict(sorted(Counter(home for homes in skipped for home in homes).items()))


def skips_text(skipped: Mapping[str, int]) -> str:
    """Words for the result of `skip_counts`: "apt_0 in 2 episodes, apt_3 in 1"."""
    homes = [f"{home} in {count}" for home, count in skipped.items()]
    unit = " episode" if next(iter(skipped.values())) == 1 else " episodes"
    return ", ".join([homes[0] + unit, *homes[1:]])


def _without_empty(values: dict[str, Any]) -> dict[str, Any]:
    """Fields of a record without the OPTIONAL ones that are empty; a force of 0.0 is not."""
    return {
        name: value
        for name, value in values.items()
        if name not in OPTIONAL or value or isinstance(value, float)
    }


def _values(data: Mapping[str, Any]) -> dict[str, Any]:
    """The fields of a record by name, each of its type."""
    values = {
        f.name: data[f.name] for f in fields(EpisodeRecord) if f.name not in OPTIONAL
    }
    for name in ("seed", "index", "steps", "completed"):
        values[name] = _count(name, data[name])
    for name in ("success_once", "success_at_end", "fail", "spawn_fallback"):
        values[name] = _truth(name, data[name])
    for name in ("peak_force", "cumulative_force", "seconds"):
        values[name] = _number(name, data[name])
    values["style"] = dict(data.get("style", {}))
    values["perturbation"] = _mapping("perturbation", data.get("perturbation", {}))
    values["actors"] = {
        _sentence(name): _count("actors", steps)
        for name, steps in _mapping("actors", data.get("actors", {})).items()
    }
    values["instruction"] = _sentence(data.get("instruction", ""))
    values["instructions"] = tuple(
        _sentence(text) for text in data.get("instructions", ())
    )
    values["error"] = _sentence(data.get("error", ""))
    values["config_hash"] = str(data.get("config_hash", ""))
    values["peak_finger_force"] = _peak(data.get("peak_finger_force"))
    values["final_state"] = str(data["final_state"])
    skipped = data.get("skipped_homes", ())
    _check_list("skipped_homes", skipped)
    values["skipped_homes"] = tuple(str(name) for name in skipped)
    for name in ("plan", "subtasks", "events", "force", "taint"):
        _check_list(name, data[name])
    values["plan"] = tuple(PlanEntry(**entry) for entry in data["plan"])
    values["subtasks"] = tuple(
        SubtaskRecord.from_dict(_with_teleport(entry, values["instructions"]))
        for entry in data["subtasks"]
    )
    values["events"] = _events(data["events"])
    values["force"] = tuple(_number("force", value) for value in data["force"])
    values["taint"] = tuple(data["taint"])
    return values


def _with_teleport(
    entry: Mapping[str, Any], instructions: tuple[str, ...]
) -> Mapping[str, Any]:
    """A subtask as it was written. In older files the sentences alone say what was done by teleport."""
    index = _count("index", entry["index"])
    instruction = instructions[index] if index < len(instructions) else ""
    # The entry last: what a newer file says itself counts.
    return {"teleported": instruction.endswith(BY_TELEPORT), **entry}


def _peak(value: Any) -> float | None:
    return None if value is None else round(_number("peak_finger_force", value), 3)


def _count(name: str, value: Any) -> int:
    """A whole number from 0 that was read from a file; numpy scalars become ints."""
    # JSON's true would pass for 1.
    whole = isinstance(value, Integral) and not isinstance(value, bool)
    if not whole or not 0 <= int(value) <= MAX_COUNT:
        raise ValueError(
            f"{name} must be a whole number from 0, not {str(value)[:60]!r}."
        )
    return int(value)


def _check_list(name: str, value: Any) -> None:
    """Refuse what can be gone through like a list, but is none: keys of an object, characters of a text."""
    if isinstance(value, Mapping | str):
        raise ValueError(f"{name} must be a list, not {str(value)[:60]!r}.")


def _mapping(name: str, value: Any) -> dict[str, Any]:
    """An object that was read from a file."""
    if not isinstance(value, Mapping):
        raise ValueError(f"{name} must be an object, not {str(value)[:60]!r}.")
    return dict(value)


def _truth(name: str, value: Any) -> bool:
    if not isinstance(value, bool | np.bool_):
        raise ValueError(f"{name} must be true or false, not {str(value)[:60]!r}.")
    return bool(value)


def _number(name: str, value: Any) -> float:
    """A number that was read from a file; NaN and infinity may come from a tainted episode."""
    if isinstance(value, bool) or not isinstance(value, Real):
        raise ValueError(f"{name} must be a number, not {str(value)[:60]!r}.")
    try:
        return float(value)
    except OverflowError as error:
        raise ValueError(f"{name} must be a number that fits 64 bits.") from error


def _events(entries: Any) -> tuple[Event, ...]:
    return tuple((_count("step of an event", step), str(name)) for step, name in entries)


def _sentence(text: Any) -> str:
    """A line of text that was read from a file, if it is one: others go into pages and into the names of tasks."""
    if not isinstance(text, str) or len(text) > MAX_INSTRUCTION_CHARACTERS:
        raise ValueError(
            f"an instruction or an error is a text of at most {MAX_INSTRUCTION_CHARACTERS} characters, "
            f"not {str(text)[:60]!r}."
        )
    # A line break or a control character would break tables, and steer terminals.
    if text and not text.isprintable():
        raise ValueError(
            f"an instruction or an error is one line of printable text, not {text[:60]!r}."
        )
    return text


def _check_names(record: EpisodeRecord) -> None:
    for name in ("home", "task", "split"):
        check_name(f"field {name!r} of the record", getattr(record, name))
    check_name("field 'subtask' of the record", record.subtask or "", empty=True)
    for home in record.skipped_homes:
        check_name("skipped home of the record", home)
    for entry in (*record.plan, *record.subtasks):
        check_name("kind of a subtask", entry.kind)
        target = entry.target
        if isinstance(target, str):
            # It has spaces, which names have not.
            target = target.removeprefix(GOAL_OF)
        check_name("target of a subtask", target, empty=True)
    for entry in record.subtasks:
        check_name("label of a subtask", entry.label or "", empty=True)
        check_name("legacy label of a subtask", entry.legacy_label or "", empty=True)
    for _, event in record.events:
        check_name("name of an event", event)
    for fault in record.taint:
        check_name("name of a fault", fault)
