"""Command lines from specifications: every option has help, and values reach the fields they are of."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from mjhab.cli import commands
from mjhab.cli.main import main, parse
from mjhab.cli.parsing import options_of
from mjhab.config.env import EnvConfig
from mjhab.core.typed.flags import field_docs
from mjhab.evaluation.specs import EvalSpec, GenerateSpec

SPECS = [command for command in commands.COMMANDS if command.spec]


@pytest.mark.parametrize("command", SPECS, ids=lambda command: command.name)
def test_every_option_has_a_docstring(command: commands.Command) -> None:
    options = list(options_of(commands.load(command.options)))
    assert [option.name for option in options if not option.help] == []
    assert len({option.name for option in options}) == len(options)


@pytest.mark.parametrize("owner", [EnvConfig, EvalSpec, GenerateSpec])
def test_every_field_has_a_docstring(owner: type) -> None:
    assert [
        name for name in owner.__dataclass_fields__ if name not in field_docs(owner)
    ] == []


@pytest.mark.parametrize("command", commands.COMMANDS, ids=lambda command: command.name)
def test_every_command_is_there(command: commands.Command) -> None:
    assert callable(command.load_run())
    assert isinstance(commands.load(command.options), type)


def test_options_reach_their_fields(tmp_path: Path) -> None:
    words = [
        "eval",
        "--subtask",
        "pick",
        "--worlds",
        "3",
        "--obs",
        "depth",
        "--films",
        "0",
    ]
    pack = ["--articulate", "cabinet,chest_of_drawers", "--stage-mesh", "walls.glb"]
    served = [
        "--policy",
        "ws://host:1",
        "--execute",
        "4",
        "--batch",
        "--dialect",
        "behavior",
    ]
    spec = parse([*words, *pack, *served, "--out", str(tmp_path)]).spec
    assert spec.env == {
        "subtask": "pick",
        "num_envs": 3,
        "obs_mode": "depth",
        "assets": {
            "place": "builtin",
            "articulate": ["cabinet", "chest_of_drawers"],
            "stage_mesh": "walls.glb",
        },
    }
    assert spec.served == {"execute": 4, "batch": True, "dialect": "behavior"}
    assert spec.policy == "ws://host:1?execute=4&batch=True&dialect=behavior" or (
        sorted(spec.policy.partition("?")[2].split("&"))
        == ["batch=True", "dialect=behavior", "execute=4"]
    )
    assert (spec.films, spec.out) == (0, tmp_path)


def test_what_is_absent_is_not_given() -> None:
    """The policy's own options hold where the command line says nothing."""
    assert parse(["eval"]).spec.env == {}
    assert parse(["generate", "--episodes", "1", "--out", "x"]).spec.env == {}


def test_an_old_name_is_read_with_a_line_about_the_new_one(
    capsys: pytest.CaptureFixture[str],
) -> None:
    spec = parse(["eval", "--subtask", "pick", "--starts", "published"]).spec
    assert spec.env["spawn_rule"] == "published"
    told = capsys.readouterr().err
    assert "--starts" in told and "--spawn-rule" in told and told.count("\n") == 1


def test_config_tells_what_a_command_line_means(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    words = [
        "eval",
        "--subtask",
        "pick",
        "--profile",
        "ms_hab",
        "--out",
        str(tmp_path / "run"),
    ]
    assert main(["config", *words]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["command"] == "eval" and told["options"]["episodes"] == 20
    assert told["options"]["env"]["stationary"] == ["head"]
    assert told["options"]["env"]["num_envs"] == 8
    assert not (tmp_path / "run").exists()
    assert main(["config", "eval", "--subtask", "pik"]) == 2


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["evl"], "Did you mean 'eval'"),
        (["homes", "lst"], "Did you mean 'list'"),
        (["bench", ""], "unknown command of bench"),
        ([], "name a command: demo, eval"),
    ],
)
def test_a_wrong_command_is_told_with_the_nearest(
    words: list[str], told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(words) == 2
    assert told in capsys.readouterr().err


def test_a_group_lists_its_commands(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["homes"])
    assert ended.value.code == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines if line.startswith("  ")] == [
        "list",
        "show",
        "check",
        "render",
    ]
