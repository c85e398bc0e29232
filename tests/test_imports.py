"""The import rule: data flows one way, heavy libraries stay where they belong, ``import mjhab`` is light."""

from __future__ import annotations

import ast
import functools
import re
import subprocess
import sys
from collections.abc import Iterable, Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

SOURCE = Path(__file__).parents[1] / "src" / "mjhab"

_WORLD = frozenset({"core", "scenes", "tasks", "robots", "layout", "sim"})
_ENV = _WORLD | {"render", "config", "episodes", "envs"}
_RUN = _ENV | {"experts", "rollout", "data", "reports", "serving", "evaluation"}
ALLOWED: dict[str, frozenset[str]] = {
    "core": frozenset(),
    "assets": frozenset({"core"}),
    "scenes": frozenset({"core"}),
    "tasks": frozenset({"core"}),
    "robots": frozenset({"core", "scenes"}),
    "layout": frozenset({"core", "scenes", "robots"}),
    "sim": frozenset({"core", "scenes", "robots", "layout"}),
    "render": frozenset({"core", "scenes", "robots", "layout", "sim"}),
    "config": frozenset({"core", "scenes", "tasks", "robots", "sim"}),
    "episodes": _WORLD | {"config"},
    "envs": _WORLD | {"render", "config", "episodes"},
    "experts": frozenset({"core", "tasks", "robots", "episodes", "envs"}),
    "rollout": frozenset({"core", "tasks"}),
    "data": frozenset({"core", "tasks", "rollout"}),
    "reports": frozenset({"core", "tasks", "rollout", "data"}),
    "serving": frozenset({"core"}),
    "evaluation": _ENV | {"assets", "experts", "rollout", "data", "reports", "serving"},
    "integrations": frozenset({"core", "tasks", "robots", "envs", "evaluation"}),
    "learning": frozenset(
        {"core", "tasks", "robots", "config", "episodes", "envs", "experts"}
    )
    | {"rollout", "data", "reports", "evaluation"},
    "viewer": _RUN,
    "bench": _RUN | {"assets"},
    "compat": _RUN | {"assets", "learning"},
    "cli": _RUN | {"assets", "learning", "viewer", "bench", "compat"},
    "paper": _RUN | {"assets", "learning", "cli"},
}
"""Package to the packages it may import, besides itself."""

HEAVY: dict[str, frozenset[str]] = {
    "mujoco": frozenset({"robots", "layout", "sim", "render", "viewer"}),
    "warp": frozenset({"sim", "render"}),
    "mujoco_warp": frozenset({"sim", "render"}),
    "torch": frozenset(
        {"sim", "render", "envs", "data", "learning", "integrations", "paper", "compat"}
    ),
    "safetensors": frozenset({"learning"}),
    "onnxruntime": frozenset({"learning"}),
    "mitsuba": frozenset({"render"}),
    "mitsuba_oidn": frozenset({"render"}),
    "drjit": frozenset({"render"}),
    "h5py": frozenset({"data", "compat"}),
    "filelock": frozenset({"core"}),
    "platformdirs": frozenset({"core"}),
    "huggingface_hub": frozenset({"assets"}),
    "jinja2": frozenset({"reports"}),
    "msgpack": frozenset({"serving"}),
    "vla_eval": frozenset({"integrations"}),
    "websockets": frozenset({"serving", "viewer"}),
    "viser": frozenset({"viewer"}),
    "trimesh": frozenset({"scenes", "robots", "episodes", "viewer"}),
}
"""Library to the packages that may import it."""

MOST_FILES = 15
"""Files beside the subfolders of a folder."""
EXAMPLES = SOURCE / "examples"
"""Examples of what users write; nothing of the package imports them."""
FILES = sorted(
    path
    for path in SOURCE.rglob("*.py")
    if path.parent != SOURCE and not path.is_relative_to(EXAMPLES)
)


PAGE = Path(__file__).parents[1] / "docs" / "architecture.md"
"""Documentation whose tables repeat ALLOWED and HEAVY."""


@functools.cache
def nodes_of(text: str) -> tuple[ast.AST, ...]:
    """The imports, classes, attributes and constants of a source, wherever they stand in it."""
    wanted = (ast.Import, ast.ImportFrom, ast.ClassDef, ast.Attribute, ast.Constant)
    return tuple(node for node in ast.walk(ast.parse(text)) if isinstance(node, wanted))


def imported(path: Path) -> Iterator[str]:
    """Yield the full name of every module (or name in a module) that a file imports, wherever in the file."""
    for node in nodes_of(path.read_text(encoding="utf-8")):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                package = ("mjhab", *path.relative_to(SOURCE).parent.parts)
                base = ".".join(
                    (*package[: len(package) - node.level + 1], *filter(None, [base]))
                )
            yield from (f"{base}.{alias.name}" for alias in node.names)


def package_of(path: Path) -> str:
    return path.relative_to(SOURCE).parts[0]


def forbidden(path: Path) -> Iterator[str]:
    """Yield what a file imports and its package may not, each with its reason."""
    package = package_of(path)
    assert package in ALLOWED, f"package {package!r} has no line in the table of imports"
    for name in imported(path):
        top, *below = name.split(".")
        if top == "benchmarks":
            yield f"{path}: benchmarks are no part of the package"
        elif top == "mjhab" and below and below[0] in ALLOWED:
            allowed = ALLOWED[package] | {package}
            if below[0] not in allowed:
                yield f"{path}: {package} may not import {name}; it may import {sorted(allowed)}"
        elif top in HEAVY and package not in HEAVY[top]:
            yield f"{path}: {package} may not import {top}"
        elif top in ("warp", "mujoco_warp") and path.parent.name != "warp":
            yield f"{path}: {top} outside a folder warp"
        elif top == "torch" and package == "envs" and path.parent.name != "device":
            yield f"{path}: torch outside the folder device"


def test_files_import_only_what_their_package_may() -> None:
    found = [line for path in FILES for line in forbidden(path)]
    assert len(FILES) > 300 and not found, "\n".join(found)


LINUX_ONLY = {
    "core/files/locking.py": {"fcntl"},
    "core/machine.py": {"/proc", "sched_getaffinity"},
}
"""What other systems lack, and the one file that names it; that file does without where it is missing."""
LINUX_MODULES = {"fcntl", "grp", "pwd", "resource", "termios"}


def test_what_only_linux_has_is_named_in_one_file_each() -> None:
    for path in FILES:
        named = LINUX_MODULES.intersection(imported(path))
        for node in nodes_of(path.read_text(encoding="utf-8")):
            if isinstance(node, ast.Attribute) and node.attr == "sched_getaffinity":
                named.add(node.attr)
            elif isinstance(node, ast.Constant) and str(node.value).startswith("/proc/"):
                named.add("/proc")
        allowed = LINUX_ONLY.get(path.relative_to(SOURCE).as_posix(), set())
        assert named <= allowed, f"{path} names {sorted(named - allowed)}"


def module_of(path: Path) -> str:
    """Full name of the module of a source file."""
    parts = ("mjhab", *path.relative_to(SOURCE).with_suffix("").parts)
    return ".".join(parts).removesuffix(".__init__")


def import_graph(paths: Iterable[Path]) -> dict[str, set[str]]:
    """The modules of ours that every module imports, wherever in the file and for types alone too."""
    graph: dict[str, set[str]] = {module_of(path): set() for path in paths}
    for path in paths:
        for name in imported(path):
            # A name is a module of its own, or stands in one.
            found = name if name in graph else name.rpartition(".")[0]
            if found in graph and found != module_of(path):
                graph[module_of(path)].add(found)
    return graph


def test_no_file_imports_itself_by_way_of_others() -> None:
    graph = import_graph(sorted(SOURCE.rglob("*.py")))
    assert len(graph) > 300
    tuple(TopologicalSorter(graph).static_order())


def test_a_circle_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys.modules[__name__], "SOURCE", tmp_path)
    (tmp_path / "a.py").write_text("from mjhab import b")
    (tmp_path / "b.py").write_text("def f():\n    from mjhab.a import g")
    with pytest.raises(CycleError, match=r"mjhab\.a"):
        TopologicalSorter(import_graph(sorted(tmp_path.rglob("*.py")))).prepare()


def rows_of(head: str) -> dict[str, str]:
    """First and last cell of every row of the table in PAGE that begins with a line."""
    text = PAGE.read_text(encoding="utf-8")
    assert f"\n{head}\n" in text, f"{PAGE.name} has no table {head}"
    table = text.split(f"\n{head}\n")[1].split("\n\n")[0].splitlines()[1:]
    cells = [row.strip("| ").split(" | ") for row in table]
    return {row[0].strip("`"): row[-1] for row in cells}


def names_in(cell: str) -> frozenset[str]:
    """Names in a cell: a list in backticks, "all but" such a list, or "nothing"."""
    listed = frozenset(re.findall(r"`(\w+)`", cell))
    assert listed or cell == "nothing", f"unreadable cell {cell!r}"
    return frozenset(ALLOWED) - listed if cell.startswith("all but") else listed


def test_the_page_on_architecture_has_the_same_imports() -> None:
    packages = rows_of("| package | holds | may import |")
    assert set(packages) == set(ALLOWED)
    for name, cell in packages.items():
        assert names_in(cell) - {name} == ALLOWED[name], f"row {name!r} of {PAGE.name}"
    libraries = rows_of("| library | packages |")
    assert {name: names_in(cell) for name, cell in libraries.items()} == HEAVY


def test_no_folder_is_a_heap() -> None:
    """A flat folder of many files says nothing about what lies where."""
    for folder in {path.parent for path in FILES}:
        files = [path for path in folder.glob("*.py") if path.name != "__init__.py"]
        assert len(files) <= MOST_FILES, f"{folder} has {len(files)} files"


def subfolder_pairs(graph: dict[str, set[str]]) -> set[tuple[str, str]]:
    """Pairs of subfolders of one package that import each other."""
    arrows = set()
    for module, names in graph.items():
        for name in names:
            one, two = module.split("."), name.split(".")
            # mjhab.PACKAGE.FOLDER.MODULE: what lies in the package itself belongs to no folder.
            if one[1] == two[1] and min(len(one), len(two)) > 3 and one[2] != two[2]:
                arrows.add((f"{one[1]}/{one[2]}", f"{two[1]}/{two[2]}"))
    return {(one, two) for one, two in arrows if one < two and (two, one) in arrows}


def test_subfolders_have_an_order() -> None:
    found = subfolder_pairs(import_graph(FILES))
    assert not found, f"import each other: {sorted(found)}"
    graph = {"mjhab.a.x.m": {"mjhab.a.y.n"}, "mjhab.a.y.n": {"mjhab.a.x.k"}}
    assert subfolder_pairs(graph) == {("a/x", "a/y")}


def test_class_names_are_unique() -> None:
    places: dict[str, list[str]] = {}
    for path in FILES:
        for node in nodes_of(path.read_text(encoding="utf-8")):
            if isinstance(node, ast.ClassDef):
                places.setdefault(node.name, []).append(module_of(path))
    shared = {name: found for name, found in places.items() if len(found) > 1}
    assert not shared, f"several classes of one name: {shared}"


def test_the_rule_can_be_broken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys.modules[__name__], "SOURCE", tmp_path)
    for place, line in (
        ("tasks", "from mjhab.sim import cpu"),
        ("tasks", "import mujoco"),
        ("tasks", "from ..envs import make"),
        ("tasks", "def f():\n    import torch"),
        ("tasks", "import benchmarks.sim"),
        ("sim", "import warp"),
        ("envs", "import torch"),
    ):
        path = tmp_path / place / "bad.py"
        path.parent.mkdir(exist_ok=True)
        path.write_text(line)
        assert len(list(forbidden(path))) == 1, line


def test_import_mjhab_is_light_and_every_package_an_attribute() -> None:
    """In a process of its own: here the packages have been imported already, which makes them attributes."""
    packages = sorted(path.parent.name for path in SOURCE.glob("*/__init__.py"))
    code = (
        "import sys, mjhab\n"
        "bad = {'torch', 'warp', 'mujoco', 'numba', 'scipy', 'trimesh', 'h5py'} & set(sys.modules)\n"
        "assert not bad, f'import mjhab loaded {bad}'\n"
        "import mjhab.cli.worlds.assets, mjhab.rollout.store\n"
        "bad = {'huggingface_hub', 'filelock', 'platformdirs'} & set(sys.modules)\n"
        "assert not bad, f'{bad} before it is needed'\n"
        f"for name in {packages}:\n"
        "    assert name in dir(mjhab)\n"
        "    getattr(mjhab, name)\n"
    )
    subprocess.run([sys.executable, "-c", code], timeout=60, check=True)


def test_lazy_names_resolve() -> None:
    import mjhab

    for name in mjhab.__all__:
        assert name in dir(mjhab) and getattr(mjhab, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'mkae'"):
        _ = mjhab.mkae
