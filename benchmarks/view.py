"""What the viewer sends to a page, how often, and what that costs here; nothing is drawn."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from benchmarks.command import run_command
from mjhab.cli.output import Listing, report
from mjhab.core.errors import MjhabError, UsageError
from mjhab.evaluation.evaluate import EvalSpec
from mjhab.evaluation.resolve import inspect_policy
from mjhab.viewer import require_viser

if TYPE_CHECKING:
    from mjhab.viewer.pages.app import Viewer
    from mjhab.viewer.pages.counting import CountingPage
    from mjhab.viewer.sources.live import LiveSession

PATIENCE_SECONDS = 120.0
"""Longest wait for a first frame; kernels may have to be compiled."""
MIN_FRAMES_PER_S = 30.0
"""Asked for with one world."""


@dataclass(frozen=True)
class ViewSpec:
    """Measure the viewer: time until the first frame, frames per second, bytes and processor time per frame.

    `python -m benchmarks.view --worlds 1 4 16`

    The test client counts frames without drawing. Fails below 30 frames per second with a single world.
    """

    worlds: tuple[int, ...] = (1, 4, 16)
    """Numbers of running worlds, measured one after the other."""
    policy: str = "random"
    """The policy, as in `mjhab eval`."""
    task: str = "set_table"
    """Task of the worlds: set_table, tidy_house or prepare_groceries."""
    subtask: str = "pick"
    """Subtask of the worlds."""
    seconds: float = 5.0
    """Duration of counting frames [s]."""
    threads: int = 0
    """Threads of the physics; 0 takes all cores."""
    assets: str = "builtin"
    """Asset pack: builtin, or the folder of another pack."""
    json: bool = False
    """Print one line of JSON instead of a table."""


def measure_view(spec: ViewSpec) -> dict[str, dict[str, float]]:
    """Show running worlds to a page that only counts, with each of several numbers of worlds.

    Returns:
        By number of worlds: "first_frame_s" from making the viewer, the environment included, to the first frame;
        "page_s" from opening a page until it has all that was there before, which is "opening_mb"; "frames_per_s" and
        "kb_per_frame", panels and camera pictures included; "frame_cpu_ms" of processor time for poses and marks;
        "control_steps_per_s" of all worlds together; "cores" that were busy with all of it.

    Raises:
        UsageError: the viewer needs a package that is not installed, or there is no such policy.
        MjhabError: nothing is shown.
    """
    require_viser()
    if not spec.worlds or min(spec.worlds) < 1:
        raise UsageError(f"worlds must be at least 1, got {list(spec.worlds)}.")
    inspect_policy(spec.policy)
    return {str(worlds): _measure(worlds, spec) for worlds in spec.worlds}


def _measure(worlds: int, spec: ViewSpec) -> dict[str, float]:
    from mjhab.viewer.pages.app import Viewer
    from mjhab.viewer.pages.counting import CountingPage
    from mjhab.viewer.sources.live import LiveSession
    from mjhab.viewer.sources.pace import RealTimeClock

    begun = time.perf_counter()
    what = EvalSpec.of(
        policy=spec.policy,
        task=spec.task,
        subtask=spec.subtask,
        worlds=worlds,
        episodes=worlds,
        threads=spec.threads,
        assets=spec.assets,
    )
    # Worlds go on with their next episode, or soon there would be nothing to send.
    session = LiveSession(what, 0, RealTimeClock(), hold_at_end=False)
    viewer = Viewer(session, port=0)
    try:
        viewer.start()
        # Without a page the first frame tells how long the worlds take to open.
        _wait(lambda: viewer.frames > 0, viewer)
        opened = time.perf_counter()
        page = CountingPage(viewer.port)
        try:
            _wait(lambda: not math.isinf(page.complete_at), viewer)
            opening = page.bytes
            found = _rates(viewer, session, page, spec.seconds)
        finally:
            page.close()
    finally:
        viewer.close()
    return {
        "first_frame_s": round(viewer.first_frame_at - begun, 2),
        "page_s": round(page.complete_at - opened, 2),
        "opening_mb": round(opening / 1e6, 2),
        **found,
    }


def _wait(ready: Callable[[], bool], viewer: Viewer) -> None:
    until = time.monotonic() + PATIENCE_SECONDS
    while not ready():
        problem = viewer.problem or viewer.source.problem
        if problem or time.monotonic() > until:
            raise MjhabError(f"the viewer shows nothing: {problem or 'it is too slow'}")
        time.sleep(0.01)


def _rates(
    viewer: Viewer, session: LiveSession, page: CountingPage, seconds: float
) -> dict[str, float]:
    """Rates over so many seconds."""
    frames = viewer.frames
    steps = session.steps
    sent = page.bytes
    frame_cpu = viewer.frame_cpu_s
    cpu = time.process_time()
    begun = time.perf_counter()
    # This thread must not work: its time would count for the viewer.
    time.sleep(seconds)
    spent = time.perf_counter() - begun
    shown = max(viewer.frames - frames, 1)
    return {
        "frames_per_s": round((viewer.frames - frames) / spent, 1),
        "kb_per_frame": round((page.bytes - sent) / shown / 1e3, 2),
        "frame_cpu_ms": round(1e3 * (viewer.frame_cpu_s - frame_cpu) / shown, 2),
        "control_steps_per_s": round(
            (session.steps - steps) * len(session.tracks) / spent, 1
        ),
        "cores": round((time.process_time() - cpu) / spent, 2),
    }


def bench_view(spec: ViewSpec) -> int:
    """Print a row per number of worlds; returns 1 if the frame rate of a single world is too low."""
    found = measure_view(spec)
    rows = [(worlds, *numbers.values()) for worlds, numbers in found.items()]
    columns = [name.replace("_", " ") for name in next(iter(found.values()))]
    report(spec.json, found, Listing("The viewer", ("worlds", *columns), rows))
    single = found.get("1")
    return 1 if single is not None and single["frames_per_s"] < MIN_FRAMES_PER_S else 0


def main(words: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    return run_command("view", ViewSpec, bench_view, words, {"worlds": 1, "seconds": 1})


if __name__ == "__main__":
    sys.exit(main())
