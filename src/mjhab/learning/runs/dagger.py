"""Take-over DAgger: the student starts an episode, the expert takes over, and the student learns from the expert.

Round 0 is plain imitation of the expert. In every later round the student acts for a random number of control steps,
at most `DaggerConfig.longest_prefix`. Then the expert plans from the state reached and finishes the episode; its part
is added to the demonstrations if the episode succeeds. Training continues with the same network, and a fixed fraction
of every batch comes from the newest round.
"""

from __future__ import annotations

from mjhab.learning.configs import DaggerConfig
from mjhab.learning.runs.collection import Round
from mjhab.learning.runs.session import Session


def train_dagger(session: Session, config: DaggerConfig) -> None:
    """Run the remaining rounds.

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
        if session.spec.round_episodes:
            session.evaluate(session.spec.round_episodes)
        if number == config.rounds and not config.final_updates:
            return
        session.save_student(session.folder.round_student(number + 1))
        session.next_round()
    session.train(config.final_updates, session.newest_share, cool_down=True)


def restore_rounds(session: Session, config: DaggerConfig) -> None:
    """Load the demonstrations of the finished rounds."""
    for number in range(session.progress.round):
        if number == 0 and session.spec.data:
            session.load(session.spec.data, session.spec.filter)
        else:
            session.load_round(number)


def collect_round(session: Session, config: DaggerConfig, number: int) -> None:
    """Load or collect the demonstrations of a round; round 0 takes the data of the specification, if there are any."""
    if number == 0 and session.spec.data:
        session.load(session.spec.data, session.spec.filter)
        return
    student = session.folder.round_student(number) if number else None
    episodes = config.episodes if number else session.config.demos
    # Without a student prefix the task's own horizon is long enough.
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
