"""The viewer in a real browser: run by `make test-browser`, not by pytest, since it needs Chromium.

Opens recorded episodes, running worlds and an exported page in headless Chromium; asks for a picture that is not
empty, a time line that moves the robot, keys that drive it; measures first frame and frame rate. Looks for faults of
layout in every report, on a screen and on a phone. Searches the site of `make docs`, where that was built. Prints one
line of JSON.
"""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

import mjhab
from mjhab.core.action_notes import HUMAN
from mjhab.evaluation.evaluate import EvalSpec
from mjhab.viewer.export.page import MAX_BYTES, export_page
from mjhab.viewer.pages.app import Viewer
from mjhab.viewer.sources.live import LiveSession
from mjhab.viewer.sources.pace import RealTimeClock
from mjhab.viewer.sources.replay import Replay
from mjhab.viewer.sources.source import ViewSource
from tests.reports.gallery import pages
from tests.viewer.browser import Browser, find_browser, wait_for

WORLDS = (1, 4, 16)
SITE = Path("runs/site")
WIDTHS = (1300, 390)
"""Of a screen and of a phone [px]."""
FAULTS = Path(__file__).with_name("page_faults.js").read_text(encoding="utf-8")
PLOTS_ARE_DRAWN = """[...document.querySelectorAll("section > div[id]")].every(
  (place) => place.classList.contains("js-plotly-plot"))"""
MEASURE_SECONDS = 8.0
HAND_HORIZON = 4000
HAND_SECONDS = 60.0
MIN_CHANGED_PX = 500
COLORS_OF_A_PICTURE = 200
COLORS_OF_A_HOME = 2000
PATIENCE_SECONDS = 300.0
COUNT_FRAMES = """(() => {
  window.drawnFrames = 0;
  const count = () => { window.drawnFrames++; requestAnimationFrame(count); };
  requestAnimationFrame(count);
})()"""
"""Counts what the browser draws: without a GPU the processor draws, which is slow."""


PARTS = (
    "pages",
    "export",
    "begin",
    "replay",
    "hand",
    "site",
    *(str(worlds) for worlds in WORLDS),
)


def main(out: Path, parts: Sequence[str] = PARTS) -> int:
    """Run some of PARTS; pictures go to the folder ``out``."""
    if find_browser() is None:
        print("skipped: no Chromium is installed (apt install chromium)")
        return 0
    out.mkdir(parents=True, exist_ok=True)
    shards = out / "shards"
    if not shards.is_dir():
        mjhab.generate(
            "expert",
            out=shards,
            subtask="pick",
            episodes=1,
            worlds=1,
            reward_mode="dense",
        )
    told: dict[str, Any] = {}
    for part in parts:
        if part == "pages":
            check_pages(out)
        elif part == "begin":
            check_begin(out)
        elif part == "export":
            told[part] = check_export(shards, out)
        elif part == "replay":
            check_replay(shards, out)
        elif part == "hand":
            check_hand(out)
        elif part == "site":
            check_site()
        else:
            told[f"{part} worlds"] = measure(int(part), out)
        print(f"{part}: good", file=sys.stderr, flush=True)
    print(json.dumps(told))
    return 0


def shoot(browser: Browser, file: Path) -> np.ndarray:
    """A picture that is not empty, kept in a file."""
    picture = browser.picture()
    Image.fromarray(picture).save(file)
    colors = len(np.unique(picture.reshape(-1, 3), axis=0))
    assert colors > COLORS_OF_A_PICTURE, f"{file} has {colors} colours: nothing is drawn"
    return picture


def changed(a: np.ndarray, b: np.ndarray) -> int:
    """Pixels that differ visibly."""
    return int((np.abs(a.astype(int) - b.astype(int)).max(axis=2) > 24).sum())


def check_export(shards: Path, out: Path) -> dict[str, Any]:
    """The exported page shows the episode, and its time line moves the robot."""
    replay = Replay(shards)
    done = export_page(replay, replay.choices[0], out / "episode.html")
    replay.close()
    assert done.bytes <= MAX_BYTES
    with Browser(f"file://{done.file.resolve()}") as browser:
        wait_for(lambda: browser.run("window.episode && episode.frames"), 30.0)
        time.sleep(1.0)
        assert not browser.run("performance.getEntriesByType('resource').length"), (
            "it asks for files"
        )
        first = shoot(browser, out / "page_first.png")
        before = browser.run("episode.robot()")
        box = browser.run(
            "(b => [b.left, b.top, b.width, b.height])(line.getBoundingClientRect())"
        )
        x, y = box[0] + 0.5 * box[2], box[1] + 0.5 * box[3]
        for kind in ("mousePressed", "mouseReleased"):
            browser.call(
                "Input.dispatchMouseEvent",
                type=kind,
                x=x,
                y=y,
                button="left",
                clickCount=1,
            )
        time.sleep(1.0)
        moved = math.dist(before, browser.run("episode.robot()"))
        assert moved > 0.02, f"the time line moved the hand by {moved:.3f} m"
        assert changed(first, shoot(browser, out / "page_middle.png")) > MIN_CHANGED_PX
        check_phone(browser, out)
    return {"bytes": done.bytes, "frames": done.frames}


def check_pages(out: Path) -> None:
    """No page of the gallery has a fault of its layout on a screen or on a phone."""
    found = []
    with Browser("about:blank") as browser:
        for name, page in pages(out / "gallery").items():
            file = out / f"{name}.html"
            file.write_text(page, encoding="utf-8")
            for width in WIDTHS:
                browser.resize(width, 900)
                browser.open(file.resolve().as_uri())
                wait_for(lambda: browser.run(PLOTS_ARE_DRAWN), PATIENCE_SECONDS)
                Image.fromarray(browser.picture()).save(out / f"{name}_{width}.png")
                found += [f"{name}, {width} px: {fault}" for fault in browser.run(FAULTS)]
    assert not found, "\n".join(found)


def check_phone(browser: Browser, out: Path) -> None:
    """On a phone an exported page has its side panel and a time line over the whole width."""
    width = min(WIDTHS)
    browser.resize(width, 844)
    wait_for(lambda: browser.run("innerWidth") == width, HAND_SECONDS)
    time.sleep(1.0)
    shoot(browser, out / "page_phone.png")
    line, panel, right = browser.run(
        "[line.getBoundingClientRect().width,"
        " document.querySelector('aside').getBoundingClientRect().width,"
        " document.scrollingElement.scrollWidth]"
    )
    assert line > 0.9 * width and panel == width and right <= width, (line, panel, right)


def check_begin(out: Path) -> None:
    """An episode does not begin before the browser has drawn it; the time line covers no other panel."""
    spec = EvalSpec.of(policy="expert", subtask="pick", worlds=1, episodes=1)
    session = LiveSession(spec, 0, RealTimeClock())
    viewer, browser = opened(session, hold=True, size=(max(WIDTHS), 860))
    with browser:
        wait_for(lambda: session.steps > 0, PATIENCE_SECONDS)
        colors = len(np.unique(browser.picture().reshape(-1, 3), axis=0))
        assert colors > COLORS_OF_A_HOME, f"it began with {colors} colours on the screen"
        assert viewer.clients and not session.problem
        shoot(browser, out / "begin.png")
    viewer.close()


def opened(
    source: ViewSource, *, hold: bool = False, size: tuple[int, int] = (960, 640)
) -> tuple[Viewer, Browser]:
    viewer = Viewer(source, port=0, hold=hold)
    viewer.start()
    return viewer, Browser(f"http://localhost:{viewer.port}", size)


def wait_for_picture(viewer: Viewer, browser: Browser) -> None:
    """Wait until the home is drawn; on a busy processor without a GPU that takes a while."""

    def drawn() -> bool:
        assert not viewer.problem and not viewer.source.problem, (
            viewer.problem or viewer.source.problem
        )
        colors = len(np.unique(browser.picture().reshape(-1, 3), axis=0))
        return bool(viewer.clients) and viewer.frames > 10 and colors > COLORS_OF_A_HOME

    wait_for(drawn, PATIENCE_SECONDS)


def check_replay(shards: Path, out: Path) -> None:
    """A recorded episode shows, and the slider of its time line moves the robot."""
    viewer, browser = opened(Replay(shards))
    with browser:
        wait_for_picture(viewer, browser)
        viewer.playhead.play(False)
        track = viewer.source.track
        assert track is not None
        pictures = []
        for step in (0, track.last // 2):
            viewer.playhead.scrub(step)
            time.sleep(3.0)
            pictures.append(shoot(browser, out / f"replay_{step}.png"))
        assert changed(*pictures) > MIN_CHANGED_PX
        scrub_to_end(browser)
        wait_for(lambda: viewer.playhead.step == track.last, 10.0)
    viewer.close()


def scrub_to_end(browser: Browser) -> None:
    """Move the slider of the time line to its end, with the keyboard."""
    found = browser.run(
        "(() => { const all = document.querySelectorAll('[role=slider]'); const last = all[all.length - 1];"
        " if (last) last.focus(); return all.length; })()"
    )
    assert found, "the time line has no slider"
    browser.press("End", "End", down=True)
    browser.press("End", "End", down=False)


def check_hand(out: Path) -> None:
    """Keys in the page drive the robot; closing the page stops it; what was driven is in the shard."""
    shard = out / "by_hand.h5"
    shard.unlink(missing_ok=True)
    # A browser that draws on a busy processor is slow to send keys: the episode outlasts it.
    env = {"horizon": HAND_HORIZON}
    spec = EvalSpec.of(policy=HUMAN, subtask="pick", worlds=1, episodes=1, env=env)
    session = LiveSession(spec, 0, RealTimeClock(), shard=shard)
    viewer, browser = opened(session)
    with browser:
        wait_for_picture(viewer, browser)
        wait_for(lambda: session.hand_drives, HAND_SECONDS)
        assert session.env is not None
        view = session.env.view(0)
        yaw = view.q[2]
        browser.press("KeyA", "a", down=True)
        wait_for(lambda: abs(view.q[2] - yaw) > 0.3, HAND_SECONDS)
        browser.press("KeyA", "a", down=False)
        shoot(browser, out / "by_hand.png")
        place = view.q[:2].copy()
        browser.run(PAD_FORWARD)
        wait_for(lambda: np.linalg.norm(view.q[:2] - place) > 0.2, HAND_SECONDS)
        click(browser, "Give back")
        wait_for(lambda: not session.hand_drives, HAND_SECONDS)
        click(browser, "Take over")
        wait_for(lambda: session.hand_drives, HAND_SECONDS)
    wait_for(lambda: not session.pace.playing, HAND_SECONDS)
    viewer.close()
    (episode,) = Replay(shard).choices
    assert episode, "nothing was recorded"


def check_site() -> None:
    """The search of the documentation works in pages from a disk, in a folder, too."""
    if not SITE.is_dir():
        print(f"site: skipped, there is no {SITE} (make docs)", file=sys.stderr)
        return
    for name in ("index.html", "reference/mjhab.html"):
        with Browser(f"file://{(SITE / name).resolve()}") as browser:
            wait_for(
                lambda: browser.run("document.readyState") == "complete", PATIENCE_SECONDS
            )
            assert browser.run(SEARCH), "the page has no field to search"
            links = wait_for(lambda: browser.run(FOUND), PATIENCE_SECONDS)
            assert any("score.html" in link for link in links), links


SEARCH = """(() => {
  const field = document.querySelector("input[data-md-component=search-query]");
  if (!field) return false;
  document.querySelector("label[for=__search]")?.click();
  field.focus();
  field.value = "capability";
  field.dispatchEvent(new KeyboardEvent("keyup", {bubbles: true}));
  return true;
})()"""
"""Types a word into the search of the site."""
FOUND = "[...document.querySelectorAll('.md-search-result__link')].map(a => a.href)"
"""Links to what the search found."""


PAD_FORWARD = """(() => {
  const pad = {mapping: "standard", axes: [0, -1, 0, 0], buttons: []};
  navigator.getGamepads = () => [pad];
})()"""
"""Stands where a gamepad would be, its left stick pushed forward."""


def click(browser: Browser, label: str) -> None:
    """Click the button with a label, once the page has it."""
    wanted = json.dumps(label)
    script = (
        "(() => { const all = [...document.querySelectorAll('button')];"
        f" const one = all.find(b => b.textContent.trim() === {wanted});"
        " if (one) one.click(); return !!one; })()"
    )
    wait_for(lambda: browser.run(script), HAND_SECONDS)


def measure(worlds: int, out: Path) -> dict[str, float]:
    """Seconds until the first frame, and frames per second, of so many running worlds."""
    spec = EvalSpec.of(policy="random", subtask="pick", worlds=worlds, episodes=worlds)
    begun = time.perf_counter()
    session = LiveSession(spec, 0, RealTimeClock(), hold_at_end=False)
    viewer, browser = opened(session)
    with browser:
        wait_for_picture(viewer, browser)
        shown = time.perf_counter() - begun
        browser.run(COUNT_FRAMES)
        frames, steps, at = viewer.frames, session.steps, time.perf_counter()
        time.sleep(MEASURE_SECONDS)
        spent = time.perf_counter() - at
        rate = (viewer.frames - frames) / spent
        stepped = (session.steps - steps) / spent
        drawn = browser.run("drawnFrames") / spent
        shoot(browser, out / f"live_{worlds}.png")
    viewer.close()
    return {
        "first_frame_sent_s": round(viewer.first_frame_at - begun, 2),
        "first_picture_in_chromium_s": round(shown, 2),
        "frames_sent_per_s": round(rate, 1),
        "frames_drawn_per_s": round(drawn, 1),
        "control_steps_per_s": round(stepped, 1),
    }


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]), sys.argv[2:] or PARTS))
