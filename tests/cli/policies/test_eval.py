"""``mjhab eval``: files, JSON, exit codes, Ctrl-C and resume, on an env without physics."""

from __future__ import annotations

import json
import os
import resource
import signal
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest

from mjhab.cli.main import main
from mjhab.evaluation import evaluate
from mjhab.evaluation.evaluate import EvalSpec
from mjhab.evaluation.resolve import PolicyFacts
from mjhab.rollout.films import HumanView
from mjhab.rollout.store import EvaluationFolder, read_records
from tests.rollout.fake_env import FakeEnv

KEYS = [
    "profile",
    "episodes",
    "success_once",
    "success_at_end",
    "progressive",
    "upper_bound",
    "labels",
    "legacy_labels",
    "tainted",
    "errors",
    "skipped_homes",
    "subtasks",
    "seconds",
]

REPORT_TOO_LARGE = 3 * 2**20
"""Limit of files [bytes]: more than all records, less than a report, which holds the library of its charts."""


class Stage:
    """Stands in for the real env; remembers what was built and may interrupt the next run."""

    def __init__(self) -> None:
        self.built: list[FakeEnv] = []
        self.options: list[dict[str, Any]] = []
        self.interrupt_at: int | None = None
        self.terminate_at: int | None = None
        self.broken_camera = False

    def make_env(self, spec: EvalSpec, options: Mapping[str, Any]) -> FakeEnv:
        plan: dict[str, Any] = {}
        subtask = spec.asked.subtask
        if subtask:
            plan = {"plan": ((subtask, "024_bowl_:0000"),), "subtask": subtask}
        env = FakeEnv(
            min(spec.asked.num_envs, spec.episodes),
            broken_camera=self.broken_camera,
            **plan,
        )
        env.interrupt_at = self.interrupt_at
        self.interrupt_at = None
        if self.terminate_at is not None:
            env.interrupt_at = self.terminate_at
            self.terminate_at = None
            env.interrupt = lambda: os.kill(os.getpid(), signal.SIGTERM)
        self.built.append(env)
        self.options.append(dict(options))
        return env


@pytest.fixture
def stage(monkeypatch: pytest.MonkeyPatch) -> Stage:
    stage = Stage()
    monkeypatch.setattr(evaluate, "make_env", stage.make_env)
    # A camera that looks for hand and target needs the robot, which the stand-in lacks.
    monkeypatch.setattr("mjhab.evaluation.spread.FilmCrew", lambda *_: HumanView(64, 48))
    return stage


@pytest.fixture
def run(stage: Stage, tmp_path: Path) -> Callable[..., int]:
    def call(*extra: str, out: str = "run", policy: str = "zero") -> int:
        base = [
            "eval",
            "--policy",
            policy,
            *"--episodes 12 --worlds 3 --films 0".split(),
        ]
        return main([*base, "--out", str(tmp_path / out), *extra])

    return call


def last_line(text: str) -> dict[str, Any]:
    return json.loads(text.strip().splitlines()[-1])


def test_run_writes_all_files_and_prints_json_last(
    run: Callable[..., int], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("--json") == 0
    out = capsys.readouterr().out
    assert len(out.strip().splitlines()) == 1, (
        "with --json, stdout holds the JSON line only"
    )
    summary = last_line(out)
    assert (
        list(summary) == KEYS
        and summary["episodes"] == 12
        and len(summary["progressive"]) == 16
    )
    folder = tmp_path / "run"
    assert sorted(entry.name for entry in folder.iterdir()) == [
        "config.json",
        "episodes.jsonl",
        "report.html",
        "summary.json",
    ]
    stored = json.loads((folder / "summary.json").read_text())
    assert {key: stored[key] for key in KEYS} == summary
    assert [row["kind"] for row in stored["along_the_plan"]][:2] == ["navigate", "open"]
    config = json.loads((folder / "config.json").read_text())
    assert config["task"] == "set_table" and config["mujoco"] == "3.17.0"


def test_the_profile_and_its_values_are_recorded_and_told(
    run: Callable[..., int], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("--json") == 0
    assert last_line(capsys.readouterr().out)["profile"] == "mjhab"
    assert run("--profile", "ms_hab", "--json", out="paper") == 0
    assert last_line(capsys.readouterr().out)["profile"] == "ms_hab"
    config = json.loads((tmp_path / "paper" / "config.json").read_text())
    wanted = {
        "profile": "ms_hab",
        "stillness": "published",
        "spawn_rule": "published",
        "joint_dynamics": "published",
        "frame_stack": 3,
    }
    assert wanted.items() <= config.items() and config["stationary"] == ["head"]
    assert (
        json.loads((tmp_path / "paper" / "summary.json").read_text())["profile"]
        == "ms_hab"
    )
    # A run goes on under its own profile only.
    assert run("--resume", out="paper") == 2
    assert run("--stillness", "published", out="mixed") == 0
    config = json.loads((tmp_path / "mixed" / "config.json").read_text())
    assert (config["profile"], config["stillness"], config["spawn_rule"]) == (
        "mjhab",
        "published",
        "front_box",
    )


@pytest.mark.parametrize(
    ("extra", "words"),
    [
        (("--profile", "mshab"), "Did you mean 'ms_hab'"),
        (
            ("--profile", "ms_hab", "--stillness", "absolute"),
            "profile 'ms_hab': stillness must be 'published'",
        ),
        (
            ("--profile", "ms_hab", "--starts", "front_box"),
            "profile 'ms_hab': spawn_rule must be 'published'",
        ),
        (("--starts", "anywhere"), "front_box, published"),
    ],
)
def test_profiles_that_cannot_be_are_refused(
    run: Callable[..., int],
    stage: Stage,
    capsys: pytest.CaptureFixture[str],
    extra: tuple[str, ...],
    words: str,
) -> None:
    assert run(*extra) == 2
    assert words in capsys.readouterr().err and not stage.built


def test_output_for_people(
    run: Callable[..., int], capsys: pytest.CaptureFixture[str]
) -> None:
    assert run() == 0
    out, err = capsys.readouterr()
    assert "Success along the plan" in out and "report.html" in out
    assert "12/12" in err, "the progress bar is on stderr"


def test_number_of_worlds_and_threads_do_not_change_the_records(
    run: Callable[..., int], tmp_path: Path
) -> None:
    assert run("--worlds", "1", out="a", policy="random") == 0
    assert run("--worlds", "8", "--threads", "2", out="b", policy="random") == 0
    a, b = ({r.index: r for r in read_records(tmp_path / name)} for name in ("a", "b"))
    assert a == b and len(a) == 12


def test_interrupt_keeps_episodes_and_resume_finishes(
    run: Callable[..., int],
    stage: Stage,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert run(out="whole") == 0
    stage.interrupt_at = 250
    assert run("--json") == 130
    captured = capsys.readouterr()
    assert "interrupted" in captured.err and "--resume" in captured.err
    kept = last_line(captured.out)["episodes"]
    assert 0 < kept < 12
    assert f"Partial: {kept} of 12" in (tmp_path / "run" / "report.html").read_text()
    first_seconds = json.loads((tmp_path / "run" / "summary.json").read_text())["seconds"]

    assert run("--json", "--resume", "--worlds", "5") == 0
    summary = last_line(capsys.readouterr().out)
    assert summary["episodes"] == 12 and summary["seconds"] >= first_seconds
    assert sum(len(indices) for indices in stage.built[-1].resets) == 12 - kept
    by_index = {r.index: r for r in read_records(tmp_path / "run")}
    assert by_index == {r.index: r for r in read_records(tmp_path / "whole")}
    assert "Partial" not in (tmp_path / "run" / "report.html").read_text()


def test_sigterm_writes_the_report_as_ctrl_c_does(
    run: Callable[..., int],
    stage: Stage,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    before = signal.getsignal(signal.SIGTERM)
    stage.terminate_at = 250
    assert run("--json") == 130
    captured = capsys.readouterr()
    kept = last_line(captured.out)["episodes"]
    assert 0 < kept < 12 and "--resume" in captured.err
    assert f"Partial: {kept} of 12" in (tmp_path / "run" / "report.html").read_text()
    assert signal.getsignal(signal.SIGTERM) is before
    assert run("--json", "--resume") == 0
    assert last_line(capsys.readouterr().out)["episodes"] == 12


def test_a_full_disk_is_told_with_the_file_and_the_way_on(
    run: Callable[..., int], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A limit on the size of files acts as a full disk: the report is larger."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (REPORT_TOO_LARGE, before[1]))
    try:
        assert run("--json") == 1
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    told = capsys.readouterr().err.strip().splitlines()[-1]
    assert f"{tmp_path / 'run' / 'report.html'} cannot be used" in told
    assert "--resume continues" in told
    assert run("--json", "--resume") == 0
    assert last_line(capsys.readouterr().out)["episodes"] == 12
    assert (tmp_path / "run" / "report.html").is_file()


def test_two_runs_into_one_folder_never_mix(
    run: Callable[..., int],
    stage: Stage,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert run() == 0
    config = json.loads((tmp_path / "run" / "config.json").read_text())
    with EvaluationFolder.open(tmp_path / "run", config, resume=True):
        for extra in (
            ("--overwrite", "--seed", "1"),
            ("--resume",),
            ("--resume", "--policy", "random"),
        ):
            capsys.readouterr()
            assert run(*extra) == 2
            assert "is being written by process" in capsys.readouterr().err
    assert len(stage.built) == 1, "refused before anything is built"
    assert run("--resume", "--policy", "random") == 2
    assert "policy = 'zero', now it is 'random'" in capsys.readouterr().err


OWN = """
import numpy as np

class Still:
    name = "still"
    env_options = {"obs_mode": "depth", "camera_size": 16}
    def reset(self, mask):
        self.worlds = len(mask)
    def act(self, obs, info):
        return np.zeros((self.worlds, 13))
"""


def test_a_policy_of_ones_own(
    run: Callable[..., int],
    stage: Stage,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    file = tmp_path / "mine.py"
    file.write_text(OWN)
    spec = f"{file}:Still"
    assert run(policy=spec) == 0
    assert run(out="zero") == 0
    assert read_records(tmp_path / "run") == read_records(tmp_path / "zero")
    sees = {"obs_mode": "depth", "camera_size": 16}
    assert sees.items() <= stage.options[0].items()
    assert not sees.keys() & stage.options[1].keys()
    config = json.loads((tmp_path / "run" / "config.json").read_text())
    assert config["policy"] == "mine.py:Still" and config["env"] == sees
    assert "by mine.py:Still" in (tmp_path / "run" / "report.html").read_text()
    assert (
        run(
            *"--obs rgb --camera-size 64 --control pd_ee_delta_pose".split(),
            policy=spec,
            out="rgb",
        )
        == 0
    )
    asked = {"obs_mode": "rgb", "camera_size": 64, "control_mode": "pd_ee_delta_pose"}
    assert asked.items() <= stage.options[-1].items()
    file.write_text(OWN + "# another version")
    capsys.readouterr()
    assert run("--resume", policy=spec) == 2
    assert "was started with policy_sha256" in capsys.readouterr().err
    assert run(policy=f"{file}:Stil", out="new") == 2
    assert (
        "Did you mean 'Still'" in capsys.readouterr().err
        and not (tmp_path / "new").exists()
    )


def test_resume_of_a_finished_run_builds_nothing(
    run: Callable[..., int], stage: Stage, tmp_path: Path
) -> None:
    assert run() == 0
    (tmp_path / "run" / "report.html").unlink()
    assert run("--resume") == 0
    assert len(stage.built) == 1 and (tmp_path / "run" / "report.html").is_file()


def test_resume_with_more_episodes_runs_the_new_ones(
    run: Callable[..., int], stage: Stage, tmp_path: Path
) -> None:
    assert run() == 0
    assert run("--resume", "--episodes", "15") == 0
    assert [index for indices in stage.built[-1].resets for index in indices] == [
        12,
        13,
        14,
    ]


def test_full_folder_is_refused_and_overwritten_on_demand(
    run: Callable[..., int], stage: Stage, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run() == 0
    assert run() == 2
    err = capsys.readouterr().err
    assert (
        "out must be empty" in err
        and "--resume" in err
        and "--overwrite" in err
        and "Traceback" not in err
    )
    assert len(stage.built) == 1, "refused before anything is built"
    assert run("--resume", "--seed", "1") == 2
    assert "seed = 0, now it is 1" in capsys.readouterr().err
    assert run("--overwrite", "--seed", "1") == 0


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (
            ("--task", "set_tabel"),
            ("unknown task 'set_tabel'", "Did you mean 'set_table'", "tidy_house"),
        ),
        (("--task", ""), ("unknown task ''", "set_table")),
        (("--subtask", "pik"), ("unknown subtask 'pik'", "'pick'", "open")),
        (("--navigate", "fly"), ("unknown navigate mode 'fly'", "teleport", "drive")),
        (("--policy", "export"), ("unknown policy", "'expert'", "zero")),
        (("--split", "vla"), ("unknown split", "'val'", "train")),
        (
            ("--target", "024_bowl"),
            ("target must be left out without a subtask", "024_bowl"),
        ),
        (("--worlds", "0"), ("worlds must be at least 1, got 0",)),
        (("--episodes", "-3"), ("episodes must be at least 1, got -3",)),
        (("--seed", "-1"), ("seed must be at least 0",)),
        (("--films", "-1"), ("films must be at least 0",)),
        (("--resume", "--overwrite"), ("resume must be left out with overwrite",)),
        (
            ("--alone", "nowhere"),
            ("alone must be a folder with runs of --subtask", "nowhere"),
        ),
    ],
)
def test_bad_input_is_one_clear_message(
    run: Callable[..., int],
    stage: Stage,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    arguments: tuple[str, ...],
    words: tuple[str, ...],
) -> None:
    assert run(*arguments) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.startswith("mjhab: ") and err.count("\n") == 1
    for word in words:
        assert word in err
    assert stage.built == [] and not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    "arguments", [["eval", "--episods", "3"], ["evil"], [], ["eval", "--worlds", "many"]]
)
def test_unknown_words_exit_with_2(
    arguments: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    try:
        code = main(arguments)
    except SystemExit as stop:
        code = stop.code
    assert code == 2
    assert capsys.readouterr().err


def test_broken_camera_leaves_the_evaluation_alone(
    run: Callable[..., int],
    stage: Stage,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    stage.broken_camera = True
    assert run("--films", "2") == 0
    assert "films stopped" in capsys.readouterr().err
    assert "no renderer works here" in (tmp_path / "run" / "report.html").read_text()
    assert len(read_records(tmp_path / "run")) == 12


def test_films_are_written_and_shown(run: Callable[..., int], tmp_path: Path) -> None:
    assert run("--films", "2", "--episodes", "3") == 0
    names = sorted(entry.name for entry in (tmp_path / "run" / "films").iterdir())
    assert names == ["episode_00000.mp4", "episode_00001.mp4"]
    assert (tmp_path / "run" / "report.html").read_text().count("<video") == 2


def test_alone_runs_give_the_bound(
    run: Callable[..., int], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("--subtask", "pick", out="pick") == 0
    rate = json.loads((tmp_path / "pick" / "summary.json").read_text())["success_once"]
    capsys.readouterr()
    assert run("--json", "--alone", str(tmp_path / "pick")) == 0
    summary = last_line(capsys.readouterr().out)
    bound = summary["upper_bound"]
    assert bound[3] / bound[2] == pytest.approx(rate, abs=1e-3)


def test_default_folder_names_the_run() -> None:
    spec = EvalSpec.of(subtask="open", target="fridge/top_door", seed=3)
    assert evaluate.default_out(spec, "expert") == Path(
        "runs/set_table_open_fridge-top_door_expert_seed3"
    )


def test_a_style_needs_the_expert_and_valid_names(
    run: Callable[..., int], capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("--style", "speed=0.5") == 2
    assert (
        "style must be left out: only the expert has a style" in capsys.readouterr().err
    )
    assert run("--style", "sped=0.5", policy="expert") == 2
    assert "Did you mean 'speed'?" in capsys.readouterr().err


def test_a_style_belongs_to_the_config_of_a_run() -> None:
    facts = PolicyFacts("expert")
    assert "style" not in evaluate.resolved_config(EvalSpec.of(), facts)
    asked = evaluate.resolved_config(
        EvalSpec.of(style=("release=drop", "speed=0.5..1")), facts
    )
    assert asked["style"] == ["speed=0.5..1.0", "release=drop"]
