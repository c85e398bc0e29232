"""Success of a served policy by the latency of its answers: ``python -m benchmarks.latency``."""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.command import run_command
from mjhab.cli.output import Listing, report
from mjhab.core.files.cache import write_json, write_text
from mjhab.evaluation.evaluate import run_evaluation
from mjhab.evaluation.resolve import PolicyOptions
from mjhab.evaluation.specs import EvalSpec
from mjhab.reports.pages import Section, render_sections
from mjhab.serving import require_serving
from mjhab.serving.address import MEANWHILE

RESULT = "latency.json"
PAGE = "latency.html"


@dataclass(frozen=True)
class LatencySpec:
    """Evaluate a policy that is served while the world goes on, with simulated latencies, and draw the success by them.

    `python -m benchmarks.latency --policy student:set_table/close/kitchen_counter/drawer3`

    After a break the same command goes on.
    """

    policy: str = "student:set_table/close/kitchen_counter/drawer3"
    """What is served, as for `mjhab serve`."""
    task: str = "set_table"
    """The task."""
    subtask: str = "close"
    """The subtask."""
    target: str = "kitchen_counter/drawer3"
    """The object or link; "" for all."""
    profile: str = "ms_hab"
    """The profile."""
    latencies: tuple[float, ...] = (0.0, 50.0, 100.0, 200.0, 400.0)
    """Latencies of the answers [ms]."""
    meanwhile: tuple[str, ...] = MEANWHILE
    """What acts while the policy thinks."""
    execute: int = 2
    """Actions of a chunk that are executed before the next request."""
    episodes: int = 100
    """Episodes of each evaluation, of split val."""
    worlds: int = 8
    """Number of worlds."""
    out: Path = Path("runs/latency")
    """Folder with an evaluation for every latency, latency.json and latency.html."""
    json: bool = False
    """Print one line of JSON instead of a table."""


def measure(spec: LatencySpec) -> dict[str, Any]:
    """Success by what acts meanwhile and by latency, written to ``latency.json`` and ``latency.html``."""
    rows = []
    with _served(spec.policy) as port:
        for meanwhile in spec.meanwhile:
            for latency in spec.latencies:
                run = run_evaluation(_request(spec, port, meanwhile, latency))
                rows.append(
                    {
                        "meanwhile": meanwhile,
                        "latency_ms": latency,
                        "success_once": run.summary["success_once"],
                        "interval": list(run.summary["subtasks"][0]["interval"]),
                        "late_steps": run.summary["late_steps"],
                        "episodes": run.summary["episodes"],
                    }
                )
    found = {"policy": spec.policy, "execute": spec.execute, "rows": rows}
    write_json(spec.out / RESULT, found)
    write_text(spec.out / PAGE, page(found))
    return found


def _request(spec: LatencySpec, port: int, meanwhile: str, latency: float) -> EvalSpec:
    out = spec.out / f"{meanwhile}_{latency:g}"
    return EvalSpec(
        f"ws://127.0.0.1:{port}",
        episodes=spec.episodes,
        env={
            "task": spec.task,
            "subtask": spec.subtask,
            "target": spec.target,
            "profile": spec.profile,
            "split": "val",
            "num_envs": spec.worlds,
            # One thread leaves the other cores to the policy, which runs in this process, too.
            "threads": 1,
        },
        served={
            "real_time": True,
            "latency_ms": latency,
            "meanwhile": meanwhile,
            "execute": spec.execute,
        },
        films=0,
        out=out,
        # Evaluations with delays take as long as they say; a second start goes on.
        resume=out.exists(),
    )


@contextmanager
def _served(policy: str) -> Iterator[int]:
    """Serve a policy of mjhab in a thread of its own; the port."""
    require_serving()
    from mjhab.evaluation.served.twin import TwinResponder
    from mjhab.serving.dialects.names import dialect_named
    from mjhab.serving.server import PolicyServer, ServerOptions

    responder = TwinResponder(policy, PolicyOptions())
    server = PolicyServer(responder, dialect_named("openpi"), ServerOptions(port=0))
    thread = threading.Thread(target=server.run, daemon=True)
    thread.start()
    try:
        yield server.port
    finally:
        server.shutdown()
        thread.join()


def page(found: dict[str, Any]) -> str:
    """The report: success over latency, a line for what acts meanwhile."""
    ways = list(dict.fromkeys(row["meanwhile"] for row in found["rows"]))
    data = []
    for way in ways:
        rows = [row for row in found["rows"] if row["meanwhile"] == way]
        rate = [100 * row["success_once"] for row in rows]
        low, high = ([100 * row["interval"][k] for row in rows] for k in (0, 1))
        data.append(
            {
                "x": [row["latency_ms"] for row in rows],
                "y": rate,
                "error_y": {
                    "array": [h - r for h, r in zip(high, rate, strict=True)],
                    "arrayminus": [r - v for r, v in zip(rate, low, strict=True)],
                },
                "type": "scatter",
                "mode": "lines+markers",
                "name": way,
            }
        )
    layout = {
        "xaxis": {"title": {"text": "latency of the answers [ms]"}},
        "yaxis": {"title": {"text": "success once [%]"}, "range": [0, 100]},
        "height": 460,
    }
    hint = (
        f"{found['policy']}, {found['rows'][0]['episodes']} episodes of split val each, asked again after "
        f"{found['execute']} actions; whiskers: 95 % confidence."
    )
    sections = [Section("Success over latency", hint, chart="latency")]
    return render_sections(
        "A policy that thinks while the world goes on",
        sections,
        {"latency": {"data": data, "layout": layout}},
    )


def run(spec: LatencySpec) -> int:
    """Measure, and print what was found; returns 0."""
    found = measure(spec)
    rows = [
        (
            row["meanwhile"],
            f"{row['latency_ms']:g}",
            f"{100 * row['success_once']:.1f}",
            str(row["late_steps"]),
        )
        for row in found["rows"]
    ]
    columns = ("meanwhile", "ms", "success once %", "late steps")
    report(spec.json, found, Listing("Success by latency", columns, rows))
    return 0


def main(words: Sequence[str] | None = None) -> int:
    """Run the command line."""
    minima = {"latencies": 0, "execute": 1, "episodes": 1, "worlds": 1}
    return run_command("latency", LatencySpec, run, words, minima)


if __name__ == "__main__":
    sys.exit(main())
