"""``mjhab homes check`` and the sheets of ``mjhab homes render --all``."""

from __future__ import annotations

import dataclasses
import errno
import json
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from mjhab.cli.main import main
from mjhab.core.registration.registry import Registry
from mjhab.reports.contact_sheet import Tile, _cells, save_html, save_png
from mjhab.scenes import pack_source, packs
from mjhab.scenes.builtin.homes import make_home
from mjhab.scenes.builtin.pack import builtin_pack
from mjhab.scenes.pack_source import PackRequest, PackSource
from mjhab.scenes.spec import Geom, Pack
from tests.refusals import command, refused

EXAMPLES = Path(__file__).parents[3] / "examples"
KEYS = ["homes", "ok", "failed", "layout", "ngeom", "nv", "compile_s"]


def pack_of(*keys: tuple[int, int]) -> Pack:
    return dataclasses.replace(
        builtin_pack(), homes=tuple(make_home(*key) for key in keys)
    )


def use(monkeypatch: pytest.MonkeyPatch, pack: Pack) -> None:
    monkeypatch.setattr(packs, "open_pack", lambda name: pack)


def said(capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    (line,) = capsys.readouterr().out.strip().splitlines()
    return json.loads(line)


def test_check_gives_the_keys_and_finds_nothing(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("MJHAB_CACHE", str(tmp_path))
    use(monkeypatch, pack_of((0, 5), (3, 20), (4, 20)))
    assert main(["homes", "check", "--json"]) == 0
    first = said(capsys)
    assert list(first)[:7] == KEYS
    found = first["remarks"]
    assert [row["name"] for row in found] == ["builtin_m3_20"] * 2
    assert (
        "fridge/top_door meets a wall: no episode starts beyond 1.85 of 2.30"
        in (found[0]["what"])
    )
    assert (first["homes"], first["ok"], first["failed"], first["remarks"]) == (
        3,
        3,
        [],
        found,
    )
    assert (
        first["compiled_cold"] == 3
        and first["compile_s"] > 0
        and first["nv"] == 15 + 9 + 6 * 30
    )
    assert main(["homes", "check", "--split", "test", "--json"]) == 0
    second = said(capsys)
    assert (second["homes"], second["compiled_cold"], second["layout"]) == (
        1,
        0,
        first["layout"],
    )
    assert main(["homes", "check"]) == 0
    assert first["layout"] in capsys.readouterr().out


def test_check_fails_for_homes_that_do_not_work(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    pack = pack_of((0, 0), (0, 1), (3, 20))
    good, other, blocked = pack.homes
    x0, y0, x1, y1 = other.floor
    slab = Geom(
        "box", ((x1 - x0) / 2, (y1 - y0) / 2, 1.0), ((x0 + x1) / 2, (y0 + y1) / 2, 1.0)
    )
    full = dataclasses.replace(other, walls=(slab, *other.walls[1:]))
    flat = dataclasses.replace(
        other, name="flat", walls=(Geom("box", (0.0, 1.0, 1.0)), *other.walls[1:])
    )
    silent = dataclasses.replace(blocked, open_limits=())
    use(monkeypatch, dataclasses.replace(pack, homes=(good, full, flat, silent)))
    assert main(["homes", "check", "--json"]) == 1
    found = said(capsys)
    why = {row["name"]: row["why"] for row in found["failed"]}
    assert found["ok"] == 2 and set(why) == {full.name, "flat"}
    assert (
        "no floor" in why[full.name]
        and "does not compile" in why["flat"]
        and "\n" not in why["flat"]
    )
    assert [row["name"] for row in found["remarks"]] == [silent.name] * 2
    assert "fridge/top_door opens to 1.86 of 2.30" in found["remarks"][0]["what"]
    assert main(["homes", "check"]) == 1
    assert "no floor" in capsys.readouterr().out


def test_show_tells_the_hard_case(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    use(monkeypatch, pack_of((3, 20)))
    assert main(["homes", "show", "builtin_m3_20", "--json"]) == 0
    shown = said(capsys)
    assert (
        "not solvable" in shown["note"]
        and shown["open_limits"]["fridge/top_door"] == 1.85
    )
    assert main(["homes", "show", "builtin_m3_20"]) == 0
    out = capsys.readouterr().out
    assert "not solvable" in out and "fridge/top_door opens to" in out


@pytest.fixture
def painted(monkeypatch: pytest.MonkeyPatch) -> list[tuple[Any, ...]]:
    """Pictures of one colour instead of homes."""
    asked: list[tuple[Any, ...]] = []

    def draw(
        pack: Pack,
        homes: Sequence[str],
        view: str,
        width: int,
        height: int,
        *shading: object,
    ) -> Iterator[np.ndarray]:
        asked.append((list(homes), view, width, height))
        return (
            np.full((height, width, 3), 40 * k, np.uint8) for k, _ in enumerate(homes)
        )

    monkeypatch.setattr("mjhab.render.pictures.home_views.render_homes", draw)
    return asked


def test_a_sheet_of_all_homes(
    painted: list[tuple[Any, ...]],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    use(monkeypatch, pack_of((0, 0), (0, 1), (3, 20)))
    page = tmp_path / "new" / "homes.html"
    sheet = tmp_path / "homes.png"
    assert main(["homes", "render", "--all", "--out", str(page), "--json"]) == 0
    assert said(capsys) == {"homes": 3, "view": "top", "out": str(page)}
    text = page.read_text()
    assert len(re.findall("data:image/jpeg", text)) == 3 and "http" not in text
    assert "train, layout 0: 2" in text and "not solvable" in text
    assert painted == [
        (["builtin_m0_00", "builtin_m0_01", "builtin_m3_20"], "top", 400, 300)
    ]
    size = ("--width", "64", "--height", "48")
    assert (
        main(["homes", "render", "--all", "--split", "train", "--out", str(sheet), *size])
        == 0
    )
    assert (
        painted[-1][0] == ["builtin_m0_00", "builtin_m0_01"]
        and Image.open(sheet).width > 128
    )


def test_groups_begin_new_rows(tmp_path: Path) -> None:
    image = np.zeros((30, 40, 3), np.uint8)
    tiles = [
        Tile(f"h{k}", "ab"[k > 3], "a note that is far too long for its picture", image)
        for k in range(7)
    ]
    assert _cells(tiles, 3) == [(0, 0), (0, 1), (0, 2), (1, 0), (2, 0), (2, 1), (2, 2)]
    save_png(tmp_path / "sheet.png", "seven", tiles)
    save_html(tmp_path / "sheet.html", "a <b>", tiles)
    assert Image.open(tmp_path / "sheet.png").height > 3 * 30
    assert "a &lt;b&gt;" in (tmp_path / "sheet.html").read_text()


@pytest.mark.parametrize(
    ("args", "option", "given"),
    [
        (("render",), "name", None),
        (("render", "builtin_m0_00", "--all"), "name", "builtin_m0_00"),
        (("render", "builtin_m0_00", "--split", "val"), "split", "val"),
        (("render", "--all", "--out", "homes.jpg"), "out", "homes.jpg"),
        (("render", "--all", "--split", "vla"), "split", "vla"),
        (("check", "--split", "all"), "split", "all"),
    ],
)
def test_bad_input(args: tuple[str, ...], option: str, given: str | None) -> None:
    with refused(option, given):
        command("homes", *args)


@pytest.mark.parametrize(
    ("words", "name"),
    [
        (("builtin_m0_00",), "home.png"),
        (("--all",), "homes.png"),
        (("--all",), "homes.html"),
    ],
)
def test_a_picture_that_cannot_be_written_leaves_the_one_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...], name: str
) -> None:
    use(monkeypatch, pack_of((0, 0)))
    image = np.zeros((16, 16, 3), np.uint8)
    monkeypatch.setattr(
        "mjhab.render.pictures.home_views.render_homes", lambda *_: iter([image])
    )

    def full(self: Any, path: Path, *_: Any, **options: Any) -> None:
        path.write_bytes(b"half")
        raise OSError(errno.ENOSPC, "No space left on device")

    def full_text(self: Path, *_: Any, **options: Any) -> None:
        full(None, self)

    out = tmp_path / name
    out.write_bytes(b"before")
    monkeypatch.setattr(Image.Image, "save", full)
    if name.endswith(".html"):
        monkeypatch.setattr("mjhab.reports.contact_sheet._jpeg", lambda tile: "")
        monkeypatch.setattr(Path, "write_text", full_text)
    assert main(["homes", "render", *words, "--out", str(out)]) == 1
    assert out.read_bytes() == b"before"
    assert [file.name for file in tmp_path.iterdir()] == [name]


def test_one_real_sheet(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    use(monkeypatch, pack_of((0, 0), (4, 20)))
    out = tmp_path / "homes.png"
    assert (
        main(
            [
                *"homes render --all --out".split(),
                str(out),
                *"--width 96 --height 72".split(),
            ]
        )
        == 0
    )
    pixels = np.asarray(Image.open(out))
    assert len(np.unique(pixels.reshape(-1, 3), axis=0)) > 500


def test_options_of_a_real_pack_go_into_its_request(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    asked: list[PackRequest] = []

    def opened(request: PackRequest) -> Pack:
        asked.append(request)
        return pack_of((0, 0))

    source = PackSource("data", opened, options=frozenset({"articulate", "stage_mesh"}))
    monkeypatch.setattr(pack_source, "PACK_SOURCES", Registry("asset pack"))
    pack_source.register_pack(source)
    (stage := tmp_path / "stage.glb").touch()
    options = [
        "--assets",
        "data",
        "--stage-mesh",
        str(stage),
        "--articulate",
        "chest_of_drawers,cabinet",
        "--json",
    ]
    assert main(["homes", "show", "builtin_m0_00", *options]) == 0
    assert asked == [PackRequest("data", ("cabinet", "chest_of_drawers"), str(stage))]
    monkeypatch.undo()
    with refused("articulate", ("cabinet",)):
        command("homes", "show", "builtin_m0_00", "--articulate", "cabinet")


def test_check_tells_roles_that_nobody_asks_for(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    body = json.loads((EXAMPLES / "home" / "cottage.json").read_text())
    body["receptacles"][0]["roles"] = ["open_surfaces", "sink"]
    file = tmp_path / "cottage.json"
    file.write_text(json.dumps(body))
    assert main(["homes", "check", "--assets", str(file), "--json"]) == 0
    remarks = [row["what"] for row in said(capsys)["remarks"] if "role" in row["what"]]
    assert remarks == [
        "no registered task asks for the role 'open_surfaces'; did you mean 'open_surface'?"
    ]
