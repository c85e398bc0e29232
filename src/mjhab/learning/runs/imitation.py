"""Imitation of demonstrations: collecting or reading them, updates, and the algorithms that need no more.

`dagger` adds rounds in which the student acts.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from mjhab.core.arithmetic.sums import ordered_sum
from mjhab.core.files.interrupts import held_interrupts
from mjhab.data.record.job import Standing, tried_in
from mjhab.data.select.query import Filter
from mjhab.learning.batches import BatchSampler
from mjhab.learning.checkpoint import restoring
from mjhab.learning.demos import Demonstrations, load_demonstrations
from mjhab.learning.devices import CPU, training_device
from mjhab.learning.observation.spec import ObservationSpec
from mjhab.learning.runs.budget import EpisodeClock, FirstUpdate
from mjhab.learning.runs.collection import Collector, Round
from mjhab.learning.runs.run import TrainingFolder
from mjhab.learning.runs.session import OutOfTime, Session
from mjhab.learning.runs.specs import ImitationSpec
from mjhab.learning.runs.training import Trainer
from mjhab.learning.students.heads import make_student
from mjhab.learning.students.student import Batch, Student

REPORT_EVERY = 50
"""Number of updates between two reports of the loss."""
# A kill costs at most a minute, and writing some MB far less.
CHECKPOINT_SECONDS = 60.0
"""Time between checkpoints [s]."""
LOAD_SHARE = "loading_share"
"""Metric: fraction of the training time spent on reading batches."""
EVALUATIONS = 4
"""Number of evaluations of a run without rounds, at equal numbers of updates; the last one is the final evaluation."""


class ImitationSession(Session):
    """A run of imitation. Make one with `train.open_session`; ``start``: the student whose weights it begins with."""

    spec: ImitationSpec

    def __init__(
        self,
        spec: ImitationSpec,
        layout: ObservationSpec,
        folder: TrainingFolder,
        start: Student | None = None,
    ) -> None:
        threads = spec.config.student.inputs.network_threads(spec.torch_threads)
        if threads:
            torch.set_num_threads(threads)
        super().__init__(spec, folder)
        self.config = spec.config.student
        self.judging = spec.resources
        self.sources: list[Demonstrations] = []
        if self.saved is not None:
            # An older version began the run with other conventions, perhaps; its weights keep them.
            layout = layout.in_conventions(self.saved.layout.conventions)
        self.device = training_device(spec.device)
        student = make_student(self.config, layout, spec.seed).to(self.device)
        self.trainer = Trainer(student, spec.seed, spec.config.updates)
        if self.saved is not None:
            with restoring(folder.training):
                self.trainer.restore(dict(self.saved.tensors), self.state.updates)
        elif start is not None:
            student.load_state_dict(start.state_dict())
            # The average would otherwise begin from the random weights that were made before.
            self.trainer.restart_average()
            self.state.fitted = self.began_trained = True
        self.settle(layout)
        self.collectors = [
            Collector(scene, view, spec.resources, spec.seed, spec.ray or "")
            for scene, view in zip(self.scenes, self.views(layout), strict=True)
        ]
        self._saved_at = time.perf_counter()

    @property
    def policy(self) -> Student:
        """The moving average of the weights."""
        return self.trainer.average

    # -- the run -----------------------------------------------------------------------------------------------------

    def learn(self) -> None:
        """Collect or load the demonstrations and make the remaining updates."""
        self.take_demonstrations()
        updates = self.config.updates
        for part in range(1, EVALUATIONS + 1):
            until = updates * part // EVALUATIONS
            if self.state.round_step < until:
                self.train(until)
            if not self.spec.round_episodes or part == EVALUATIONS or not until:
                continue
            # An earlier start of the run may have been stopped in the evaluation.
            made = until in self.state.evaluated
            if self.state.round_step == until and not made:
                self.evaluate(self.spec.round_episodes)

    def finish(self) -> None:
        """Write both checkpoints."""
        self.save()

    def stop(self, broken: bool) -> None:
        """Write both checkpoints: neither an interrupt nor a broken loss changes weights."""
        # Before the data are read there is nothing to keep.
        if self.state.fitted:
            # Before the evaluation, so that an interrupt in it costs no updates.
            self.save()

    def evaluate(self, episodes: int, last: bool = False) -> None:
        """See `Session.evaluate`; a run that is stopped in the evaluation makes it again."""
        if not last:
            self.save()
        super().evaluate(episodes, last)
        self.save()

    def save(self) -> None:
        """Write the training and the student checkpoint."""
        self.write_checkpoint(self.trainer.student, self.trainer.tensors())
        self._saved_at = time.perf_counter()

    def summarize(self) -> dict[str, Any]:
        """See `Session.summarize`."""
        return {
            **super().summarize(),
            "rounds": self.state.round,
            "demonstrations": sum(source.episodes for source in self.sources),
            "frames": sum(len(source.first) for source in self.sources),
            "device": str(self.device),
        }

    # -- data --------------------------------------------------------------------------------------------------------

    def load(self, places: Path | Sequence[Path], where: Filter | None = None) -> None:
        """Add demonstrations to the training data; the first ones added determine the normalizers."""
        self.log.show({"phase": "reading demonstrations"})
        workers = self.spec.resources.workers
        data = load_demonstrations(
            places,
            self.layout,
            self.config.hold_steps,
            where,
            workers,
            self.spec.per_target,
        )
        self.sources.append(data if self.device.type == CPU else data.on(self.device))
        # Once: later rounds must not change what the weights have learned to read.
        if not self.state.fitted:
            self.trainer.student.fit_normalizers(data)
            self.trainer.restart_average()
            self.state.fitted = True

    def take_demonstrations(self) -> None:
        """Load the data of the specification, or collect those of the expert."""
        if self.spec.data:
            self.load(self.spec.data, self.spec.filter)
            return
        config = self.config
        self.collect(
            Round(0, config.demos, hold_steps=config.hold_steps, style=config.style)
        )

    def views(self, layout: ObservationSpec) -> list[dict[str, Any]]:
        """Observation options of the environment that every scene's demonstrations are collected in."""
        return [layout.env_options()] * len(self.scenes)

    def round_in(self, wanted: Round, place: int) -> Round:
        """A round in the scene at a place of ``scenes``."""
        del place
        return wanted

    def load_round(self, number: int, where: Filter | None = None) -> None:
        """Add the collected demonstrations of a round to the training data."""
        folder = self.folder.data(number)
        self.load([self.place(folder, name) for name in self.names], where)

    def collect(self, wanted: Round) -> None:
        """Collect the missing demonstrations of a round, in every scene, and add them to the training data.

        Raises:
            OutOfTime: the time budget ended before they were complete.
            BudgetTooSmallError: it will end before the first update.
        """
        began = time.perf_counter()
        tried = 0
        kept = 0
        self._expect(wanted)
        for place, name in enumerate(self.names):
            phase = f"collecting round {wanted.number}"
            if len(self.scenes) > 1:
                phase += f", {name}"

            pace = EpisodeClock(self.spec.resources.at_once)

            # Bound as defaults, since a closure would see the values of the last scene.
            def tell(
                now: Standing, phase: str = phase, pace: EpisodeClock = pace
            ) -> None:
                self.log.show({"phase": f"{phase}: {now.tried}/{wanted.episodes}"})
                seconds = pace.seconds(now.tried, self.log.seconds)
                if seconds is not None:
                    self.time.measured(seconds)

            self.log.show({"phase": phase})
            out = self.place(self.folder.data(wanted.number), name)
            standing = self.collectors[place].collect(
                self.round_in(wanted, place), out, tell, self.time.is_spent
            )
            if not standing.complete:
                raise OutOfTime
            tried += standing.tried
            kept += standing.kept
        if tried:
            self.time.estimate_evaluation((time.perf_counter() - began) / tried)
        self.load_round(wanted.number)
        numbers = {
            "round": wanted.number,
            "episodes": sum(source.episodes for source in self.sources),
            "collection_success": kept / max(tried, 1),
            "collection_seconds": round(time.perf_counter() - began, 2),
        }
        self.log.report(self.state.updates, self.state.samples, numbers)

    def _expect(self, wanted: Round) -> None:
        """Refuse a budget in which the first round would end without an update, before the round begins.

        Raises:
            BudgetTooSmallError: it tells what is needed.
        """
        out = self.folder.data(wanted.number)
        made = sum(tried_in(self.place(out, name)) for name in self.names)
        left = max(0, len(self.scenes) * wanted.episodes - made)
        kind = {
            "scenes": [scene.record() for scene in self.scenes],
            "view": self.layout.env_options(),
            "resources": asdict(self.spec.resources),
            "style": wanted.style,
            "hold_steps": wanted.hold_steps,
        }
        work = f"{left} episodes of the expert"
        less = "--demos and --eval-episodes"
        if self.expect(FirstUpdate(work, left, less, of_expert=True), kind) or not left:
            return
        self.log.show({"phase": "timing the expert"})
        at_once = self.spec.resources.at_once
        enough = self.time.seconds_left * at_once / left
        first = self.round_in(wanted, 0)
        wave = self.collectors[0].wave_seconds(first, enough, lambda: self.log.seconds)
        if wave is not None:
            self.time.check(wave / at_once)

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
        while self.state.round_step < updates:
            self.check_time()
            before = time.perf_counter()
            batch = self._batch(sampler)
            loading += time.perf_counter() - before
            rate = 1.0 - self.state.round_step / updates if cool_down else 1.0
            # Weights and counters change together, or a checkpoint after Ctrl-C would not fit.
            with held_interrupts():
                losses.append(self.trainer.update(batch, rate).loss)
                self.state.updates = self.trainer.step
                self.state.trained = True
                self.state.round_step += 1
                self.state.samples += len(batch.actions)
            if self.trainer.step % REPORT_EVERY == 0 or self.state.round_step == updates:
                seconds = time.perf_counter() - began
                numbers = {
                    "loss": ordered_sum(losses) / len(losses),
                    "samples_per_second": len(losses) * len(batch.actions) / seconds,
                    LOAD_SHARE: loading / seconds,
                }
                self.log.show({"phase": f"training, round {self.state.round}"})
                self.log.report(self.trainer.step, self.state.samples, numbers)
                losses = []
                began = time.perf_counter()
                loading = 0.0
            if time.perf_counter() - self._saved_at > CHECKPOINT_SECONDS:
                self.save()
        self.save()

    def _batch(self, sampler: BatchSampler) -> Batch:
        config = self.config
        chunks = sampler.batch(self.trainer.step, config.chunk, config.inputs)
        return Batch.of(chunks)

    def next_round(self) -> None:
        """Begin the next round."""
        self.state.round += 1
        self.state.round_step = 0
        self.save()
