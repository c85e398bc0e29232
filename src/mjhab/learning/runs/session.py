"""A run of training: its folder, state, log, checkpoints, evaluations and time budget, for all algorithms.

A subclass says where the samples come from: `ImitationSession`, `ReinforcementSession`.
"""

from __future__ import annotations

import shutil
import time
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, cast

from torch import Tensor

from mjhab.core.files.cache import write_atomic
from mjhab.data.record.provenance import source_commit
from mjhab.learning.checkpoint import (
    Checkpoint,
    load_checkpoint,
    restoring,
    save_student,
    save_tensors,
    saved_state,
)
from mjhab.learning.observation.backbone import keep_copy
from mjhab.learning.observation.spec import ObservationSpec
from mjhab.learning.runs import distributed
from mjhab.learning.runs.budget import FirstUpdate
from mjhab.learning.runs.evaluation import (
    EvalResult,
    Evaluations,
    evaluation_row,
)
from mjhab.learning.runs.report import render_training_report
from mjhab.learning.runs.run import Logbook, TrainingFolder
from mjhab.learning.runs.specs import Resources, Scene, TrainSpec, scene_names
from mjhab.learning.runs.time_budget import TimeBudget
from mjhab.learning.students.student import Student
from mjhab.rollout.records import EpisodeRecord

FIRST = "first"
LATEST = "latest"
"""Names of the evaluations that are kept."""
ONCE = "once"
"""Value of ``keep_best_by``: the success at any time of an episode, not at its end."""


@dataclass
class TrainState:
    """How far a run is: what its training checkpoint holds besides tensors.

    updates, samples: made so far. seconds: wall time of the run [s]. evaluated: number of updates at each evaluation on
    the way. trained: whether the policy was ever updated, or began from a checkpoint. fitted: whether its normalizers
    are those of its data. round, round_step: round of DAgger, and updates made in it. checkpoints: number of those
    written. best_success, best_samples: of the best evaluation on the way. student_samples: number of samples of the
    policy in the student checkpoint.
    """

    updates: int = 0
    samples: int = 0
    seconds: float = 0.0
    evaluated: list[int] = field(default_factory=list)
    trained: bool = False
    fitted: bool = False
    round: int = 0
    round_step: int = 0
    checkpoints: int = 0
    best_success: float = -1.0
    best_samples: int = 0
    student_samples: int = 0


class OutOfTime(Exception):
    """The time budget is spent."""


class Session(ABC):
    """State of a run.

    Args:
        spec: what to train.
        folder: of the run.
        checkpoint: the training checkpoint to go on from; by default that of the folder.
    """

    def __init__(
        self, spec: TrainSpec, folder: TrainingFolder, checkpoint: Path | None = None
    ) -> None:
        self.spec = spec
        self.folder = folder
        self.training_file = checkpoint or folder.training
        """The state that the next update depends on, of this process."""
        self.saved: Checkpoint | None = None
        self.state = TrainState()
        if spec.resume and self.training_file.is_file():
            self.saved = load_checkpoint(self.training_file)
            about = self.saved.about
            self.state = saved_state(self.training_file, about, TrainState)
            # Files of older versions tell fewer things.
            with restoring(self.training_file):
                self.state.updates = int(about.get("step", self.state.updates))
            self.state.trained = self.state.trained or self.state.updates > 0
            self.state.fitted = bool(about.get("fitted", True))
        self.evaluated = EvalResult()
        """The latest complete evaluation; none after `keep_best` has chosen a policy that was evaluated earlier."""
        self.shortage = ""
        """What the run needs, if its time budget ends before its first update; "" while it does not."""
        self.evaluation_seconds = 0.0
        """Wall time of the evaluations since this process started the run [s]."""
        self.began_trained = False
        """Whether the policy began from a checkpoint."""
        self.keep_best_by = ""
        """Which success chooses the policy that is kept: once or at_end; "" keeps the last one."""
        self.judging = Resources()
        """Resources of evaluations."""

    config: Any
    """Configuration of the policy."""

    @property
    @abstractmethod
    def policy(self) -> Student:
        """What is evaluated."""

    def settle(self, layout: ObservationSpec) -> None:
        """Take the layout of the policy, and open the log."""
        self.layout = layout
        if layout.backbone and not distributed.rank():
            keep_copy(layout.inputs.backbone, layout.backbone, self.folder.path)
        self.scenes = [
            replace(scene, profile=layout.profile) for scene in self.spec.scenes
        ]
        self.names = scene_names(self.scenes)
        self.log = Logbook(self.folder, self.state.seconds, self.state.updates)
        self.time = TimeBudget(
            self.spec.budget_seconds,
            lambda: self.log.seconds,
            self._episodes_to_judge,
            len(self.scenes),
        )

    @abstractmethod
    def learn(self) -> None:
        """Train until the end of the run.

        Raises:
            OutOfTime: the budget is spent. BudgetTooSmallError: it ends before the first update.
        """

    @abstractmethod
    def finish(self) -> None:
        """Write the checkpoints at the end of the training, also where the budget ended it."""

    @abstractmethod
    def stop(self, broken: bool) -> None:
        """Write what is worth keeping after Ctrl-C, or after a broken loss."""

    # -- time --------------------------------------------------------------------------------------------------------

    def check_time(self) -> None:
        """Check that the time budget still covers the evaluations to come.

        Raises:
            OutOfTime: it does not, so training must end now.
        """
        if self.time.is_spent():
            raise OutOfTime

    def _episodes_to_judge(self) -> int:
        """Number of episodes of every scene whose evaluation the time budget must still cover."""
        # At the end the last policy may have to be compared with the best one.
        once_more = self.keep_best_by or not self.state.evaluated
        return self.spec.eval_episodes + (self.spec.round_episodes if once_more else 0)

    def expect(self, needs: FirstUpdate, kind: Mapping[str, Any]) -> bool:
        """The first update waits for some work, see `TimeBudget.expect`; nothing is checked where it was made.

        Returns:
            Whether nothing need be measured beforehand.

        Raises:
            BudgetTooSmallError: the time budget ends before.
        """
        state = self.state
        imitated = state.trained and not self.began_trained
        if state.updates or imitated:
            self.time.expect_nothing()
            return True
        return self.time.expect(needs, kind)

    # -- checkpoints -------------------------------------------------------------------------------------------------

    def write_checkpoint(self, network: Student, tensors: Mapping[str, Tensor]) -> None:
        """Write the training checkpoint, and that of the policy if it was ever updated: random weights are no policy.

        Args:
            network: that is trained.
            tensors: state that the next update depends on.
        """
        state = self.state
        state.seconds = self.log.seconds
        state.checkpoints += 1
        # All processes have the same weights; one of them writes.
        if distributed.rank():
            return
        if state.trained:
            state.student_samples = state.samples
        # "step" for readers of older versions.
        about = {**vars(state), "step": state.updates, **self._named()}
        # Before the policy: a kill between leaves the older policy, which is still one of this run.
        save_tensors(self.folder.training, network, tensors, about)
        if state.trained:
            self.save_policy()

    def save_policy(self, path: Path | None = None) -> None:
        """Write the policy as a student checkpoint, which `mjhab eval` can run; by default as the run's student."""
        about = {
            **self._named(),
            "step": self.state.updates,
            "samples": self.state.samples,
            "trained": self.state.trained,
            "scene": self.scenes[0].record(),
            "also": [scene.record() for scene in self.scenes[1:]],
            "seed": self.spec.seed,
        }
        save_student(path or self.folder.student, self.policy, about)
        if path is None:
            self.state.student_samples = self.state.samples

    def _named(self) -> dict[str, Any]:
        algorithm = cast(Any, self.spec).config.algorithm
        return {"algorithm": algorithm, "preset": self.config.preset}

    def keep_best(self) -> None:
        """Make the checkpoint with the best evaluation the run's student; of equal ones the latest.

        The policy at the end of training takes part, too.
        """
        state = self.state
        if distributed.rank() or not state.evaluated:
            return
        if self.spec.round_episodes and state.evaluated[-1] != state.updates:
            self.evaluate(self.spec.round_episodes)
        if self.folder.best.is_file() and state.best_samples != state.samples:
            best = self.folder.best
            write_atomic(self.folder.student, lambda path: shutil.copyfile(best, path))
            state.student_samples = state.best_samples
            # It was of the last policy, and the summary tells of the student.
            self.evaluated = EvalResult()

    # -- evaluation --------------------------------------------------------------------------------------------------

    def evaluate(self, episodes: int, last: bool = False) -> None:
        """Evaluate the student in the episodes 0 to ``episodes`` - 1 of every scene.

        On the way it is the policy of this moment, which is kept if no earlier one was better. The ``last`` evaluation
        is that of the run's student checkpoint. The first and the last evaluation are filmed; their folders are kept.
        """
        if distributed.rank():
            return
        state = self.state
        if last:
            self._judge(episodes, last)
            return
        # The evaluation reads the file, as `mjhab eval` would.
        self.save_policy()
        success = self._judge(episodes, last)
        state.evaluated.append(state.updates)
        # ``>=``: of equal ones the latest has seen more.
        if self.keep_best_by and success >= state.best_success:
            state.best_success = success
            state.best_samples = state.samples
            self.save_policy(self.folder.best)

    def _judge(self, episodes: int, last: bool) -> float:
        """Success rate of the student checkpoint, as by `mjhab eval`: once or at the end, as ``keep_best_by`` says."""
        first = not self.state.evaluated
        films = self.spec.films if first or last else 0
        folder = self.folder.evaluation(FIRST if first and not last else LATEST)
        # Those on the way choose the best policy: not in the homes that it is judged in.
        split = self.spec.final_split if last else self.spec.scene.split
        began = time.perf_counter()
        found = {
            name: self._evaluate_in(
                scene, split, episodes, films, self.place(folder, name)
            )
            for name, scene in zip(self.names, self.scenes, strict=True)
        }
        self.evaluated = EvalResult(split, self.state.student_samples, found)
        spent = time.perf_counter() - began
        # Of all scenes together, as the budget must cover them all.
        self.time.evaluations.measured(spent / episodes)
        self.evaluation_seconds += spent
        rates = self.evaluated.summary()
        once = float(rates["success_once"])
        at_end = float(rates["success_at_end"])
        numbers = evaluation_row(once, rates["episodes"], split, last)
        numbers |= {"success_at_end": at_end, "round": self.state.round}
        if len(found) > 1:
            by_row = self.evaluated.success_by_row()
            numbers |= {f"success_once/{row}": rate for row, rate in by_row.items()}
        self.log.report(self.state.updates, self.state.samples, numbers)
        return at_end if self.keep_best_by not in ("", ONCE) else once

    def _evaluate_in(
        self, scene: Scene, split: str, episodes: int, films: int, out: Path
    ) -> list[EpisodeRecord]:
        def tell(done: int) -> None:
            self.log.show({"phase": f"evaluating {scene.name}: {done}/{episodes}"})

        tell(0)
        # A file of starts is of one split.
        spawns = scene.spawns if scene.split == split else ""
        evaluated = replace(scene, split=split, spawns=spawns)
        evaluations = Evaluations(evaluated, self.judging, self.spec.seed, tell)
        return list(evaluations.run(self.folder.student, episodes, films, out).records)

    def place(self, folder: Path, name: str) -> Path:
        """Where a folder of the run keeps what belongs to a scene of ``names``: below it, if there are several."""
        # A single scene keeps the folders that runs always had.
        return folder / name.replace("/", ".") if len(self.names) > 1 else folder

    # -- results -----------------------------------------------------------------------------------------------------

    def summarize(self) -> dict[str, Any]:
        """Results of the run as JSON data.

        ``split``, ``success_once``, ``interval``, ``success_at_end``, ``episodes`` and ``rows`` come from one
        evaluation, the latest complete one, that of the policy after ``evaluated_samples``. ``checkpoint`` is None
        while there is none; it holds the policy after ``student_samples``. ``trained`` tells whether it was ever
        updated, and ``shortage`` what a budget lacks that ends before the first update.
        """
        state = self.state
        evaluated = self.evaluated
        return {
            **self._named(),
            "steps": state.updates,
            "samples": state.samples,
            "seconds": round(self.log.seconds, 1),
            "cpu_seconds": round(self.log.cpu_seconds, 1),
            "checkpoint": self.folder.kept_student,
            "student_samples": state.student_samples,
            "trained": state.trained,
            **({"shortage": self.shortage} if self.shortage else {}),
            **evaluated.summary(),
            "rows": [
                {"row": row, "success_once": rate, "episodes": len(evaluated.rows[row])}
                for row, rate in evaluated.success_by_row().items()
            ],
            "commit": source_commit(),
        }

    def write_results(self) -> tuple[dict[str, Any], Path]:
        """Write summary and report; returns the summary and the path of the report."""
        summary = self.summarize()
        self.folder.write_summary(summary)
        page = render_training_report(
            self.folder, self.log.rows, self.evaluated.records, summary
        )
        return summary, self.folder.write_report(page)
