"""Imitation of a fixed set of demonstrations: ``mjhab train bc|flow|act|diffusion``."""

from __future__ import annotations

from mjhab.learning.runs.collection import Round
from mjhab.learning.runs.session import Session

EVALUATIONS = 4
"""Number of evaluations in a run, at equal numbers of updates; the last one is the final evaluation."""


def train_supervised(session: Session) -> None:
    """Collect or load the demonstrations and make the remaining updates.

    Raises:
        OutOfTime: the budget is spent.
    """
    spec = session.spec
    config = session.config
    if spec.data:
        session.load(spec.data, spec.filter)
    else:
        session.collect(
            Round(0, config.demos, hold_steps=config.hold_steps, style=config.style)
        )
    for part in range(1, EVALUATIONS + 1):
        until = config.updates * part // EVALUATIONS
        if session.progress.round_step < until:
            session.train(until)
        if not spec.round_episodes or part == EVALUATIONS or not until:
            continue
        # An earlier start of the run may have been stopped in the evaluation.
        made = until in session.progress.evaluated
        if session.progress.round_step == until and not made:
            session.evaluate(spec.round_episodes)
