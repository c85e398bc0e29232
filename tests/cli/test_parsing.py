"""Command lines from specifications: every option has help, and values reach the fields they are of."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import pytest

from mjhab.cli import commands
from mjhab.cli.main import main, parse
from mjhab.cli.parsing import options_of
from mjhab.config.env import EnvConfig
from mjhab.core.typed.flags import field_docs
from mjhab.evaluation.specs import EvalSpec, GenerateSpec


@pytest.mark.parametrize("command", commands.COMMANDS, ids=lambda command: command.name)
def test_every_option_has_a_docstring(command: commands.Command) -> None:
    options = list(options_of(command.spec_type))
    assert [option.name for option in options if not option.help] == []
    assert len({option.name for option in options}) == len(options)


@pytest.mark.parametrize("owner", [EnvConfig, EvalSpec, GenerateSpec])
def test_every_field_has_a_docstring(owner: type) -> None:
    names = [field.name for field in dataclasses.fields(owner)]
    assert [name for name in names if name not in field_docs(owner)] == []


@pytest.mark.parametrize("command", commands.COMMANDS, ids=lambda command: command.name)
def test_every_command_is_there(command: commands.Command) -> None:
    assert callable(command.load_run())
    assert isinstance(command.spec_type, type)


def test_options_reach_their_fields(tmp_path: Path) -> None:
    words = "eval --subtask pick --worlds 3 --obs depth --films 0".split()
    pack = ["--articulate", "cabinet,chest_of_drawers", "--stage-mesh", "walls.glb"]
    served = "--policy ws://host:1 --execute 4 --batch --dialect behavior".split()
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
        *"eval --subtask pick --profile ms_hab --out".split(),
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


@pytest.mark.parametrize(
    ("words", "new", "values"),
    [
        (
            ["score", "--check", "r.json", "--check-seed", "4294967295"],
            "score check",
            {"env": {"seed": 2**32 - 1}},
        ),
        (["score", "--page", "x.md", "--table", "a", "b"], "score table", {}),
        (["score", "--starts", "--split", "val"], "score starts", {}),
        (["doctor", "--estimate", "--num-envs", "5"], "estimate", {}),
        (
            ["spawns", "make", "--out", "x.npz", "--starts", "published"],
            "spawns make",
            {},
        ),
    ],
)
def test_old_forms_are_read_with_a_line_about_the_new_one(
    words: list[str],
    new: str,
    values: dict[str, object],
    capsys: pytest.CaptureFixture[str],
) -> None:
    parsed = parse(words)
    assert parsed.command.name == new
    assert {name: parsed.values[name] for name in values} == values
    assert "is now" in capsys.readouterr().err


def test_entries_of_mappings_are_options_of_their_own() -> None:
    words = ["--overrides.pick.force-limit", "2000", "--overrides.goal_type=cylinder"]
    scales = ["--reward-scales.pick.reach", "4.0"]
    spec = parse(["eval", "--subtask", "pick", *words, *scales]).spec
    assert spec.env["overrides"] == {"pick.force_limit": 2000, "goal_type": "cylinder"}
    assert spec.env["reward_scales"] == {"pick": {"reach": 4.0}}


def test_an_entry_of_a_mapping_without_a_value_is_refused(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["eval", "--overrides.goal-type"]) == 2
    assert "--overrides.goal-type needs a value" in capsys.readouterr().err


def test_config_tells_every_command(capsys: pytest.CaptureFixture[str]) -> None:
    for words in (
        ["homes", "list"],
        ["data", "fields"],
        ["score"],
        ["warmup"],
        ["estimate"],
    ):
        assert main(["config", *words, "--json"]) == 0
        told = json.loads(capsys.readouterr().out)
        assert told["command"] == " ".join(words)
