"""Scripts of our own in the manner of MS-HAB's run through ``python -m mjhab.compat.mshab``."""

from __future__ import annotations

import ast
import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium
import pytest
import torch

from mjhab.compat.mshab.running.check import check_script
from mjhab.compat.mshab.running.forks import own_modules
from mjhab.compat.mshab.running.hook import Answers
from mjhab.compat.mshab.running.script import (
    checkout_of,
    find_script,
    read_constant,
    run_module,
    run_script,
)
from mjhab.compat.mshab.running.table import FOREIGN, MSHAB
from mjhab.core.errors import UsageError
from tests.refusals import refused

SCRIPTS = Path(__file__).parent / "scripts"
Lines = Callable[..., list[str]]


def run(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "mjhab.compat.mshab", *map(str, arguments)]
    return subprocess.run(
        command, capture_output=True, text=True, timeout=580, env=dict(os.environ)
    )


@pytest.fixture
def lines(monkeypatch: Any, capsys: Any) -> Iterator[Lines]:
    """What a script prints; it runs in this process, which forgets what was answered."""
    for name in ("meta_path", "path", "argv"):
        monkeypatch.setattr(sys, name, list(getattr(sys, name)))
    monkeypatch.setattr(torch.Tensor, "cuda", torch.Tensor.cuda)
    monkeypatch.setattr(gymnasium.Wrapper, "__getattr__", None, raising=False)
    # So that the script begins without, and its habit is taken away with this one.
    delattr(gymnasium.Wrapper, "__getattr__")

    def printed(name: str, *arguments: str | Path, constants: Any = None) -> list[str]:
        run_script(SCRIPTS / name, list(map(str, arguments)), constants or {})
        return capsys.readouterr().out.splitlines()

    yield printed
    for name in [n for n in sys.modules if n.partition(".")[0] in FOREIGN]:
        del sys.modules[name]


def test_a_training_script_runs_with_its_imports_answered(lines: Lines) -> None:
    episodes, stats = lines("train.py", "3")[-2:]
    assert episodes.startswith("episodes 4 return")
    assert 0 < float(episodes.rsplit(maxsplit=1)[-1]) < 1.1
    assert stats == "stats [4, 4]"


def test_a_collector_writes_trajectories_labels_and_films(
    lines: Lines, tmp_path: Path
) -> None:
    shapes, labels, films = lines("collect.py", tmp_path)[-3:]
    assert shapes.startswith("trajectories 4 ")
    assert json.loads(shapes.removeprefix("trajectories 4 ")) == {
        "actions": [3, 13],
        "obs/agent/qpos": [4, 12],
        "obs/sensor_data/fetch_hand/depth": [4, 24, 32, 1],
    }
    assert labels == "labels " + str(["mobility_failure"] * 4)
    assert films == "films ['0.mp4', '1.mp4']"


def test_an_evaluation_of_a_vla_counts_success_by_both_rules(lines: Lines) -> None:
    lengths, success = lines("vla.py", "2")[-2:]
    assert lengths == "lengths [4, 4] calls 4"
    assert success == "once 0 at end 0 of 2"


def test_a_collector_of_whole_tasks_has_its_counts_from_outside(
    lines: Lines, tmp_path: Path
) -> None:
    constants = {"NUM_ENVS": 1, "MAX_TRAJECTORIES": 2, "LABEL": "short"}
    printed = lines("chains.py", tmp_path, constants=constants)[-1]
    lengths, pointers = ast.literal_eval(
        printed.removeprefix("short ").replace("] [", "],[")
    )
    # It is written up to the step before that in which the drive was finished.
    assert len(lengths) == 2 and all(2 <= length <= 7 for length in lengths)
    assert [len(each) - 1 for each in pointers] == lengths
    assert not any(map(any, pointers))


@pytest.mark.parametrize("given", ["NUM_ENVS", "NUM ENVS=3", "NUM_ENVS=a b", "=3"])
def test_a_constant_that_is_none_is_refused(given: str) -> None:
    with refused("--set", given, "NAME=VALUE"):
        read_constant(given)


def test_a_constant_that_the_script_lacks_is_refused(tmp_path: Path) -> None:
    assert read_constant('LABELS={"pick": None}') == ("LABELS", {"pick": None})
    script = tmp_path / "one.py"
    script.write_text("A = 1\nB: int = 2\nC: int\nD = E = 3\nif A:\n    F = 4\n")
    for name in ("C", "D", "F", "G"):
        with refused("constant of one.py", name, "A"):
            run_script(script, [], {name: 1})


def test_wrappers_of_a_fork_are_its_own(tmp_path: Path) -> None:
    package = tmp_path / "mshab"
    wrappers = package / "envs" / "wrappers"
    wrappers.mkdir(parents=True)
    make = "from mshab.envs.wrappers import DebugVideoGPU, FetchActionWrapper"
    (package / "envs" / "make.py").write_text(make)
    assert own_modules(package, MSHAB) == {}
    (wrappers / "observation.py").write_text(
        "class Colours: pass\nclass FrameStack: pass"
    )
    (wrappers / "__init__.py").write_text("from .observation import Colours, FrameStack")
    (package / "envs" / "make.py").write_text(f"{make}, Colours")
    own = own_modules(package, MSHAB)
    assert set(own) == {
        f"mshab.envs{part}" for part in (".make", ".wrappers", ".wrappers.observation")
    }
    assert all(names == {"Colours"} for names in own.values())
    # Below a package that is answered, modules that are not come from the fork.
    finder = Answers({n: names for n, names in MSHAB.items() if n not in own}, package)
    spec = finder.find_spec("mshab.envs")
    assert spec is not None
    assert spec.submodule_search_locations == [str(package / "envs")]
    assert finder.find_spec("mshab.envs.wrappers") is None


@pytest.mark.parametrize(
    ("name", "subtask"),
    [("train.py", "Pick"), ("collect.py", "Pick"), ("vla.py", "Close")],
)
def test_a_check_tells_what_is_answered(name: str, subtask: str) -> None:
    found = check_script(SCRIPTS / name)
    assert set(found["imports"].values()) == {"answered"}
    assert found["ids"] == [f"{subtask}SubtaskTrain-v0"]


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


def test_an_import_that_is_not_answered_is_told_with_its_place(
    lines: Lines, tmp_path: Path
) -> None:
    script = tmp_path / "tasks.py"
    for text, missing in (
        ("import mani_skill.envs.tasks", "No module named 'mani_skill.envs.tasks'"),
        ("from mshab.envs.make import no_such", "cannot import name 'no_such'"),
    ):
        script.write_text(f"import json\n{text}\n")
        with pytest.raises(UsageError, match=rf"tasks.py, line 2: {missing}.*--check"):
            lines(str(script))
    with refused(where="mshab.train_sac", said="no such module"):
        run_module("mshab.train_sac", [])


def test_a_script_that_is_not_there_is_refused() -> None:
    with refused(where="nowhere.py", said="no such script"):
        find_script("nowhere.py")
