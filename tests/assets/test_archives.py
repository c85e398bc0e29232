"""Archives from strangers, bundles for machines without a network, and the record of what is installed."""

from __future__ import annotations

import bz2
import gzip
import io
import json
import lzma
import random
import stat
import tarfile
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest

from mjhab.assets.archive import safe_path, unpack
from mjhab.assets.install import RECORD, install_bundle, read_record, verify
from mjhab.assets.sources import SOURCES
from tests.refusals import refused

SOURCE = SOURCES["replica_cad"]
GOOD = {
    "configs/scenes/a.scene_instance.json": b"{}",
    "configs/objects/b.object_config.json": b"{}",
    "urdf/fridge.urdf": b"<robot/>",
}


def make_zip(
    path: Path, files: dict[str, bytes], links: dict[str, str] | None = None
) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in files.items():
            archive.writestr(name, data)
        for name, target in (links or {}).items():
            info = zipfile.ZipInfo(name)
            info.external_attr = (stat.S_IFLNK | 0o777) << 16
            archive.writestr(info, target)
    return path


def make_tar(
    path: Path,
    files: dict[str, bytes],
    special: dict[str, tuple[bytes, str]] | None = None,
) -> Path:
    with tarfile.open(path, "w:gz") as archive:
        for name, data in files.items():
            info = tarfile.TarInfo(name)
            info.size = len(data)
            archive.addfile(info, io.BytesIO(data))
        for name, (kind, target) in (special or {}).items():
            info = tarfile.TarInfo(name)
            info.type = kind
            info.linkname = target
            archive.addfile(info)
    return path


@pytest.mark.parametrize("make", [make_zip, make_tar])
@pytest.mark.parametrize(
    "name",
    ["../evil", "a/../../evil", "/evil", "a\\..\\evil", "C:/evil", "..", "./../evil"],
)
def test_paths_that_lead_out_are_refused(tmp_path: Path, make: object, name: str) -> None:
    archive = make(tmp_path / "bundle", {**GOOD, name: b"x"})  # type: ignore[operator]
    root = tmp_path / "deep" / "root"
    with refused(
        where="bundle", said="leads out of the folder; nothing was installed"
    ) as caught:
        install_bundle(SOURCE, archive, root)
    assert "bundle" in str(caught.value)
    assert not list(tmp_path.rglob("evil")) and not (root / "replica_cad").exists()
    assert not any((root / ".partial").glob("*"))


@pytest.mark.parametrize("make", [make_zip, make_tar])
def test_an_archive_that_holds_far_more_than_its_size_is_refused_before_it_is_unpacked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, make: Callable[..., Path]
) -> None:
    monkeypatch.setattr("mjhab.assets.archive.LEAST_UNPACKED_BYTES", 100_000)
    archive = make(tmp_path / "bomb", {**GOOD, "zeros": bytes(2_000_000)})
    with refused(where="bomb", said="holds more than 0.0 GB, which no data set"):
        unpack(archive, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_header_of_a_tar_archive_that_states_gigabytes_is_not_read(
    tmp_path: Path,
) -> None:
    header = tarfile.TarInfo("pax")
    header.type = tarfile.XHDTYPE
    header.size = 2**32
    archive = tmp_path / "bomb.tar.gz"
    with gzip.open(archive, "wb", compresslevel=1) as stream:
        stream.write(header.tobuf(tarfile.GNU_FORMAT) + bytes(2**22))
    with refused(where="bomb.tar.gz", said="damaged"):
        unpack(archive, tmp_path / "out")


@pytest.mark.parametrize("target", ["/etc/passwd", "../../outside", "configs"])
def test_links_and_devices_are_refused(tmp_path: Path, target: str) -> None:
    archives = [
        make_zip(tmp_path / "link.zip", GOOD, {"objects": target}),
        make_tar(tmp_path / "soft.tar.gz", GOOD, {"objects": (tarfile.SYMTYPE, target)}),
        make_tar(tmp_path / "hard.tar.gz", GOOD, {"objects": (tarfile.LNKTYPE, target)}),
        make_tar(tmp_path / "device.tar.gz", GOOD, {"objects": (tarfile.CHRTYPE, "")}),
    ]
    for archive in archives:
        with refused(said="nothing was installed"):
            install_bundle(SOURCE, archive, tmp_path / "root")
    assert not (tmp_path / "root" / "replica_cad").exists()


def test_a_file_behind_a_link_of_the_same_archive_is_refused(tmp_path: Path) -> None:
    """The classic: a link to a folder outside, then a file below the link."""
    outside = tmp_path / "outside"
    outside.mkdir()
    archive = make_zip(tmp_path / "a.zip", {"d/evil": b"x", **GOOD}, {"d": str(outside)})
    with refused(said="is a link"):
        install_bundle(SOURCE, archive, tmp_path / "root")
    assert not any(outside.iterdir())


@pytest.mark.parametrize("kind", ["zip", "tar.gz", "text"])
def test_damaged_archives_are_refused(tmp_path: Path, kind: str) -> None:
    path = tmp_path / f"bundle.{kind}"
    payload = {**GOOD, "big": bytes(range(256)) * 4000}
    if kind == "text":
        path.write_text("hello")
    else:
        whole = (make_zip if kind == "zip" else make_tar)(path, payload).read_bytes()
        middle = len(whole) // 2
        path.write_bytes(
            whole[:middle]
            if kind == "tar.gz"
            else whole[:200] + b"\0" * 300 + whole[500:]
        )
    with refused(said="neither a zip nor a tar") as caught:
        install_bundle(SOURCE, path, tmp_path / "root")
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)
    assert not (tmp_path / "root" / "replica_cad").exists()


@pytest.mark.parametrize("compress", [gzip.compress, bz2.compress, lzma.compress])
@pytest.mark.parametrize("place", [-6, 0.5])
def test_a_turned_bit_is_found(
    tmp_path: Path, compress: Callable[[bytes], bytes], place: float
) -> None:
    noise = random.Random(0).randbytes(100_000)
    whole = make_tar(tmp_path / "whole.tar.gz", {**GOOD, "big": noise}).read_bytes()
    packed = bytearray(compress(gzip.decompress(whole)))
    packed[int(place) if place < 0 else int(place * len(packed))] ^= 1
    path = tmp_path / "turned"
    path.write_bytes(packed)
    with refused(where="turned", said="neither a zip nor a tar"):
        install_bundle(SOURCE, path, tmp_path / "root")
    assert not (tmp_path / "root" / "replica_cad").exists()


@pytest.mark.parametrize("make", [make_zip, make_tar])
@pytest.mark.parametrize("wrapper", ["", "ReplicaCAD/", "data/replica_cad/"])
def test_a_bundle_is_installed_without_a_network(
    tmp_path: Path, make: object, wrapper: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "mjhab.assets.install.list_files", lambda *args: pytest.fail("network")
    )
    bundle = make(
        tmp_path / "bundle", {wrapper + name: data for name, data in GOOD.items()}
    )  # type: ignore[operator]
    folder = install_bundle(SOURCE, bundle, tmp_path / "root")
    assert {
        p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()
    } == {
        *GOOD,
        RECORD,
    }
    record = read_record(folder)
    assert record is not None and (record["origin"], record["trust"]) == (
        "bundle",
        "first use",
    )
    assert not any((tmp_path / "root" / ".partial").iterdir())
    with refused(where="replica_cad", said="--overwrite replaces it"):
        install_bundle(SOURCE, bundle, tmp_path / "root")


@pytest.mark.parametrize(
    "path",
    ["ycb/024_bowl/textured.glb", "ycb-main/meshes/024_bowl/google_16k/textured.glb"],
)
def test_a_bundle_may_have_the_layout_of_the_repository(
    tmp_path: Path, path: str
) -> None:
    bundle = make_zip(tmp_path / "b.zip", {path: b"bowl", "ycb-main/README.md": b"r"})
    folder = install_bundle(SOURCES["ycb"], bundle, tmp_path / "root")
    assert (folder / "024_bowl" / "textured.glb").read_bytes() == b"bowl"
    assert sorted(p.name for p in folder.rglob("*") if p.is_file()) == [
        RECORD,
        "textured.glb",
    ]


def test_a_bundle_of_something_else_is_refused(tmp_path: Path) -> None:
    bundle = make_zip(tmp_path / "holiday.zip", {"photo.jpg": b"x"})
    for name in ("replica_cad", "ycb", "hab_episodes"):
        with refused(where="holiday.zip", said=f"not the data set {name}"):
            install_bundle(SOURCES[name], bundle, tmp_path / "root")
    with refused(where="nothing.zip", said="does not exist"):
        install_bundle(SOURCE, tmp_path / "nothing.zip", tmp_path / "root")
    assert not any((tmp_path / "root").glob("[!.]*"))


def test_an_archive_larger_than_the_disk_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bundle = make_zip(tmp_path / "b.zip", {**GOOD, "zeros": bytes(1 << 20)})
    monkeypatch.setattr(
        "shutil.disk_usage", lambda path: type("Usage", (), {"free": 1 << 19})
    )
    with refused(where="b.zip", said="only 0.0 GB free"):
        unpack(bundle, tmp_path / "out")


def test_verify_finds_what_changed(tmp_path: Path) -> None:
    folder = install_bundle(SOURCE, make_zip(tmp_path / "b.zip", GOOD), tmp_path)
    assert verify(folder) == type(verify(folder))(3, (), (), False)
    (folder / "urdf/fridge.urdf").write_bytes(b"<robot>")
    (folder / "configs/scenes/a.scene_instance.json").unlink()
    found = verify(folder)
    assert found.changed == ("urdf/fridge.urdf",) and found.missing == (
        "configs/scenes/a.scene_instance.json",
    )


def test_a_folder_without_a_record_is_trusted_on_first_use(tmp_path: Path) -> None:
    folder = tmp_path / "ycb"
    (folder / "024_bowl").mkdir(parents=True)
    (folder / "024_bowl" / "textured.glb").write_bytes(b"bowl")
    assert verify(folder).first_use and not verify(folder).first_use
    (folder / "024_bowl" / "textured.glb").write_bytes(b"b0wl")
    assert verify(folder).changed == ("024_bowl/textured.glb",)
    with refused(
        where="nothing", said="does not exist; `mjhab assets fetch nothing` gets it"
    ):
        verify(tmp_path / "nothing")


@pytest.mark.parametrize(
    "body",
    [
        "",
        "[]",
        '{"format": "other"}',
        json.dumps({"format": "mjhab-asset-1", "files": {"a": {}}}),
        json.dumps({"format": "mjhab-asset-1", "files": {"../a": {"sha256": ""}}}),
    ],
)
def test_a_damaged_record_is_named(tmp_path: Path, body: str) -> None:
    (tmp_path / RECORD).write_text(body)
    with refused(where=RECORD):
        verify(tmp_path)


@pytest.mark.parametrize(
    ("given", "kept"),
    [("a/b.txt", "a/b.txt"), ("./a//b", "a/b"), ("a/./..b/c", "a/..b/c")],
)
def test_harmless_paths_stay(given: str, kept: str) -> None:
    assert safe_path(given, "x") == kept
