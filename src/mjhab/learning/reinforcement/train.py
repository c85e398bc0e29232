"""Training of an agent by reinforcement learning."""

from __future__ import annotations

from mjhab.learning.reinforcement.ppo.run import PpoRun
from mjhab.learning.reinforcement.sac.run import SacRun
from mjhab.learning.reinforcement.session import open_reinforcement
from mjhab.learning.reinforcement.specs import ReinforcementSpec
from mjhab.learning.runs.run import TrainingResult
from mjhab.learning.runs.session import run_session


def train_reinforcement(spec: ReinforcementSpec) -> TrainingResult:
    """Train an agent, evaluate it, and write everything into the folder of the run, see `run_session`.

    Raises:
        UsageError: folder, scene or checkpoint do not fit.
        BrokenLossError: a loss or a gradient is not finite; the run's student is that of the last checkpoint.
    """
    with open_reinforcement(spec) as session:
        run = PpoRun(session) if session.config.ppo is not None else SacRun(session)
        session.run = run
        return run_session(session)
