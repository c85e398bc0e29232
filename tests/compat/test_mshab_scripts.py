"""Scripts of our own in the manner of MS-HAB's run through ``python -m mjhab.compat.mshab``."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from mjhab.compat.mshab.running.check import check_script
from mjhab.compat.mshab.running.script import checkout_of, find_script
from mjhab.core.errors import UsageError

SCRIPTS = Path(__file__).parent / "scripts"


def run(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "mjhab.compat.mshab", *map(str, arguments)]
    return subprocess.run(
        command, capture_output=True, text=True, timeout=580, env=dict(os.environ)
    )


def lines(found: subprocess.CompletedProcess[str]) -> list[str]:
    assert found.returncode == 0, found.stderr[-3000:]
    return found.stdout.splitlines()


def test_a_training_script_runs_with_its_imports_answered() -> None:
    printed = lines(run(SCRIPTS / "train.py", "3"))
    episodes, stats = printed[-2:]
    assert episodes.startswith("episodes 4 return")
    assert 0 < float(episodes.rsplit(maxsplit=1)[-1]) < 1.1
    assert stats == "stats [4, 4]"


def test_a_collector_writes_trajectories_labels_and_films(tmp_path: Path) -> None:
    shapes, labels, films = lines(run(SCRIPTS / "collect.py", tmp_path))[-3:]
    assert shapes.startswith("trajectories 4 ")
    assert json.loads(shapes.removeprefix("trajectories 4 ")) == {
        "actions": [3, 13],
        "obs/agent/qpos": [4, 12],
        "obs/sensor_data/fetch_hand/depth": [4, 24, 32, 1],
    }
    assert labels == "labels " + str(["mobility_failure"] * 4)
    assert films == "films ['0.mp4', '1.mp4']"


@pytest.mark.parametrize("name", ["train.py", "collect.py"])
def test_a_check_tells_what_is_answered(name: str) -> None:
    found = check_script(SCRIPTS / name)
    assert set(found["imports"].values()) == {"answered"}
    assert found["ids"] == ["PickSubtaskTrain-v0"]


def test_a_check_tells_what_is_missing(tmp_path: Path) -> None:
    script = tmp_path / "other.py"
    script.write_text(
        "import mani_skill.envs\n"
        "import no_such_library\n"
        "from mani_skill.utils.common import to_tensor, no_such_function\n"
        "from mshab.agents.sac import Agent\n"
        "ENV = 'SequentialTask-v0'\n"
    )
    printed = run("--check", script, "--json")
    assert printed.returncode == 1
    assert json.loads(printed.stdout) == {
        "imports": {
            "mani_skill.envs": "answered",
            "mani_skill.utils.common.no_such_function": "missing",
            "mani_skill.utils.common.to_tensor": "answered",
            "mshab.agents.sac.Agent": "missing",
            "no_such_library": "missing",
        },
        "ids": ["SequentialTask-v0"],
    }


def test_the_checkout_is_found_above_its_scripts(tmp_path: Path) -> None:
    script = tmp_path / "mshab" / "train.py"
    (tmp_path / "mshab" / "envs").mkdir(parents=True)
    script.write_text("")
    assert checkout_of(script) == tmp_path
    assert checkout_of(tmp_path / "train.py") is None
    (tmp_path / "mshab" / "agents.py").write_text("class Agent: pass")
    script.write_text("from mshab.agents import Agent")
    assert check_script(script)["imports"] == {"mshab.agents.Agent": "answered"}
    sys.path.remove(str(tmp_path))


def test_a_script_that_is_not_there_is_refused() -> None:
    with pytest.raises(UsageError, match="no such script"):
        find_script("nowhere.py")
