"""``mjhab replay``: verify that the simulator reproduces recorded episodes, or render recorded states."""

from __future__ import annotations

import math

from mjhab.cli.output import Listing, report
from mjhab.core.progress import progress_bar
from mjhab.data.store.places import entries
from mjhab.evaluation.datasets.actions import replay_converted
from mjhab.evaluation.datasets.replay import run_rendering, run_verification
from mjhab.evaluation.datasets.specs import ReplaySpec

_MOST_ROWS = 20


def run_replay(spec: ReplaySpec, json: bool) -> int:
    """Run the command; returns 0, or 1 if a replayed episode differs from its recording.

    Of converted actions: 1 if an episode that succeeded does not with them.
    """
    if spec.actions:
        return _convert(spec, json)
    return _verify(spec, json) if spec.verify else _render(spec, json)


def _convert(spec: ReplaySpec, json: bool) -> int:
    found = replay_converted(spec)
    report(
        json,
        {"actions": spec.actions, **vars(found)},
        f"{spec.actions}: of {found.recorded} episodes that succeeded {found.both} do with converted actions "
        f"({found.episodes} replayed)",
    )
    return 0 if found.both == found.recorded else 1


def _verify(spec: ReplaySpec, json: bool) -> int:
    with progress_bar("replaying", _count(spec)) as advance:
        found = run_verification(spec, advance)
    facts = {
        "episodes": found.episodes,
        "exact": found.exact,
        "max_error": found.max_error if math.isfinite(found.max_error) else None,
        "unlike": len(found.unlike),
        "moved": len(found.moved),
    }
    rows = [
        (name, "yes" if name in found.unlike else "", what)
        for name, what in found.wrong.items()
    ]
    columns = ("episode", "other model", "what differs")
    report(
        json,
        facts,
        Listing("Not as recorded", columns, rows[:_MOST_ROWS]) if rows else None,
        f"{found.exact} of {found.episodes} episodes exact, largest difference {found.max_error:g}",
        f"{len(found.moved)} of them have another start state here and were replayed from the recorded one."
        if found.moved
        else "",
        "Other model: the home compiles to another model here than when it was recorded, with another version "
        "of mjhab or of its assets (see `versions` and `commit` in the shard)."
        if rows and found.unlike
        else "",
    )
    return 0 if found.exact == found.episodes else 1


def _render(spec: ReplaySpec, json: bool) -> int:
    with progress_bar("drawing", _count(spec)) as advance:
        done = run_rendering(spec, advance)
    report(
        json,
        vars(done),
        f"{done.episodes} episodes, {done.frames} frames each camera and image, {done.bytes:,} bytes in "
        f"{spec.out}; {done.present} were there already",
    )
    return 0


def _count(spec: ReplaySpec) -> int:
    return sum(1 for _ in entries(spec.places, copies=True))
