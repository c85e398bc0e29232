"""Entries: policies and what they do."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mjhab.core.errors import UsageError, fault
from mjhab.core.names import kind_of
from mjhab.core.typed.options import read_record
from mjhab.evaluation.resolve import NoPolicyError, Wanted


@dataclass(frozen=True)
class Entry:
    """A policy for a subtask and a type of target ("" for all targets).

    checkpoint: a file of `mjhab train`, several joined by "+" (see `policy_kind`), or another specification as for
    ``--policy``, such as "expert". task: the only one that it is for, "" for all.
    """

    subtask: str
    target: str
    checkpoint: str
    task: str = ""

    @property
    def words(self) -> str:
        """What it does: "set_table open fridge/top_door"."""
        return " ".join(filter(None, (self.task, self.subtask, self.target)))


def chosen(
    where: str, entries: Sequence[Entry], wanted: Wanted | None
) -> tuple[Entry, ...]:
    """The entries that act in a subtask or a whole task; those for its task come before those for all tasks.

    Args:
        where: the file or folder of the entries, for messages.
        entries: all of them.
        wanted: what is to be done; None for all entries.

    Raises:
        NoPolicyError: there is none for the subtask or the task; the message lists the existing ones.
        UsageError: two do the same.
    """
    check_apart(where, entries)
    if wanted is None:
        return tuple(entries)
    best: dict[tuple[str, str], Entry] = {}
    # Reversed, because "" sorts first and stands for all tasks: named tasks must be taken before it.
    for entry in sorted(entries, key=lambda entry: entry.task, reverse=True):
        if entry.task in ("", wanted.task) and _acts_in(entry, wanted):
            best.setdefault((entry.subtask, entry.target), entry)
    if not best:
        done = ", ".join(entry.words for entry in entries) or "nothing"
        missing = Entry(wanted.subtask, wanted.target, "", wanted.task).words
        raise NoPolicyError(
            f"{where} has no policy for {missing}; it has some for: {done}.",
            option="policy",
            given=missing,
            where=where,
        )
    # With a target a policy for it alone comes before one for all targets.
    own = [entry for entry in best.values() if entry.target]
    return tuple(own if wanted.target and own else best.values())


def check_apart(where: str, entries: Sequence[Entry]) -> None:
    """Refuse two entries that do the same.

    Raises:
        UsageError: names both.
    """
    seen: dict[tuple[str, str, str], Entry] = {}
    for entry in entries:
        first = seen.setdefault((entry.task, entry.subtask, entry.target), entry)
        if first is not entry:
            what = entry.words if entry.target else f"{entry.words} of all targets"
            raise UsageError(
                f"{where} names two policies for {what}, {first.checkpoint} and {entry.checkpoint}; leave one out.",
                where=where,
            )


def _acts_in(entry: Entry, wanted: Wanted) -> bool:
    if not wanted.subtask:
        return True
    if entry.subtask != wanted.subtask:
        return False
    # An entry for all targets fits any, and a request without a target leaves the choice to the episode.
    return not (entry.target and wanted.target) or entry.target == kind_of(wanted.target)


def trained_for(path: Path, about: Mapping[str, Any]) -> list[Wanted]:
    """What a checkpoint was trained for, each once.

    Args:
        path: the file, for the message.
        about: of its header.

    Raises:
        UsageError: it does not tell.
    """
    # Files of other programs may be students that nothing was recorded of.
    if "scene" not in about:
        raise fault(
            path,
            "does not say what it was trained for; name it in a file of policies (POLICIES.json).",
        )
    names = ("task", "subtask", "target")
    try:
        scenes = read_record(
            list[dict[str, Any]], [about["scene"], *about.get("also", ())], "scenes"
        )
        told = [
            read_record(Wanted, {name: scene.get(name) for name in names}, "scene")
            for scene in scenes
        ]
    except (TypeError, ValueError) as error:
        raise fault(path, f"is damaged: {error}") from error
    # A dict keeps the order of the file.
    return list(dict.fromkeys(told))
