"""Training of an agent by reinforcement learning: open the folder, train, evaluate, write summary and report."""

from __future__ import annotations

from typing import Any

from mjhab.learning.reinforcement.ppo.run import PpoRun
from mjhab.learning.reinforcement.sac.run import SacRun
from mjhab.learning.reinforcement.session import (
    ReinforcementSession,
    open_reinforcement,
)
from mjhab.learning.reinforcement.specs import ReinforcementSpec
from mjhab.learning.runs.budget import BudgetTooSmallError
from mjhab.learning.runs.report import render_training_report
from mjhab.learning.runs.result import TrainingResult
from mjhab.learning.runs.session import OutOfTime


def train_reinforcement(spec: ReinforcementSpec) -> TrainingResult:
    """Train an agent, evaluate it, and write everything into the folder of the run.

    After Ctrl-C the student is the actor of that moment; a resumed run continues from the last training checkpoint.

    Raises:
        UsageError: folder, scene or checkpoint do not fit.
        BrokenLossError: a loss or a gradient is not finite; the run's student is that of the last checkpoint.
    """
    interrupted = False
    with open_reinforcement(spec) as session:
        run = PpoRun(session) if session.config.ppo is not None else SacRun(session)
        prepared = False
        try:
            try:
                run.prepare()
                prepared = True
                session.check_time()
                if spec.round_episodes and not session.standing.evaluated:
                    session.evaluate(run.actor, spec.round_episodes)
                run.learn()
            except OutOfTime:
                session.log.show({"phase": "the budget is spent"})
            except BudgetTooSmallError as error:
                session.log.show({"phase": "the budget is too small"})
                session.shortage = str(error)
                # Its few steps are no part of the run: a larger budget begins anew.
                prepared = False
            if prepared:
                run.save()
            else:
                # A checkpoint would be resumed without the rest of the imitation.
                session.keep_last(run.actor)
            session.keep_best(run.actor)
            # Random weights are not judged.
            if spec.eval_episodes and session.standing.trained:
                session.evaluate_student(spec.eval_episodes)
        except KeyboardInterrupt:
            session.keep_last(run.actor)
            interrupted = True
        finally:
            session.drop_untrained()
            summary = summarize(session)
            session.folder.write_summary(summary)
            page = render_training_report(
                session.folder, session.log.rows, session.judged.records, summary
            )
            report = session.folder.write_report(page)
    return TrainingResult(summary, report, interrupted)


def summarize(session: ReinforcementSession) -> dict[str, Any]:
    """Results of a run as JSON data.

    ``split``, ``success_once``, ``interval``, ``success_at_end`` and ``episodes`` come from one evaluation, that of the
    actor after ``evaluated_samples``. ``checkpoint`` is None while there is none; it holds the actor after
    ``student_samples``.
    """
    standing = session.standing
    return {
        "algorithm": session.config.algorithm,
        "preset": session.config.preset,
        "steps": standing.updates,
        "samples": standing.samples,
        "seconds": round(session.log.seconds, 1),
        "cpu_seconds": round(session.log.cpu_seconds, 1),
        "checkpoint": session.folder.kept_student,
        "student_samples": standing.student_samples,
        "trained": standing.trained,
        **({"shortage": session.shortage} if session.shortage else {}),
        **session.judged.summary(),
        "rounds": 0,
        "demonstrations": session.demonstrations,
        "time_shares": session.time_shares(),
    }
