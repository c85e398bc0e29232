"""Training by imitation: a session of the algorithm that a specification names."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from mjhab.learning.runs.dagger import DaggerSession
from mjhab.learning.runs.imitation import ImitationSession
from mjhab.learning.runs.request import layout_for, resolved_config
from mjhab.learning.runs.run import TrainingFolder
from mjhab.learning.runs.specs import ImitationSpec
from mjhab.learning.students.heads import check_student


@contextmanager
def open_session(spec: ImitationSpec) -> Iterator[ImitationSession]:
    """Open a training session in the folder of the run; its logs are closed on exit.

    Raises:
        UsageError: data, folder or scene do not fit; then nothing was written.
    """
    config = resolved_config(spec)
    TrainingFolder.check(spec.out, config, resume=spec.resume)
    layout = layout_for(spec)
    check_student(spec.config.student, layout)
    kind = DaggerSession if spec.config.dagger is not None else ImitationSession
    with TrainingFolder.open(spec.out, config, resume=spec.resume) as folder:
        session = kind(spec, layout, folder)
        with session.log:
            yield session
