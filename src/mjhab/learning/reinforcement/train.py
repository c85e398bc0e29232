"""Training of an agent by reinforcement learning."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from mjhab.learning.reinforcement.ppo.run import PpoRun
from mjhab.learning.reinforcement.request import check_start, resolved_config
from mjhab.learning.reinforcement.sac.run import SacRun
from mjhab.learning.reinforcement.session import ReinforcementSession
from mjhab.learning.reinforcement.specs import ReinforcementSpec
from mjhab.learning.runs import distributed
from mjhab.learning.runs.run import TRAINING, TrainingFolder, TrainingResult
from mjhab.learning.runs.train import run_session


@contextmanager
def open_reinforcement(spec: ReinforcementSpec) -> Iterator[ReinforcementSession]:
    """Open a training session in the folder of the run; its logs are closed on exit.

    Raises:
        UsageError: folder, scene or checkpoint do not fit; then nothing was written.
    """
    distributed.join()
    config = resolved_config(spec)
    first = distributed.rank() == 0
    # A folder per process: each has its own log and buffers.
    mine = spec.out if first else spec.out / f"rank_{distributed.rank()}"
    if not first:
        # The first process refuses a folder that is not empty, so it goes first.
        distributed.wait()
    TrainingFolder.check(mine, config, resume=spec.resume)
    check_start(spec)
    with TrainingFolder.open(mine, config, resume=spec.resume) as folder:
        if first:
            distributed.wait()
        # The first process alone writes checkpoints, and all read them.
        session = ReinforcementSession(spec, folder, spec.out / TRAINING)
        is_ppo = spec.config.ppo is not None
        session.run = PpoRun(session) if is_ppo else SacRun(session)
        with session.log:
            yield session


def train_reinforcement(spec: ReinforcementSpec) -> TrainingResult:
    """Train an agent, see `run_session`.

    Raises:
        UsageError: folder, scene or checkpoint do not fit.
        BrokenLossError: a loss or a gradient is not finite; the run's student is that of the last checkpoint.
    """
    with open_reinforcement(spec) as session:
        return run_session(session)
