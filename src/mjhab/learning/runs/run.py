"""The folder of a training run, and its log.

config.json        the resolved config; a resumed run must match it, but may be longer (`learning.resuming`)
metrics.jsonl      one line per report: step, samples, seconds and metrics
tensorboard/       the same metrics for TensorBoard
data/round_000/    collected demonstrations of a round, in shards
training.safetensors   state that the next update depends on
student.safetensors    the policy for `mjhab eval --policy`
backbone.onnx      copy of the pretrained network whose features the policy sees, if it does
best.safetensors       of reinforcement: the policy with the best evaluation during training
evaluations/       run folders of the first and the latest evaluation, as of `mjhab eval`
summary.json, report.html   written at the end, also after Ctrl-C
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.live import Live
from rich.table import Table

from mjhab.core.arithmetic.sums import ordered_sum
from mjhab.core.files.cache import write_text
from mjhab.core.files.run_folder import RunFolder
from mjhab.learning.resuming import as_begun_now
from mjhab.reports.compared.trainings import FINAL, METRICS, read_metrics

TENSORBOARD = "tensorboard"
DATA = "data"
SUFFIX = ".safetensors"
TRAINING = "training.safetensors"
STUDENT = "student.safetensors"
BEST = "best.safetensors"
ROUNDS = "rounds"
EVALUATIONS = "evaluations"
REFRESH_SECONDS = 0.5
"""Shortest time between two updates of the table in the terminal [s]."""


class TrainingFolder(RunFolder):
    """The folder of a training run; metrics.jsonl counts as work if it has a line."""

    WORK = (f"*{SUFFIX}", "*.h5", "*.jsonl", "complete.json")

    @classmethod
    def _as_begun_now(
        cls, old: Mapping[str, Any], config: Mapping[str, Any]
    ) -> Mapping[str, Any]:
        return as_begun_now(old, config)

    @property
    def training(self) -> Path:
        """Path of the training checkpoint: the state that the next update depends on."""
        return self.path / TRAINING

    @property
    def student(self) -> Path:
        """Path of the student checkpoint: the policy for evaluation."""
        return self.path / STUDENT

    @property
    def best(self) -> Path:
        """Path of the student checkpoint with the best evaluation during training."""
        return self.path / BEST

    @property
    def kept_student(self) -> str | None:
        """Path of the student checkpoint as text; None while there is none."""
        return str(self.student) if self.student.is_file() else None

    def data(self, number: int) -> Path:
        """Folder of the demonstrations of a round."""
        return self.path / DATA / f"round_{number:03d}"

    def round_student(self, number: int) -> Path:
        """Path of the student checkpoint that starts the episodes of a round."""
        return self.path / ROUNDS / f"round_{number:03d}.safetensors"

    def evaluation(self, name: str) -> Path:
        """Run folder of an evaluation."""
        return self.path / EVALUATIONS / name


@dataclass(frozen=True)
class TrainingResult:
    """Result of a training run.

    summary: results as JSON data. report: path of the HTML report. interrupted: Ctrl-C ended the run.
    """

    summary: dict[str, Any]
    report: Path
    interrupted: bool


class Logbook:
    """Log of a run: lines in metrics.jsonl, TensorBoard curves and a table in the terminal. A context manager.

    Args:
        folder: of the run.
        earlier_seconds: wall time of the run before this start.
        step: number of updates in the checkpoint that the run resumes from; rows of later updates are dropped.
    """

    def __init__(
        self, folder: TrainingFolder, earlier_seconds: float = 0.0, step: int = 0
    ) -> None:
        from torch.utils.tensorboard.writer import SummaryWriter

        # Lines after the checkpoint are of updates that will be made again.
        self.rows = read_metrics(folder.path, step)
        lines = "".join(json.dumps(row) + "\n" for row in self.rows)
        write_text(folder.path / METRICS, lines)
        self._file = (folder.path / METRICS).open("a", encoding="utf-8")
        self._board = SummaryWriter(
            # TensorBoard would draw both the old and the new points of repeated steps.
            str(folder.path / TENSORBOARD),
            purge_step=step or None,
        )
        self._began = time.perf_counter() - earlier_seconds
        earlier_cpu_seconds = max((row["cpu_seconds"] for row in self.rows), default=0.0)
        # One process may train several policies in turn (`mjhab reproduce`).
        self._cpu_began = _cpu_seconds() - earlier_cpu_seconds
        self._shown: dict[str, str] = {}
        self._title = f"mjhab train, {folder.path}"
        self._live = Live(
            console=Console(stderr=True),
            auto_refresh=False,
            transient=False,
        )
        self._drawn = 0.0

    @property
    def seconds(self) -> float:
        """Wall time of the run, earlier starts included [s]."""
        return time.perf_counter() - self._began

    @property
    def cpu_seconds(self) -> float:
        """CPU time of the run in this process and in workers that have ended, earlier starts included [s]."""
        return _cpu_seconds() - self._cpu_began

    def report(self, step: int, samples: int, numbers: Mapping[str, float | str]) -> None:
        """Log metrics after ``step`` updates and ``samples`` samples; texts go into metrics.jsonl alone."""
        row = {"step": step, "samples": samples, "seconds": round(self.seconds, 2)}
        row |= {"cpu_seconds": round(self.cpu_seconds, 2), **numbers}
        self.rows.append(row)
        self._file.write(json.dumps(row) + "\n")
        # A kill must not cost the curve.
        self._file.flush()
        shown = {"updates": f"{step:,}", "samples": f"{samples:,}"}
        # The final evaluation has curves of its own: its episodes are others.
        group = "final/" if numbers.get("evaluation") == FINAL else ""
        for name, value in numbers.items():
            if isinstance(value, str):
                shown[name] = value
            else:
                self._board.add_scalar(f"{group}{name}", value, step)
                shown[name] = f"{value:.4g}"
        self.show(shown)

    def show(self, words: Mapping[str, str]) -> None:
        """Set rows of the table in the terminal, by name."""
        self._shown |= words
        now = time.perf_counter()
        if now - self._drawn > REFRESH_SECONDS:
            self._drawn = now
            self._live.update(self._table(), refresh=True)

    def say(self, text: str) -> None:
        """Print a line above the table, at once, also where the table is only printed at the end (a file)."""
        self._live.console.print(f"mjhab: {text}", soft_wrap=True, highlight=False)

    def _table(self) -> Table:
        table = Table(title=self._title, title_justify="left", show_header=False)
        minutes, seconds = divmod(int(self.seconds), 60)
        for name, value in {**self._shown, "time": f"{minutes}:{seconds:02d}"}.items():
            table.add_row(name, value)
        return table

    def __enter__(self) -> Logbook:
        self._live.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._live.update(self._table(), refresh=True)
        self._live.stop()
        if not self._live.console.is_terminal:
            # In a file the table has no end of line, and an error message would follow its frame.
            self._live.console.line()
        self._board.close()
        self._file.close()


def _cpu_seconds() -> float:
    """CPU time of this process and of its children that have ended [s]."""
    # The fifth is wall time.
    return ordered_sum(os.times()[:4])
