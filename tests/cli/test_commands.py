"""The other commands: keys for machines, tables for people, errors."""

from __future__ import annotations

import json
import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from mjhab.cli.machine import doctor
from mjhab.cli.main import main
from mjhab.cli.output import print_table
from mjhab.cli.policies import evaluate
from mjhab.core import machine as machine_module
from mjhab.core.machine import checkout, install_extra, pip_install
from mjhab.core.registration.plugins import Plugin
from mjhab.core.version import __version__
from mjhab.render import gl_probe
from mjhab.render.pictures import home_views


def machine(capsys: pytest.CaptureFixture[str], *args: str) -> dict[str, Any]:
    assert main([*args, "--json"]) == 0
    lines = capsys.readouterr().out.strip().splitlines()
    assert len(lines) == 1
    return json.loads(lines[0])


def test_help_names_the_commands() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "mjhab", "--help"],
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
    )
    for name in ("eval", "homes", "bench", "doctor"):
        assert name in done.stdout


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"mjhab {__version__}\n"


def test_help_loads_no_heavy_library() -> None:
    code = (
        "import sys; from mjhab.cli.commands import COMMANDS; from mjhab.cli.main import main\n"
        "try: main(['eval', '--help'])\n"
        "except SystemExit: pass\n"
        "for command in COMMANDS: command.spec_type\n"
        "bad = {'mujoco', 'torch', 'warp', 'numba', 'plotly'} & set(sys.modules)\n"
        "sys.exit(f'loaded {bad}' if bad else 0)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("module", ["mjhab", "mjhab.cli.main"])
def test_help_does_not_wait_for_gymnasium(module: str) -> None:
    """The command registers its environments only when it runs something."""
    done = subprocess.run(
        [sys.executable, "-X", "importtime", "-m", module, "eval", "--help"],
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    loaded = {line.split("|")[-1].strip() for line in done.stderr.splitlines()}
    assert "tyro" in loaded
    assert not loaded & {"gymnasium", "mjhab.envs", "h5py"}


def test_a_program_that_is_given_words_of_ours_has_the_ids(tmp_path: Path) -> None:
    program = tmp_path / "train.py"
    program.write_text(
        "import gymnasium, mjhab\nassert 'mjhab/TidyHouse-v1' in gymnasium.registry\n"
    )
    words = ["-m", "mjhab", "mjhab.cli.main"]
    subprocess.run([sys.executable, str(program), *words], check=True, timeout=60)


def test_homes_list(capsys: pytest.CaptureFixture[str]) -> None:
    found = machine(capsys, "homes", "list")
    assert list(found) == ["homes"] and len(found["homes"]) >= 4
    for home in found["homes"]:
        assert list(home) == ["name", "pack", "split", "macro", "micro"]
    assert main(["homes", "list"]) == 0
    assert found["homes"][0]["name"] in capsys.readouterr().out


def test_homes_show(capsys: pytest.CaptureFixture[str]) -> None:
    name = machine(capsys, "homes", "list")["homes"][0]["name"]
    shown = machine(capsys, "homes", "show", name)
    assert shown["name"] == name and sorted(shown["articulations"]) == [
        "fridge",
        "kitchen_counter",
    ]
    assert main(["homes", "show", name]) == 0
    out = capsys.readouterr().out
    assert "sofa" in out and "fridge" in out


def test_homes_render_writes_the_picture(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def draw(
        pack: Any, homes: list[str], view: str, width: int, height: int, shading: Any
    ) -> list[np.ndarray]:
        assert shading is None
        assert (homes, view) == (["builtin_m0_00"], "inside")
        return [np.full((height, width, 3), 90, np.uint8)]

    monkeypatch.setattr(home_views, "render_homes", draw)
    out = tmp_path / "new" / "home.png"
    size = ("--width", "64", "--height", "48")
    said = machine(
        capsys,
        *"homes render builtin_m0_00 --out".split(),
        str(out),
        "--view",
        "inside",
        *size,
    )
    assert said.pop("seconds") >= 0.0
    assert said == {
        "home": "builtin_m0_00",
        "view": "inside",
        "width": 64,
        "height": 48,
        "file": str(out),
        "shader": "raster",
        "samples": None,
    }
    assert Image.open(out).size == (64, 48)


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (
            ("homes", "show", "builtin_m0_0"),
            ("unknown home", "Did you mean", "builtin_m1_00"),
        ),
        (("homes", "render", "nowhere"), ("unknown home", "builtin_m0_00")),
        (
            ("homes", "render", "builtin_m0_00", "--out", "x.jpg"),
            ("a name that ends with .png",),
        ),
        (
            ("homes", "render", "builtin_m0_00", "--width", "0"),
            ("width must be at least 16",),
        ),
        (("homes", "list", "--assets", "bulitin"), ("asset pack", "builtin")),
        (("homes", "list", "--assets", "no/such/folder"), ("no/such/folder",)),
        (("bench", "sim", "--worlds", "4"), ("`python -m benchmarks.sim` now",)),
    ],
)
def test_bad_input(
    args: tuple[str, ...], words: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(args) == 2
    out, err = capsys.readouterr()
    assert out == "" and "Traceback" not in err
    for word in words:
        assert word in err


def test_doctor(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        gl_probe, "renderer_probe", lambda: {"egl": True, "osmesa": False}
    )
    monkeypatch.setattr(
        doctor,
        "loaded_plugins",
        lambda: (
            Plugin("push", "/push", ("subtask 'push'",)),
            Plugin("b", "b.py", error="E: gone"),
        ),
    )
    found = machine(capsys, "doctor")
    assert list(found) == [
        "python",
        "mujoco",
        "renderers",
        "gpu",
        "cores",
        "cache",
        "memory_cache_mb",
        "plugins",
        "robots",
    ]
    assert found["robots"]["fetch"] == ""
    assert [plugin["registered"] for plugin in found["plugins"]] == [
        ["subtask 'push'"],
        [],
    ]
    assert found["plugins"][1]["error"] == "E: gone"
    assert found["renderers"] == {"rasterizer": True, "egl": True, "osmesa": False}
    assert found["mujoco"] == "3.17.0" and found["cores"] >= 1
    assert main(["doctor"]) == 0
    out = capsys.readouterr().out
    assert "libosmesa6" in out and "gymnasium-robotics" in out and "cache" in out
    assert "subtask 'push'" in out and "could not be loaded: E: gone" in out


def test_doctor_knows_all_extras() -> None:
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())[
        "project"
    ]
    extras = set(project["optional-dependencies"]) - {"all", "dev"}
    assert set(doctor.EXTRAS) == extras


def test_hints_install_into_the_python_that_runs_from_where_mjhab_is(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    root = Path(__file__).parents[2]
    assert checkout() == root
    assert shlex.split(install_extra("view"))[-2:] == ["-e", f"{root}[view]"]
    assert shlex.split(pip_install("torchrl", "sets of words"))[-2:] == [
        "torchrl",
        "sets of words",
    ]
    assert pip_install("torchrl").startswith((sys.executable, "uv "))
    monkeypatch.setattr(
        machine_module, "__file__", "/lib/site-packages/mjhab/core/machine.py"
    )
    assert shlex.split(install_extra("view"))[-1] == "mjhab[view]"


def test_tables_are_whole_where_nobody_sees_a_terminal(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["envs", "describe", "mjhab/CloseSubtaskTrain-v1", "--obs", "depth"]) == 0
    text = capsys.readouterr().out
    assert "…" not in text and "sensor_param/fetch_head/extrinsic_cv" in text


@pytest.mark.parametrize("width", [40, 60, 80, 200])
def test_tables_cut_no_word_in_narrow_terminals(
    width: int, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", str(width))
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    columns = ("key", "shape", "dtype", "unit", "frame", "meaning")
    row = (
        "extra/tcp_pose_wrt_base",
        7,
        "float32",
        "m, wxyz",
        "base_link",
        "position, quaternion",
    )
    print_table("observations", columns, [row, row])
    text = re.sub(r"\x1b\[[0-9;]*m", "", capsys.readouterr().out)
    assert max(map(len, text.splitlines())) <= width and "…" not in text
    words = " ".join([*columns, *map(str, row)]).split()
    assert all(text.count(word) >= 1 for word in words)
    assert text.count("extra/tcp_pose_wrt_base") == 2
    assert ("┃" in text) == (width >= 80)


def test_a_reader_may_stop_early() -> None:
    command = f"{sys.executable} -m mjhab.cli.main envs describe mjhab/PickSubtaskTrain-v1 | head -1"
    done = subprocess.run(
        command, shell=True, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0 and done.stderr == "" and done.stdout.count("\n") == 1


def test_demo_is_an_evaluation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []
    monkeypatch.setattr(
        evaluate, "run_eval", lambda spec, json: asked.append((spec, json)) or 0
    )
    assert main(["demo", "--out", str(tmp_path), "--json"]) == 0
    ((spec, json),) = asked
    assert (spec.asked.task, spec.episodes, spec.policy) == ("set_table", 4, "expert")
    assert json and spec.overwrite and spec.out == tmp_path


def test_doctor_fails_without_the_right_mujoco(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(gl_probe, "renderer_probe", dict)
    monkeypatch.setattr(doctor, "installed", lambda package: None)
    assert main(["doctor"]) == 1
    assert "pip install mujoco==3.17.0" in capsys.readouterr().out.replace("\n", " ")


def test_gpu_is_asked_for_without_cuda(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    tool = tmp_path / "nvidia-smi"
    tool.write_text("#!/bin/sh\necho 'NVIDIA H200'\necho 'NVIDIA H200'\n")
    tool.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=":")
    assert doctor.gpu_name() == "NVIDIA H200"
    tool.write_text("#!/bin/sh\nexit 9\n")
    assert doctor.gpu_name() is None
