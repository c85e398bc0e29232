"""``mjhab view``: view recorded episodes and running worlds in the browser, or write an episode as one page."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING

from mjhab.cli.output import print_json, report
from mjhab.core.action_notes import HUMAN
from mjhab.core.files.interrupts import sigterm_interrupts
from mjhab.data.select.query import read_filter
from mjhab.evaluation.resolve import full_spec, inspect_policy
from mjhab.viewer import require_viser
from mjhab.viewer.spec import ViewSpec

if TYPE_CHECKING:
    from mjhab.viewer.sources.source import ViewSource


def run_view(spec: ViewSpec, json: bool) -> int:
    """Run the command; returns 0. A page is served until Ctrl-C or SIGTERM."""
    if spec.export is not None:
        return _export(spec, json)
    require_viser()
    return _serve(spec, json)


def _export(spec: ViewSpec, json: bool) -> int:
    from mjhab.viewer.export.page import export_page
    from mjhab.viewer.export.stills import stills_of
    from mjhab.viewer.sources.replay import Replay

    assert spec.export is not None
    replay = Replay(spec.places, read_filter(spec.where, spec.preset))
    try:
        title = replay.choice_at(spec.episode)
        stills = []
        if spec.stills:
            stills = stills_of(*replay.place_of(title), spec.stills, spec.env)
        done = export_page(replay, title, spec.export, stills)
    finally:
        replay.close()
    counted = {"bytes": done.bytes, "frames": done.frames, "stills": len(stills)}
    said = f"{done.file}: {done.frames} frames, {done.bytes:,} bytes"
    report(json, {"file": str(done.file), **counted}, said)
    return 0


def _serve(spec: ViewSpec, json: bool) -> int:
    from mjhab.viewer.pages.app import Viewer

    source = _source(spec)
    try:
        source.prepare()
        viewer = Viewer(source, spec.host, spec.port, hold=True)
    # Ctrl-C, too, must close what the source has opened.
    except BaseException:
        source.close()
        raise
    try:
        with sigterm_interrupts():
            viewer.start()
            url = f"http://{spec.host}:{viewer.port}"
            if json:
                print_json({"url": url, "port": viewer.port})
            else:
                in_use = spec.port not in (0, viewer.port)
                other = f" (port {spec.port} is in use)" if in_use else ""
                print(f"Open {url}{other}. Ctrl-C ends.", flush=True)
            # The page is served by threads of viser; this one has nothing to do but end.
            threading.Event().wait()
    except KeyboardInterrupt:
        pass
    finally:
        viewer.close()
    return 0


def _source(spec: ViewSpec) -> ViewSource:
    if spec.places:
        from mjhab.viewer.sources.replay import Replay

        return Replay(spec.places, read_filter(spec.where, spec.preset), spec.episode)
    from mjhab.viewer.sources.live import LiveSession
    from mjhab.viewer.sources.pace import RealTimeClock

    asked = spec.asked
    for policy in (spec.policy, *spec.policies):
        if policy != HUMAN:
            # Before the page opens, where a wrong name would only show as a world that stands still.
            inspect_policy(full_spec(policy, asked.task, asked.subtask, asked.target))
    # Nobody drives before a page is open, and time would run out: the page begins with a pause.
    pace = RealTimeClock(playing=spec.policy != HUMAN)
    return LiveSession(
        spec.as_evaluation(),
        spec.episode,
        pace,
        policies=spec.policies,
        shard=spec.record,
    )
