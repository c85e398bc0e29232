from __future__ import annotations

import collections
import dataclasses
import json
import re
import socket
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import closing
from html import escape
from importlib.resources import files
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import viser
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

import mjhab
from mjhab.core.errors import UsageError
from mjhab.data.select.sets import merge
from mjhab.data.store.shard import ShardWriter
from mjhab.viewer.drawn.glb import home_files
from mjhab.viewer.pages.app import DRAWN, HOLD_SECONDS, Viewer, _HeldStart
from mjhab.viewer.pages.counting import CountingPage
from mjhab.viewer.pages.gateway import HAND_PATH, Gateway
from mjhab.viewer.pages.panels import Panels
from mjhab.viewer.pages.playhead import Playhead
from mjhab.viewer.pages.timeline import actor_colors
from mjhab.viewer.sources.replay import Replay
from tests.refusals import refused
from tests.viewer import check_browser
from tests.viewer.conftest import STEPS


@pytest.fixture(scope="module")
def viewer(shard: Path) -> Iterator[Viewer]:
    """A viewer of recorded episodes whose frames are asked for by hand."""
    made = Viewer(Replay(shard), port=0, cameras=False)
    made.source.start()
    yield made
    made.close()


def robot_positions(viewer: Viewer) -> np.ndarray:
    return np.array([placed.node.position for placed in viewer.stage._placed[:10]])


def test_a_scrubbed_time_line_moves_the_robot(viewer: Viewer) -> None:
    seen = []
    for step in (0, STEPS, 0):
        viewer.playhead.scrub(step)
        assert viewer.frame(0.02) is not None
        seen.append(robot_positions(viewer))
    assert np.abs(seen[0] - seen[1]).max() > 0.01
    np.testing.assert_array_equal(seen[0], seen[2])


def test_only_what_moves_is_sent(viewer: Viewer) -> None:
    viewer.playhead.scrub(3)
    viewer.frame(0.02)
    before = viewer.stage.sent
    viewer.frame(0.02)
    assert viewer.stage.sent == before
    viewer.playhead.scrub(4)
    viewer.frame(0.02)
    assert 0 < viewer.stage.sent - before < 2 * len(viewer.stage._placed)


def test_time_passes_and_ends(viewer: Viewer) -> None:
    viewer.playhead.scrub(0)
    viewer.playhead.play(True)
    viewer.frame(0.1)
    assert viewer.playhead.now == pytest.approx(2.0)
    viewer.source.pace.set_speed(0.5)
    viewer.frame(0.1)
    assert viewer.playhead.now == pytest.approx(3.0)
    viewer.playhead.step_once()
    assert (viewer.playhead.now, viewer.playhead.playing) == (4.0, False)
    viewer.source.pace.set_speed(1.0)
    viewer.playhead.play(True)
    viewer.frame(60.0)
    assert (viewer.playhead.step, viewer.playhead.playing) == (STEPS, False)
    viewer.playhead.play(True)
    assert viewer.playhead.now == 0.0


def test_panels_tell_of_the_state(viewer: Viewer) -> None:
    viewer.playhead.scrub(STEPS)
    viewer.frame(0.02)
    viewer._fill_panels()
    track = viewer.source.track
    assert track is not None and track.last == STEPS
    assert f"{track.moments[STEPS].reward:.3f}" in viewer.panels._terms.content
    assert "cumulative force" in viewer.panels._gauges.content
    assert int(viewer.panels._slider.value) == STEPS == viewer.panels._slider.max
    other = viewer.source.choices[1]
    viewer.source.choose(other)
    viewer.frame(0.02)
    assert viewer.source.track is viewer.playhead.track is not track


def test_the_page_tells_instruction_home_and_who_acts(viewer: Viewer) -> None:
    viewer.source.choose(viewer.source.choices[0])
    viewer.frame(0.02)
    viewer.playhead.scrub(STEPS)
    viewer.frame(0.02)
    viewer._fill_panels()
    track = viewer.source.track
    assert track is not None and track.instruction
    title = viewer.panels._title.content
    assert escape(track.instruction) in title and f"home {track.home}" in title
    (color,) = actor_colors(track).values()
    assert f"background:{color}" in viewer.panels._actors.content
    assert "random" in viewer.panels._actors.content
    assert color in viewer.panels._line.content


def test_terms_are_those_of_the_subtask(viewer: Viewer) -> None:
    track = viewer.source.track
    assert track is not None
    own = dict(track.moments[1].terms)
    moment = dataclasses.replace(track.moments[1], terms={**own, "heading": 0.0})
    chain = dataclasses.replace(track, moments=[track.moments[0], moment])
    assert own and chain.terms_at(1) == own
    assert chain.terms_at(0) == {}


def test_next_shows_another_episode_from_its_beginning(viewer: Viewer) -> None:
    viewer.source.choose(viewer.source.choices[0])
    viewer.frame(0.02)
    viewer.playhead.scrub(STEPS)
    viewer.playhead.callbacks()["next"]()
    viewer.frame(0.02)
    viewer._fill_panels()
    assert viewer.source.choice == viewer.source.choices[1] == viewer.panels._choice.value
    assert viewer.playhead.playing and viewer.playhead.step == 0
    viewer.playhead.callbacks()["next"]()
    assert viewer.source.choice == viewer.source.choices[0]


def test_the_time_line_ends_where_the_episode_does(viewer: Viewer) -> None:
    track = viewer.source.track
    assert track is not None
    shorter = dataclasses.replace(track, moments=track.moments[:4])
    for shown in (track, shorter, track):
        viewer.panels.show(shown, shown.last)
        assert (viewer.panels._slider.max, viewer.panels._slider.value) == (
            shown.last,
            shown.last,
        )


def test_the_expert_plans_in_recorded_states(viewer: Viewer) -> None:
    source = viewer.source
    source.choose(source.choices[0])
    assert source.track is not None and source.plan_at(0) is None
    source.show_expert_plan(True)
    until(lambda: source.plan_at(STEPS) is not None or source.problem, 60.0)
    plan = source.plan_at(0)
    assert plan is not None, source.problem
    base = source.sim.addresses.robot_q[:2]
    np.testing.assert_allclose(
        plan.path[0], source.track.moments[0].qpos[base], atol=0.05
    )
    assert plan.placement is not None and len(plan.hands)
    source.show_expert_plan(False)
    assert source.plan_at(0) is None


def test_the_expert_plans_the_subtask_that_is_active(tmp_path: Path) -> None:
    mjhab.generate(
        "zero", task="set_table", episodes=1, worlds=1, horizon=4, threads=1, out=tmp_path
    )
    replay = Replay(tmp_path)
    try:
        replay.start()
        track = replay.track
        assert track is not None and track.plan[2].kind == "navigate"
        # As if the first subtasks had been done by then: the robot is to drive to the bowl.
        later = [dataclasses.replace(moment, active=2) for moment in track.moments[2:]]
        track.moments[2:] = later
        assert [track.begin_of(step) for step in (0, 1, 2, 4)] == [0, 0, 2, 2]
        replay.show_expert_plan(True)
        until(lambda: replay.plan_at(4) is not None or replay.problem, 60.0)
        plan = replay.plan_at(3)
        assert plan is not None, replay.problem
        base = replay.sim.addresses.robot_q[:2]
        np.testing.assert_allclose(plan.path[0], track.moments[2].qpos[base], atol=0.05)
    finally:
        replay.close()


def test_a_plan_that_cannot_be_made_is_told(
    viewer: Viewer, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise UsageError("its pack is not here")

    monkeypatch.setattr("mjhab.viewer.sources.plan_overlay.ExpertPolicy", refuse)
    replay = Replay(viewer.source._episodes[viewer.source.choice].shard.path)  # type: ignore[attr-defined]
    replay.start()
    replay.show_expert_plan(True)
    until(lambda: replay.plan_at(0) is None and replay.problem)
    assert replay.problem == "the expert cannot plan here: its pack is not here"
    replay.show_expert_plan(False)
    assert not replay.problem
    replay.close()


@pytest.fixture
def panels() -> Iterator[tuple[Panels, list[tuple[Any, ...]]]]:
    """Panels of running worlds, and what people did there."""
    server = viser.ViserServer("127.0.0.1", 0, verbose=False)
    told: list[tuple[Any, ...]] = []
    on: Any = collections.defaultdict(
        lambda: bool, policy=lambda name: told.append(("policy", name))
    )
    yield Panels(server, ["world 0"], ["expert"], others=True, on=on), told
    server.stop()


def test_policies_can_be_typed_in(panels: tuple[Panels, list[tuple[Any, ...]]]) -> None:
    page, told = panels
    page._take_policy("")
    page._take_policy("ws://localhost:8000")
    page._take_policy("ws://localhost:8000")
    assert told == [("policy", "ws://localhost:8000")] * 2
    assert page._policy.options == ("expert", "ws://localhost:8000")


def test_cameras_are_those_of_the_pictures(
    panels: tuple[Panels, list[tuple[Any, ...]]],
) -> None:
    page, _ = panels
    picture = np.zeros((8, 8, 3), np.uint8)
    page.show_images({"eye": picture})
    page.show_images({"eye": picture + 1})
    assert [image.label for image in page._images.values()] == ["eye"]
    page.show_images({"left_eye": picture, "hand": picture})
    assert [image.label for image in page._images.values()] == ["left eye", "hand"]


def test_an_episode_that_cannot_be_shown_is_told_in_the_page(
    viewer: Viewer, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(title: str) -> None:
        raise UsageError("its asset pack is not here")

    monkeypatch.setattr(viewer.source, "load", refuse)
    viewer.source.choose(viewer.source.choices[0])
    viewer._fill_panels()
    assert "asset pack is not here" in viewer.panels._problem.content
    assert viewer.panels._problem.visible
    monkeypatch.undo()
    # The next one is that after the one that was asked for, not after the one that is shown still.
    viewer.source.next_episode()
    assert viewer.source.choice == viewer.source.choices[1] and not viewer.source.problem
    viewer.source.choose(viewer.source.choices[0])
    viewer._fill_panels()
    assert not viewer.panels._problem.visible


def test_copies_of_an_episode_have_titles_of_their_own(
    shard: Path, tmp_path: Path
) -> None:
    for name in "abc":
        merge([shard], tmp_path / f"{name}.h5")
    replay = Replay(tmp_path)
    assert len(replay.choices) == 6
    shards = [replay._episodes[title].shard.path.name for title in replay.choices]
    assert shards == ["a.h5", "a.h5", "b.h5", "b.h5", "c.h5", "c.h5"]
    replay.close()


def test_the_episode_that_was_chosen_last_is_shown(
    shard: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    replay = Replay(shard)
    first, second = replay.choices
    load = replay.load
    loads, go = threading.Event(), threading.Event()

    def slow(title: str) -> Any:
        if title == first:
            loads.set()
            go.wait(10.0)
        return load(title)

    monkeypatch.setattr(replay, "load", slow)
    threads = [
        threading.Thread(target=replay.choose, args=(title,)) for title in replay.choices
    ]
    threads[0].start()
    assert loads.wait(5.0)
    threads[1].start()
    until(lambda: replay.choice == second)
    threads[1].join(1.0)
    go.set()
    for thread in threads:
        thread.join(20.0)
    assert replay.track is not None and replay.choice == second
    assert replay.track.index == load(second).index != load(first).index
    replay.close()


def test_another_task_in_the_same_home_shows_its_own_objects(tmp_path: Path) -> None:
    for task in ("set_table", "tidy_house"):
        mjhab.generate(
            "zero",
            out=tmp_path / task,
            task=task,
            subtask="pick",
            home="builtin_m0_00",
            episodes=1,
            horizon=2,
            threads=1,
        )
    made = Viewer(Replay(tmp_path), port=0, cameras=False)
    try:
        made.source.start()
        shown = []
        for choice in (*made.source.choices, made.source.choices[0]):
            made.source.choose(choice)
            assert made.frame(0.02) is not None
            files = home_files(
                made.source.sim.layout, "builtin_m0_00", lambda: pytest.fail("kept")
            )
            bodies = [placed._bodies for placed in made.stage._placed]
            assert bodies == [list(bodies) for bodies, _ in files.movable]
            shown.append(bodies)
        assert shown[0] == shown[2] != shown[1]
    finally:
        made.close()


def test_a_failure_that_has_passed_is_told_no_longer(
    shard: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = Viewer(Replay(shard), port=0)
    frame = made.frame
    cameras = made._cameras
    assert cameras is not None
    draw = cameras.draw
    failures = {"frame": 0, "draw": 0}

    def once(name: str, call: Callable[..., Any], *arguments: Any) -> Any:
        failures[name] += 1
        if failures[name] == 1:
            raise RuntimeError(f"no {name} yet")
        return call(*arguments)

    monkeypatch.setattr(made, "frame", lambda seconds: once("frame", frame, seconds))
    monkeypatch.setattr(cameras, "draw", lambda *seen: once("draw", draw, *seen))
    made.start()
    page = CountingPage(made.port)
    try:
        until(lambda: made.panels._problem.visible)
        until(lambda: cameras.drawn > 1 and not made.panels._problem.visible, 60.0)
        assert not made.problem and not cameras.problem
    finally:
        page.close()
        made.close()


def test_checks_in_a_browser_are_skipped_with_a_reason(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("shutil.which", lambda name: None)
    assert check_browser.main(tmp_path / "out") == 0
    assert (
        capsys.readouterr().out
        == "skipped: no Chromium is installed (apt install chromium)\n"
    )


def get(viewer: Viewer, path: str) -> bytes:
    with urllib.request.urlopen(f"http://localhost:{viewer.port}{path}") as answer:
        return answer.read()


def test_one_port_serves_the_page_with_our_script(viewer: Viewer) -> None:
    page = get(viewer, "/")
    assert b"<html" in page and b"mjhab/hand" in page
    with pytest.raises(urllib.error.HTTPError, match="404"):
        get(viewer, "/nothing")


def until(holds: Callable[[], Any], seconds: float = 5.0) -> None:
    end = time.monotonic() + seconds
    while not holds() and time.monotonic() < end:
        time.sleep(0.01)
    assert holds()


def test_messages_of_viser_pass(viewer: Viewer) -> None:
    url = f"ws://localhost:{viewer.port}/"
    protocol: Any = f"viser-v{viser.__version__}"
    with connect(
        url, subprotocols=[protocol], compression=None, max_size=1 << 26
    ) as page:
        assert page.subprotocol == protocol
        assert len(page.recv(timeout=5.0)) > 100


def test_pages_of_other_sites_cannot_connect(viewer: Viewer) -> None:
    url = f"ws://localhost:{viewer.port}{HAND_PATH}"
    with pytest.raises(InvalidStatus, match="403"):
        connect(url, origin="http://elsewhere.example")  # type: ignore[arg-type]
    with connect(url, origin=f"http://localhost:{viewer.port}") as page:  # type: ignore[arg-type]
        assert isinstance(json.loads(page.recv(timeout=5.0)), dict)


def test_a_shard_that_is_being_written_shows_what_it_has(
    shard: Path, tmp_path: Path
) -> None:
    copy = tmp_path / "copy.h5"
    merge([shard], copy)
    with ShardWriter(copy):
        replay = Replay(copy)
        assert replay.load(replay.choices[0]).last == STEPS
        replay.close()


def test_a_port_in_use_gives_way_to_the_next(shard: Path) -> None:
    with closing(socket.create_server(("localhost", 0))) as taken:
        port = taken.getsockname()[1]
        made = Viewer(Replay(shard), port=port, cameras=False)
        try:
            assert port < made.port <= port + 20
        finally:
            made.close()


@pytest.mark.parametrize("host", ["192.0.2.1", "a..b"])
def test_a_host_that_is_not_ours_is_refused(shard: Path, host: str) -> None:
    with pytest.raises(UsageError, match=f"{re.escape(host)}.*Give another"):
        Viewer(Replay(shard), host=host, port=0, cameras=False)


def test_after_the_last_port_there_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    tried: list[int] = []

    async def refuse(handler: object, host: str, port: int, **_: object) -> None:
        tried.append(port)
        raise OSError("in use")

    monkeypatch.setattr("mjhab.viewer.pages.gateway.serve", refuse)
    with refused(said="ports 65530 to 65535: in use"):
        Gateway(1, "localhost", 65530, bool)
    assert tried == list(range(65530, 65536))


def test_an_episode_waits_for_the_page_that_draws_it(shard: Path) -> None:
    made = Viewer(Replay(shard), port=0, cameras=False, hold=True)
    made.source.start()
    try:
        for _ in range(3):
            made.frame(0.1)
        assert made.playhead.now == 0.0 and not made.playhead.playing
        made._hear('{"keys": []}')
        assert not made.playhead.playing
        made._hear(DRAWN)
        made.frame(0.1)
        assert made.playhead.playing and made.playhead.now > 0.0
        # It says so again when its connection was lost; the pause of a person stays.
        made.playhead.play(False)
        made._hear(DRAWN)
        assert not made.playhead.playing
    finally:
        made.close()
    script = files("mjhab.viewer.pages").joinpath("hand.js").read_text(encoding="utf-8")
    assert "send({ drawn })" in script


@pytest.mark.parametrize("name", ["play", "step", "scrub"])
def test_who_takes_over_before_the_page_has_drawn_is_not_overruled(name: str) -> None:
    head = SimpleNamespace(playing=True, calls=[])
    head.play = head.calls.append
    start = _HeldStart(cast(Playhead, head), hold=True)
    assert head.calls == [False]
    start.letting_go({name: lambda *args: None})[name](0)
    start.let_go()
    assert head.calls == [False]


def test_a_page_that_never_tells_gets_some_time() -> None:
    head = SimpleNamespace(playing=True, calls=[])
    head.play = head.calls.append
    start = _HeldStart(cast(Playhead, head), hold=True)
    start.wait(HOLD_SECONDS - 1.0)
    assert start.held
    start.wait(2.0)
    assert head.calls == [False, True] and not start.held


def test_a_world_that_a_person_drives_stays_paused() -> None:
    head = SimpleNamespace(playing=False, calls=[])
    head.play = head.calls.append
    _HeldStart(cast(Playhead, head), hold=True).let_go()
    assert head.calls == []
