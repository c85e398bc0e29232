"""A run of training from its beginning to its end, and the sessions of imitation."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from mjhab.learning.runs import distributed
from mjhab.learning.runs.budget import BudgetTooSmallError
from mjhab.learning.runs.dagger import DaggerSession
from mjhab.learning.runs.imitation import ImitationSession
from mjhab.learning.runs.request import layout_for, resolved_config, start_of
from mjhab.learning.runs.run import TrainingFolder, TrainingResult
from mjhab.learning.runs.session import OutOfTime, Session
from mjhab.learning.runs.specs import ImitationSpec
from mjhab.learning.runs.training import BrokenLossError
from mjhab.learning.students.heads import check_student


@contextmanager
def open_session(spec: ImitationSpec) -> Iterator[ImitationSession]:
    """Open a training session in the folder of the run; its logs are closed on exit.

    Raises:
        UsageError: data, folder or scene do not fit; then nothing was written.
    """
    config = resolved_config(spec)
    # First, since the layout takes seconds and a folder that is taken is told at once.
    TrainingFolder.check(spec.out, config, resume=spec.resume)
    # Before the folder is made: a wrong camera or data set leaves nothing behind.
    layout = layout_for(spec)
    check_student(spec.config.student, layout)
    start = start_of(spec, layout)
    kind = DaggerSession if spec.config.dagger is not None else ImitationSession
    with TrainingFolder.open(spec.out, config, resume=spec.resume) as folder:
        session = kind(spec, layout, folder, start)
        with session.log:
            yield session


def run_session(session: Session) -> TrainingResult:
    """Train, evaluate, and write everything into the folder of the run.

    After Ctrl-C the student is the policy of that moment; a resumed run goes on from the last training checkpoint.

    Raises:
        BrokenLossError: a loss or a gradient is not finite; the weights from before it are kept.
    """
    interrupted = False
    try:
        try:
            session.learn()
        except OutOfTime:
            session.log.show({"phase": "the budget is spent"})
        except BudgetTooSmallError as error:
            session.log.show({"phase": "the budget is too small"})
            session.shortage = str(error)
        session.finish()
        # Random weights are not judged.
        if session.spec.eval_episodes and session.state.trained:
            session.evaluate(session.spec.eval_episodes, last=True)
    # The weights from before the broken update are kept; it must not become a result.
    except BrokenLossError:
        session.stop(broken=True)
        raise
    except KeyboardInterrupt:
        session.stop(broken=False)
        interrupted = True
    finally:
        if not session.state.trained and not distributed.rank():
            # An evaluation of random weights has left them: they are no policy.
            session.folder.student.unlink(missing_ok=True)
        # Also after an error, so that the folder says how far the run came.
        summary, report = session.write_results()
    return TrainingResult(summary, report, interrupted)
