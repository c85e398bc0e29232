"""Data sets and policies to a hub on 127.0.0.1 and back: whole, compared, or refused with a clear line."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from huggingface_hub import close_session

from mjhab.assets.hub import TransferError
from mjhab.core.files.checksums import list_files
from mjhab.evaluation.publishing.about import ABOUT
from mjhab.evaluation.publishing.check import EXPORTED, check_set
from tests.assets.hub_server import FakeHub
from tests.refusals import command, refused

REPO = "someone/some-set"


@pytest.fixture(autouse=True)
def no_waiting(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """No pauses before another try, no proxy, and a token."""
    monkeypatch.setattr("mjhab.assets.hub.time.sleep", lambda seconds: None)
    for name in ("http_proxy", "HTTP_PROXY", "all_proxy", "ALL_PROXY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("huggingface_hub.get_token", lambda: "secret")
    close_session()
    yield
    close_session()


def serve(monkeypatch: pytest.MonkeyPatch, kind: str) -> FakeHub:
    hub = FakeHub(REPO, {}, kind=kind)
    monkeypatch.setenv("HF_ENDPOINT", hub.endpoint)
    return hub


@pytest.fixture
def hub(monkeypatch: pytest.MonkeyPatch) -> Iterator[FakeHub]:
    served = serve(monkeypatch, "dataset")
    yield served
    served.close()


@pytest.fixture
def exported(tmp_path: Path) -> Path:
    """A folder that lists its files as an export does."""
    folder = tmp_path / "set"
    (folder / "data").mkdir(parents=True)
    (folder / "data/a.parquet").write_bytes(bytes(range(200)))
    (folder / "README.md").write_text("---\nlicense: mit\n---\n# A set\n")
    (folder / "meta").mkdir()
    files = list_files(folder, frozenset())
    (folder / EXPORTED).write_text(json.dumps({"files": files}))
    (folder / ".cache").mkdir()
    (folder / ".cache/private").write_text("mine")
    (folder / "notes.txt").write_text("mine, too")
    return folder


def test_a_set_goes_there_and_back(hub: FakeHub, exported: Path, tmp_path: Path) -> None:
    assert command("dataset", "push", exported, REPO) == 0
    assert set(hub.files) == {"data/a.parquet", EXPORTED, "README.md"}
    assert hub.commits == ["mjhab: set"]
    out = tmp_path / "pulled"
    assert command("dataset", "pull", REPO, "--out", out) == 0
    assert check_set(out) == []
    for name, data in hub.files.items():
        assert (out / name).read_bytes() == data
    # The same command again finds everything there.
    asked = len(hub.asked)
    assert command("dataset", "pull", REPO, "--out", out) == 0
    assert len(hub.asked) == asked


def test_a_lost_card_is_made_anew(hub: FakeHub, tmp_path: Path) -> None:
    folder = tmp_path / "set"
    folder.mkdir()
    (folder / "a.h5").write_bytes(b"data")
    about = {
        "name": "ms_hab_7",
        "episodes": 1,
        "frames": 2,
        "hz": 20,
        "gb": 0.1,
        "hours": 0.1,
        "cpu_hours": 0.1,
        "licence": "MIT",
        "command": "mjhab dataset make ms_hab_7",
        "per_target": {},
        "splits": {},
        "labels": {},
        "subsets": {"demonstrations": "success"},
        "skills": {},
        "actions": [],
        "state": [],
        "per_1000_episodes": {"cpu_hours": 1, "gb": 1},
        "sentences": {"distinct": 1, "wordings": 1, "examples": ["go"]},
    }
    about["files"] = list_files(folder, frozenset())
    (folder / ABOUT).write_text(json.dumps(about))
    assert command("dataset", "push", folder, REPO) == 0
    assert b"license: mit" in hub.files["README.md"] and set(hub.files) == {
        "a.h5",
        ABOUT,
        "README.md",
    }


def test_without_a_token_nothing_is_sent(
    hub: FakeHub, exported: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("huggingface_hub.get_token", lambda: None)
    with refused("token", advice="HF_TOKEN"):
        command("dataset", "push", exported, REPO)
    assert not hub.files and not hub.hosts


def test_a_token_that_may_not_write(hub: FakeHub, exported: Path) -> None:
    hub.token = "another"
    with refused(where=REPO, said="may not write"):
        command("dataset", "push", exported, REPO)
    assert not hub.files


def test_files_that_do_not_match_the_card_stay_here(hub: FakeHub, exported: Path) -> None:
    (exported / "data/a.parquet").write_bytes(bytes(200))
    with refused(said="data/a.parquet has other content"):
        command("dataset", "push", exported, REPO)
    assert not hub.files
    with refused(said="neither"):
        command("dataset", "push", exported.parent, REPO)
    with refused("repo", given="no name"):
        shutil.copytree(exported, exported.parent / "b")
        (exported.parent / "b/data/a.parquet").write_bytes(bytes(range(200)))
        command("dataset", "push", exported.parent / "b", "no name")


def test_a_hub_that_fails_keeps_what_it_had(hub: FakeHub, exported: Path) -> None:
    hub.files["README.md"] = b"older"
    hub.refuses = [500] * 10
    with pytest.raises(TransferError, match="500"):
        command("dataset", "push", exported, REPO)
    assert hub.files == {"README.md": b"older"}
    hub.refuses = [503]
    assert command("dataset", "push", exported, REPO) == 0
    assert len(hub.files) == 3


def test_what_is_pulled_is_compared(hub: FakeHub, exported: Path, tmp_path: Path) -> None:
    assert command("dataset", "push", exported, REPO) == 0
    hub.files["data/a.parquet"] = bytes(200)
    with refused(where="", said="data/a.parquet has other content"):
        command("dataset", "pull", REPO, "--out", tmp_path / "pulled")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/letter.txt").write_text("dear")
    with refused(where=tmp_path / "mine", said="letter.txt"):
        command("dataset", "pull", REPO, "--out", tmp_path / "mine")
    assert [path.name for path in (tmp_path / "mine").iterdir()] == ["letter.txt"]
    hub.files = {"../out.txt": b"x", EXPORTED: b"{}"}
    with refused(said="../out.txt"):
        command("dataset", "pull", REPO, "--out", tmp_path / "other")
    hub.files = {"README.md": b"of others"}
    with refused(where=REPO, said="not pushed by mjhab"):
        command("dataset", "pull", REPO, "--out", tmp_path / "other")
    assert not (tmp_path / "other").exists() and not (tmp_path / "out.txt").exists()


def test_a_policy_goes_there_and_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import mjhab.learning
    from mjhab.learning.checkpoint import load_checkpoint

    shipped = sorted(
        (Path(mjhab.learning.__file__).parent / "shipped").rglob("*.safetensors")
    )
    hub = serve(monkeypatch, "model")
    try:
        assert command("policy", "push", shipped[0], REPO, "--licence", "apache-2.0") == 0
        assert command("policy", "pull", REPO, "--out", tmp_path / "there") == 0
        text = (tmp_path / "there/README.md").read_text()
        assert "license: apache-2.0" in text and "mjhab policy pull" in text
        found = load_checkpoint(tmp_path / "there/student.safetensors")
        assert (
            found.about == load_checkpoint(shipped[0]).about
            and check_set(tmp_path / "there") == []
        )
        (tmp_path / "none").mkdir()
        with refused(where=tmp_path / "none", said="student.safetensors"):
            command("policy", "push", tmp_path / "none", REPO)
        (tmp_path / "bad.safetensors").write_bytes(b"no checkpoint")
        with refused(where="bad.safetensors"):
            command("policy", "push", tmp_path / "bad.safetensors", REPO)
    finally:
        hub.close()
