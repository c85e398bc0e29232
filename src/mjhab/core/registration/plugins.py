"""Plugins: code outside the package that registers subtasks, tasks, robots, packs or objects when mjhab is imported.

A plugin is a Python file or a folder with an ``__init__.py``, named in the environment variable ``MJHAB_PLUGINS``, or
an installed module behind an entry point of the group ``mjhab.plugins``. It calls ``mjhab.register_subtask`` and the
like while it is imported. Worker processes inherit the variable and the installation, so they load the same plugins.
"""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import multiprocessing
import os
import sys
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib.metadata import entry_points
from pathlib import Path

from mjhab.core.errors import UsageError

ENTRY_POINT_GROUP = "mjhab.plugins"
PATHS_VARIABLE = "MJHAB_PLUGINS"
"""Paths of plugin files and folders, separated as in PATH (``:``, on Windows ``;``)."""
_MODULE_PREFIX = "mjhab_plugin_"


class PluginWarning(UserWarning):
    """A plugin could not be loaded; what it would have registered is not there."""


@dataclass(frozen=True)
class Plugin:
    """A plugin that was found."""

    name: str
    """Path as given in ``MJHAB_PLUGINS``, or name of the entry point."""
    origin: str
    """What is imported: the full path of a file or folder, or the module of an entry point."""
    registered: tuple[str, ...] = ()
    """What it has registered, in order: "subtask 'push'". Nothing if it could not be loaded."""
    error: str = ""
    """Why it could not be loaded, "" if it was."""


@dataclass
class _Loading:
    """A plugin while it is imported, what it has registered so far, and how to take that back."""

    name: str
    registered: list[str] = field(default_factory=list)
    undo: list[Callable[[], None]] = field(default_factory=list)


_found: list[Plugin] = []
_loading: list[_Loading] = []
_done = False


def load_plugins() -> tuple[Plugin, ...]:
    """Load all plugins, once per process: entry points by name, then ``MJHAB_PLUGINS`` in its order.

    ``import mjhab`` calls it. A plugin that raises is left out with everything it has registered, a `PluginWarning`
    tells which one and why, and the others are loaded.
    """
    global _done
    if not _done:
        _done = True
        for entry in sorted(entry_points(group=ENTRY_POINT_GROUP), key=lambda entry: entry.name):
            _load(entry.name, f"entry point {entry.value}", entry.load)
        for path in filter(None, os.environ.get(PATHS_VARIABLE, "").split(os.pathsep)):
            load_plugin(path)
    return tuple(_found)


def load_plugin(path: str | Path) -> Plugin:
    """Load one plugin file or folder now; see `load_plugins` for what happens when it raises."""
    place = Path(path).expanduser().resolve()
    return _load(str(path), str(place), lambda: _import_path(place))


def loaded_plugins() -> tuple[Plugin, ...]:
    """The plugins that were found so far, those that could not be loaded included."""
    return tuple(_found)


def failed_plugins() -> str:
    """One sentence on the plugins that could not be loaded, "" if there are none: for errors about unknown names."""
    failed = [plugin for plugin in _found if plugin.error]
    if not failed:
        return ""
    told = "; ".join(f"{plugin.name}: {plugin.error}" for plugin in failed)
    return f" Plugins that could not be loaded: {told}."


def current_source() -> str:
    """Name of the plugin that is being loaded, "" outside of plugins."""
    return _loading[-1].name if _loading else ""


def note_registration(what: str, undo: Callable[[], None]) -> None:
    """Remember what the plugin that is being loaded has registered; does nothing outside of plugins.

    Args:
        what: sort and name, such as "subtask 'push'".
        undo: takes the registration back; called if the plugin raises later on.
    """
    if _loading:
        _loading[-1].registered.append(what)
        _loading[-1].undo.append(undo)


def _load(name: str, origin: str, run: Callable[[], object]) -> Plugin:
    loading = _Loading(name)
    _loading.append(loading)
    error = ""
    try:
        run()
    # A plugin is code of others: whatever it raises must not take mjhab down.
    except (Exception, SystemExit) as raised:
        error = f"{type(raised).__name__}: {raised}"
        for undo in reversed(loading.undo):
            undo()
        loading.registered.clear()
    finally:
        _loading.pop()
    plugin = Plugin(name, origin, tuple(loading.registered), error)
    _found.append(plugin)
    # Worker processes load the same plugins; the process that started them has told.
    if error and multiprocessing.parent_process() is None:
        warnings.warn(
            f"mjhab: plugin {name!r} could not be loaded and is left out: {error}",
            PluginWarning,
            stacklevel=2,
        )
    return plugin


def _import_path(path: Path) -> None:
    """Import a file, or a folder as a package, under a name of its own.

    Raises:
        UsageError: there is no such file, or the folder is no package.
    """
    file = path / "__init__.py" if path.is_dir() else path
    if not file.is_file() or file.suffix != ".py":
        raise UsageError(f"{path} is neither a Python file nor a folder with an __init__.py.")
    name = _MODULE_PREFIX + path.stem + "_" + hashlib.sha256(str(path).encode()).hexdigest()[:8]
    folders = [str(path)] if path.is_dir() else None
    spec = importlib.util.spec_from_file_location(name, file, submodule_search_locations=folders)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    # Under its name before it runs: relative imports, dataclasses and pickle look it up.
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise


def source_digest(name: str) -> str:
    """Hash of the Python files of a plugin of ``MJHAB_PLUGINS``, "" for mjhab and for installed plugins.

    Caches of results that a plugin's code decides are keyed by it.
    """
    path = Path(name).expanduser()
    if not name or not path.exists():
        return ""
    files = sorted(path.rglob("*.py")) if path.is_dir() else [path]
    digest = hashlib.sha256()
    for file in files:
        digest.update(file.read_bytes())
    return digest.hexdigest()[:16]


def resolved(item: object) -> object:
    """What a text "package.module:name" refers to; anything else is returned as it is."""
    return referred(item) if isinstance(item, str) else item


def referred(reference: str) -> object:
    """The object that ``"package.module:name"`` names.

    Raises:
        UsageError: the text has no such form, or the module no such name.
    """
    module, colon, name = reference.partition(":")
    if not (module and colon and name):
        raise UsageError(f"{reference!r} is no reference; expected 'package.module:name'.")
    found = importlib.import_module(module)
    if not hasattr(found, name):
        raise UsageError(f"module {module!r} has no {name!r}, which {reference!r} refers to.")
    return getattr(found, name)
