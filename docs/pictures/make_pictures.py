"""Make the pictures and films of the documentation: ``python docs/pictures/make_pictures.py``, minutes on two cores.

Each file is smaller than MAX_BYTES. The picture of the viewer needs Chromium and is left alone where there is none.
"""

from __future__ import annotations

import shutil
import sys
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image

import mjhab
from mjhab.render.views import render_home
from mjhab.scenes.packs import open_pack

HERE = Path(__file__).parent
MAX_BYTES = 300_000
SIZE_PX = (960, 600)
FILMS: dict[str, dict[str, str]] = {
    "pick": {"policy": "expert", "task": "set_table", "subtask": "pick"},
    "open_fridge": {
        "policy": "expert",
        "task": "set_table",
        "subtask": "open",
        "target": "fridge/top_door",
    },
    "student_closes_drawer": {
        "policy": "student",
        "task": "set_table",
        "subtask": "close",
        "target": "kitchen_counter/drawer3",
    },
}
"""Name of a film to the evaluation whose first successful episode it shows."""
TRIES = 4
"""Episodes of which one has to succeed."""
SHOWN_SECONDS = 6.0
"""How long the episode runs in the viewer before it is photographed."""


def main() -> int:
    """Write all files beside this one."""
    save(HERE / "home.jpg", picture_of_a_home())
    for name, options in FILMS.items():
        film(HERE / f"{name}.mp4", options)
    picture = picture_of_the_viewer()
    if picture is not None:
        save(HERE / "viewer.jpg", picture)
    too_large = [p.name for p in HERE.iterdir() if p.stat().st_size > MAX_BYTES]
    if too_large:
        print(f"larger than {MAX_BYTES} bytes: {', '.join(too_large)}", file=sys.stderr)
    return 1 if too_large else 0


def save(path: Path, picture: np.ndarray) -> None:
    """Write a picture (h, w, 3) uint8 as JPEG."""
    Image.fromarray(picture).save(path, quality=82, optimize=True)
    print(f"{path.name}: {path.stat().st_size} bytes")


def picture_of_a_home() -> np.ndarray:
    """A built-in home from a corner of its room."""
    pack = open_pack("builtin")
    return render_home(pack, pack.homes[0], "inside", *SIZE_PX)


def film(path: Path, options: dict[str, str]) -> None:
    """Film an episode that succeeds."""
    with tempfile.TemporaryDirectory() as folder:
        run = mjhab.evaluate(
            episodes=TRIES, worlds=TRIES, films=TRIES, out=folder + "/run", **options
        )
        won = [record.index for record in run.records if record.success_once]
        shutil.copy(run.path / "films" / f"episode_{won[0]:05d}.mp4", path)
    print(f"{path.name}: {path.stat().st_size} bytes")


def picture_of_the_viewer() -> np.ndarray | None:
    """The viewer's page while the expert picks; None without Chromium."""
    import time

    from mjhab.evaluation.evaluate import EvalSpec
    from mjhab.viewer.pages.app import Viewer
    from mjhab.viewer.sources.live import LiveSession
    from mjhab.viewer.sources.pace import Pace
    from tests.viewer.browser import Browser, find_browser, wait_for

    if find_browser() is None:
        return None
    spec = EvalSpec(policy="expert", subtask="pick", env={"reward_mode": "dense"})
    viewer = Viewer(LiveSession(spec, 0, Pace()), port=0)
    viewer.start()
    try:
        with Browser(f"http://localhost:{viewer.port}", size=(1280, 760)) as browser:
            wait_for(lambda: viewer.clients and viewer.frames > 10, 120.0)
            time.sleep(SHOWN_SECONDS)
            viewer.source.pace.play(False)
            time.sleep(SHOWN_SECONDS)
            return browser.picture()
    finally:
        viewer.close()


if __name__ == "__main__":
    sys.exit(main())
