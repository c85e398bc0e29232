"""Plugins and registries: what is loaded, in which order, and what happens when one fails."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import mjhab
from mjhab.core.registration import plugins
from mjhab.core.registration.registry import Registry
from tests.refusals import refused

SOURCE = Path(__file__).parents[3] / "src"


@pytest.fixture
def shelf() -> Registry[object]:
    return Registry("thing", {"path": "pathlib:Path"})


@pytest.fixture(autouse=True)
def forget() -> Iterator[None]:
    """Plugins that a test loads are forgotten after it."""
    before = list(plugins._found)
    entries = dict(plugins._entries)
    yield
    plugins._entries.clear()
    plugins._entries.update(entries)
    plugins._found[:] = before


def test_builtin_items_come_first_and_are_imported_when_asked_for(
    shelf: Registry[object],
) -> None:
    shelf.add("mine", 3)
    assert shelf.names() == ("path", "mine")
    assert shelf["path"] is Path
    assert shelf.values() == (Path, 3)
    assert "mine" in shelf and "other" not in shelf and len(shelf) == 2
    broken = Registry[object]("thing", {"a": "pathlib:Nothing"})
    assert broken.names() == ("a",)
    with refused("reference", "pathlib:Nothing"):
        _ = broken["a"]


def test_a_name_is_registered_once(shelf: Registry[object]) -> None:
    for name in ("path", "mine"):
        who = {"path": "mjhab itself", "mine": "the calling program"}[name]
        with refused("thing", name, expected=f"{who} and the calling program"):
            shelf.add("mine", 1)
            shelf.add(name, 2)
    with refused(where="thing", said="has not been registered by a plugin"):
        shelf.remove("path")


@pytest.mark.parametrize("name", ["", 3, [], "../up", "two words"])
def test_what_is_no_name_is_refused(shelf: Registry[object], name: Any) -> None:
    before = shelf.names()
    with refused("name of the thing"):
        shelf.add(name, object())
    assert shelf.names() == before


def test_an_unknown_name_lists_the_names_and_the_plugins_that_failed(
    shelf: Registry[object], tmp_path: Path
) -> None:
    with refused("thing", "pth", expected="path"):
        _ = shelf["pth"]
    file = tmp_path / "broken.py"
    file.write_text("raise ValueError('no weights.')")
    with pytest.warns(plugins.PluginWarning, match=r"broken\.py.*ValueError: no weights"):
        plugins.load_plugin(file)
    with refused("thing", "pth", expected="path", said="could not be loaded:"):
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
    with pytest.warns(
        plugins.PluginWarning, match="registered once: .*plugin .*whole.py"
    ):
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
    assert plugins.source_digest("") == plugins.source_digest("no_plugin") == ""
    with pytest.warns(plugins.PluginWarning, match="neither a Python file nor a folder"):
        plugins.load_plugin(tmp_path / "nothing.py")


def test_an_edit_of_an_installed_plugin_changes_its_digest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A module, and a module in a package whose neighbour is edited; and another version of the distribution."""
    package = tmp_path / "digested_package"
    package.mkdir()
    module = tmp_path / "digested_module.py"
    neighbour = package / "rules.py"
    for file in (module, neighbour, package / "__init__.py", package / "plugin.py"):
        file.write_text("VALUE = 1")
    info = tmp_path / "digested-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: digested\nVersion: 1.0\n"
    )
    (info / "entry_points.txt").write_text(
        "[mjhab.plugins]\nalone = digested_module\ninside = digested_package.plugin\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(plugins, "_done", False)
    monkeypatch.delenv("MJHAB_PLUGINS", raising=False)
    plugins.load_plugins()
    for name, file in (("alone", module), ("inside", neighbour)):
        digest = plugins.source_digest(name)
        assert digest and plugins.source_digest(name) == digest
        file.write_text("VALUE = 2")
        assert plugins.source_digest(name) != digest
    digest = plugins.source_digest("alone")
    (info / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: digested\nVersion: 1.1\n"
    )
    monkeypatch.setattr(plugins, "_done", False)
    plugins.load_plugins()
    assert plugins.source_digest("alone") != digest


def test_a_plugin_that_is_listed_twice_is_loaded_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, recwarn: pytest.WarningsRecorder
) -> None:
    folder = tmp_path / "several"
    folder.mkdir()
    (folder / "__init__.py").write_text("from .part import VALUE")
    (folder / "part.py").write_text("VALUE = 4")
    (tmp_path / "one.py").write_text("")
    monkeypatch.chdir(tmp_path)
    names = (
        "one.py",
        str(tmp_path / "one.py"),
        "./one.py",
        "several",
        "several/__init__.py",
    )
    monkeypatch.setenv("MJHAB_PLUGINS", os.pathsep.join(names))
    monkeypatch.setattr(plugins, "_done", False)
    monkeypatch.setattr(plugins, "entry_points", lambda group: ())
    before = len(plugins.loaded_plugins())
    found = plugins.load_plugins()[before:]
    assert [plugin.name for plugin in found] == ["one.py", "several"]
    assert not any(plugin.error for plugin in found) and not recwarn.list
    # The digest is of the file, not of a path that is relative to another folder.
    monkeypatch.chdir("/")
    assert plugins.source_digest("one.py")


def test_the_warning_is_at_the_line_that_imports(tmp_path: Path) -> None:
    (tmp_path / "bad.py").write_text("1 / 0")
    with pytest.warns(plugins.PluginWarning) as caught:
        plugins.load_plugin(tmp_path / "bad.py")
    assert caught[0].filename == __file__


@pytest.mark.parametrize(
    "reference",
    [
        "nowhere",
        "nowhere_at_all:fn",
        "broken_module:fn",
        "pathlib:Nothing",
    ],
)
def test_a_reference_that_leads_nowhere_is_told(
    reference: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "broken_module.py").write_text("\n1 / 0")
    monkeypatch.syspath_prepend(tmp_path)
    with refused("reference", reference):
        plugins.resolved(reference)


@pytest.mark.parametrize(
    ("function", "kind"),
    [
        ("register_subtask", "SubtaskSpec"),
        ("register_task", "TaskSpec"),
        ("register_robot", "Robot"),
        ("register_control_mode", "ControlMode"),
        ("register_object", "ObjectModel"),
        ("register_pack", "PackSource"),
    ],
)
@pytest.mark.parametrize("given", [{"name": "x"}, "x", None])
def test_a_registering_function_says_what_it_expects(
    function: str, kind: str, given: object
) -> None:
    with refused("argument"):
        getattr(mjhab, function)(given)


def test_plugins_of_the_variable_and_of_entry_points_are_loaded_on_import(
    tmp_path: Path,
) -> None:
    """In a process of its own, and in a worker process of it, which does not repeat the warning."""
    (tmp_path / "one.py").write_text("import mjhab\nprint('one', mjhab.__version__)")
    (tmp_path / "bad.py").write_text("1 / 0")
    (tmp_path / "installed.py").write_text("print('installed')")
    info = tmp_path / "installed-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: installed\nVersion: 1.0\n"
    )
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
    environment = {
        **os.environ,
        "MJHAB_PLUGINS": paths,
        "PYTHONPATH": f"{SOURCE}:{tmp_path}",
    }
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
    assert (
        done.stderr.count("could not be loaded and is left out: ZeroDivisionError") == 1
    )
