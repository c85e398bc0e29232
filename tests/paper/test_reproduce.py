"""``mjhab reproduce table1``: rows of the paper, one student for each."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from mjhab.cli.main import main, parse
from mjhab.core.errors import MjhabError
from mjhab.learning import configs
from mjhab.learning.changes import with_changes
from mjhab.learning.checkpoint import load_checkpoint
from mjhab.learning.configs import DaggerConfig, ImitationConfig, InputConfig, preset_of
from mjhab.paper.reproduce.means import means
from mjhab.paper.reproduce.results import mean_cells, titles
from mjhab.paper.reproduce.rows import table_rows
from mjhab.paper.reproduce.spec import TableSpec, chosen_rows, table_config
from mjhab.paper.reproduce.studies import config_of
from mjhab.paper.reproduce.variants import CHANGED, STYLES, VARIANTS, Imitation
from mjhab.reports.paper import paper_success
from mjhab.robots.robot import Robot
from tests.learning.small import config
from tests.refusals import command, refused

COMMAND = "reproduce table1 --rows set_table/close/drawer --preset tiny --json".split()


def test_rows_are_those_of_the_paper() -> None:
    rows = table_rows()
    assert len(rows) == 10
    for split in ("train", "val"):
        found = [
            paper_success(row.task, row.subtask, split, row.target)
            for row in rows.values()
        ]
        assert len({tuple(numbers.items()) for numbers in found}) == 10 and all(found)


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("--robot", "fetsh"), dict(option="robot", expected="fetch")),
        (("--rows", "set_table/close/drawr"), dict(expected="set_table/close/drawer")),
        (("--preset", "smal"), dict(expected="small")),
        (("--split", "vla"), dict(option="split", given="vla")),
        (("--episodes", "0"), dict(option="episodes", given=0)),
        (("--profile", "ms_hub"), dict(option="profile", expected="ms_hab")),
        (("--set", "inputs.image_sise=16"), dict(expected="inputs.image_size")),
        (("--variants", "px_64"), dict(option="variant of table1", given="px_64")),
        (("--column", "rl_al"), dict(expected="rl_all")),
        (("--column", "rl_all", "--preset", "small"), dict(said="preset")),
        (("--policies", "nowhere"), dict(where="nowhere", said="not a folder of")),
        (("--demos", "-1"), dict(option="demos", given=-1)),
        (("--demos", "5"), dict(option="demos", given=5, expected="table5")),
        (("--updates", "5"), dict(option="updates", given=5, expected="table5")),
    ],
)
def test_bad_input(words: tuple[str, ...], told: dict[str, Any], tmp_path: Path) -> None:
    out = tmp_path / "run"
    with refused(**told):
        command("reproduce", "table1", "--out", str(out), *words)
    assert not out.exists()


def test_a_robot_is_that_of_training_and_evaluation(tmp_path: Path) -> None:
    words = ["reproduce", "table1", "--out", str(tmp_path), "--robot", "fetch"]
    spec = parse(words).spec
    assert spec.asked.robot == table_config(spec)["robot"] == "fetch"


def test_a_robot_without_its_files_leaves_no_folder(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def absent(robot: Robot) -> Any:
        raise MjhabError("the files are not installed")

    monkeypatch.setattr(Robot, "body", property(absent))
    words = ["reproduce", "table5", "--out", str(tmp_path / "run"), "--robot", "fetch"]
    assert main(words) == 1
    assert "the files are not installed" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_a_row_that_is_named_twice_is_one_row(tmp_path: Path) -> None:
    rows = ["--rows", "set_table/close/drawer", "set_table/close/drawer"]
    words = ["reproduce", "table1", "--out", str(tmp_path), *rows]
    assert [row.name for row in chosen_rows(parse(words).spec)] == rows[1:2]


def test_a_row_is_trained_judged_and_set_beside_the_paper(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    student = config(inputs=InputConfig(image_size=16), demos=1, updates=2, hold_steps=5)
    dagger = DaggerConfig(rounds=0)
    monkeypatch.setitem(
        configs.PRESETS["dagger"], "tiny", ImitationConfig(student, dagger)
    )
    words = [
        *COMMAND,
        "--out",
        str(tmp_path),
        *"--worlds 1 --threads 1 --split train --set inputs.target_in_hand=true".split(),
    ]
    words += ["--episodes", "1"]
    assert main(words) == 0
    (row,) = json.loads(capsys.readouterr().out.splitlines()[-1])["rows"]
    trained_with = load_checkpoint(
        tmp_path / row["row"].replace("/", ".") / "train" / "student.safetensors"
    )
    assert trained_with.config.inputs.target_in_hand
    assert row["row"] == "set_table/close/drawer" and row["episodes"] == 1
    assert row["low"] <= row["success_once"] <= row["high"]
    assert row["paper"] == {"rl_per": 88.79, "bc": 88.39, "dp": 89.29}
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "88.39" in text and 'src="http' not in text
    with refused("out", expected="empty"):
        command(*words)
    trained = (
        (tmp_path / "set_table.close.drawer" / "train" / "student.safetensors")
        .stat()
        .st_mtime_ns
    )
    # The same policy under other rules, without training.
    others = str(tmp_path / "others")
    again = ["reproduce", "force_limits", *words[2:], "--policies", str(tmp_path)]
    again[again.index("--out") + 1] = others
    assert main(again) == 0
    results = json.loads(capsys.readouterr().out.splitlines()[-1])["rows"]
    assert [found["rules"] for found in results] == [
        "evaluation",
        "no_force_limit",
        "force_limit_1400",
    ]
    assert results[0]["success_once"] == row["success_once"]
    assert results[2]["paper_says"] == "5 to 20 points less" and not results[2]["paper"]
    assert main([*words, "--resume"]) == 0
    assert (
        tmp_path / "set_table.close.drawer" / "train" / "student.safetensors"
    ).stat().st_mtime_ns == trained


def test_the_mean_of_the_rows_is_beside_the_papers() -> None:
    def row(name: str, ours: float | None, **paper: float) -> dict[str, Any]:
        return {"row": name, "rules": "evaluation", "success_once": ours, "paper": paper}

    both = [row("a", 0.5, bc=60.0, rl_all=1.0), row("b", 0.7, bc=70.0)]
    told = {"rules": "evaluation", "rows": 2, "success_once": 0.6, "paper": {"bc": 65.0}}
    # A row without a result counts neither for us nor for the paper.
    assert means([*both, row("c", None, bc=0.0)]) == [told]
    assert not means(both[:1])
    shown = dict(zip(titles(), mean_cells(told), strict=True))
    assert (shown["row"], shown["success once [%]"]) == ("mean of 2 rows", 60.0)
    assert (shown["paper: BC [%]"], shown["paper: RL for all [%]"]) == (65.0, "")


def test_a_policy_without_an_update_has_no_result(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    student = config(inputs=InputConfig(image_size=16), demos=1, updates=2, hold_steps=5)
    dagger = DaggerConfig(rounds=0)
    monkeypatch.setitem(
        configs.PRESETS["dagger"], "tiny", ImitationConfig(student, dagger)
    )
    words = [
        *COMMAND,
        "--out",
        str(tmp_path),
        *"--threads 1 --budget-minutes 1e-6".split(),
    ]
    assert main(words) == 0
    (row,) = json.loads(capsys.readouterr().out.splitlines()[-1])["rows"]
    assert (row["success_once"], row["untrained"], row["episodes"]) == (None, 1, 0)
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "no result: 1 of 1 policies untrained" in page
    assert not (tmp_path / "set_table.close.drawer" / "evaluation").exists()


def test_a_study_trains_one_policy_for_each_of_its_variants(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    student = config(inputs=InputConfig(image_size=16), demos=2, updates=2, hold_steps=5)
    monkeypatch.setitem(configs.PRESETS["bc"], "tiny", ImitationConfig(student))
    monkeypatch.setitem(VARIANTS, "demo_count", VARIANTS["demo_count"][:2])
    out = tmp_path / "study"
    words = ["reproduce", "demo_count", *COMMAND[2:], "--out", str(out), "--worlds", "2"]
    words += ["--threads", "1", "--split", "train", "--episodes", "1"]
    assert main(words) == 0
    rows = json.loads(capsys.readouterr().out.splitlines()[-1])["rows"]
    assert [row["rules"] for row in rows] == ["demos_1", "demos_10"]
    assert [row["demonstrations"] for row in rows] == [1, 2]
    assert [row["paper_says"] for row in rows] == ["0 %", "2 ± 3 %"]
    assert "at most 10 demonstrations per object" in (out / "report.html").read_text(
        "utf-8"
    )
    data = out / "set_table.close.drawer" / "data" / "demonstrations" / "episodes"
    data = min(data.glob("*.h5"))
    collected = data.stat().st_mtime_ns
    assert main([*words, "--resume"]) == 0
    assert data.stat().st_mtime_ns == collected
    filters = ("reproduce", "filters", "--out", tmp_path / "f")
    with refused("column", "rl_all", expected="left out with filters"):
        command(*filters, "--column", "rl_all")
    with refused("set", ("chunk=4",), expected="left out with filters"):
        command(*filters, "--set", "chunk=4")
    with refused(where="filters", said="leave out --policies"):
        command(*filters, "--policies", out)


def test_data_of_the_filter_study_differ_in_how_objects_are_released() -> None:
    style = {name: words for name, words in STYLES.items() if name}
    assert {"release=place", "release=drop"} <= {
        word for words in style.values() for word in words
    }
    assert [
        variant.imitation.data for variant in VARIANTS["filters"] if variant.imitation
    ] == [
        ("placed",),
        ("dropped",),
        ("placed", "dropped"),
    ]


def test_the_diffusion_policy_sees_images_of_the_presets_size() -> None:
    spec = TableSpec(what="table5", out=Path("x"), preset="small", episodes=1)
    small, paper = (
        config_of(spec, Imitation(algorithm)).student for algorithm in ("bc", "diffusion")
    )
    assert paper.algorithm == "diffusion" and paper.chunk == 16
    assert paper.inputs.image_size == small.inputs.image_size == 32
    assert paper.updates == small.updates


def test_choices_share_data_where_they_need_the_same(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    student = config(inputs=InputConfig(image_size=16), demos=1, updates=9, hold_steps=5)
    monkeypatch.setitem(configs.PRESETS["bc"], "tiny", ImitationConfig(student))
    kept = ("chunk_1", "whole_episodes", "px_64")
    words = [
        "reproduce",
        "choices",
        *COMMAND[2:],
        "--out",
        str(tmp_path),
        "--worlds",
        "1",
    ]
    words += ["--threads", "1", "--split", "train", "--episodes", "1", "--updates", "2"]
    assert main([*words, "--variants", "px_64", "chunk_1"]) == 0
    rows = json.loads(capsys.readouterr().out.splitlines()[-1])["rows"]
    assert [row["rules"] for row in rows] == ["chunk_1", "px_64"]
    folder = tmp_path / "set_table.close.drawer"
    first = folder / "train" / "px_64" / "student.safetensors"
    trained_at = first.stat().st_mtime_ns
    page = (tmp_path / "report.html").read_text("utf-8")
    assert "images of 64 x 64 px" in page and "not cut after success" not in page
    # Others are added, and those that are there stay.
    assert main([*words, "--resume", "--variants", "whole_episodes"]) == 0
    rows = json.loads(capsys.readouterr().out.splitlines()[-1])["rows"]
    assert [row["rules"] for row in rows] == list(kept)
    assert first.stat().st_mtime_ns == trained_at
    assert sorted(path.name for path in (folder / "data").iterdir() if path.is_dir()) == [
        "demonstrations",
        "demonstrations_64px",
        "demonstrations_whole",
    ]
    trained = {
        name: json.loads((folder / "train" / name / "config.json").read_text("utf-8"))
        for name in kept
    }
    students = {name: found["config"]["student"] for name, found in trained.items()}
    assert students["chunk_1"]["chunk"] == students["chunk_1"]["execute"] == 1
    assert students["whole_episodes"]["hold_steps"] == -1
    assert students["px_64"]["inputs"]["image_size"] == 64
    assert all(found["updates"] == 2 for found in students.values())


@pytest.mark.parametrize("what", VARIANTS)
def test_an_unknown_variant_is_refused_with_the_list(what: str, tmp_path: Path) -> None:
    out = tmp_path / "run"
    known = [variant.name for variant in VARIANTS[what]]
    with refused(f"variant of {what}", "x") as told:
        command("reproduce", what, "--out", str(out), "--variants", known[0], "x")
    assert told.value.expected == tuple(sorted(known))
    assert not out.exists()


def test_every_choice_changes_the_preset() -> None:
    small = preset_of("bc", "small")
    for name, (_, changes) in CHANGED.items():
        assert (with_changes(small, changes) == small) == (name == "preset")


def test_students_of_a_table_are_trained_on_the_device(tmp_path: Path) -> None:
    out = tmp_path / "run"
    rows = ["--rows", "set_table/close/drawer", "--preset", "quick"]
    words = ["reproduce", "table1", *rows, "--device", "cuda:77", "--out", str(out)]
    with refused("device", "cuda:77"):
        command(*words)
    assert not out.exists()
