"""Training: `train` is `mjhab.train`; ``mjhab train`` calls `train_spec` with a specification of its options."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mjhab.core.errors import unknown_name
from mjhab.learning.reinforcement.specs import (
    PpoSpec,
    ReinforcementSpec,
    RlpdSpec,
    SacSpec,
)
from mjhab.learning.require import require_learn
from mjhab.learning.runs.run import TrainingResult
from mjhab.learning.runs.specs import (
    ActSpec,
    BcSpec,
    DaggerSpec,
    DiffusionSpec,
    FlowSpec,
    ImitationSpec,
)

SPECS: Mapping[str, type[ImitationSpec] | type[ReinforcementSpec]] = {
    kind.ALGORITHM: kind
    for kind in (
        BcSpec,
        FlowSpec,
        ActSpec,
        DiffusionSpec,
        DaggerSpec,
        PpoSpec,
        SacSpec,
        RlpdSpec,
    )
}
"""Specifications by the names of algorithms."""


def train(algorithm: str, *, out: Path | str, **options: Any) -> TrainingResult:
    """Train a policy and write a folder with its checkpoints, evaluations and a report, as ``mjhab train`` does.

    >>> import mjhab
    >>> result = mjhab.train(
    ...     "bc", out="runs/close", preset="state", subtask="close", target="kitchen_counter/drawer3",
    ...     home="builtin_m0_00", demos=1, style=["plan=rule"], updates=2, set=["optimizer.batch=8"], worlds=1,
    ...     threads=1, eval_episodes=0, round_episodes=0,
    ... )
    >>> result.summary["steps"], result.summary["trained"]
    (2, True)
    >>> run = mjhab.evaluate(
    ...     result.summary["checkpoint"], subtask="close", target="kitchen_counter/drawer3",
    ...     home="builtin_m0_00", episodes=1, films=0, out="runs/close_eval",
    ... )
    >>> run.summary["episodes"]
    1

    Args:
        algorithm: bc, flow, act, diffusion or dagger, which imitate the expert; ppo, sac or rlpd, which are rewarded.
        out: folder of the run.
        **options: fields of the algorithm's specification, such as `DaggerSpec` or `PpoSpec`, and of `EnvConfig` for
            the environment.

    Returns:
        The results: ``result.summary``, ``result.report``. Ctrl-C keeps a checkpoint and sets ``result.interrupted``.

    Raises:
        UsageError: an option is unknown or invalid, a library is missing, or data, folder or environment do not fit.
        BrokenLossError: a loss became NaN; the weights from before it are kept.
    """
    if algorithm not in SPECS:
        raise unknown_name("algorithm", algorithm, SPECS)
    return train_spec(SPECS[algorithm].of(out=out, **options))


def train_spec(spec: ImitationSpec | ReinforcementSpec) -> TrainingResult:
    """Train what a specification asks for; see `train`."""
    require_learn()
    from mjhab.learning.reinforcement.train import train_reinforcement
    from mjhab.learning.runs.train import open_session, run_session

    if isinstance(spec, ReinforcementSpec):
        return train_reinforcement(spec)
    with open_session(spec) as session:
        return run_session(session)
