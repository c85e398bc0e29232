"""``mjhab bench sim`` and ``bench grasp``: simulation speed, and slip of grasped objects."""

from __future__ import annotations

from mjhab.bench.simulation.engine import measure_engine
from mjhab.cli.options.engine import BenchGraspOptions, BenchSimOptions
from mjhab.cli.output import at_least, print_json, print_table
from mjhab.robots.registry import DEFAULT_ROBOT


def bench_sim(options: BenchSimOptions) -> int:
    """Print control steps/s of the engine and of the environment, measured in the same run."""
    for name in ("worlds", "steps", "rounds"):
        at_least(name, getattr(options, name), 1)
    at_least("threads", options.threads, 0)
    at_least("seed", options.seed, 0)
    result = measure_engine(options)
    if options.json:
        print_json(result)
    else:
        rows = [
            ("bare engine", result["engine_sps"]),
            ("env.step without cameras", result["env_sps"]),
        ]
        robot = options.robot or DEFAULT_ROBOT
        title = f"{options.task}, {robot}, {options.worlds} worlds, {result['threads']} threads"
        print_table(title, ("what", "control steps/s over all worlds"), rows)
        print(
            f"the environment runs at {100 * result['ratio']:.0f} % of the bare engine; "
            f"resetting a world takes {result['reset_ms']:.1f} ms"
        )
    return 0


def bench_grasp(options: BenchGraspOptions) -> int:
    """Print how far objects slip in the moving gripper; returns 1 if one is dropped."""
    at_least("seed", options.seed, 0)
    at_least("seconds", options.seconds, 0.1)
    from mjhab.bench.simulation.grasp import grasp_table

    rows = grasp_table(
        seconds=options.seconds, seed=options.seed, robot=options.robot or DEFAULT_ROBOT
    )
    if options.json:
        print_json({"grasps": rows})
    else:
        columns = list(rows[0])
        print_table(
            f"{options.seconds:g} s of base and arm motion",
            columns,
            [[row[key] for key in columns] for row in rows],
        )
    return 1 if any(row["dropped"] for row in rows) else 0
