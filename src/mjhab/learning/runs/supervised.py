"""Imitation of a fixed set of demonstrations: what ``mjhab train bc|flow|act|diffusion`` does."""

from __future__ import annotations

from mjhab.learning.runs.collection import Round
from mjhab.learning.runs.session import Session

EVALUATIONS = 4
"""Parts that the updates are divided into; the student is evaluated after each."""


def train_supervised(session: Session) -> None:
    """Make all updates that are left.

    Raises:
        OutOfTime: the budget is spent.
    """
    request = session.request
    config = session.config
    if request.data:
        session.load(request.data, request.filter)
    else:
        session.collect(Round(0, config.demos, hold_steps=config.hold_steps, style=config.style))
    for part in range(1, EVALUATIONS + 1):
        until = config.updates * part // EVALUATIONS
        if session.progress.round_step < until:
            session.train(until)
            if request.round_episodes and part < EVALUATIONS:
                session.evaluate(request.round_episodes)
