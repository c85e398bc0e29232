"""``mjhab episodes make`` and ``check``: keys for machines, tables for people, errors."""

from __future__ import annotations

import errno
import gzip
import json
from pathlib import Path
from typing import Any

import pytest

from mjhab.cli.main import main
from mjhab.episodes import files
from mjhab.episodes.files import manifest_path
from mjhab.episodes.hab.format import read_hab, write_hab
from tests.real_data import real_data


def machine(capsys: pytest.CaptureFixture[str], *args: str) -> dict[str, Any]:
    assert main([*args, "--json"]) == 0
    lines = capsys.readouterr().out.strip().splitlines()
    assert len(lines) == 1
    return json.loads(lines[0])


def refused(capsys: pytest.CaptureFixture[str], code: int, *args: str) -> str:
    assert main(["episodes", *args]) == code
    said = [
        line
        for line in capsys.readouterr().err.splitlines()
        if line.startswith("mjhab: ")
    ]
    assert len(said) == 1
    return said[0]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("episodes") / "new" / "groceries.json.gz"
    args = "--task prepare_groceries --split val --count 2 --seed 1 --workers 1".split()
    assert main(["episodes", "make", *args, "--out", str(out)]) == 0
    return out


def test_a_full_disk_is_told_with_the_file_and_the_way_on(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*args: Any) -> Any:
        raise OSError(errno.ENOSPC, "No space left on device")

    out = tmp_path / "a.json"
    with monkeypatch.context() as patch:
        patch.setattr(files, "_rows", full)
        told = refused(capsys, 1, "make", "--count", "1", "--out", str(out))
    assert f"{out}.partial cannot be used (No space left on device)" in told
    assert told.endswith("then the same command continues.")
    said = machine(capsys, "episodes", "make", "--count", "1", "--out", str(out))
    assert said["episodes"] == 1


def test_make_says_what_it_did(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    out = tmp_path / "a.json"
    said = machine(
        capsys,
        *"episodes make --task set_table --count 1 --out".split(),
        str(out),
    )
    assert list(said) == ["episodes", "rejected", "seconds"] and said["episodes"] == 1
    assert read_hab(out).episodes[0].info["task"] == "set_table"
    assert manifest_path(out).exists()


def test_check_counts_what_stays(capsys: pytest.CaptureFixture[str], made: Path) -> None:
    assert machine(capsys, "episodes", "check", str(made)) == {
        "episodes": 2,
        "loaded": 2,
        "at_rest": 1.0,
        "moved": {},
    }
    assert main(["episodes", "check", str(made)]) == 0
    out = capsys.readouterr().out
    assert "024_bowl" in out and "100.0 % of 60 objects stay" in out


def test_check_tells_what_moves(
    capsys: pytest.CaptureFixture[str], made: Path, tmp_path: Path
) -> None:
    file = read_hab(made)
    name, matrix = file.episodes[0].rigid_objs[0]
    matrix[1, 3] += 0.1
    lifted = tmp_path / "lifted_prepare_groceries.json"
    write_hab(lifted, file)
    said = machine(capsys, "episodes", "check", str(lifted))
    assert said["moved"] == {name.split(".")[0]: 1} and said["at_rest"] == pytest.approx(
        59 / 60, abs=1e-4
    )


def test_check_compares_with_the_manifest(
    capsys: pytest.CaptureFixture[str], made: Path, tmp_path: Path
) -> None:
    copy = tmp_path / made.name
    file = read_hab(made)
    file.episodes[1].rigid_objs[0][1][0, 3] += 0.001
    write_hab(copy, file)
    manifest_path(copy).write_bytes(manifest_path(made).read_bytes())
    assert "episodes[1] differs from groceries.manifest.json" in refused(
        capsys, 1, "check", str(copy)
    )


def test_wrong_orders_are_refused(
    capsys: pytest.CaptureFixture[str], made: Path, tmp_path: Path
) -> None:
    out = str(tmp_path / "x.json")
    assert "exists; add --overwrite" in refused(
        capsys, 2, "make", "--count", "2", "--out", str(made)
    )
    assert "out must be a name that ends with .json or .json.gz" in refused(
        capsys, 2, "make", "--out", str(tmp_path / "x.txt")
    )
    assert "Did you mean 'tidy_house'" in refused(
        capsys, 2, "make", "--task", "tidy_hose", "--out", out
    )
    assert "unknown split 'dev'" in refused(
        capsys, 2, "make", "--split", "dev", "--out", out
    )
    assert "count must be at least 1" in refused(
        capsys, 2, "make", "--count", "0", "--out", out
    )
    assert "unknown task" in refused(capsys, 2, "check", str(made), "--task", "tidy")
    assert not list(tmp_path.iterdir())


def test_broken_files_are_refused(
    capsys: pytest.CaptureFixture[str], made: Path, tmp_path: Path
) -> None:
    data = made.read_bytes()
    cut = tmp_path / "cut.json.gz"
    cut.write_bytes(data[: len(data) // 2])
    assert "cut.json.gz: the gzip data is cut off" in refused(
        capsys, 2, "check", str(cut)
    )
    body = json.loads(gzip.decompress(data))
    body["episodes"][1]["scene_id"] = "x/nowhere.scene_instance.json"
    odd = tmp_path / "odd_prepare_groceries.json"
    odd.write_text(json.dumps(body))
    assert (
        "odd_prepare_groceries.json: episodes[1].scene_id: unknown scene 'nowhere'"
        in refused(capsys, 2, "check", str(odd))
    )


def test_check_of_real_episodes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = real_data("hab_episodes", "tidy_house_v3_sc1_staging_01.json.gz")
    made = json.loads(gzip.decompress(whole.read_bytes()))
    made["episodes"] = made["episodes"][::5]
    path = tmp_path / whole.name
    path.write_bytes(gzip.compress(json.dumps(made).encode()))
    said = machine(
        capsys, "episodes", "check", str(path), "--assets", str(real_data("replica_cad"))
    )
    assert (said["episodes"], said["loaded"]) == (10, 10)
    assert said["at_rest"] > 0.99
