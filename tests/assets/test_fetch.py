"""Downloads from a hub that cuts connections, ignores ranges and serves wrong bytes."""

from __future__ import annotations

import errno
import hashlib
import io
import signal
import socket
import time
import zipfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from huggingface_hub import close_session

from mjhab.assets.hub import TIMEOUT_S, TRIES, RemoteFile, TransferError
from mjhab.assets.install import RECORD, fetch, read_record, verify
from mjhab.assets.sources import SOURCES, hub_endpoint, source_named
from mjhab.core.files.locking import WriteLock
from tests.assets.hub_server import COMMIT, FakeHub
from tests.refusals import refused

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


@pytest.fixture(autouse=True)
def waits(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[float]]:
    """Pauses before another try [s], which nobody waits for; and a client of its own, which knows no proxy."""
    asked: list[float] = []
    sleep = time.sleep

    def pause(seconds: float) -> None:
        # Threads of the hub's client poll its locks every 0.05 s: that is no pause before another try.
        if seconds < 1.0:
            sleep(seconds)
        else:
            asked.append(seconds)

    monkeypatch.setattr("time.sleep", pause)
    monkeypatch.setattr("huggingface_hub.constants.DOWNLOAD_CHUNK_SIZE", 1 << 10)
    for name in ("http_proxy", "HTTP_PROXY", "all_proxy", "ALL_PROXY"):
        monkeypatch.delenv(name, raising=False)
    close_session()
    yield asked
    close_session()


@pytest.fixture
def hub(monkeypatch: pytest.MonkeyPatch) -> Iterator[FakeHub]:
    served = FakeHub(SOURCE.repo, dict(FILES), lfs=(BIG_PATH,))
    monkeypatch.setenv("HF_ENDPOINT", served.endpoint + "/")
    yield served
    served.close()


def ranges(hub: FakeHub, path: str = BIG_PATH) -> list[str]:
    return [wanted for asked, wanted in hub.asked if asked == path]


def installed(root: Path) -> dict[str, bytes]:
    folder = root / "replica_cad"
    paths = (path for path in folder.rglob("*") if path.is_file() and path.name != RECORD)
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths}


def no_leftovers(root: Path) -> bool:
    return not any((root / ".partial").iterdir())


def test_fetch_installs_every_file_and_records_its_hash(
    hub: FakeHub, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert fetch(SOURCE, tmp_path) == tmp_path / "replica_cad"
    assert capfd.readouterr() == ("", ""), "bars are for terminals"
    assert installed(tmp_path) == FILES and no_leftovers(tmp_path)
    record = read_record(tmp_path / "replica_cad")
    assert record is not None and record["commit"] == COMMIT and record["trust"] == "hub"
    assert record["files"][BIG_PATH] == {
        "size": len(BIG),
        "sha256": hashlib.sha256(BIG).hexdigest(),
    }
    assert set(record["files"]) == set(FILES)
    assert verify(tmp_path / "replica_cad").first_use is False


def test_a_cut_connection_continues_where_it_broke(hub: FakeHub, tmp_path: Path) -> None:
    hub.faults[BIG_PATH] = ["cut", "cut"]
    fetch(SOURCE, tmp_path)
    assert installed(tmp_path)[BIG_PATH] == BIG
    starts = [int(asked[6:-1]) for asked in ranges(hub)[1:]]
    # What did not fill a chunk is lost.
    assert len(BIG) // 2 - 1024 <= starts[0] <= len(BIG) // 2 < starts[1]


@pytest.mark.parametrize("faults", [["busy"], ["gone"], ["cut", "whole"]])
def test_troubles_that_pass(hub: FakeHub, tmp_path: Path, faults: list[str]) -> None:
    hub.faults[BIG_PATH] = list(faults)
    fetch(SOURCE, tmp_path)
    assert installed(tmp_path) == FILES and len(ranges(hub)) == 2


@pytest.mark.parametrize("path", [BIG_PATH, "LICENSE.txt"])
def test_wrong_bytes_are_thrown_away(hub: FakeHub, tmp_path: Path, path: str) -> None:
    hub.faults[path] = ["wrong"]
    fetch(SOURCE, tmp_path)
    assert installed(tmp_path) == FILES and len(ranges(hub, path)) == 2


def test_a_server_of_wrong_bytes_is_given_up_and_nothing_is_installed(
    hub: FakeHub, tmp_path: Path
) -> None:
    hub.faults[BIG_PATH] = ["wrong"] * TRIES
    with pytest.raises(TransferError) as caught:
        fetch(SOURCE, tmp_path)
    assert caught.value.what == f"{SOURCE.repo}/{BIG_PATH}"
    assert "other bytes" in caught.value.problem
    assert not (tmp_path / "replica_cad").exists()
    assert not list(tmp_path.rglob("big.glb"))


def test_a_broken_run_is_continued_by_the_next(hub: FakeHub, tmp_path: Path) -> None:
    hub.faults[BIG_PATH] = ["gone"] * 100
    with pytest.raises(TransferError, match="the same command continues"):
        fetch(SOURCE, tmp_path)
    assert not (tmp_path / "replica_cad").exists()
    hub.asked.clear()
    hub.faults.clear()
    fetch(SOURCE, tmp_path)
    assert installed(tmp_path) == FILES and no_leftovers(tmp_path)
    assert [path for path, _ in hub.asked] == [BIG_PATH], "the others were there"


def test_ctrl_c_ends_a_file_in_its_middle(hub: FakeHub, tmp_path: Path) -> None:
    hub.faults[BIG_PATH] = ["ctrl-c"]
    # A shell starts its background jobs with SIGINT ignored, and the test suite may be one.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            fetch(SOURCE, tmp_path)
    finally:
        signal.signal(signal.SIGINT, before)
    assert not list(tmp_path.rglob("big.glb")) and len(ranges(hub)) == 1
    fetch(SOURCE, tmp_path)
    assert installed(tmp_path) == FILES and no_leftovers(tmp_path)


def test_what_was_kept_of_a_broken_run_is_checked(hub: FakeHub, tmp_path: Path) -> None:
    hub.faults[BIG_PATH] = ["gone"] * 100
    with pytest.raises(TransferError):
        fetch(SOURCE, tmp_path)
    hub.faults.clear()
    (kept,) = (tmp_path / ".partial").rglob("LICENSE.txt")
    kept.write_bytes(b"termz")
    fetch(SOURCE, tmp_path)
    assert installed(tmp_path) == FILES


def test_what_an_earlier_version_of_mjhab_began_is_continued(
    hub: FakeHub, tmp_path: Path
) -> None:
    begun = tmp_path / ".partial" / f"replica_cad-{COMMIT[:12]}"
    (begun / BIG_PATH).parent.mkdir(parents=True)
    (begun / BIG_PATH).write_bytes(BIG)
    (begun / "LICENSE.txt.part").write_bytes(b"te")
    fetch(SOURCE, tmp_path)
    assert installed(tmp_path) == FILES and no_leftovers(tmp_path)
    assert ranges(hub) == []


def test_a_missing_repository_is_not_tried_again(
    hub: FakeHub, tmp_path: Path, waits: list[float]
) -> None:
    with pytest.raises(TransferError) as caught:
        fetch(replace(SOURCE, repo="nobody/nothing"), tmp_path)
    assert caught.value.status == 404 and "nobody/nothing" in caught.value.what
    assert "it is not there" in caught.value.problem and waits == []


def test_no_repository_can_have_that_name(hub: FakeHub, tmp_path: Path) -> None:
    with refused("repo", "a/b/c"):
        fetch(replace(SOURCE, repo="a/b/c"), tmp_path)


def test_a_dead_hub_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, waits: list[float]
) -> None:
    monkeypatch.setenv("HF_ENDPOINT", "http://127.0.0.1:9")
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    with pytest.raises(TransferError) as caught:
        fetch(SOURCE, tmp_path)
    assert "127.0.0.1:9" in caught.value.what and caught.value.status is None
    assert "is there a network" in caught.value.problem
    assert "https_proxy" in caught.value.problem
    # Nobody waits long to hear that there is no network.
    assert waits == [] and "\n" not in str(caught.value)


def test_a_hub_that_says_nothing_is_given_up_soon(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, waits: list[float]
) -> None:
    assert TIMEOUT_S <= 10
    monkeypatch.setattr("mjhab.assets.hub.TIMEOUT_S", 0.05)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        monkeypatch.setenv("HF_ENDPOINT", f"http://127.0.0.1:{silent.getsockname()[1]}")
        monkeypatch.setenv("no_proxy", "127.0.0.1")
        with pytest.raises(TransferError, match="is there a network"):
            fetch(SOURCE, tmp_path)
    assert waits == []


def test_a_file_of_which_nothing_comes_is_given_up(
    hub: FakeHub, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_DOWNLOAD_TIMEOUT", 0.1)
    hub.faults[BIG_PATH] = ["silent"] * 100
    with pytest.raises(TransferError, match="is there a network"):
        fetch(SOURCE, tmp_path)


def test_no_network_is_used_where_it_is_forbidden(
    hub: FakeHub, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    with pytest.raises(TransferError, match=r"HF_HUB_OFFLINE.*--offline"):
        fetch(SOURCE, tmp_path)
    assert hub.asked == []


def test_a_full_disk_is_told_at_once(
    hub: FakeHub, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, waits: list[float]
) -> None:
    class Full(io.BytesIO):
        def write(self, data: object) -> int:
            raise OSError(errno.ENOSPC, "No space left on device")

    opened = Path.open

    def full(self: Path, *args: Any, **options: Any) -> Any:
        is_download = self.name.endswith(".incomplete")
        return Full() if is_download else opened(self, *args, **options)

    monkeypatch.setattr(Path, "open", full)
    with pytest.raises(TransferError, match=r"No space left.*same command continues"):
        fetch(SOURCE, tmp_path)
    assert waits == [] and not (tmp_path / "replica_cad").exists()


@pytest.mark.parametrize("sign", ["", "x"])
def test_a_file_is_held_to_what_the_hub_lists(tmp_path: Path, sign: str) -> None:
    path = tmp_path / "file"
    assert not RemoteFile(0, "", "").matches(path)
    path.write_bytes(b"abc" + sign.encode())
    sha256 = hashlib.sha256(b"abc").hexdigest()
    blob = hashlib.sha1(b"blob 3\0abc").hexdigest()
    for listed in (RemoteFile(3, sha256, ""), RemoteFile(3, "", blob)):
        assert listed.matches(path) == (not sign)


def test_a_repository_with_other_files_is_refused(hub: FakeHub, tmp_path: Path) -> None:
    hub.files = {"README.md": b"moved"}
    with refused(where="ReplicaCAD", said="must hold configs/scenes/*"):
        fetch(SOURCE, tmp_path)
    with refused(where="ReplicaCAD_dataset", said="none that ycb is made of"):
        fetch(
            replace(SOURCES["ycb"], repo=SOURCE.repo),
            tmp_path,
        )
    assert not (tmp_path / "replica_cad").exists() and not (tmp_path / "ycb").exists()


def test_a_repository_cannot_write_outside(hub: FakeHub, tmp_path: Path) -> None:
    hub.files["../outside.txt"] = b"x"
    with refused(where="ReplicaCAD_dataset", said="leads out of the folder"):
        fetch(SOURCE, tmp_path / "root")
    assert not (tmp_path / "outside.txt").exists()


def test_ycb_files_go_where_the_reader_looks(hub: FakeHub, tmp_path: Path) -> None:
    hub.files = {
        "meshes/024_bowl/google_16k/textured.glb": b"bowl",
        "meshes/024_bowl/google_16k/textured.glb.orig": b"no",
        "collision_meshes/024_cv_decomp.glb": b"no",
        "LICENSE": b"terms",
    }
    folder = fetch(replace(SOURCES["ycb"], repo=SOURCE.repo), tmp_path)
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
    fetch(SOURCE, tmp_path)
    hub.files["LICENSE.txt"] = b"new terms"
    with refused(where="replica_cad", said="--overwrite replaces it"):
        fetch(SOURCE, tmp_path)
    assert installed(tmp_path)["LICENSE.txt"] == b"terms"
    fetch(SOURCE, tmp_path, overwrite=True)
    assert installed(tmp_path)["LICENSE.txt"] == b"new terms" and no_leftovers(tmp_path)


def test_a_failed_replacement_keeps_what_was_there(
    hub: FakeHub, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fetch(SOURCE, tmp_path)
    rename = Path.rename

    def refuse(self: Path, target: Path) -> Path:
        if self.name == "replica_cad-content":
            raise OSError("disk trouble")
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", refuse)
    with pytest.raises(OSError, match="disk trouble"):
        fetch(SOURCE, tmp_path, overwrite=True)
    assert installed(tmp_path) == FILES


def test_no_room_is_found_out_before_the_download(
    hub: FakeHub, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "shutil.disk_usage", lambda path: type("Usage", (), {"free": 1000})
    )
    with refused(
        where="replica_cad-0123456789ab", said="GB more, but only 0.0 GB are free"
    ):
        fetch(SOURCE, tmp_path)
    assert hub.asked == []


def test_proxies_are_used(
    hub: FakeHub, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HF_ENDPOINT", "http://hub.example")
    monkeypatch.setenv("http_proxy", hub.endpoint)
    monkeypatch.setenv("no_proxy", "")
    fetch(SOURCE, tmp_path)
    assert installed(tmp_path) == FILES and hub.hosts == {"hub.example"}


def test_the_endpoint_must_be_an_address(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HF_ENDPOINT", "file:///etc")
    with refused("HF_ENDPOINT", "file:///etc"):
        hub_endpoint()
    monkeypatch.delenv("HF_ENDPOINT")
    assert hub_endpoint() == "https://huggingface.co"


def test_unknown_data_sets_are_refused_with_a_hint() -> None:
    with refused("data set", "ycbb", expected="ycb"):
        source_named("ycbb")


@pytest.mark.parametrize("body", [b"<html>", b'{"error": "no"}', b"[1]", b"[" * 100_000])
def test_an_answer_of_something_else_is_one_line(
    tmp_path: Path, body: bytes, hub: FakeHub
) -> None:
    hub.body = body
    with pytest.raises(TransferError) as caught:
        fetch(SOURCE, tmp_path)
    assert "HF_ENDPOINT" in caught.value.problem and "\n" not in str(caught.value)


def test_two_processes_do_not_install_the_same_data_set_at_once(
    hub: FakeHub, tmp_path: Path
) -> None:
    (tmp_path / ".partial").mkdir()
    with (
        WriteLock(tmp_path / ".partial" / SOURCE.name),
        refused(said="is being written by"),
    ):
        fetch(SOURCE, tmp_path)
    assert hub.asked == []
