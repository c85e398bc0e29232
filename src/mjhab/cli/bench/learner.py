"""``mjhab bench learner``: speed of collection and updates in reinforcement learning."""

from __future__ import annotations

from mjhab.cli.options.policies.benches import BenchLearnerOptions
from mjhab.cli.output import at_least, print_json, print_table
from mjhab.learning.require import require_learn


def bench_learner(options: BenchLearnerOptions) -> int:
    """Print the results of `measure_learner`."""
    for name, least in (
        ("worlds", 0),
        ("rounds", 1),
        ("updates", 1),
        ("threads", 0),
        ("seed", 0),
    ):
        if getattr(options, name) is not None:
            at_least(name, getattr(options, name), least)
    at_least("batches", min(options.batches, default=0), 2)
    require_learn()
    from mjhab.bench.training.learner import measure_learner

    found = measure_learner(options)
    if options.json:
        print_json(found)
        return 0
    ppo = found["ppo"]
    names = {
        "ppo_sps": "PPO from states [control steps/s]",
        "env_sps": "its environment alone [control steps/s]",
        "ratio": "PPO / environment",
        "env_share": "share of the time in the environment",
        "learner_share": "share of the time in updates",
    }
    rows = [(told, ppo[name]) for name, told in names.items()]
    print_table(
        f"PPO, {ppo['worlds']} worlds, {found['threads']} threads",
        ("what", "value"),
        rows,
    )
    print_table(
        "SAC",
        ("inputs", "batch", "updates/s"),
        [
            (row["inputs"], row["batch"], row["updates_per_second"])
            for row in found["sac"]
        ],
    )
    return 0
