"""The source of mjhab uses nothing whose result depends on the version of Python or on the order of hashes or files."""

from __future__ import annotations

import ast
import functools
from collections.abc import Iterator
from pathlib import Path

import pytest

from mjhab.core.arithmetic.sums import ordered_sum

SOURCE = Path(__file__).parents[2] / "src" / "mjhab"
COMPUTING = ("config", "core", "envs", "episodes", "experts", "layout", "robots")
COMPUTING += ("scenes", "sim", "tasks")
"""Packages that make models, starts and actions."""
STARTING = ("episodes", "layout", "scenes")
"""Packages that decide where episodes begin."""
BY_PROCESSOR = frozenset(
    "arccos arcsin arctan arctan2 cbrt exp expm1 log log10 log1p log2 power tan".split()
)
"""Functions of NumPy with other last bits where there is AVX-512 (`core.arithmetic.elementary`)."""

INTEGER_FIELDS = frozenset(
    {
        "image_channels",
        "horizon",
        "st_size",
        "size",
        "nbytes",
        "bytes",
        "shape",
        "itemsize",
        "count",
        "steps",
        "frames",
        "samples",
        "episodes",
        "tries",
        "passes",
        "rejected",
        "fallback",
        "kept",
        "finished",
        "present",
        "successes",
        "wanted",
        "tainted",
        "success_once",
        "success_at_end",
        "completed",
    }
)
"""Attributes, and keys of dicts, that hold integers or truth values everywhere in mjhab."""
INTEGER_CALLS = frozenset(
    [
        "len",
        "bool",
        "int",
        "any",
        "all",
        "startswith",
        "isdigit",
        "array_equal",
        "array_bytes",
        "decoded_bytes",
        "width_of",
    ]
)
INTEGER_SUMS = {
    "compat/mshab/files/making.py": {"part.left_out"},
    "compat/mshab/worlds/starting.py": {"map(starts.spawns, range(len(starts.plans)))"},
    "bench/experts/report.py": {"asked"},
    "bench/experts/run.py": {"row.episodes - len(found)"},
    "bench/parity/run.py": {"row['close']"},
    "bench/soak/run.py": {"env.nan_resets.sum()"},
    "cli/bench/experts.py": {"done.values()"},
    "cli/datasets/data.py": {"count"},
    "cli/output.py": {"widths"},
    "data/export/lerobot/card.py": {"each.interventions"},
    "data/export/lerobot/features.py": {"widths.values()"},
    "data/record/quotas.py": {"n"},
    "data/record/recorder.py": {"parts.values()"},
    "data/select/sets.py": {"map(len, groups.values())"},
    "data/store/reading.py": {
        "dataset(self._group, path).id.get_storage_size()",
    },
    "data/store/schema.py": {"_width(name)"},
    "envs/parts/memory.py": {"PIXEL_BYTES[name]", "drawn"},
    "evaluation/generate.py": {"done.errors.values()"},
    "evaluation/score/capabilities.py": {"capability.shown(record)"},
    "evaluation/score/summary.py": {
        "_begins_elsewhere(asked, episode)",
        "asked.count(row)",
    },
    "experts/planning/reach.py": {"map(len, found)"},
    "layout/contact_sensors.py": {"1 << field"},
    "learning/observation/spec.py": {"width", "widths"},
    "learning/observation/parts.py": {"width"},
    "paper/ms_hab/sac.py": {
        "size(shapes, f'{_PIXELS}{camera}.projection.0.weight', 0, 50)",
    },
    "learning/reinforcement/session.py": {"self._outcomes"},
    "learning/students/routed.py": {"widths", "widths[:number]"},
    "learning/runs/imitation.py": {"tried_in(self.place(out, name))"},
    "paper/reproduce/results.py": {"summary['demonstrations']"},
    "evaluation/score/perturbed.py": {"self.won.values()"},
    "reports/compared/paired.py": {
        "math.comb(coins, k)",
        "part.both",
        "part.neither",
    },
    "reports/plots.py": {"counts[kind].values()"},
}
"""Further sums of integers or truth values: what is added, by file."""
ARRAY_SUMS = {
    "data/select/statistics.py": {
        "piece.sum(axis=0, dtype=np.float64)",
        "((piece - mean) ** 2).sum(axis=0)",
    }
}
"""Sums of arrays, which no version of Python compensates."""
UNORDERED_FILES = {
    "core/files/cache.py": "links every folder, in any order",
    "episodes/spawn_factory.py": "deletes every file",
}
"""Files of COMPUTING that list a folder without sorting, and why its order does not matter."""
FORBIDDEN_IN_MATH = {"fsum", "sumprod", "fma"}
FORBIDDEN_MODULES = {"random", "statistics"}


Nodes = tuple[ast.AST, ...]


@functools.cache
def sources() -> dict[str, Nodes]:
    """All nodes of every file; walking through a tree takes longer than making it."""
    return {
        path.relative_to(SOURCE).as_posix(): nodes_of(path.read_text(encoding="utf-8"))
        for path in sorted(SOURCE.rglob("*.py"))
    }


def nodes_of(source: str) -> Nodes:
    return tuple(ast.walk(ast.parse(source)))


def summands(nodes: Nodes) -> Iterator[ast.expr]:
    """What every use of the built-in ``sum`` adds: the element of its comprehension, or its argument."""
    called = {id(node.func): node for node in nodes if isinstance(node, ast.Call)}
    for node in nodes:
        if isinstance(node, ast.Name) and node.id == "sum":
            call = called.get(id(node))
            # Not called here: sum is handed on, and nobody knows what it will add.
            added = call.args[0] if call else node
            yield added.elt if isinstance(added, ast.GeneratorExp) else added


def is_integer(node: ast.expr) -> bool:
    """Whether an expression is an integer or a truth value, by its form."""
    if isinstance(node, ast.Constant):
        return isinstance(node.value, int)
    if isinstance(node, ast.Compare):
        return True
    if isinstance(node, ast.UnaryOp):
        return isinstance(node.op, ast.Not) or is_integer(node.operand)
    if isinstance(node, ast.BoolOp):
        return all(is_integer(value) for value in node.values)
    if isinstance(node, ast.BinOp):
        exact = isinstance(node.op, ast.Add | ast.Sub | ast.Mult)
        return exact and is_integer(node.left) and is_integer(node.right)
    if isinstance(node, ast.Attribute):
        return node.attr in INTEGER_FIELDS
    if isinstance(node, ast.Subscript):
        key = node.slice
        named = isinstance(key, ast.Constant) and key.value in INTEGER_FIELDS
        return named or (isinstance(node.value, ast.Attribute) and is_integer(node.value))
    if isinstance(node, ast.Call):
        name = node.func.attr if isinstance(node.func, ast.Attribute) else ""
        name = node.func.id if isinstance(node.func, ast.Name) else name
        return name in INTEGER_CALLS or name.endswith("_size_in_bytes")
    return False


def test_no_built_in_sum_of_floats() -> None:
    """Since Python 3.12 it compensates rounding errors: the last bits would depend on the version."""
    wrong: list[str] = []
    listed = {
        (file, text)
        for sums in (INTEGER_SUMS, ARRAY_SUMS)
        for file, texts in sums.items()
        for text in texts
    }
    for file, nodes in sources().items():
        for added in summands(nodes):
            text = ast.unparse(added)
            if (file, text) not in listed and not is_integer(added):
                wrong.append(f"{file}:{added.lineno}: sum of {text}")
    assert not wrong, (
        "built-in sum of what may be floats; take mjhab.core.arithmetic.sums.ordered_sum, or "
        f"list it here if it adds integers: {wrong}"
    )


@pytest.mark.parametrize(
    "source",
    [
        "sum(g.volume for g in geoms)",
        "sum(sides)",
        "add = sum",
        "functools.reduce(sum, rows)",
        "sum(a * b for a, b in pairs)",
        "sum(values[1:])",
        "sum([0.5, x])",
    ],
)
def test_the_rule_finds_sums_of_floats(source: str) -> None:
    found = list(summands(nodes_of(source)))
    assert len(found) == 1 and not is_integer(found[0])


def test_nothing_else_that_differs_between_versions_or_runs() -> None:
    wrong: list[str] = []
    for file, nodes in sources().items():
        # Benches take medians of times; policies of others may use the global generators, which are seeded.
        if not file.startswith(("bench/", "evaluation/global_random")):
            for node in nodes:
                wrong += [f"{file}:{line}: {what}" for line, what in _faults(node)]
    assert not wrong, wrong


def _faults(node: ast.AST) -> Iterator[tuple[int, str]]:
    if isinstance(node, ast.Import):
        names = {alias.name.split(".")[0] for alias in node.names}
        for name in sorted(names & FORBIDDEN_MODULES):
            yield node.lineno, f"import {name}"
    if isinstance(node, ast.ImportFrom) and node.level == 0:
        named = {alias.name for alias in node.names}
        if node.module in FORBIDDEN_MODULES:
            yield node.lineno, f"from {node.module}"
        if node.module == "math" and named & FORBIDDEN_IN_MATH:
            yield node.lineno, f"from math import {named & FORBIDDEN_IN_MATH}"
    spelt = {f"math.{name}" for name in FORBIDDEN_IN_MATH}
    if isinstance(node, ast.Attribute) and ast.unparse(node) in spelt:
        yield node.lineno, ast.unparse(node)


def test_starts_use_no_function_whose_bits_depend_on_the_processor() -> None:
    found = [
        (path, node.lineno, node.attr)
        for path, nodes in sources().items()
        if path.split("/")[0] in STARTING
        for node in nodes
        if isinstance(node, ast.Attribute)
        and node.attr in BY_PROCESSOR
        and isinstance(node.value, ast.Name)
        and node.value.id in ("np", "xp")
    ]
    # Without an axis the norm of a vector is a product of BLAS.
    found += [
        (path, node.lineno, "norm")
        for path, nodes in sources().items()
        if path.split("/")[0] in STARTING
        for node in nodes
        if isinstance(node, ast.Call)
        and ast.unparse(node.func) == "np.linalg.norm"
        and not node.keywords
    ]
    assert found == []


def test_folders_are_listed_in_order() -> None:
    wrong: list[str] = []
    unordered: set[str] = set()
    for file, nodes in sources().items():
        if file.split("/")[0] not in COMPUTING:
            continue
        ordered = {
            id(inner)
            for node in nodes
            if isinstance(node, ast.Call)
            and isinstance(node.func, ast.Name)
            and node.func.id in ("sorted", "any", "all")
            for inner in ast.walk(node)
        }
        for node in nodes:
            if not isinstance(node, ast.Attribute):
                continue
            listing = node.attr in (
                "glob",
                "rglob",
                "iterdir",
                "scandir",
                "listdir",
            )
            if listing and id(node) not in ordered:
                unordered.add(file)
                if file not in UNORDERED_FILES:
                    wrong.append(f"{file}:{node.lineno}")
    assert not wrong, f"files come in an order that depends on the disk: {wrong}"
    assert unordered == set(UNORDERED_FILES)


def test_sets_are_not_walked_through() -> None:
    """The order of a set of strings changes from process to process."""
    wrong = [
        f"{file}:{node.iter.lineno}"
        for file, nodes in sources().items()
        if file.split("/")[0] in COMPUTING
        for node in nodes
        if isinstance(node, ast.For)
        and _is_set(node.iter)
        # Only checks, which raise for any of them.
        and file != "episodes/spawn_sets.py"
    ]
    assert not wrong, f"sort it: {wrong}"


def _is_set(node: ast.expr) -> bool:
    name = (
        node.func.id
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
        else ""
    )
    return isinstance(node, ast.Set | ast.SetComp) or name in ("set", "frozenset")


def test_ordered_sum_adds_from_left_to_right() -> None:
    values = [1e16, 1.0, -1e16, 1.0, 0.1, 0.2]
    total = 0.0
    for value in values:
        total = total + value
    assert ordered_sum(iter(values)) == total != 2.3
    assert ordered_sum([0.1] * 10) == 0.9999999999999999
    assert ordered_sum([]) == 0.0 and ordered_sum([3]) == 3.0
