"""Help texts name every style option and every preset that there is; every file that is run has one."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path

import pytest

from mjhab.cli.main import main
from mjhab.learning import configs
from mjhab.learning.reinforcement.configs import PRESETS as REINFORCEMENT_PRESETS
from mjhab.learning.train import SPECS
from mjhab.tasks.style import NAMES

ROOT = Path(__file__).parents[2]
SCRIPTS = ROOT / "docs" / "scripts"
RUN = [
    path
    for folder in (ROOT / "src" / "mjhab", SCRIPTS)
    for path in sorted(folder.rglob("*.py"))
    if '\nif __name__ == "__main__":\n' in path.read_text(encoding="utf-8")
]
"""Files that are commands: of ``python -m`` and of the documentation."""


@pytest.mark.parametrize("path", RUN, ids=lambda path: str(path.relative_to(ROOT)))
def test_a_file_that_is_run_has_a_help_and_refuses_unknown_options(
    path: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(SCRIPTS)
    for option, code in (("--help", 0), ("--no-such-option", 2)):
        monkeypatch.setattr(sys, "argv", [str(path), option])
        with pytest.raises(SystemExit) as ended:
            runpy.run_path(str(path), run_name="__main__")
        assert ended.value.code == code
        told = capsys.readouterr()
        assert told.out.startswith("usage:") or code
        # Words that are absent may be told first, under a line of usage.
        assert "usage:" in told.err or "no-such-option" in told.err or not code
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("command", ["eval", "generate"])
def test_help_names_every_style(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main([command, "--help"])
    told = " ".join(capsys.readouterr().out.replace("│", " ").split())
    about_styles = told[told.index("--style") :].split("--")[1]
    assert [
        name for name in NAMES if name not in about_styles.replace(",", " ").split()
    ] == []


@pytest.mark.parametrize("algorithm", SPECS)
def test_help_names_every_preset(algorithm: str) -> None:
    presets = {**configs.PRESETS, **REINFORCEMENT_PRESETS}[algorithm]
    told = (SPECS[algorithm].__doc__ or "").replace(",", " ").replace(".", " ").split()
    assert [name for name in presets if name not in told] == []
