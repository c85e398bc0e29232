"""``mjhab view``: view recorded episodes and running worlds in the browser, or write an episode as one page."""

from __future__ import annotations

import dataclasses
import signal
import threading
from typing import TYPE_CHECKING

from mjhab.cli.options.view import ViewOptions
from mjhab.cli.output import at_least, print_json
from mjhab.config.profile_choice import profile_options
from mjhab.core.errors import UsageError
from mjhab.data.select.query import read_filter
from mjhab.evaluation.evaluate import EvalSpec
from mjhab.evaluation.resolve import full_spec, inspect_policy
from mjhab.tasks.household.registry import TASKS
from mjhab.tasks.subtasks.registry import SUBTASKS
from mjhab.viewer import require_viser
from mjhab.viewer.sources.hand import HUMAN

if TYPE_CHECKING:
    from mjhab.viewer.sources.source import Source

RECORDED_OPTIONS = ("places", "where", "preset", "export")
"""Options that recorded episodes alone have."""
SHARED_OPTIONS = ("episode", "host", "port", "threads", "json")
"""Options of both; all others are for running worlds."""


def run_view(options: ViewOptions) -> int:
    """Run the command; returns 0. A page is served until Ctrl-C or SIGTERM."""
    at_least("worlds", options.worlds, 1)
    at_least("episode", options.episode, 0)
    _check_choice(options)
    if options.export is not None:
        return _export(options)
    require_viser()
    return _serve(options)


def _check_choice(options: ViewOptions) -> None:
    for field in dataclasses.fields(options):
        name = field.name
        given = getattr(options, name) != field.default
        if given and options.places and name not in (*RECORDED_OPTIONS, *SHARED_OPTIONS):
            raise UsageError(
                f"--{name.replace('_', '-')} is for running worlds: leave out the shards to look at."
            )
        if given and not options.places and name in RECORDED_OPTIONS:
            raise UsageError(
                f"--{name} is for recorded episodes: give a shard or a folder of them."
            )


def _export(options: ViewOptions) -> int:
    from mjhab.viewer.export.page import export_page
    from mjhab.viewer.sources.replay import Replay

    assert options.export is not None
    replay = Replay(options.places, read_filter(options.where, options.preset))
    try:
        done = export_page(replay, replay.choice_at(options.episode), options.export)
    finally:
        replay.close()
    if options.json:
        print_json({"file": str(done.file), "bytes": done.bytes, "frames": done.frames})
    else:
        print(f"{done.file}: {done.frames} frames, {done.bytes:,} bytes")
    return 0


def _serve(options: ViewOptions) -> int:
    from mjhab.viewer.pages.app import Viewer

    source = _source(options)
    try:
        source.prepare()
        viewer = Viewer(source, options.host, options.port, hold=True)
    except BaseException:
        source.close()
        raise
    ended = threading.Event()
    before = signal.signal(signal.SIGTERM, lambda *_: ended.set())
    try:
        viewer.start()
        url = f"http://{options.host}:{viewer.port}"
        if options.json:
            print_json({"url": url, "port": viewer.port})
        else:
            in_use = options.port not in (0, viewer.port)
            other = f" (port {options.port} is in use)" if in_use else ""
            print(f"Open {url}{other}. Ctrl-C ends.", flush=True)
        ended.wait()
    except KeyboardInterrupt:
        pass
    finally:
        viewer.close()
        signal.signal(signal.SIGTERM, before)
    return 0


def _source(options: ViewOptions) -> Source:
    if options.places:
        from mjhab.viewer.sources.replay import Replay

        return Replay(
            options.places, read_filter(options.where, options.preset), options.episode
        )
    from mjhab.viewer.sources.live import LiveSession
    from mjhab.viewer.sources.pace import Pace

    for spec in (options.policy, *options.policies):
        if spec != HUMAN:
            inspect_policy(full_spec(spec, options.task, options.subtask, options.target))
    env = profile_options(options)
    env["reward_mode"] = options.reward or _reward_with_terms(options)
    if options.horizon:
        env["horizon"] = options.horizon
    spec = EvalSpec.of(
        policy=options.policy,
        task=options.task,
        subtask=options.subtask,
        target=options.target,
        worlds=options.worlds,
        episodes=options.worlds,
        seed=options.seed,
        split=options.split,
        home=options.home,
        navigate=options.navigate,
        assets=options.assets,
        threads=options.threads,
        env=env,
    )
    # Nobody drives before a page is open, and time would run out: the page begins with a pause.
    pace = Pace(playing=options.policy != HUMAN)
    return LiveSession(
        spec, options.episode, pace, policies=options.policies, shard=options.record
    )


def _reward_with_terms(options: ViewOptions) -> str:
    """The dense reward, whose terms the page shows; "" (that of an evaluation) where a subtask has none."""
    kinds = (options.subtask,) if options.subtask else TASKS[options.task].subtasks
    return "dense" if all(SUBTASKS[kind].reward is not None for kind in kinds) else ""
