"""What README and docs/evaluation.md show can be copied and runs; the keys that are listed are those that there are."""

from __future__ import annotations

import importlib
import re
import shlex
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import mjhab
from mjhab.cli.main import parse
from mjhab.evaluation.resolve import inspect_policy
from mjhab.rollout.loop import rollout
from mjhab.rollout.policy import ZeroPolicy
from tests.refusals import refused

ROOT = Path(__file__).parents[1]
SMALL = {"episodes": 2, "worlds": 2, "films": 1, "horizon": 4}
"""Options that make an evaluation take seconds."""


def blocks(language: str) -> list[str]:
    """Code blocks of the README in a language."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    return re.findall(rf"^```{language}[^\n]*\n(.*?)^```", text, re.DOTALL | re.MULTILINE)


def block_with(language: str, word: str) -> str:
    """The one code block that has a word in it."""
    (found,) = (block for block in blocks(language) if word in block)
    return found


@pytest.fixture
def policy_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The README's policy, saved under the name it asks for, in the working directory."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    path = tmp_path / "my_policy.py"
    path.write_text(block_with("python", "class DriveToGoal"))
    yield path
    sys.modules.pop("my_policy", None)


def eval_command() -> list[str]:
    """Arguments of the README's command that evaluates this policy."""
    (line,) = (
        line
        for line in block_with("bash", "DriveToGoal").splitlines()
        if "DriveToGoal" in line
    )
    return shlex.split(line)[1:]


def test_the_policy_of_the_readme_runs_as_a_file(policy_file: Path) -> None:
    spec = parse(eval_command()).spec
    assert not inspect_policy(str(spec.policy)).env_options
    asked = spec.asked
    run = mjhab.evaluate(
        spec.policy, task=asked.task, subtask=asked.subtask, out=spec.out, **SMALL
    )
    assert [record.steps for record in run.records] == [4, 4] and run.report.is_file()
    assert run.config["policy"] == "my_policy.py:DriveToGoal"
    assert (
        run.path / "films" / "episode_00000.mp4"
    ).stat().st_size > 0 and run.film_problem is None


def test_the_policy_of_the_readme_succeeds_sometimes(policy_file: Path) -> None:
    spec = parse(eval_command()).spec
    env = mjhab.make(
        task=spec.asked.task,
        subtask=spec.asked.subtask,
        num_envs=2,
        autoreset="disabled",
    )
    policy = importlib.import_module("my_policy").DriveToGoal()
    # Episodes of the line to expect in which nothing is in between; 8 s of robot time suffice.
    records = rollout(env, policy, [6, 14], seed=0, max_steps=160)
    assert any(record.success_once for record in records)
    assert min(record.cumulative_force for record in records) == 0.0
    env.close()


def test_code_of_the_readme_is_not_wrapped_by_a_formatter() -> None:
    for code in blocks("python"):
        assert not [line for line in code.splitlines() if len(line) > 90]
        # A comment behind a bracket that a formatter has opened stands alone on its line.
        assert not re.search(r"^\s*[)\]},]+\s+#", code, re.MULTILINE)


def test_listed_keys_are_those_of_the_environment() -> None:
    text = (ROOT / "docs" / "evaluation.md").read_text(encoding="utf-8")
    env = mjhab.make(
        subtask="pick", obs_mode="rgbd", camera_size=16, autoreset="disabled", horizon=2
    )
    obs, info = env.reset(seed=0)
    listed = keys_of_table(text, "Info")
    assert listed == set(info) == set(env.step(np.zeros((1, 13), np.float32))[4])
    entries = {
        key.replace("<camera>", "fetch_head")
        for key in keys_of_table(text, "Observations")
    }
    assert entries <= set(obs)
    env.close()


def keys_of_table(text: str, section: str) -> set[str]:
    """Keys in the first column of the table of a section."""
    body = text.split(f"\n## {section}\n")[1].split("\n## ")[0]
    rows = [line.split("|")[1] for line in body.splitlines() if line.startswith("| `")]
    return {key for row in rows for key in re.findall("`(.*?)`", row)}


def test_the_default_environment_is_refused_by_the_loop() -> None:
    env = mjhab.make(subtask="pick", horizon=2)
    with refused("autoreset", "same_step", advice="mjhab.evaluate"):
        rollout(env, ZeroPolicy(), [0], seed=0)
    env.close()
