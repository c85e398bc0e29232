"""``mjhab bench interact``: the paper's Interact benchmark on either backend."""

from __future__ import annotations

from mjhab.bench.interact.run import CAMERA_SIZE, measure_interact, write_results
from mjhab.cli.options.gpu import BenchInteractOptions
from mjhab.cli.output import at_least, print_json, print_table
from mjhab.core.files.outputs import check_folder

_HEADS = {
    "worlds": "worlds",
    "sps_mean": "SPS",
    "sps_ci95": "± 95 %",
    "physics_ms": "phys",
    "render_ms": "render",
    "device_mb": "GPU MB",
    "rss_mb": "RSS MB",
    "moved": "moved",
    "tainted_worlds": "taint",
}


def bench_interact(options: BenchInteractOptions) -> int:
    """Print and write the results of `measure_interact`."""
    for name in ("seeds", "steps"):
        at_least(name, getattr(options, name), 1)
    at_least("worlds", min(options.worlds, default=0), 1)
    at_least("threads", options.threads, 0)
    check_folder(options.out)
    found, runs, pictures = measure_interact(options)
    write_results(options.out, found, runs, pictures)
    if options.json:
        print_json(found)
        return 0
    kind = (
        "no cameras" if options.no_render else f"2 x {CAMERA_SIZE} x {CAMERA_SIZE} RGB-D"
    )
    rows = [
        [len(p[k]) if k == "moved" else p[k] for k in _HEADS] for p in found["points"]
    ]
    print_table(
        f"Interact, {found['backend']} on {found['device']}, {kind}; stages in ms",
        tuple(_HEADS.values()),
        rows,
    )
    print(f"Plot of speed over memory: {options.out / 'report.html'}")
    return 0
