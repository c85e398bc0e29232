"""Downloads from a hub that cuts connections, ignores ranges and serves wrong bytes."""

from __future__ import annotations

import hashlib
import io
import json
import socket
import zipfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from mjhab.assets.hub import list_files
from mjhab.assets.install import RECORD, Progress, fetch, read_record, verify
from mjhab.assets.sources import SOURCES, hub_endpoint, source_named
from mjhab.assets.transfer import (
    FIRST_TIMEOUT,
    SILENCE_COSTS,
    TRIES,
    Expected,
    TransferError,
    download,
    pause,
)
from mjhab.core.errors import UsageError
from tests.assets.hub_server import COMMIT, FakeHub

SOURCE = SOURCES["replica_cad"]
BIG = bytes(range(256)) * 3000
FILES = {
    "configs/scenes/a.scene_instance.json": b'{"a": 1}',
    "configs/objects/with space.object_config.json": b"{}",
    "urdf/fridge/fridge.urdf": b"<robot/>",
    "objects/big.glb": BIG,
    "LICENSE.txt": b"terms",
}
BIG_PATH = "objects/big.glb"


@pytest.fixture
def hub(monkeypatch: pytest.MonkeyPatch) -> Iterator[FakeHub]:
    served = FakeHub(SOURCE.repo, dict(FILES), lfs=(BIG_PATH,), page=2)
    monkeypatch.setenv("HF_ENDPOINT", served.endpoint + "/")
    for name in ("http_proxy", "HTTP_PROXY", "all_proxy", "ALL_PROXY"):
        monkeypatch.delenv(name, raising=False)
    yield served
    served.close()


class Count:
    """Counts bytes and waits, and waits for nothing."""

    def __init__(self) -> None:
        self.total = self.came = 0
        self.waits: list[float] = []

    def progress(self) -> Progress:
        return Progress(self._total, self._step, self.waits.append)

    def _total(self, count: int) -> None:
        self.total = count

    def _step(self, count: int) -> None:
        self.came += count


def ranges(hub: FakeHub, path: str = BIG_PATH) -> list[str]:
    return [wanted for asked, wanted in hub.asked if asked == path]


def installed(root: Path) -> dict[str, bytes]:
    folder = root / "replica_cad"
    paths = (path for path in folder.rglob("*") if path.is_file() and path.name != RECORD)
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths}


def no_leftovers(root: Path) -> bool:
    return not any((root / ".partial").iterdir())


def test_fetch_installs_every_file_and_records_its_hash(
    hub: FakeHub, tmp_path: Path
) -> None:
    count = Count()
    assert fetch(SOURCE, tmp_path, progress=count.progress()) == tmp_path / "replica_cad"
    assert installed(tmp_path) == FILES and no_leftovers(tmp_path)
    record = read_record(tmp_path / "replica_cad")
    assert record is not None and record["commit"] == COMMIT and record["trust"] == "hub"
    assert record["files"][BIG_PATH] == {
        "size": len(BIG),
        "sha256": hashlib.sha256(BIG).hexdigest(),
    }
    assert set(record["files"]) == set(FILES)
    assert count.total == count.came == sum(map(len, FILES.values()))
    assert verify(tmp_path / "replica_cad").first_use is False


def test_a_cut_connection_continues_where_it_broke(hub: FakeHub, tmp_path: Path) -> None:
    hub.faults[BIG_PATH] = ["cut", "busy", "cut", "gone"]
    count = Count()
    fetch(SOURCE, tmp_path, progress=count.progress())
    assert installed(tmp_path)[BIG_PATH] == BIG
    half = len(BIG) // 2
    rest = len(BIG) // 4
    assert ranges(hub) == [
        "",
        f"bytes={half}-",
        f"bytes={half}-",
        f"bytes={half + rest}-",
        f"bytes={half + rest}-",
    ]
    assert count.came == count.total
    assert count.waits == [pause(0), pause(0)]


def test_a_server_without_ranges_starts_again(hub: FakeHub, tmp_path: Path) -> None:
    hub.faults[BIG_PATH] = ["cut", "whole"]
    count = Count()
    fetch(SOURCE, tmp_path, progress=count.progress())
    assert installed(tmp_path)[BIG_PATH] == BIG and len(ranges(hub)) == 2
    assert count.came == count.total


@pytest.mark.parametrize("path", [BIG_PATH, "LICENSE.txt"])
def test_wrong_bytes_are_thrown_away(hub: FakeHub, tmp_path: Path, path: str) -> None:
    hub.faults[path] = ["wrong"]
    fetch(SOURCE, tmp_path, progress=Count().progress())
    assert installed(tmp_path) == FILES


def test_a_half_of_wrong_bytes_does_not_stay(hub: FakeHub, tmp_path: Path) -> None:
    """The hash of the whole is wrong when a resumed download began with other bytes."""
    hub.faults[BIG_PATH] = ["wrong", "cut"]
    part = tmp_path / ".partial" / f"replica_cad-{COMMIT[:12]}" / (BIG_PATH + ".part")
    part.parent.mkdir(parents=True)
    part.write_bytes(b"\xff" * 1000)
    fetch(SOURCE, tmp_path, progress=Count().progress())
    assert installed(tmp_path) == FILES


def test_a_server_of_wrong_bytes_is_given_up_and_nothing_is_installed(
    hub: FakeHub, tmp_path: Path
) -> None:
    hub.faults[BIG_PATH] = ["wrong"] * 9
    with pytest.raises(TransferError, match="other bytes than the hub lists") as caught:
        fetch(SOURCE, tmp_path, progress=Count().progress())
    assert BIG_PATH in str(caught.value) and "\n" not in str(caught.value)
    assert not (tmp_path / "replica_cad").exists()
    assert not list(tmp_path.rglob("big.glb*"))


def test_a_broken_run_is_continued_by_the_next(hub: FakeHub, tmp_path: Path) -> None:
    hub.faults[BIG_PATH] = ["cut"] + ["gone"] * TRIES
    with pytest.raises(TransferError, match="the same command continues"):
        fetch(SOURCE, tmp_path, progress=Count().progress())
    assert not (tmp_path / "replica_cad").exists()
    hub.asked.clear()
    count = Count()
    fetch(SOURCE, tmp_path, progress=count.progress())
    assert installed(tmp_path) == FILES and no_leftovers(tmp_path)
    assert ranges(hub) == [f"bytes={len(BIG) // 2}-"]
    assert count.came == count.total


def test_a_missing_repository_is_not_tried_again(hub: FakeHub, tmp_path: Path) -> None:
    count = Count()
    with pytest.raises(TransferError, match="404 Not Found: it is not there") as caught:
        fetch(replace(SOURCE, repo="nobody/nothing"), tmp_path, progress=count.progress())
    assert "nobody/nothing" in str(caught.value) and count.waits == []


def test_a_dead_hub_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HF_ENDPOINT", "http://127.0.0.1:9")
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    count = Count()
    with pytest.raises(
        TransferError, match=r"127\.0\.0\.1:9.*the connection failed.*proxy"
    ):
        fetch(SOURCE, tmp_path, progress=count.progress())
    # Nobody waits long to hear that there is no network; a server that was reached gets TRIES.
    assert sum(count.waits) + FIRST_TIMEOUT <= 5


def test_a_hub_that_says_nothing_is_given_up_soon(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert FIRST_TIMEOUT * TRIES / SILENCE_COSTS <= 10
    monkeypatch.setattr("mjhab.assets.transfer.FIRST_TIMEOUT", 0.05)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        monkeypatch.setenv("HF_ENDPOINT", f"http://127.0.0.1:{silent.getsockname()[1]}")
        monkeypatch.setenv("no_proxy", "127.0.0.1")
        count = Count()
        with pytest.raises(
            TransferError, match="the server says nothing, again and again"
        ):
            fetch(SOURCE, tmp_path, progress=count.progress())
    assert count.waits == []


def test_a_file_of_which_nothing_comes_is_given_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mjhab.assets.transfer.TIMEOUT", 0.05)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        monkeypatch.setenv("no_proxy", "127.0.0.1")
        url = f"http://127.0.0.1:{silent.getsockname()[1]}/file"
        waits: list[float] = []
        with pytest.raises(
            TransferError, match="the server says nothing, again and again"
        ):
            download(url, tmp_path / "file", Expected(10), sleep=waits.append)
    assert len(waits) == TRIES / SILENCE_COSTS - 1


def test_a_full_disk_is_told_at_once(hub: FakeHub, tmp_path: Path) -> None:
    waits: list[float] = []
    _, listed = list_files(hub_endpoint(), SOURCE.repo, SOURCE.revision, waits.append)
    (big,) = [file for file in listed if file.path == BIG_PATH]
    (tmp_path / "big.part").symlink_to("/dev/full")
    with pytest.raises(TransferError, match=r"big\.part cannot be written: No space"):
        download(big.url, tmp_path / "big", big.expected, sleep=waits.append)
    assert waits == [] and len(ranges(hub)) == 1


def test_documents_are_bounded(
    hub: FakeHub, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mjhab.assets.transfer.MAX_DOCUMENT_MB", 1e-5)
    count = Count()
    with pytest.raises(TransferError, match="larger than"):
        fetch(SOURCE, tmp_path, progress=count.progress())
    assert count.waits == [], "it would be as large again"


def test_a_list_of_files_has_an_end(
    hub: FakeHub, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mjhab.assets.hub.MAX_PAGES", 2)
    with pytest.raises(TransferError, match="more than 2 pages"):
        fetch(SOURCE, tmp_path, progress=Count().progress())


def test_a_repository_with_other_files_is_refused(hub: FakeHub, tmp_path: Path) -> None:
    hub.files = {"README.md": b"moved"}
    with pytest.raises(
        UsageError,
        match=r"is not the data set replica_cad: it must hold configs/scenes/\*",
    ):
        fetch(SOURCE, tmp_path, progress=Count().progress())
    with pytest.raises(UsageError, match=r"none that ycb is made of.*--repo.*--offline"):
        fetch(
            replace(SOURCES["ycb"], repo=SOURCE.repo),
            tmp_path,
            progress=Count().progress(),
        )
    assert not (tmp_path / "replica_cad").exists() and not (tmp_path / "ycb").exists()


def test_a_repository_cannot_write_outside(hub: FakeHub, tmp_path: Path) -> None:
    hub.files["../outside.txt"] = b"x"
    with pytest.raises(UsageError, match="leads out of the folder"):
        fetch(SOURCE, tmp_path / "root", progress=Count().progress())
    assert not (tmp_path / "outside.txt").exists()


def test_ycb_files_go_where_the_reader_looks(hub: FakeHub, tmp_path: Path) -> None:
    hub.files = {
        "meshes/024_bowl/google_16k/textured.glb": b"bowl",
        "meshes/024_bowl/google_16k/textured.glb.orig": b"no",
        "collision_meshes/024_cv_decomp.glb": b"no",
        "LICENSE": b"terms",
    }
    folder = fetch(
        replace(SOURCES["ycb"], repo=SOURCE.repo), tmp_path, progress=Count().progress()
    )
    assert (folder / "024_bowl" / "textured.glb").read_bytes() == b"bowl"
    assert sorted(p.name for p in folder.rglob("*") if p.is_file()) == [
        RECORD,
        "LICENSE",
        "textured.glb",
    ]


def test_episodes_come_out_of_their_archive(hub: FakeHub, tmp_path: Path) -> None:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("rearrange/v1/val/tidy_house.json.gz", b"episodes")
    hub.files = {"rearrange.zip": buffer.getvalue(), "other.zip": b"no"}
    hub.lfs = ("rearrange.zip",)
    folder = fetch(
        replace(SOURCES["hab_episodes"], repo=SOURCE.repo),
        tmp_path,
        progress=Count().progress(),
    )
    assert [path.read_bytes() for path in folder.rglob("*.json.gz")] == [b"episodes"]
    record = read_record(folder)
    assert (
        record is not None
        and record["archive_sha256"] == hashlib.sha256(buffer.getvalue()).hexdigest()
    )
    assert no_leftovers(tmp_path)


def test_an_installed_data_set_is_replaced_only_on_request(
    hub: FakeHub, tmp_path: Path
) -> None:
    fetch(SOURCE, tmp_path, progress=Count().progress())
    hub.files["LICENSE.txt"] = b"new terms"
    with pytest.raises(UsageError, match=r"exists; .*--overwrite replaces it"):
        fetch(SOURCE, tmp_path, progress=Count().progress())
    assert installed(tmp_path)["LICENSE.txt"] == b"terms"
    fetch(SOURCE, tmp_path, overwrite=True, progress=Count().progress())
    assert installed(tmp_path)["LICENSE.txt"] == b"new terms" and no_leftovers(tmp_path)


def test_a_failed_replacement_keeps_what_was_there(
    hub: FakeHub, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fetch(SOURCE, tmp_path, progress=Count().progress())
    rename = Path.rename

    def refuse(self: Path, target: Path) -> Path:
        if self.name.startswith("replica_cad-0"):
            raise OSError("disk trouble")
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", refuse)
    with pytest.raises(OSError, match="disk trouble"):
        fetch(SOURCE, tmp_path, overwrite=True, progress=Count().progress())
    assert installed(tmp_path) == FILES


def test_no_room_is_found_out_before_the_download(
    hub: FakeHub, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "shutil.disk_usage", lambda path: type("Usage", (), {"free": 1000})
    )
    with pytest.raises(UsageError, match=r"GB more, but only 0\.0 GB are free"):
        fetch(SOURCE, tmp_path, progress=Count().progress())
    assert hub.asked == []


def test_proxies_are_used(
    hub: FakeHub, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HF_ENDPOINT", "http://hub.example")
    monkeypatch.setenv("http_proxy", hub.endpoint)
    monkeypatch.setenv("no_proxy", "")
    fetch(SOURCE, tmp_path, progress=Count().progress())
    assert installed(tmp_path) == FILES and hub.hosts == {"hub.example"}


def test_the_endpoint_must_be_an_address(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HF_ENDPOINT", "file:///etc")
    with pytest.raises(UsageError, match="HF_ENDPOINT must be an address"):
        hub_endpoint()
    monkeypatch.delenv("HF_ENDPOINT")
    assert hub_endpoint() == "https://huggingface.co"


def test_unknown_data_sets_are_refused_with_a_hint() -> None:
    with pytest.raises(
        UsageError, match=r"unknown data set 'ycbb'\. Did you mean 'ycb'\?"
    ):
        source_named("ycbb")


@pytest.mark.parametrize(
    "body",
    [
        b"<html>",
        json.dumps({"error": "no"}).encode(),
        json.dumps([1]).encode(),
        b"[" * 100_000,
    ],
)
def test_an_answer_of_something_else_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, body: bytes, hub: FakeHub
) -> None:
    monkeypatch.setattr("mjhab.assets.hub.get", lambda *asked, **options: (body, ""))
    with pytest.raises(TransferError, match=r"not JSON|field 'sha' must be") as caught:
        fetch(SOURCE, tmp_path)
    assert "\n" not in str(caught.value)
