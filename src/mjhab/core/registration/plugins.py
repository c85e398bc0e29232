"""Plugins: code outside the package that registers subtasks, tasks, robots, control modes,
packs or objects when mjhab is imported.

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
import traceback
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path

from mjhab.core.errors import MjhabError, fault, wrong_value
from mjhab.core.files.reading import reason

ENTRY_POINT_GROUP = "mjhab.plugins"
PATHS_VARIABLE = "MJHAB_PLUGINS"
"""Paths of plugin files and folders, separated as in PATH (``:``, on Windows ``;``)."""
_MODULE_PREFIX = "mjhab_plugin_"
_PACKAGE = str(Path(__file__).parents[2])
"""Folder of mjhab: warnings are about the code that imports it."""
_DIGEST_CHARACTERS = 16


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
_entries: dict[str, EntryPoint] = {}
"""Entry points that were found, by name."""


def load_plugins() -> tuple[Plugin, ...]:
    """Load all plugins, once per process: entry points by name, then ``MJHAB_PLUGINS`` in its order.

    ``import mjhab`` calls it. A plugin that raises is left out with everything it has registered, a `PluginWarning`
    tells which one and why, and the others are loaded.
    """
    global _done
    if not _done:
        # Before the loading: a plugin that imports mjhab comes here again.
        _done = True
        for entry in sorted(
            # In a fixed order: it gives the numbers of subtasks in arrays.
            entry_points(group=ENTRY_POINT_GROUP),
            key=lambda entry: entry.name,
        ):
            _entries[entry.name] = entry
            _load(entry.name, f"entry point {entry.value}", entry.load)
        for path in _paths(os.environ.get(PATHS_VARIABLE, "")):
            load_plugin(path)
    return tuple(_found)


def load_plugin(path: str | Path) -> Plugin:
    """Load one plugin file or folder now; see `load_plugins` for what happens when it raises."""
    place = _place(path)
    return _load(str(path), str(place), lambda: _import_path(place))


def _place(path: str | Path) -> Path:
    """The full path of a plugin; of a package its folder.

    Raises:
        UsageError: it is no path, or begins with the home of somebody who has none.
    """
    try:
        place = Path(path).expanduser().resolve()
    except (TypeError, ValueError, RuntimeError, OSError) as error:
        raise wrong_value("plugin", path, f"a path ({reason(error)})") from error
    return place.parent if place.name == "__init__.py" else place


def _paths(text: str) -> list[str]:
    """The paths in `PATHS_VARIABLE`; a file that is named twice, say by a relative and an absolute path, once."""
    found: dict[Path, str] = {}
    for path in filter(None, text.split(os.pathsep)):
        found.setdefault(_place(path), path)
    return list(found.values())


def loaded_plugins() -> tuple[Plugin, ...]:
    """The plugins that were found so far, those that could not be loaded included."""
    return tuple(_found)


def failed_plugins() -> str:
    """One sentence on the plugins that could not be loaded, "" if there are none: for errors about unknown names."""
    failed = [plugin for plugin in _found if plugin.error]
    if not failed:
        return ""
    problems = "; ".join(
        f"{plugin.name}: {plugin.error.rstrip(' .')}" for plugin in failed
    )
    return f"Plugins that could not be loaded: {problems}."


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
        # Backwards, as later registrations may rest on earlier ones.
        for undo in reversed(loading.undo):
            undo()
        loading.registered.clear()
    finally:
        _loading.pop()
    plugin = Plugin(name, origin, tuple(loading.registered), error)
    _found.append(plugin)
    # Worker processes load the same plugins; the process that started them has told.
    if error and multiprocessing.parent_process() is None:
        _warn(f"mjhab: plugin {name!r} could not be loaded and is left out: {error}")
    return plugin


def _warn(message: str) -> None:
    """A `PluginWarning` at the line outside of mjhab that imports it; the outermost line if there is none."""
    frame = sys._getframe(1)
    while frame.f_back is not None and frame.f_code.co_filename.startswith(
        (_PACKAGE, "<frozen")
    ):
        frame = frame.f_back
    warnings.warn_explicit(
        message,
        PluginWarning,
        frame.f_code.co_filename,
        frame.f_lineno,
        # That of the importing module, as for any warning of its own, so that Python tells it once per place.
        registry=frame.f_globals.setdefault("__warningregistry__", {}),
    )


def _import_path(path: Path) -> None:
    """Import a file, or a folder as a package, under a name of its own.

    Raises:
        UsageError: there is no such file, or the folder is no package.
    """
    file = path / "__init__.py" if path.is_dir() else path
    if not file.is_file() or file.suffix != ".py":
        raise fault(path, "neither a Python file nor a folder with an __init__.py.")
    name = (
        _MODULE_PREFIX
        + path.stem
        + "_"
        # Two plugins may have files of one name in different folders.
        + hashlib.sha256(str(path).encode()).hexdigest()[:8]
    )
    folders = [str(path)] if path.is_dir() else None
    spec = importlib.util.spec_from_file_location(
        name, file, submodule_search_locations=folders
    )
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    # Under its name before it runs: relative imports, dataclasses and pickle look it up.
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except BaseException:
        # A module that was executed in part must not be found by a second try.
        del sys.modules[name]
        raise


def source_digest(name: str) -> str:
    """Hash of the Python files of a plugin, "" for mjhab and for names that are none.

    Of an installed plugin these are the files of its package, with name and version of the distribution. Caches of
    results that a plugin's code decides are keyed by it.
    """
    if not name:
        return ""
    digest = hashlib.sha256()
    if name in _entries:
        entry = _entries[name]
        files = _files_of_module(entry.module)
        if entry.dist is not None:
            # Compiled parts of a distribution are no Python files; its version stands for them.
            digest.update(f"{entry.dist.name} {entry.dist.version}".encode())
    else:
        # By its full path: the working directory may be another one by now.
        origin = next((plugin.origin for plugin in _found if plugin.name == name), name)
        files = _python_files(_place(origin))
    if not files:
        return ""
    for file in files:
        digest.update(file.read_bytes())
    return digest.hexdigest()[:_DIGEST_CHARACTERS]


def _python_files(path: Path) -> list[Path]:
    """The Python files of a plugin at a path, none if there is nothing."""
    if path.is_dir():
        return sorted(path.rglob("*.py"))
    return [path] if path.is_file() else []


def _files_of_module(module: str) -> list[Path]:
    """The Python files of the outermost package that a module is in, or of the module where that is one file."""
    parts = module.split(".")
    for count in range(1, len(parts) + 1):
        spec = importlib.util.find_spec(".".join(parts[:count]))
        # A namespace package has no file of its own, and parts of other distributions.
        if spec is None or spec.origin is None:
            continue
        folders = spec.submodule_search_locations or [spec.origin]
        return [file for folder in folders for file in _python_files(Path(folder))]
    return []


def raised_text(error: BaseException) -> str:
    """An exception in code of others, in words: its type, its message, and the line that raised it."""
    text = f"{type(error).__name__}: {error}".rstrip(" .:")
    frames = traceback.extract_tb(error.__traceback__)
    outside = [
        frame for frame in frames if not frame.filename.startswith((_PACKAGE, "<frozen"))
    ]
    if not outside:
        return text
    return f"{text} ({outside[-1].filename}, line {outside[-1].lineno})"


def resolved(item: object) -> object:
    """What a text "package.module:name" refers to; anything else is returned as it is."""
    return referred(item) if isinstance(item, str) else item


def referred(reference: str) -> object:
    """The object that ``"package.module:name"`` names.

    Raises:
        UsageError: the text has no such form, the module cannot be imported, or it has no such name.
    """
    module, colon, name = reference.partition(":")
    if not (module and colon and name):
        raise wrong_value("reference", reference, "'package.module:name'")
    try:
        found = importlib.import_module(module)
    except MjhabError:
        raise
    # The module may be code of others, which raises whatever it likes.
    except Exception as error:
        raise wrong_value(
            "reference",
            reference,
            f"in a module that can be imported; it raises {raised_text(error)}",
        ) from error
    if not hasattr(found, name):
        raise wrong_value("reference", reference, f"a name that module {module!r} has")
    return getattr(found, name)
