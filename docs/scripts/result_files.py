"""What the tables of results share: their files under docs/results, cells, and the places in pages that they fill."""

from __future__ import annotations

import datetime
import json
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

DOCS = Path(__file__).parents[1]
RESULTS = DOCS / "results"
TASKS = ("tidy_house", "prepare_groceries", "set_table")
SUBTASKS = ("pick", "place", "open", "close", "navigate")
END = "<!-- end -->"

Row = dict[str, Any]
Table = Callable[[], str]


def read(name: str) -> dict[str, Any]:
    """The results of docs/results/NAME.json."""
    return json.loads((RESULTS / f"{name}.json").read_text(encoding="utf-8"))


def write(name: str, content: Mapping[str, Any]) -> None:
    """Put results into docs/results/NAME.json."""
    text = json.dumps(content, indent=1, ensure_ascii=False) + "\n"
    (RESULTS / f"{name}.json").write_text(text, encoding="utf-8")


def place_of(row: Row) -> tuple[int, int, str]:
    """The place of a row in tables: by task, subtask and target."""
    return (TASKS.index(row["task"]), SUBTASKS.index(row["subtask"]), row["target"])


def percent(share: float, digits: int = 0) -> str:
    """A share as a cell."""
    return f"{100 * share:.{digits}f}"


def interval(bounds: Sequence[float]) -> str:
    """The bounds of an interval of shares as a cell [%]."""
    low, high = bounds
    return f"{percent(low)}-{percent(high)}"


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def source(*names: str) -> str:
    """Where the numbers of a table come from: date, version and command of its files, and links to these.

    Links begin with ``RESULTS/``: ``fill`` replaces it by the path from the page.
    """
    told = []
    for name in names:
        about = read(name)
        file = f"[{name}.json](RESULTS/{name}.json)"
        told.append(f"{origin(about)}; {file}.")
    return "\n\n" + "\n".join(told)


def origin(about: Mapping[str, str]) -> str:
    """Date, version and command of results as a phrase."""
    days = [datetime.date.fromisoformat(day) for day in about["date"].split("/")]
    when = " to ".join(f"{day.day} {day:%B %Y}" for day in days)
    return f"Measured {when} with mjhab {about['version']}: `{about['command']}`"


def fill(page: Path, tables: Mapping[str, Table]) -> str:
    """The text of a page, every ``<!-- table: NAME -->`` ... ``<!-- end -->`` filled anew.

    Raises:
        KeyError: the page asks for a table that there is not.
    """
    mark = "<!-- table: "
    head, *parts = page.read_text(encoding="utf-8").split(mark)
    text = head
    folder = os.path.relpath(RESULTS, page.parent)
    for part in parts:
        name, _, rest = part.partition(" -->\n")
        made = tables[name]().replace("](RESULTS/", f"]({folder}/")
        made = made.replace("](./", "](")
        text += f"{mark}{name} -->\n{made}\n{END}{rest.partition(END)[2]}"
    return text


def pages() -> list[Path]:
    """README and all pages that have a table."""
    found = [DOCS.parent / "README.md", *sorted(DOCS.rglob("*.md"))]
    return [page for page in found if "<!-- table: " in page.read_text(encoding="utf-8")]
