"""Training of a student: open the folder, run the algorithm, evaluate, write summary and report."""

from __future__ import annotations

from typing import Any

from mjhab.data.record.provenance import source_commit
from mjhab.learning.runs.budget import BudgetTooSmallError
from mjhab.learning.runs.dagger import train_dagger
from mjhab.learning.runs.report import render_training_report
from mjhab.learning.runs.result import TrainingResult
from mjhab.learning.runs.session import OutOfTime, Session, open_session
from mjhab.learning.runs.specs import ImitationSpec
from mjhab.learning.runs.supervised import train_supervised
from mjhab.learning.runs.training import BrokenLossError


def train_imitation(spec: ImitationSpec) -> TrainingResult:
    """Train a student, evaluate it, and write everything into a folder. Ctrl-C writes a checkpoint.

    Args:
        spec: what to train; the result of a resumed run equals that of an uninterrupted one.

    Raises:
        UsageError: data, folder or scene do not fit.
        BrokenLossError: the loss became NaN; the weights from before it are kept.
    """
    interrupted = False
    with open_session(spec) as session:
        try:
            _learn(session)
            session.save()
            # Random weights are not judged.
            if spec.eval_episodes and session.trainer.step:
                session.evaluate(spec.eval_episodes, last=True)
                session.save()
        except (KeyboardInterrupt, BrokenLossError) as error:
            # Neither an interrupt nor a broken loss changes weights; before the data are read there is nothing to keep.
            if session.fitted:
                session.save()
            if isinstance(error, BrokenLossError):
                raise
            interrupted = True
        finally:
            summary = summarize(session)
            folder = session.folder
            folder.write_summary(summary)
            report = folder.write_report(
                render_training_report(
                    folder, session.log.rows, session.judged.records, summary
                )
            )
    return TrainingResult(summary, report, interrupted)


def summarize(session: Session) -> dict[str, Any]:
    """Results of a run as JSON data.

    ``split``, ``success_once``, ``interval``, ``success_at_end``, ``episodes`` and ``rows`` come from one evaluation,
    the latest complete one. ``checkpoint`` is None while there is none; ``trained`` tells whether the network was ever
    updated, and ``shortage`` what a budget lacks that ends before the first update.
    """
    dagger = session.spec.config.dagger
    judged = session.judged
    return {
        "algorithm": session.spec.config.algorithm,
        "preset": session.config.preset,
        "steps": session.trainer.step,
        "samples": session.progress.samples,
        "seconds": round(session.log.seconds, 1),
        "cpu_seconds": round(session.log.cpu_seconds, 1),
        "checkpoint": session.folder.kept_student,
        "trained": session.trainer.step > 0,
        **({"shortage": session.shortage} if session.shortage else {}),
        **judged.summary(),
        "rows": [
            {"row": row, "success_once": rate, "episodes": len(judged.rows[row])}
            for row, rate in judged.success_by_row().items()
        ],
        "rounds": min(session.progress.round, dagger.rounds) if dagger else 0,
        "demonstrations": sum(source.episodes for source in session.sources),
        "frames": sum(len(source.first) for source in session.sources),
        "device": str(session.device),
        "commit": source_commit(),
    }


def _learn(session: Session) -> None:
    """Run the algorithm until it has finished or the time budget is spent."""
    dagger = session.spec.config.dagger
    try:
        if dagger is not None:
            train_dagger(session, dagger)
        else:
            train_supervised(session)
    except OutOfTime:
        session.log.show({"phase": "the budget is spent"})
    except BudgetTooSmallError as error:
        session.log.show({"phase": "the budget is too small"})
        session.shortage = str(error)
