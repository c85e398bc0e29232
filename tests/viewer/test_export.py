from __future__ import annotations

import base64
import json
import re
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mjhab.cli.main import main
from mjhab.core.errors import MjhabError
from mjhab.viewer.drawn.posing import Poser
from mjhab.viewer.export import page as export
from mjhab.viewer.sources.replay import Replay
from tests.viewer.conftest import STEPS


class Page:
    """What `page.js` reads of a page."""

    def __init__(self, file: Path) -> None:
        text = file.read_text()
        (data,) = re.findall(r'<script id="data" type="text/plain">(.*?)</script>', text)
        block = zlib.decompress(base64.b64decode(data))
        size = int.from_bytes(block[:4], "little")
        self.text = text
        self.head: dict[str, Any] = json.loads(block[4 : 4 + size])
        self._start = 4 + size + -size % 4
        self._block = block

    def array(self, place: dict[str, Any]) -> np.ndarray:
        start = self._start + place["at"]
        return np.frombuffer(self._block, place["type"], place["n"], start)

    def positions(self) -> np.ndarray:
        """(frames, bodies, 3) [m]."""
        pose = self.head["pose"]
        change = self.array(pose).reshape(-1, self.head["frames"])
        whole = np.cumsum(change, axis=1, dtype=np.uint16).T
        rows = whole.reshape(len(whole), len(pose["bodies"]), 7)
        return np.array(pose["low"]) + rows[..., :3] / 65535.0 * pose["span"]


@pytest.fixture(scope="module")
def page(shard: Path, tmp_path_factory: pytest.TempPathFactory) -> Page:
    file = tmp_path_factory.mktemp("page") / "episode.html"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(export, "DETAILS", ((None, 2),))
        replay = Replay(shard)
        done = export.export_page(replay, replay.choices[0], file)
        replay.close()
    assert (done.bytes, done.frames) == (file.stat().st_size, STEPS + 1)
    return Page(file)


def test_poses_are_kept_to_a_millimetre(page: Page, shard: Path) -> None:
    replay = Replay(shard)
    track = replay.load(replay.choices[0])
    poser = Poser(replay.env(replay.choices[0]).sim)
    bodies = page.head["pose"]["bodies"]
    told = page.positions()
    for step in (0, STEPS):
        pose = poser.pose(track.home, track.moments[step].qpos)
        np.testing.assert_allclose(told[step], pose.pos[bodies], atol=1e-3)
    assert np.abs(told[STEPS] - told[0]).max() > 0.01
    replay.close()


def test_the_page_tells_what_the_shard_tells(page: Page, shard: Path) -> None:
    replay = Replay(shard)
    track = replay.load(replay.choices[0])
    replay.close()
    assert page.head["plan"][0]["name"] == track.describe(0)
    assert (page.head["home"], page.head["instruction"]) == (
        track.home,
        track.instruction,
    )
    assert [actor["name"] for actor in page.head["actors"]] == ["random"]
    assert [event["step"] for event in page.head["events"]] == [
        step for step, _ in track.events
    ]
    reward = page.array(page.head["series"]["reward"])
    np.testing.assert_allclose(reward, [m.reward for m in track.moments], rtol=1e-6)
    terms = page.array(page.head["term"]).reshape(STEPS + 1, -1)
    assert page.head["terms"] == list(track.moments[1].terms)
    np.testing.assert_allclose(terms[1], list(track.moments[1].terms.values()), rtol=1e-6)


def test_pictures_are_those_of_both_cameras(page: Page) -> None:
    assert page.head["pictures"]["states"] == [0, STEPS]
    for place in page.head["pictures"]["cameras"].values():
        data = page.array(place).tobytes()
        assert data.startswith(b"\xff\xd8") and sum(place["sizes"]) == len(data)


def test_a_phone_has_the_side_panel_and_a_time_line_of_full_width(page: Page) -> None:
    """`make test-browser` measures them; here the rules of the style are read."""
    found = re.search(r"@media \(max-width: 760px\) \{(.*?)\n\}", page.text, re.S)
    assert found is not None
    assert "display: none" not in found[1]
    assert re.search(r"#time \{[^}]*flex: 1 0 100%", found[1])
    assert re.search(r"footer \{[^}]*flex-wrap: wrap", found[1])
    assert re.search(r"aside \{[^}]*inset: calc\(45vh \+ 112px\) 0 0 0", found[1])


def test_the_page_needs_no_network(page: Page) -> None:
    assert not re.findall(
        r"(?:src|href)=|https?://|@import", page.text.split("<script id=")[0]
    )
    assert not re.findall(
        r"https?://|\bfetch\(|import\(", page.text.rsplit("<script>", 1)[1]
    )


def test_coarser_meshes_make_it_smaller(
    shard: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    replay = Replay(shard)
    sizes = []
    for detail in ((None, 0), (120, 0)):
        monkeypatch.setattr(export, "DETAILS", (detail,))
        sizes.append(
            export.export_page(replay, replay.choices[0], tmp_path / "a.html").bytes
        )
    assert sizes[1] < 0.9 * sizes[0]
    monkeypatch.setattr(export, "DETAILS", ((None, 0), (120, 0)))
    monkeypatch.setattr(export, "MAX_BYTES", sizes[1])
    assert (
        export.export_page(replay, replay.choices[0], tmp_path / "b.html").bytes
        == sizes[1]
    )
    monkeypatch.setattr(export, "DETAILS", ((120, 0),))
    monkeypatch.setattr(export, "MAX_BYTES", 1000)
    with pytest.raises(MjhabError, match="more than 1,000"):
        export.export_page(replay, replay.choices[0], tmp_path / "c.html")
    assert not (tmp_path / "c.html").exists()
    replay.close()


def test_the_command_writes_a_page(
    shard: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(export, "DETAILS", ((120, 0),))
    out = tmp_path / "one.html"
    words = ["view", str(shard), "--export", str(out)]
    assert main([*words, "--episode", "1", "--stills", "3", "--json"]) == 0
    told = json.loads(capsys.readouterr().out.strip().splitlines()[-1])
    counted = {"bytes": out.stat().st_size, "frames": STEPS + 1, "stills": 3}
    assert told == {"file": str(out), **counted}
    stills = Page(out).head["stills"]
    assert [still["step"] for still in stills] == [0, STEPS // 2, STEPS]
    assert len({still["picture"] for still in stills}) == 3
    evaluation = tmp_path / "evaluation"
    evaluation.mkdir()
    (evaluation / "episodes.jsonl").touch()
    file = min(shard.rglob("*.h5"))
    recorded = file.read_bytes()
    for wrong, why in (
        (
            [*words, "--episode", "2"],
            "there are 2 episodes, counted from 0; the last is --episode 1",
        ),
        (["view", str(shard), "--episode", "9"], "--episode 9: there are 2 episodes"),
        (["view", str(evaluation), "--export", str(out)], "keeps no states"),
        (["view", str(shard), "--horizon", "9"], "--horizon: is for running worlds"),
        (["view", "--export", str(out)], "give a shard"),
        ([*words, "--shader", "path"], "--shader: is for running worlds"),
        ([*words, "--stills", "99"], "stills must be at most 24"),
        (["view", str(shard), "--stills", "2"], "give --export FILE.html"),
        (["view", "--where", "steps > 3"], "--where: is for recorded episodes"),
        (["view", str(shard), "--worlds", "4"], "--worlds: is for running worlds"),
        (["view", str(shard), "--policies", "zero"], "--policies: is for running worlds"),
        (
            ["view", str(shard), "--export", str(file)],
            "must be a name that ends with .html",
        ),
        (
            ["view", str(shard), "--export", str(evaluation)],
            "must be a file such as",
        ),
        (
            ["view", "--record", str(tmp_path / "mine.txt")],
            "must be a name that ends with .h5",
        ),
        (["view", str(shard), "--record", "a.h5"], "running worlds"),
        (["view", str(tmp_path)], "no shards"),
        (["view", "--policy", "expret"], "expert"),
    ):
        assert main(wrong) == 2
        assert why in capsys.readouterr().err
    assert file.read_bytes() == recorded


def test_without_viser_it_says_what_to_install(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert main(["view"]) == 2
    told = capsys.readouterr().err
    assert "pip install" in told and "[view]'" in told
