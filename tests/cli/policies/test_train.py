"""``mjhab train``: what the options become, and what is refused."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest

from mjhab.cli.main import main, parse
from mjhab.learning import configs
from mjhab.learning.checkpoint import load_student
from mjhab.robots.registry import robot_named
from tests.data.make import record_pictures
from tests.learning.small import train_config
from tests.refusals import command, refused

COMMAND = "train dagger --task set_table --subtask close --target kitchen_counter/drawer3 --preset quick"
DAGGER = [*COMMAND.split(), *["--budget-minutes", "20", "--seed", "3", "--json", "--out"]]


def test_options_become_a_request(tmp_path: Path) -> None:
    words = [
        *DAGGER,
        str(tmp_path),
        *"--rounds 2 --takeovers 5 --demos 7 --style noise=0..0.2".split(),
    ]
    request = parse(words).spec
    assert (
        request.config.algorithm == "dagger" and request.config.student.preset == "quick"
    )
    assert request.budget_seconds == 1200.0 and request.seed == 3
    assert request.scene.target == "kitchen_counter/drawer3"
    assert request.config.dagger is not None
    assert (
        request.config.dagger.rounds,
        request.config.dagger.episodes,
        request.config.student.demos,
    ) == (2, 5, 7)
    assert request.config.student.style == ("noise=0.0..0.2",)
    longer = parse(
        [*DAGGER, str(tmp_path), "--first-prefix", "40", "--prefix-growth", "30"]
    ).spec
    assert longer.config.dagger is not None
    assert [longer.config.dagger.longest_prefix(number) for number in range(4)] == [
        0,
        40,
        70,
        100,
    ]
    plain = parse([*DAGGER, str(tmp_path)]).spec
    assert plain.scene.env_options().keys() == {
        "task",
        "subtask",
        "target",
        "split",
        "assets",
    }
    told = ["--profile", "ms_hab", "--stillness", "published"]
    scene = parse([*DAGGER, str(tmp_path), *told]).spec.scene
    assert (scene.profile, scene.stillness, scene.spawn_rule) == (
        "ms_hab",
        "published",
        "",
    )
    assert plain.config == configs.preset_of("dagger", "quick")


@pytest.mark.parametrize("algorithm", ["bc", "flow", "act", "diffusion", "dagger"])
def test_every_algorithm_has_a_command(algorithm: str, tmp_path: Path) -> None:
    request = parse(["train", algorithm, "--out", str(tmp_path)]).spec
    assert request.config == configs.preset_of(algorithm)


def test_presets_take_the_cameras_of_the_robot(tmp_path: Path) -> None:
    """Imitation and reinforcement; cameras of the user's choice stay, and so do presets without images."""
    own = robot_named("panda_omron").camera_names

    def cameras(words: str) -> tuple[str, ...]:
        command = parse(["train", *words.split(), "--out", str(tmp_path)]).spec
        config = command.config
        return getattr(config, "inputs", config.student.inputs).cameras

    for algorithm in ("bc", "dagger", "sac --preset fast", "rlpd"):
        assert cameras(f"{algorithm} --robot panda_omron") == own
        assert cameras(algorithm) == robot_named().camera_names
    assert cameras("ppo --preset fast --robot panda_omron") == ()
    chosen = f"inputs.cameras={own[1]}"
    assert cameras(f"bc --robot panda_omron --set {chosen}") == own[1:]


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("--preset", "smal"), dict(expected="small")),
        (("--task", "set_tabel"), dict(option="task", expected="set_table")),
        (("--subtask", "clos"), dict(option="subtask", expected="close")),
        (("--worlds", "0"), dict(option="worlds", given=0)),
        (("--updates", "0"), dict(option="updates", given=0)),
        (("--budget-minutes", "-1"), dict(option="budget_minutes", given=-1)),
        (("--profile", "ms_hub"), dict(option="profile", expected="ms_hab")),
        (("--style", "nois=0.1"), dict(expected="noise")),
        (("--data", "nowhere.h5"), dict(where="nowhere.h5", said="does not exist")),
    ],
)
def test_bad_input(words: tuple[str, ...], told: dict[str, Any], tmp_path: Path) -> None:
    with refused(**told):
        command("train", "bc", "--out", tmp_path / "run", *words)


CLOSE = "--subtask close --target kitchen_counter/drawer3 --home builtin_m0_00".split()


@pytest.mark.parametrize(
    ("algorithm", "words", "told"),
    [
        ("bc", ("--device", "foo"), dict(option="device", given="foo")),
        ("ppo", ("--start", "nix"), dict(where="nix", said="does not exist")),
        ("ppo", ("--backend", "foo"), dict(option="backend", given="foo")),
        (
            "ppo",
            ("--profile", "ms_hab", "--stillness", "absolute"),
            dict(option="stillness", given="absolute"),
        ),
        ("ppo", ("--preset", "polish"), dict(said="give --start CHECKPOINT")),
        (
            "ppo",
            ("--preset", "polish", "--set", "ppo.learning_rate=1e-6"),
            dict(option="least_learning_rate", given=1e-5),
        ),
        ("ppo", ("--set", "ppo.gamma=7"), dict(option="gamma", given=7.0)),
        (
            "sac",
            ("--preset", "state", "--capacity", "900000000000"),
            dict(option="capacity", given=900_000_000_000),
        ),
        ("rlpd", ("--preset", "state", "--data", "nix"), dict(where="nix")),
    ],
)
def test_a_refused_run_leaves_no_folder(
    algorithm: str,
    words: tuple[str, ...],
    told: dict[str, Any],
    tmp_path: Path,
) -> None:
    out = tmp_path / "run"
    more = () if algorithm == "bc" else ("--worlds", "2" if algorithm != "ppo" else "64")
    with refused(**told):
        command("train", algorithm, "--out", out, *CLOSE, *more, *words)
    assert not out.exists()
    # A folder of the user's stays, and stays empty.
    out.mkdir()
    assert main(["train", algorithm, "--out", str(out), *CLOSE, *more, *words]) == 2
    assert not list(out.iterdir())


def test_the_memory_of_a_buffer_is_told_before_it_is_made(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["train", "sac", "--preset", "state", "--worlds", "2", *CLOSE]
    words += ["--capacity", "1000000000", "--out", str(tmp_path / "run")]
    assert main(words) == 2
    lines = capsys.readouterr().err.splitlines()
    told = "mjhab: memory of the buffer replay: 1,000,000,000 control steps, "
    first = next(index for index, line in enumerate(lines) if line.startswith(told))
    # The error has a line of its own, below the table.
    last = "mjhab: the replay buffer (1,000,000,000 control steps, "
    assert lines[-1].startswith(last) and first < len(lines) - 1


@pytest.mark.parametrize("algorithm", ["dagger", "rlpd"])
@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--where", "success and ("), "column 13: cannot be read"),
        (("--where", "sucess", "--data", "x"), "Did you mean 'success'"),
        (("--where", "success"), "It filters recorded demonstrations: give data"),
    ],
)
def test_a_filter_is_read_before_anything_else(
    algorithm: str,
    words: tuple[str, ...],
    said: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["train", algorithm, "--out", str(tmp_path / "run"), *words]) == 2
    told = capsys.readouterr()
    assert told.err.startswith("mjhab: ") and said in told.err and not told.out
    assert not (tmp_path / "run").exists()


def test_demonstrations_are_recorded_or_generated(tmp_path: Path) -> None:
    words = ["--out", str(tmp_path / "run"), "--data", str(tmp_path), "--demos", "3"]
    with refused("demos", 3, expected="left out with data"):
        command("train", "bc", *words)


def test_an_interrupted_run_says_what_is_there(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("mjhab.learning.runs.collection.Collector.collect", interrupted)
    words = ["train", "bc", *CLOSE, "--out", str(tmp_path / "run"), "--json"]
    assert main(words) == 130
    told = capsys.readouterr()
    assert json.loads(told.out.splitlines()[-1])["checkpoint"] is None
    assert "there is no checkpoint yet" in told.err and "is kept" not in told.err


def test_a_run_that_trained_nothing_is_no_success(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    record_pictures(tmp_path / "shard.h5", range(4))
    out = tmp_path / "run"
    words = [
        "train",
        "bc",
        "--data",
        str(tmp_path / "shard.h5"),
        "--subtask",
        "pick",
        "--out",
        str(out),
    ]
    words += [
        "--set",
        "inputs.image_size=16",
        "inputs.cameras=fetch_head",
        "--eval-episodes",
        "0",
        "--round-episodes",
        "0",
    ]
    assert main([*words, "--budget-minutes", "0.000001"]) == 1
    told = capsys.readouterr()
    assert "the network was not trained" in told.err and "--resume" in told.err
    assert not (out / "student.safetensors").exists()


def test_policies_are_judged_in_homes_that_they_have_not_seen(tmp_path: Path) -> None:
    for algorithm in ("bc", "ppo"):
        words = ["train", algorithm, "--out", str(tmp_path)]

        def split(*more: str, words: list[str] = words) -> str:
            return parse([*words, *more]).spec.final_split

        assert split() == "val"
        assert split("--home", "builtin_m0_00") == "train"
        assert split("--eval-split", "test") == "test"
        with refused("split", "vla"):
            command(*words, "--eval-split", "vla")


def test_no_round_is_empty(tmp_path: Path) -> None:
    with refused("takeovers", 0):
        command("train", "dagger", "--out", tmp_path / "run", "--takeovers", "0")


def test_from_data_to_a_checkpoint(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    record_pictures(tmp_path / "data" / "a.h5", range(4))
    monkeypatch.setitem(configs.PRESETS["bc"], "tiny", train_config())
    out = tmp_path / "run"
    words = [
        *"train bc --preset tiny --subtask pick --data".split(),
        str(tmp_path / "data"),
    ]
    words += [
        "--where",
        "success or not success",
        "--out",
        str(out),
        "--threads",
        "1",
        "--json",
    ]
    words += ["--eval-episodes", "0", "--round-episodes", "0"]
    assert main(words) == 0
    summary = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert (
        summary["steps"] == 4
        and summary["success_once"] is None
        and summary["episodes"] == 0
    )
    assert summary["algorithm"] == "bc" and summary["preset"] == "tiny"
    assert load_student(Path(summary["checkpoint"])).config == dataclasses.replace(
        train_config().student
    )
    with refused("out", str(out), expected="empty") as told:
        command(*words)
    assert "--overwrite" not in told.value.advice
    with refused(said="it was started with config.student.updates = 4, now it is 3. Use"):
        command(*words, "--resume", "--updates", "3")
    assert main([*words, "--resume"]) == 0
