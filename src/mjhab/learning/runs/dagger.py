"""Take-over DAgger: the student begins, the expert takes over and finishes, the student learns from what it did.

Round 0 is plain imitation of the expert. In every later round the student acts for a drawn number of control steps, at
most `DaggerConfig.longest_prefix`; then the expert plans anew from wherever that led, and its part of the episodes that
succeed is added. The network is kept; a share of every batch comes from the newest round.
"""

from __future__ import annotations

from mjhab.learning.configs import DaggerConfig
from mjhab.learning.runs.collection import Round
from mjhab.learning.runs.session import Session


def train_dagger(session: Session, config: DaggerConfig) -> None:
    """Run all rounds that are left.

    Raises:
        OutOfTime: the budget is spent.
    """
    restore_rounds(session, config)
    while session.progress.round <= config.rounds:
        number = session.progress.round
        if len(session.sources) <= number:
            collect_round(session, config, number)
        updates = config.updates if number else session.config.updates
        session.train(updates, config.new_share)
        if session.request.round_episodes:
            session.evaluate(session.request.round_episodes)
        if number == config.rounds and not config.final_updates:
            return
        session.save_student(session.folder.round_student(number + 1))
        session.next_round()
    session.train(config.final_updates, session.newest_share, cool_down=True)


def restore_rounds(session: Session, config: DaggerConfig) -> None:
    """Read the data of the rounds that are over."""
    for number in range(session.progress.round):
        if number == 0 and session.request.data:
            session.load(session.request.data, session.request.filter)
        else:
            session.load(session.folder.data(number))


def collect_round(session: Session, config: DaggerConfig, number: int) -> None:
    """Get the data of a round: those that were given for round 0, or new ones."""
    if number == 0 and session.request.data:
        session.load(session.request.data, session.request.filter)
        return
    student = session.folder.round_student(number) if number else None
    episodes = config.episodes if number else session.config.demos
    # The expert alone needs no more time than the task gives it.
    horizon = config.horizon if number else 0
    wanted = Round(
        number=number,
        episodes=episodes,
        longest=config.longest_prefix(number),
        student=student,
        horizon=horizon,
        hold_steps=session.config.hold_steps,
        style=session.config.style,
    )
    session.collect(wanted)
