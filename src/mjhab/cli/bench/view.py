"""``mjhab bench view``: frame rate, data rate and CPU time of the viewer."""

from __future__ import annotations

from mjhab.bench.view import MIN_FRAMES_PER_S, measure_view
from mjhab.cli.options.view import BenchViewOptions
from mjhab.cli.output import at_least, print_json, print_table


def bench_view(options: BenchViewOptions) -> int:
    """Print a row per number of worlds; returns 1 if the frame rate of a single world is too low."""
    at_least("seconds", options.seconds, 1)
    found = measure_view(options)
    if options.json:
        print_json(found)
    else:
        rows = [(worlds, *numbers.values()) for worlds, numbers in found.items()]
        columns = [name.replace("_", " ") for name in next(iter(found.values()))]
        print_table("The viewer", ("worlds", *columns), rows)
    single = found.get("1")
    return 1 if single is not None and single["frames_per_s"] < MIN_FRAMES_PER_S else 0
