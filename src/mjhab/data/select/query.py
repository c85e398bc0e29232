"""The filter language: boolean expressions about episodes, validated before any episode is read.

`label in ('straightforward_success', 'winding_success') and max_force < 1400 and not dropped`

Python's parser parses the text, and this module checks and compiles the syntax tree node by node. The text is never
executed as Python code.
"""

from __future__ import annotations

import ast
import difflib
import math
import operator
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from mjhab.core.errors import UsageError, unknown_name, wrong_value
from mjhab.data.select.facts import FUNCTIONS, NUMBER, TEXT, TEXTS, TRUTH, Fact, facts
from mjhab.data.store.episode_data import RunInfo
from mjhab.rollout.records import EpisodeRecord
from mjhab.tasks.subtasks.registry import event_columns

# Python's parser may exhaust the stack on longer or deeper texts.
LONGEST = 4000
"""Longest filter [characters]."""
DEEPEST = 40
"""Deepest nesting of a filter."""
_NUMBERS = "a list of numbers"
_CONSTANTS = {"true": True, "false": False}
_ORDER: dict[type[ast.cmpop], Callable[[Any, Any], bool]] = {
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
}
_EQUAL: dict[type[ast.cmpop], Callable[[Any, Any], bool]] = {
    ast.Eq: operator.eq,
    # Python's nan != 1 is true, and would select events that did not occur.
    ast.NotEq: lambda a, b: a != b and not (_is_nan(a) or _is_nan(b)),
}
_MATH: dict[type[ast.operator], Callable[[float, float], float]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    # One episode of 0 steps must not end the selection of all.
    ast.Div: lambda a, b: a / b if b else math.nan,
}

PRESETS: dict[str, tuple[str, str]] = {
    "pick_paper": (
        "subtask == 'pick' and label == 'straightforward_success'",
        "Pick as in the paper's data",
    ),
    "place_paper": (
        "subtask == 'place' and label == 'placed_in_goal_success'",
        "Place as in the paper's data",
    ),
    "open_paper": (
        "subtask == 'open' and label == 'open_success'",
        "Open as in the paper's data",
    ),
    "close_paper": (
        "subtask == 'close' and label == 'closed_success'",
        "Close as in the paper's data",
    ),
    "pick_published": (
        "subtask == 'pick' and legacy_label == 'straightforward_success'",
        "Pick as mshab/utils/gen/gen_data.py keeps it, by the published rules of labels",
    ),
    "place_published": (
        "subtask == 'place' and legacy_label == 'placed_in_goal_success'",
        "Place as mshab/utils/gen/gen_data.py keeps it, by the published rules of labels",
    ),
    "open_published": (
        "subtask == 'open' and legacy_label == 'open_success'",
        "Open as mshab/utils/gen/gen_data.py keeps it, by the published rules of labels",
    ),
    "close_published": (
        "subtask == 'close' and (legacy_label == 'closed_success' or "
        "legacy_label == 'success_then_excessive_collisions' and furniture == 'fridge')",
        "Close as mshab/utils/gen/gen_data.py keeps it: for the fridge also with too much force after success",
    ),
    "navigate_published": (
        "subtask == 'navigate' and legacy_label == 'navigation_success'",
        "Navigate as mshab/utils/gen/gen_data.py keeps it, by the published rules of labels",
    ),
    "gentle": (
        "success and max_force < 1400",
        "reached the goal, never more than 1,400 N",
    ),
    "chain": ("subtask == '' and success", "whole chains that were completed"),
}
"""Named filters as (filter, meaning). NAME_paper selects the demonstrations of the MS-HAB paper, App. A.6.1, by mjhab's
labels; NAME_published those of MS-HAB's code, by the labels of that code."""


SHOWN_CHARACTERS = 120
"""Number of characters of a filter that an error shows before and after the column."""


class FilterError(UsageError):
    """A filter is invalid; ``column`` (from 1) is the position of the error."""

    def __init__(self, text: str, column: int, problem: str) -> None:
        self.column = column
        begin = max(0, column - 1 - SHOWN_CHARACTERS)
        shown = text[begin : column - 1 + SHOWN_CHARACTERS]
        caret = " " * (column - 1 - begin)
        # A part of the text around the column, so that the caret stands on the same line.
        super().__init__(f"filter, column {column}: {problem}\n  {shown}\n  {caret}^")


@dataclass(frozen=True)
class _Part:
    """A compiled node of a filter.

    kind: type of its value. get: computes the value. fact: set if the node is a name. literals: texts in the node.
    """

    kind: str
    get: Callable[[EpisodeRecord, RunInfo], Any]
    fact: Fact | None = None
    literals: tuple[tuple[str, ast.AST], ...] = ()


class Filter:
    """A compiled filter on episodes, called as ``filter(record, run)``.

    Tainted episodes do not pass unless the text uses ``tainted`` or ``taints``: their physics is not reliable, so they
    must not enter a data set by accident.

    Raises:
        FilterError: the text is invalid; the message shows the position and, if possible, the nearest valid name.
    """

    def __init__(self, text: str) -> None:
        self.text = text
        compiler = _Compiler(text)
        self._root = compiler.compile()
        self.names = frozenset(compiler.names)

    @classmethod
    def preset(cls, name: str) -> Filter:
        """The filter of one of PRESETS.

        Raises:
            UsageError: no preset of that name.
        """
        if name not in PRESETS:
            raise unknown_name("preset", name, PRESETS)
        return cls(PRESETS[name][0])

    @property
    def lets_taint_in(self) -> bool:
        """Whether the text itself selects or excludes tainted episodes."""
        return bool(self.names & {"tainted", "taints"})

    def holds(self, record: EpisodeRecord, run: RunInfo) -> bool:
        """Value of the expression for an episode, whether tainted or not."""
        return bool(self._root.get(record, run))

    def __call__(self, record: EpisodeRecord, run: RunInfo) -> bool:
        """Whether an episode passes."""
        return (self.lets_taint_in or not record.taint) and self.holds(record, run)


def read_filter(where: str | None, preset: str | None) -> Filter | None:
    """Combine a filter text and a preset; episodes must pass both. None if neither is given.

    Raises:
        UsageError: the text is invalid or the preset unknown.
    """
    if preset is None:
        return None if where is None else Filter(where)
    named = Filter.preset(preset)
    if where is None:
        return named
    # Compiled on its own first, so that columns of errors count in what the user typed.
    return Filter(f"({named.text}) and ({Filter(where).text})")


def _is_nan(value: Any) -> bool:
    """Whether a value is NaN, as of an event that did not occur; every comparison with it is false."""
    return isinstance(value, float) and math.isnan(value)


class _Compiler:
    """Compiles and validates the text of a filter."""

    def __init__(self, text: str) -> None:
        self.text = text
        self.names = set[str]()
        self._lead = self._depth = 0

    def compile(self) -> _Part:
        """Compile the whole text."""
        if not self.text.strip():
            raise FilterError(
                self.text,
                1,
                "the filter is empty; for instance: success and max_force < 1400",
            )
        if len(self.text) > LONGEST:
            raise wrong_value(
                "characters of the filter", len(self.text), f"at most {LONGEST}"
            )
        lead = len(self.text) - len(self.text.lstrip())
        # One line, so that columns of the parser are places in the text.
        self.text = self.text.replace("\n", " ").replace("\t", " ")
        try:
            tree = ast.parse(self.text.lstrip(), mode="eval")
        except SyntaxError as error:
            column = max(1, min((error.offset or 1) + lead, len(self.text)))
            raise FilterError(self.text, column, self._syntax(error)) from None
        # What Python's parser raises for zero bytes and for brackets without end.
        except (ValueError, MemoryError, RecursionError):
            raise FilterError(self.text, 1, "too deeply nested, or not text") from None
        self._lead = lead
        return self._truth(tree.body, "a filter")

    def _syntax(self, error: SyntaxError) -> str:
        # Signs of other languages, of which Python's own message says nothing useful.
        for wrong, right in (("&&", "and"), ("||", "or"), ("!(", "not ("), ("<>", "!=")):
            if wrong in self.text:
                return f"write {right!r} instead of {wrong!r}"
        if self.text[
            (error.offset or 1) - 1 + len(self.text) - len(self.text.lstrip()) :
        ].startswith("="):
            return "write == to compare"
        return f"cannot be read: {error.msg}"

    def _error(self, node: ast.AST, problem: str) -> FilterError:
        before = (
            self.text.lstrip()
            # Python counts columns in bytes of UTF-8.
            .encode()[: getattr(node, "col_offset", 0)]
            .decode(errors="replace")
        )
        return FilterError(self.text, len(before) + self._lead + 1, problem)

    def _truth(self, node: ast.AST, what: str) -> _Part:
        part = self._part(node)
        if part.kind != TRUTH:
            raise self._error(
                node,
                f"{what} needs {TRUTH}, but this is {part.kind}; compare it, as in steps < 100",
            )
        return part

    def _number(self, node: ast.AST, what: str) -> _Part:
        part = self._part(node)
        if part.kind != NUMBER:
            raise self._error(node, f"{what} needs numbers, but this is {part.kind}")
        return part

    def _part(self, node: ast.AST) -> _Part:
        maker = {
            ast.BoolOp: self._bool_op,
            ast.UnaryOp: self._unary,
            ast.Compare: self._compare,
            ast.BinOp: self._binary,
            ast.Name: self._name,
            ast.Attribute: self._name,
            ast.Constant: self._constant,
            ast.Tuple: self._list,
            ast.List: self._list,
            ast.Set: self._list,
            ast.Call: self._call,
            # Names of known nodes only: everything else of Python, such as calls of methods, is refused.
        }.get(type(node))
        if maker is None:
            raise self._error(
                node,
                "only names, numbers, texts, lists, comparisons, + - * /, and, or, not are known",
            )
        self._depth += 1
        if self._depth > DEEPEST:
            raise self._error(node, f"nested deeper than {DEEPEST} levels")
        part = maker(node)  # type: ignore[arg-type]
        self._depth -= 1
        return part

    def _bool_op(self, node: ast.BoolOp) -> _Part:
        # Both stop at the first part that decides, as in Python.
        word, gather = ("and", all) if isinstance(node.op, ast.And) else ("or", any)
        parts = [self._truth(value, f"{word!r}") for value in node.values]
        return _Part(TRUTH, lambda r, run: gather(part.get(r, run) for part in parts))

    def _unary(self, node: ast.UnaryOp) -> _Part:
        if isinstance(node.op, ast.Not):
            inner = self._truth(node.operand, "'not'")
            return _Part(TRUTH, lambda r, run: not inner.get(r, run))
        if not isinstance(node.op, ast.USub | ast.UAdd):
            raise self._error(node, "unknown sign; write 'not' for the opposite")
        inner = self._number(node.operand, "a sign")
        sign = -1 if isinstance(node.op, ast.USub) else 1
        return _Part(NUMBER, lambda r, run: sign * inner.get(r, run))

    def _binary(self, node: ast.BinOp) -> _Part:
        compute = _MATH.get(type(node.op))
        if compute is None:
            raise self._error(
                node, "only + - * / are known; write 'and' and 'or' for & and |"
            )
        a = self._number(node.left, "arithmetic")
        b = self._number(node.right, "arithmetic")
        return _Part(NUMBER, lambda r, run: compute(a.get(r, run), b.get(r, run)))

    def _compare(self, node: ast.Compare) -> _Part:
        sides = [node.left, *node.comparators]
        parts = [self._part(side) for side in sides]
        tests = [
            self._test(op, a, b, where)
            for op, a, b, where in zip(
                node.ops, parts, parts[1:], sides[1:], strict=False
            )
        ]

        def holds(record: EpisodeRecord, run: RunInfo) -> bool:
            values = [part.get(record, run) for part in parts]
            return all(
                test(a, b) for test, a, b in zip(tests, values, values[1:], strict=False)
            )

        return _Part(TRUTH, holds)

    def _test(
        self, op: ast.cmpop, a: _Part, b: _Part, where: ast.AST
    ) -> Callable[[Any, Any], bool]:
        if isinstance(op, ast.In | ast.NotIn):
            element = {TEXTS: TEXT, _NUMBERS: NUMBER}.get(b.kind)
            if element is None:
                raise self._error(
                    where,
                    f"'in' needs a list, but this is {b.kind}; a list of one is ('a',)",
                )
            if a.kind != element:
                raise self._error(where, f"{a.kind} is never in {b.kind}")
            self._check_choices(a, b)
            return (
                (lambda x, y: x in y)
                if isinstance(op, ast.In)
                # An event that did not occur is neither in a list nor outside of it.
                else (lambda x, y: x not in y and not _is_nan(x))
            )
        if a.kind != b.kind:
            raise self._error(where, f"{a.kind} cannot be compared with {b.kind}")
        if type(op) in _ORDER:
            if a.kind != NUMBER:
                raise self._error(where, f"{a.kind} has no order; use == or !=")
            return _ORDER[type(op)]
        if type(op) not in _EQUAL:
            raise self._error(where, "write == or != instead of is")
        # A misspelt label would pass no episode, and nobody would see why.
        self._check_choices(a, b)
        return _EQUAL[type(op)]

    def _check_choices(self, a: _Part, b: _Part) -> None:
        for fact_side, literal_side in ((a, b), (b, a)):
            choices = fact_side.fact.choices if fact_side.fact else ()
            for value, node in literal_side.literals if choices else ():
                if value not in choices:
                    assert fact_side.fact is not None
                    raise self._unknown(
                        node, f"{fact_side.fact.name} is never", value, choices
                    )

    def _unknown(
        self, node: ast.AST, what: str, given: str, valid: Iterable[str]
    ) -> FilterError:
        names = sorted(filter(None, valid))
        near = difflib.get_close_matches(given, names, n=1, cutoff=0.5)
        rest = f"Did you mean {near[0]!r}?" if near else f"Known: {', '.join(names)}."
        return self._error(
            node, f"{what} {given!r}. {rest} (`mjhab data fields` explains all names)"
        )

    def _name(self, node: ast.Name | ast.Attribute) -> _Part:
        if isinstance(node, ast.Name):
            name = node.id
        elif isinstance(node.value, ast.Name):
            # This is the name of a fact with a dot, such as style.speed, not an attribute access.
            name = f"{node.value.id}.{node.attr}"
        else:
            raise self._error(
                node, "only names with one point are known, as in style.speed"
            )
        if name in _CONSTANTS:
            return _Part(TRUTH, lambda r, run: _CONSTANTS[name])
        fact = facts().get(name)
        if fact is None:
            raise self._unknown(node, "unknown name", name, facts())
        self.names.add(name)
        return _Part(fact.kind, fact.get, fact)

    def _constant(self, node: ast.Constant) -> _Part:
        value = node.value
        # Before numbers, because a bool is an int to Python.
        if isinstance(value, bool):
            return _Part(TRUTH, lambda r, run: value)
        if isinstance(value, int | float):
            return _Part(NUMBER, lambda r, run: value)
        if isinstance(value, str):
            return _Part(TEXT, lambda r, run: value, literals=((value, node),))
        raise self._error(node, f"{value!r} is neither a number nor a text")

    def _list(self, node: ast.Tuple | ast.List | ast.Set) -> _Part:
        parts = [self._part(entry) for entry in node.elts]
        kinds = {part.kind for part in parts}
        # With facts in a list its type and its choices could not be checked.
        if kinds not in ({TEXT}, {NUMBER}) or any(part.fact for part in parts):
            raise self._error(node, "a list holds texts or numbers, and at least one")
        values = [part.get for part in parts]
        literals = tuple(entry for part in parts for entry in part.literals)
        kind = TEXTS if kinds == {TEXT} else _NUMBERS
        return _Part(
            kind, lambda r, run: [get(r, run) for get in values], literals=literals
        )

    def _call(self, node: ast.Call) -> _Part:
        name = node.func.id if isinstance(node.func, ast.Name) else ""
        if name not in FUNCTIONS:
            raise self._unknown(node, "unknown function", name or "?", FUNCTIONS)
        argument = node.args[0] if len(node.args) == 1 and not node.keywords else None
        event = (
            argument.value
            if isinstance(argument, ast.Constant)
            # Both count('dropped') and count(dropped) are meant the same.
            else getattr(argument, "id", None)
        )
        if not isinstance(event, str):
            raise self._error(node, f"{name}() takes one event, as in {name}('dropped')")
        if event not in event_columns():
            raise self._unknown(argument or node, "unknown event", event, event_columns())
        compute = FUNCTIONS[name][1]
        return _Part(NUMBER, lambda r, run: compute(r, event))
