"""``mjhab bench reward``: how well the dense reward separates success from failure."""

from __future__ import annotations

from mjhab.bench.environments.reward import REPORT, measure_rewards
from mjhab.cli.options.env import BenchRewardOptions
from mjhab.cli.output import at_least, print_json, print_table
from mjhab.core.files.outputs import check_folder


def bench_reward(options: BenchRewardOptions) -> int:
    """Print and write the results of `measure_reward`."""
    for name in ("episodes", "worlds"):
        at_least(name, getattr(options, name), 1)
    check_folder(options.out)
    found = measure_rewards(options)
    report = options.out / REPORT
    if options.json:
        print_json({"profile": options.profile, "subtasks": found, "report": str(report)})
        return 0
    columns = list(next(iter(found.values())))
    rows = [[kind, *(numbers[c] for c in columns)] for kind, numbers in found.items()]
    title = f"normalised dense reward, profile {options.profile}"
    print_table(title, ("subtask", *columns), rows)
    print(f"Curves: {report}")
    return 0
