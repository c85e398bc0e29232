"""``mjhab bench windows``: speed of reading a data set for training."""

from __future__ import annotations

from mjhab.bench.training.windows import measure_windows
from mjhab.cli.options.datasets.data import BenchWindowsOptions
from mjhab.cli.output import at_least, print_json, print_table
from mjhab.core.errors import UsageError
from mjhab.learning.require import require_learn


def bench_windows(options: BenchWindowsOptions) -> int:
    """Print windows per second; returns 0."""
    for name in ("history", "chunk", "batch"):
        at_least(name, getattr(options, name), 1)
    at_least("seed", options.seed, 0)
    if not 0 < options.seconds <= 3600:
        raise UsageError(
            f"--seconds must be above 0 and at most 3600, got {options.seconds}."
        )
    require_learn()
    found = measure_windows(options)
    if options.json:
        print_json(found)
        return 0
    rows = [
        (name, f"{found[key]['per_s']:,.0f}", f"{found[key]['per_cpu_s']:,.0f}")
        for name, key in (
            ("first pass, which decodes", "first"),
            ("later passes", "later"),
        )
    ]
    title = f"{found['windows']:,} windows of {found['bytes_per_window']:,} bytes: {', '.join(found['images'])}"
    print_table(title, ("pass", "windows/s", "windows per second of CPU"), rows)
    return 0
