"""``mjhab bench soak``: does anything break or grow over a long time?"""

from __future__ import annotations

from mjhab.bench.soak import MOST_GROWTH, soak
from mjhab.cli.options.env import BenchSoakOptions
from mjhab.cli.output import at_least, print_json, print_table


def bench_soak(options: BenchSoakOptions) -> int:
    """Print what `soak` finds; fails if memory grew by more than 3 %."""
    for name in ("steps", "worlds"):
        at_least(name, getattr(options, name), 1)
    at_least("threads", options.threads, 0)
    at_least("seed", options.seed, 0)
    found = soak(options)
    if options.json:
        print_json(found)
    else:
        rows = [
            (k, ", ".join(f"{n} {c}" for n, c in v.items()) if isinstance(v, dict) else v)
            for k, v in found.items()
        ]
        print_table(
            f"{found['steps']:,} control steps with random actions", ("what", "value"), rows
        )
    return 1 if found["rss_growth"] > MOST_GROWTH else 0
