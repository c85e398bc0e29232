"""Fill the tables of all pages from docs/results/*.json: ``python docs/scripts/result_tables.py``.

A page asks for a table by ``<!-- table: NAME -->`` and ``<!-- end -->``. NAME is a function of one of the modules here,
or a study of docs/results/studies.json: columns, rows, date, version and command as they were measured.
"""

from __future__ import annotations

import argparse
import functools

import experts_tables
import gpu_tables
import parity_tables
import policies_tables
from result_files import Table, fill, origin, pages, read, table


def study(name: str) -> str:
    """The table of a study, and where its numbers come from."""
    found = read("studies")[name]
    told = f"{origin(found)}; [studies.json](RESULTS/studies.json)."
    return f"{table(found['columns'], found['rows'])}\n\n{told}"


def tables() -> dict[str, Table]:
    """Every table by its name."""
    made: dict[str, Table] = {}
    made |= experts_tables.TABLES | policies_tables.TABLES | gpu_tables.TABLES
    made |= parity_tables.TABLES
    return made | {name: functools.partial(study, name) for name in read("studies")}


def main() -> None:
    argparse.ArgumentParser(description=__doc__.split("\n")[0]).parse_args()
    known = tables()
    for page in pages():
        page.write_text(fill(page, known), encoding="utf-8")


if __name__ == "__main__":
    main()
