"""Plugins and registries: what is loaded, in which order, and what happens when one fails."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from mjhab.core.errors import UsageError
from mjhab.core.registration import plugins
from mjhab.core.registration.registry import Registry

SOURCE = Path(__file__).parents[3] / "src"


@pytest.fixture
def shelf() -> Registry[object]:
    return Registry("thing", {"path": "pathlib:Path"})


@pytest.fixture(autouse=True)
def forget() -> Iterator[None]:
    """Plugins that a test loads are forgotten after it."""
    before = list(plugins._found)
    yield
    plugins._found[:] = before


def test_builtin_items_come_first_and_are_imported_when_asked_for(shelf: Registry[object]) -> None:
    shelf.add("mine", 3)
    assert shelf.names() == ("path", "mine")
    assert shelf["path"] is Path
    assert shelf.values() == (Path, 3)
    assert "mine" in shelf and "other" not in shelf and len(shelf) == 2
    broken = Registry[object]("thing", {"a": "pathlib:Nothing"})
    assert broken.names() == ("a",)
    with pytest.raises(UsageError, match="'pathlib' has no 'Nothing'"):
        _ = broken["a"]


def test_a_name_is_registered_once(shelf: Registry[object]) -> None:
    for name in ("path", "mine"):
        with pytest.raises(UsageError, match=f"thing '{name}' is registered twice"):
            shelf.add("mine", 1)
            shelf.add(name, 2)
    with pytest.raises(UsageError, match="has not been registered by a plugin"):
        shelf.remove("path")


def test_an_unknown_name_lists_the_names_and_the_plugins_that_failed(
    shelf: Registry[object], tmp_path: Path
) -> None:
    with pytest.raises(UsageError, match=r"unknown thing 'pth'\. Did you mean 'path'"):
        _ = shelf["pth"]
    file = tmp_path / "broken.py"
    file.write_text("raise ValueError('no weights')")
    with pytest.warns(plugins.PluginWarning, match=r"broken\.py.*ValueError: no weights"):
        plugins.load_plugin(file)
    with pytest.raises(UsageError, match=r"could not be loaded: .*broken\.py: ValueError"):
        _ = shelf["pth"]


def test_a_plugin_that_raises_leaves_nothing_behind(
    shelf: Registry[object], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(plugins, "shelf", shelf, raising=False)
    add = "from mjhab.core.registration.plugins import shelf\nshelf.add('half', 1)\n"
    (tmp_path / "half.py").write_text(f"{add}raise SystemExit(3)")
    (tmp_path / "whole.py").write_text(add.replace("half", "whole"))
    version = shelf.version
    with pytest.warns(plugins.PluginWarning, match="SystemExit: 3"):
        plugins.load_plugin(tmp_path / "half.py")
    assert "half" not in shelf and shelf.version != version
    assert plugins.load_plugin(tmp_path / "whole.py").error == ""
    assert [plugin.registered for plugin in plugins.loaded_plugins()[-2:]] == [
        (),
        ("thing 'whole'",),
    ]
    assert shelf.source("whole") == str(tmp_path / "whole.py")
    with pytest.warns(plugins.PluginWarning, match="registered twice: by plugin .*whole.py"):
        plugins.load_plugin(tmp_path / "whole.py")
    assert "whole" in shelf


def test_a_folder_is_a_package_and_a_path_that_is_none_is_told(tmp_path: Path) -> None:
    folder = tmp_path / "several"
    folder.mkdir()
    (folder / "__init__.py").write_text("from .part import VALUE\nassert VALUE == 4")
    (folder / "part.py").write_text("VALUE = 4")
    assert plugins.load_plugin(folder).error == ""
    digest = plugins.source_digest(str(folder))
    (folder / "part.py").write_text("VALUE = 5")
    assert digest and plugins.source_digest(str(folder)) != digest
    assert plugins.source_digest("") == plugins.source_digest("an_installed_plugin") == ""
    with pytest.warns(plugins.PluginWarning, match="neither a Python file nor a folder"):
        plugins.load_plugin(tmp_path / "nothing.py")


def test_plugins_of_the_variable_and_of_entry_points_are_loaded_on_import(tmp_path: Path) -> None:
    """In a process of its own, and in a worker process of it, which does not repeat the warning."""
    (tmp_path / "one.py").write_text("import mjhab\nprint('one', mjhab.__version__)")
    (tmp_path / "bad.py").write_text("1 / 0")
    (tmp_path / "installed.py").write_text("print('installed')")
    info = tmp_path / "installed-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: installed\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[mjhab.plugins]\nbooked = installed\n")
    program = tmp_path / "program.py"
    program.write_text(
        "import multiprocessing\n"
        "def names():\n"
        "    import mjhab\n"
        "    from mjhab.core.registration.plugins import loaded_plugins\n"
        "    print([p.name.rsplit('/')[-1] for p in loaded_plugins()], flush=True)\n"
        "if __name__ == '__main__':\n"
        "    names()\n"
        "    worker = multiprocessing.get_context('spawn').Process(target=names)\n"
        "    worker.start()\n"
        "    worker.join()\n"
        "    assert worker.exitcode == 0\n"
    )
    paths = os.pathsep.join(str(tmp_path / name) for name in ("bad.py", "one.py"))
    environment = {**os.environ, "MJHAB_PLUGINS": paths, "PYTHONPATH": f"{SOURCE}:{tmp_path}"}
    done = subprocess.run(
        [sys.executable, str(program)],
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
        env=environment,
    )
    once = ["installed", "one 0", "['booked', 'bad.py', 'one.py']"]
    lines = done.stdout.splitlines()
    assert len(lines) == 2 * len(once)
    for line, start in zip(lines, 2 * once, strict=True):
        assert line.startswith(start)
    assert done.stderr.count("could not be loaded and is left out: ZeroDivisionError") == 1
