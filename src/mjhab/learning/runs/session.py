"""A run of imitation learning: its data, student, log and checkpoints, for all algorithms."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import torch

from mjhab.core.arithmetic.sums import ordered_sum
from mjhab.core.files.interrupts import held_interrupts
from mjhab.data.record.generation import Standing, tried_in
from mjhab.data.select.query import Filter
from mjhab.learning.batches import BatchSampler
from mjhab.learning.checkpoint import (
    load_checkpoint,
    restoring,
    save_student,
    save_training,
    saved_state,
)
from mjhab.learning.demos import Demonstrations, load_demonstrations
from mjhab.learning.devices import CPU, training_device
from mjhab.learning.layout import Layout
from mjhab.learning.runs.budget import EpisodeClock, FirstUpdate, Rates
from mjhab.learning.runs.collection import Collector, Round
from mjhab.learning.runs.evaluation import (
    EvaluationClock,
    Evaluations,
    Judgement,
    judgement_row,
)
from mjhab.learning.runs.request import layout_for, resolved_config
from mjhab.learning.runs.run import Logbook, TrainingFolder
from mjhab.learning.runs.specs import ImitationSpec, Scene
from mjhab.learning.runs.training import Trainer
from mjhab.learning.students.heads import check_student, make_student
from mjhab.learning.students.student import Batch
from mjhab.rollout.records import EpisodeRecord

REPORT_EVERY = 50
"""Number of updates between two reports of the loss."""
CHECKPOINT_SECONDS = 60.0
"""Time between checkpoints [s]."""
FIRST = "first"
LATEST = "latest"
"""Names of the evaluations that are kept."""
LOAD_SHARE = "loading_share"
"""Metric: fraction of the training time spent on reading batches."""


@dataclass
class Progress:
    """Progress of a run.

    round: current round of DAgger. round_step: updates made in it. seconds: wall time. evaluated: number of updates at
    each evaluation.
    """

    round: int = 0
    round_step: int = 0
    seconds: float = 0.0
    samples: int = 0
    evaluated: list[int] = field(default_factory=list)


class OutOfTime(Exception):
    """The time budget is spent."""


class Session:
    """State of a run. Make one with `open_session`."""

    def __init__(
        self, spec: ImitationSpec, layout: Layout, folder: TrainingFolder
    ) -> None:
        threads = spec.config.student.inputs.network_threads(spec.torch_threads)
        if threads:
            torch.set_num_threads(threads)
        self.spec = spec
        self.folder = folder
        self.scenes = [replace(scene, profile=layout.profile) for scene in spec.scenes]
        self.config = spec.config.student
        self.sources: list[Demonstrations] = []
        self.progress = Progress()
        self.judged = Judgement()
        """The latest complete evaluation."""
        saved = (
            load_checkpoint(folder.training)
            if spec.resume and folder.training.is_file()
            else None
        )
        if saved is not None:
            self.progress = saved_state(folder.training, saved.about, Progress)
            # An older version began the run with other conventions, perhaps; its weights keep them.
            layout = layout.told_in(saved.layout.conventions)
        self.layout = layout
        self.device = training_device(spec.device)
        student = make_student(self.config, layout, spec.seed).to(self.device)
        self.trainer = Trainer(student, spec.seed, spec.config.updates)
        if saved is not None:
            with restoring(folder.training):
                self.trainer.restore(dict(saved.tensors), int(saved.about["step"]))
        self.fitted = saved is not None and bool(saved.about.get("fitted", True))
        self.collectors = [
            Collector(scene, layout.env_options(), spec.means, spec.seed, spec.ray or "")
            for scene in self.scenes
        ]
        self.log = Logbook(folder, self.progress.seconds, self.trainer.step)
        self._saved_at = time.perf_counter()
        self.shortage = ""
        """What the run needs, if its time budget ends before its first update; "" while it does not."""
        self._clock = EvaluationClock(spec.budget_seconds)

    # -- data --------------------------------------------------------------------------------------------------------

    def load(self, places: Path | Sequence[Path], where: Filter | None = None) -> None:
        """Add demonstrations to the training data; the first ones added determine the normalizers."""
        self.log.show({"phase": "reading demonstrations"})
        workers = self.spec.means.workers
        data = load_demonstrations(
            places,
            self.layout,
            self.config.hold_steps,
            where,
            workers,
            self.spec.per_target,
        )
        self.sources.append(data if self.device.type == CPU else data.on(self.device))
        if not self.fitted:
            self.trainer.student.fit_normalizers(data)
            self.trainer.restart_average()
            self.fitted = True

    def place(self, folder: Path, scene: Scene) -> Path:
        """Where a folder of the run keeps what belongs to a scene: below it, if there are several."""
        return folder / scene.name.replace("/", ".") if len(self.scenes) > 1 else folder

    def load_round(self, number: int) -> None:
        """Add the collected demonstrations of a round to the training data."""
        folder = self.folder.data(number)
        self.load([self.place(folder, scene) for scene in self.scenes])

    def collect(self, wanted: Round) -> None:
        """Collect the missing demonstrations of a round, in every scene, and add them to the training data.

        Raises:
            OutOfTime: the time budget ended before they were complete.
            BudgetTooSmallError: it will end before the first update.
        """
        began = time.perf_counter()
        tried = 0
        kept = 0
        check = self._budget_check(wanted)
        for scene, collector in zip(self.scenes, self.collectors, strict=True):
            phase = f"collecting round {wanted.number}"
            if len(self.scenes) > 1:
                phase += f", {scene.name}"

            pace = EpisodeClock(self.spec.means.at_once)

            def tell(
                now: Standing, phase: str = phase, pace: EpisodeClock = pace
            ) -> None:
                self.log.show({"phase": f"{phase}: {now.tried}/{wanted.episodes}"})
                seconds = pace.seconds(now.tried, self.log.seconds)
                if seconds is not None:
                    check(seconds)

            self.log.show({"phase": phase})
            out = self.place(self.folder.data(wanted.number), scene)
            standing = collector.collect(wanted, out, tell, self._out_of_time)
            if not standing.complete:
                raise OutOfTime
            tried += standing.tried
            kept += standing.kept
        if tried:
            # The episodes of every scene are evaluated, so the scenes' times add up.
            self._clock.guess(len(self.scenes) * (time.perf_counter() - began) / tried)
        self.load_round(wanted.number)
        numbers = {
            "round": wanted.number,
            "episodes": sum(source.episodes for source in self.sources),
            "collection_success": kept / max(tried, 1),
            "collection_seconds": round(time.perf_counter() - began, 2),
        }
        self.log.report(self.trainer.step, self.progress.samples, numbers)

    def _budget_check(self, wanted: Round) -> Callable[[float], None]:
        """Refuse a budget in which the first round would end without an update, before the round begins.

        Args:
            wanted: the round that is to be collected.

        Returns:
            Checks again, with a measured time of an episode [s].

        Raises:
            BudgetTooSmallError: it tells what is needed.
        """
        budget = self.spec.budget_seconds
        out = self.folder.data(wanted.number)
        made = sum(tried_in(self.place(out, scene)) for scene in self.scenes)
        left = len(self.scenes) * wanted.episodes - made
        if not budget or self.trainer.step or left <= 0:
            return lambda _: None
        judged = self._episodes_to_judge()
        needs = FirstUpdate(
            f"{left} episodes of the expert",
            left,
            len(self.scenes) * judged,
            "--demos and --eval-episodes",
        )
        spent = self.log.seconds
        rates = Rates(
            {
                "scenes": [asdict(scene) for scene in self.scenes],
                "view": self.layout.env_options(),
                "means": asdict(self.spec.means),
                "style": wanted.style,
                "hold_steps": wanted.hold_steps,
            }
        )

        def check(seconds: float) -> None:
            self._clock.guess(len(self.scenes) * seconds)
            judging = self._clock.needed(judged)
            needs.check(budget, seconds, spent, judging, self._clock.reserve(judged))

        def learn_and_check(seconds: float) -> None:
            rates.learn(seconds)
            check(seconds)

        known = rates.seconds
        if known is None:
            self.log.show({"phase": "timing the expert"})
            at_once = self.spec.means.at_once
            room = budget - spent - self._clock.reserve(judged)
            wave = self.collectors[0].wave_seconds(
                wanted, room * at_once / left, lambda: self.log.seconds
            )
            known = None if wave is None else wave / at_once
        if known is not None:
            check(known)
        return learn_and_check

    def sampler(self, new_share: float) -> BatchSampler:
        """Sampler of batches from the loaded data; ``new_share`` is the fraction from the newest demonstrations."""
        return BatchSampler(
            self.sources, self.config.optimizer.batch, new_share, self.spec.seed
        )

    @property
    def newest_share(self) -> float:
        """Fraction of the training data's control steps that belong to the newest demonstrations."""
        return len(self.sources[-1].usable) / sum(
            len(source.usable) for source in self.sources
        )

    # -- training ----------------------------------------------------------------------------------------------------

    def train(
        self, updates: int, new_share: float = 1.0, cool_down: bool = False
    ) -> None:
        """Make the remaining updates of this round.

        Args:
            updates: total number of updates in the round.
            new_share: fraction of every batch that comes from the newest demonstrations.
            cool_down: decrease the learning rate linearly to zero.

        Raises:
            OutOfTime: the rest of the time budget is needed for the final evaluation.
        """
        sampler = self.sampler(new_share)
        losses: list[float] = []
        began = time.perf_counter()
        loading = 0.0
        while self.progress.round_step < updates:
            if self._out_of_time():
                raise OutOfTime
            before = time.perf_counter()
            batch = self._batch(sampler)
            loading += time.perf_counter() - before
            rate = 1.0 - self.progress.round_step / updates if cool_down else 1.0
            with held_interrupts():
                losses.append(self.trainer.update(batch, rate).loss)
                self.progress.round_step += 1
                self.progress.samples += len(batch.actions)
            if (
                self.trainer.step % REPORT_EVERY == 0
                or self.progress.round_step == updates
            ):
                seconds = time.perf_counter() - began
                numbers = {
                    "loss": ordered_sum(losses) / len(losses),
                    "samples_per_second": len(losses) * len(batch.actions) / seconds,
                    LOAD_SHARE: loading / seconds,
                }
                self.log.show({"phase": f"training, round {self.progress.round}"})
                self.log.report(self.trainer.step, self.progress.samples, numbers)
                losses = []
                began = time.perf_counter()
                loading = 0.0
            if time.perf_counter() - self._saved_at > CHECKPOINT_SECONDS:
                self.save()
        self.save()

    def _batch(self, sampler: BatchSampler) -> Batch:
        config = self.config
        chunks = sampler.batch(
            self.trainer.step, config.chunk, config.inputs.history, config.inputs.shift
        )
        return Batch.of(chunks)

    def _out_of_time(self) -> bool:
        """Whether the rest of the time budget is needed for the final evaluation."""
        budget = self.spec.budget_seconds
        reserve = self._clock.reserve(self._episodes_to_judge())
        return bool(budget) and self.log.seconds + reserve > budget

    def _episodes_to_judge(self) -> int:
        """Number of episodes of every scene whose evaluation the time budget must still cover."""
        first = 0 if self.progress.evaluated else self.spec.round_episodes
        return self.spec.eval_episodes + first

    def next_round(self) -> None:
        """Begin the next round."""
        self.progress.round += 1
        self.progress.round_step = 0
        self.save()

    def save(self) -> None:
        """Write the training and the student checkpoint."""
        self.progress.seconds = self.log.seconds
        about = {
            **vars(self.progress),
            "algorithm": self.spec.config.algorithm,
            "preset": self.config.preset,
            "fitted": self.fitted,
        }
        save_training(self.folder.training, self.trainer, about)
        # Random weights are no policy.
        if self.trainer.step:
            self.save_student(self.folder.student)
        self._saved_at = time.perf_counter()

    def save_student(self, path: Path) -> None:
        """Write the policy for evaluation, the moving average of the weights, as a student checkpoint."""
        about = {
            "algorithm": self.spec.config.algorithm,
            "step": self.trainer.step,
            "samples": self.progress.samples,
            "scene": vars(self.scenes[0]),
            "also": [vars(scene) for scene in self.scenes[1:]],
            "seed": self.spec.seed,
        }
        save_student(path, self.trainer.average, about)

    # -- evaluation --------------------------------------------------------------------------------------------------

    def evaluate(self, episodes: int, last: bool = False) -> float:
        """Evaluate the student in the episodes 0 to ``episodes`` - 1 of every scene and return its success-once rate.

        The first and the ``last`` evaluation are filmed. The folders of the first and the latest one are kept.
        """
        self.save()
        first = not self.progress.evaluated
        films = self.spec.films if first or last else 0
        folder = self.folder.evaluation(FIRST if first and not last else LATEST)
        split = self.spec.judged_split if last else self.spec.scene.split
        began = time.perf_counter()
        found = {
            scene.name: self._evaluate_in(
                scene, split, episodes, films, self.place(folder, scene)
            )
            for scene in self.scenes
        }
        self.judged = Judgement(split, self.progress.samples, found)
        self._clock.measured((time.perf_counter() - began) / episodes)
        by_row = self.judged.success_by_row()
        success = float(self.judged.summary()["success_once"])
        self.progress.evaluated.append(self.trainer.step)
        self.save()
        numbers = judgement_row(success, len(self.judged.records), split, last)
        numbers["round"] = self.progress.round
        if len(found) > 1:
            numbers |= {f"success_once/{row}": rate for row, rate in by_row.items()}
        self.log.report(self.trainer.step, self.progress.samples, numbers)
        return success

    def _evaluate_in(
        self, scene: Scene, split: str, episodes: int, films: int, out: Path
    ) -> list[EpisodeRecord]:
        def tell(done: int) -> None:
            self.log.show({"phase": f"evaluating {scene.name}: {done}/{episodes}"})

        tell(0)
        judged = replace(scene, split=split)
        evaluations = Evaluations(judged, self.spec.means, self.spec.seed, tell)
        return list(evaluations.run(self.folder.student, episodes, films, out).records)


@contextmanager
def open_session(spec: ImitationSpec) -> Iterator[Session]:
    """Open a training session in the folder of the run; its logs are closed on exit.

    Raises:
        UsageError: data, folder or scene do not fit; then nothing was written.
    """
    config = resolved_config(spec)
    TrainingFolder.check(spec.out, config, resume=spec.resume)
    layout = layout_for(spec)
    check_student(spec.config.student, layout)
    with TrainingFolder.open(spec.out, config, resume=spec.resume) as folder:
        session = Session(spec, layout, folder)
        with session.log:
            yield session
