"""``mjhab assets``: keys for machines, licences, exit codes."""

from __future__ import annotations

import io
import json
import sys
import zipfile
from pathlib import Path
from typing import Any

import pytest

from mjhab.cli.main import main


@pytest.fixture
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("MJHAB_ASSETS", str(tmp_path / "assets"))
    return tmp_path / "assets"


@pytest.fixture
def bundle(tmp_path: Path) -> str:
    path = tmp_path / "ycb.zip"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("ycb/024_bowl/textured.glb", b"bowl")
    return str(path)


def said(capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    (line,) = capsys.readouterr().out.strip().splitlines()
    return json.loads(line)


def test_fetch_verify_where_list(
    root: Path, bundle: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert (
        main(
            ["assets", "fetch", "ycb", "--offline", bundle, "--accept-licence", "--json"]
        )
        == 0
    )
    out, err = capsys.readouterr()
    assert json.loads(out) == {
        "name": "ycb",
        "folder": str(root / "ycb"),
        "files": 1,
        "bytes": 4,
    }
    assert "CC BY 4.0" in err and "ycbbenchmarks" in err
    assert main(["assets", "verify", "ycb", "--json"]) == 0
    found = said(capsys)
    assert (
        list(found)
        == ["name", "folder", "ok", "files", "missing", "changed", "first_use"]
        and found["ok"]
    )
    (root / "ycb" / "024_bowl" / "textured.glb").write_bytes(b"b0wl")
    assert main(["assets", "verify", "ycb", "--json"]) == 1
    assert said(capsys)["changed"] == ["024_bowl/textured.glb"]
    assert main(["assets", "verify", "ycb"]) == 1
    assert "--overwrite" in capsys.readouterr().out
    assert main(["assets", "where", "ycb"]) == 0
    assert capsys.readouterr().out.strip() == str(root / "ycb")
    assert main(["assets", "where", "--json"]) == 0
    assert said(capsys) == {"folder": str(root), "installed": True}
    assert main(["assets", "list", "--json"]) == 0
    listed = said(capsys)["assets"]
    assert {row["name"]: row["installed"] for row in listed} == {
        "replica_cad": False,
        "ycb": True,
        "hab_episodes": False,
    }
    assert all(row["licence"] and row["terms"].startswith("https://") for row in listed)
    assert main(["assets", "list"]) == 0 and "ReplicaCAD" in capsys.readouterr().out


@pytest.mark.parametrize(("answer", "code"), [("y\n", 0), ("n\n", 2), ("", 2)])
def test_the_licence_is_asked_for(
    root: Path, bundle: str, answer: str, code: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    monkeypatch.setattr(sys, "stdin", Terminal(answer))
    assert main(["assets", "fetch", "ycb", "--offline", bundle]) == code
    assert (root / "ycb").exists() == (code == 0)


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (("fetch", "ycb"), ("add --accept-licence",)),
        (
            ("fetch", "ybc", "--accept-licence"),
            ("unknown data set", "Did you mean 'ycb'"),
        ),
        (
            ("fetch", "ycb", "--accept-licence", "--offline", "none.zip"),
            ("none.zip", "does not exist"),
        ),
        (("verify", "ycb"), ("does not exist", "mjhab assets fetch ycb")),
        (("where", "nothing"), ("unknown data set",)),
    ],
)
def test_bad_input(
    root: Path,
    args: tuple[str, ...],
    words: tuple[str, ...],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(sys, "stdin", io.StringIO())
    assert main(["assets", *args]) == 2
    out, err = capsys.readouterr()
    assert out == "" and "Traceback" not in err and all(word in err for word in words)
    assert not root.exists()


def test_a_failed_download_is_one_line(
    root: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HF_ENDPOINT", "http://127.0.0.1:9")
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    assert main(["assets", "fetch", "ycb", "--accept-licence"]) == 1
    last = capsys.readouterr().err.strip().splitlines()[-1]
    assert last.startswith("mjhab: failed: http://127.0.0.1:9/datasets/ai-habitat/ycb")
