"""``mjhab bench serving``: latency of a served policy, and the effect of killing its server."""

from __future__ import annotations

from mjhab.bench.serving import IMAGE_SIZE_PX, MAX_ADDED_MS, measure_serving
from mjhab.cli.options.policies.serve import BenchServingOptions
from mjhab.cli.output import at_least, print_json, print_table


def bench_serving(options: BenchServingOptions) -> int:
    """Print request latencies and results of episodes; returns 1 if an episode was lost or requests are too slow."""
    for name in ("worlds", "steps", "requests"):
        at_least(name, getattr(options, name), 1)
    at_least("restarts", options.restarts, 0)
    found = measure_serving(options)
    if options.json:
        print_json(found)
    else:
        rows = [
            (name, cost["p50"], cost["p99"]) for name, cost in found["requests"].items()
        ]
        title = f"A request with two images of {IMAGE_SIZE_PX} px [ms]"
        print_table(title, ("dialect", "median", "99 %"), rows)
        print_table(
            "A server that is killed", ("what", "value"), list(found["restarted"].items())
        )
    return 1 if found["lost"] or found["slowest_ms"] > MAX_ADDED_MS else 0
