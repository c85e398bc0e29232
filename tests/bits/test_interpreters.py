"""Models, starts and states are the same bits under every interpreter found here, and under any order of hashes.

Other interpreters are those that MJHAB_OTHER_PYTHON names (paths, separated as in PATH), and ``python3.*`` of PATH and
of pyenv, if they have the same versions of the libraries that compute.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest

from tests.bits.bits_of import hashed, results

ROOT = Path(__file__).parents[2]
SCRIPT = Path(__file__).with_name("bits_of.py")
VARIABLE = "MJHAB_OTHER_PYTHON"
LIBRARIES = ("numpy", "scipy", "mujoco", "numba", "gymnasium", "trimesh")
_ASK = (
    "import json, sys; from importlib.metadata import version; "
    f"print(json.dumps([sys.version_info[:2], [version(n) for n in {LIBRARIES}]]))"
)


def other_interpreters() -> list[str]:
    """One interpreter of every other minor version of Python that has our libraries in our versions."""
    named = os.environ.get(VARIABLE, "").split(os.pathsep)
    folders = [Path(entry) for entry in os.environ.get("PATH", "").split(os.pathsep)]
    folders += sorted((Path.home() / ".pyenv" / "versions").glob("*/bin"))
    found = [Path(path) for path in named if path]
    found += [file for folder in folders for file in sorted(folder.glob("python3.??"))]
    ours = [list(sys.version_info[:2]), [version(name) for name in LIBRARIES]]
    chosen: dict[tuple[int, ...], str] = {}
    for path in found:
        told = _told(path)
        if told and told[0] != ours[0] and told[1] == ours[1]:
            chosen.setdefault(tuple(told[0]), str(path))
    return [chosen[minor] for minor in sorted(chosen)]


def _told(path: Path) -> list | None:
    try:
        done = subprocess.run(
            [path, "-c", _ASK], capture_output=True, text=True, timeout=60
        )
        return json.loads(done.stdout)
    except (OSError, ValueError, subprocess.TimeoutExpired):
        return None


def bits(interpreter: str, **variables: str) -> dict[str, str]:
    """Results of `bits_of.py`, by name."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "src"), **variables}
    done = subprocess.run(
        [interpreter, SCRIPT], env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


@pytest.fixture(scope="module")
def here() -> dict[str, str]:
    """With the homes and starts that earlier runs left in the cache; the others begin with an empty one.

    In this process, with its order of hashes and its threads.
    """
    return {name: hashed(array) for name, array in results()}


def test_the_order_of_hashes_and_the_threads_of_blas_change_no_bit(
    here: dict[str, str], tmp_path: Path
) -> None:
    own = {"PYTHONHASHSEED": "4711", "OPENBLAS_NUM_THREADS": "1"}
    assert bits(sys.executable, MJHAB_CACHE=str(tmp_path), **own) == here


def test_other_versions_of_python_change_no_bit(
    here: dict[str, str], tmp_path: Path
) -> None:
    for interpreter in other_interpreters():
        cache = tmp_path / Path(interpreter).name
        found = bits(interpreter, MJHAB_CACHE=str(cache))
        differ = [name for name in here if found.get(name) != here[name]]
        assert not differ, f"{interpreter} makes other bits: {differ}"
        assert found.keys() == here.keys()
