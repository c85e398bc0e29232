"""``mjhab bench soak``: errors and memory growth in a long run."""

from __future__ import annotations

import json
from typing import Any

from mjhab.bench.soak.memory_plot import memory_picture
from mjhab.bench.soak.run import MAX_GROWTH, soak
from mjhab.cli.options.env import BenchSoakOptions
from mjhab.cli.output import at_least, print_json, print_table
from mjhab.core.errors import UsageError
from mjhab.core.files.cache import write_atomic
from mjhab.core.files.outputs import check_folder

RESULTS = "soak.json"
PICTURE = "memory.svg"


def bench_soak(options: BenchSoakOptions) -> int:
    """Print the results of `soak`; returns 1 if memory changed by more than 3 % over the second half.

    Raises:
        UsageError: a number is out of range, or an option is given that only generation has.
    """
    for name in ("steps", "worlds"):
        at_least(name, getattr(options, name), 1)
    for name in ("threads", "seed", "generate"):
        at_least(name, getattr(options, name), 0)
    if options.subtask is not None and not options.generate:
        raise UsageError(
            "--subtask needs --generate: random actions step the environments of all subtasks."
        )
    if options.out is not None:
        check_folder(options.out)
    found = soak(options)
    if options.out is not None:
        _write(options, found)
    if options.json:
        print_json(found)
    else:
        _print(found)
    return 0 if found["ok"] else 1


def _write(options: BenchSoakOptions, found: dict[str, Any]) -> None:
    assert options.out is not None
    name = "generation with the expert" if options.generate else "random actions"
    picture = memory_picture({name: found})
    text = json.dumps(found, indent=1) + "\n"
    write_atomic(
        options.out / RESULTS, lambda path: path.write_text(text, encoding="utf-8")
    )
    write_atomic(
        options.out / PICTURE, lambda path: path.write_text(picture, encoding="utf-8")
    )


def _print(found: dict[str, Any]) -> None:
    shown = {name: value for name, value in found.items() if name != "curve"}
    rows = [
        (k, ", ".join(f"{n} {c}" for n, c in v.items()) if isinstance(v, dict) else v)
        for k, v in shown.items()
    ]
    print_table("Memory over a long time", ("what", "value"), rows)
    print(
        f"Memory changed by {100 * found['growth_second_half']:+.1f} % over the second half; "
        f"{100 * MAX_GROWTH:.0f} % are allowed."
    )
