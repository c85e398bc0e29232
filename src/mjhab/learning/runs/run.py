"""The folder of a training run, and its log.

config.json        the resolved config; a resumed run must match it
metrics.jsonl      one line per report: step, samples, seconds and metrics
tensorboard/       the same metrics for TensorBoard
data/round_000/    collected demonstrations of a round, in shards
training.safetensors   state that the next update depends on
student.safetensors    the policy for `mjhab eval --policy`
best.safetensors       of reinforcement: the policy with the best evaluation during training
evaluations/       run folders of the first and the latest evaluation, as of `mjhab eval`
summary.json, report.html   written at the end, also after Ctrl-C
"""

from __future__ import annotations

import json
import os
import shutil
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any

from rich.console import Console
from rich.live import Live
from rich.table import Table

from mjhab.core.arithmetic.sums import ordered_sum
from mjhab.core.errors import UsageError
from mjhab.core.files.locking import WriteLock
from mjhab.core.files.reading import parse_json
from mjhab.rollout.store import check_folder, write_text

CONFIG = "config.json"
METRICS = "metrics.jsonl"
TENSORBOARD = "tensorboard"
DATA = "data"
SUFFIX = ".safetensors"
TRAINING = "training.safetensors"
STUDENT = "student.safetensors"
BEST = "best.safetensors"
ROUNDS = "rounds"
EVALUATIONS = "evaluations"
SUMMARY = "summary.json"
REPORT = "report.html"
REFRESH_SECONDS = 0.5
"""Shortest time between two updates of the table in the terminal [s]."""


ON_THE_WAY = "on_the_way"
FINAL = "final"
"""Which evaluation a row of metrics.jsonl tells of ("evaluation"): one during training, or that of the finished policy.
"""
WORK = (f"*{SUFFIX}", "*.h5", "*.jsonl", "complete.json", "row.json")
"""Files of a run that cost time to make, below its folder; metrics.jsonl counts if it has a line."""


@contextmanager
def refused_leaves_nothing(path: Path) -> Iterator[None]:
    """After a UsageError within this context, delete what it has put into ``path``, so that a corrected command may
    use the folder.

    A folder that held something before stays as it is, and so does one with work in it, see WORK.
    """
    is_new = not path.exists()
    was_empty = is_new or (path.is_dir() and not any(path.iterdir()))
    try:
        yield
    except UsageError:
        if was_empty and path.is_dir() and not _has_work(path):
            for entry in list(path.iterdir()):
                if entry.is_dir():
                    shutil.rmtree(entry, ignore_errors=True)
                else:
                    entry.unlink(missing_ok=True)
            if is_new:
                path.rmdir()
        raise


def _has_work(path: Path) -> bool:
    return any(
        file.stat().st_size > 0 for pattern in WORK for file in path.rglob(pattern)
    )


class TrainingFolder:
    """An opened folder of a run: nobody else can open it until `close`. Make one with ``TrainingFolder.open``."""

    def __init__(
        self, path: Path, config: Mapping[str, Any], lock: WriteLock | None = None
    ) -> None:
        self.path = path
        self.config = dict(config)
        self._lock = lock

    @classmethod
    def open(
        cls, path: Path, config: Mapping[str, Any], *, resume: bool = False
    ) -> TrainingFolder:
        """Prepare ``path`` for a run of ``config`` (plain JSON data).

        Raises:
            UsageError: the folder is not empty and ``resume`` is not set, it holds a run of another config, or another
                process writes into it.
        """
        check_folder(path, config, resume=resume, replaceable=False)
        path.mkdir(parents=True, exist_ok=True)
        lock = WriteLock(path / CONFIG, path)
        write_text(path / CONFIG, json.dumps(config, indent=2) + "\n")
        return cls(path, config, lock)

    def close(self) -> None:
        """Let others write into the folder; closing twice is fine."""
        if self._lock is not None:
            self._lock.release()
            self._lock = None

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

    def read_metrics(self, step: int | None = None) -> list[dict[str, Any]]:
        """Read the reported rows, up to ``step`` updates if given; incomplete lines are skipped."""
        path = self.path / METRICS
        found = []
        for line in (
            path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
        ):
            try:
                found.append(parse_json(line))
            except ValueError:
                continue
        return [row for row in found if step is None or row["step"] <= step]

    def write_metrics(self, rows: list[dict[str, Any]]) -> None:
        """Replace the reported rows."""
        write_text(self.path / METRICS, "".join(json.dumps(row) + "\n" for row in rows))

    def write_summary(self, summary: Mapping[str, Any]) -> None:
        """Write summary.json atomically."""
        write_text(self.path / SUMMARY, json.dumps(summary, indent=2) + "\n")

    def write_report(self, html: str) -> Path:
        """Write report.html atomically and return its path."""
        write_text(self.path / REPORT, html)
        return self.path / REPORT


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

        self.rows = folder.read_metrics(step)
        folder.write_metrics(self.rows)
        self._file = (folder.path / METRICS).open("a", encoding="utf-8")
        self._board = SummaryWriter(
            str(folder.path / TENSORBOARD), purge_step=step or None
        )
        self._began = time.perf_counter() - earlier_seconds
        earlier_cpu_seconds = max((row["cpu_seconds"] for row in self.rows), default=0.0)
        # One process may train several policies in turn (`mjhab reproduce`).
        self._cpu_began = _cpu_seconds() - earlier_cpu_seconds
        self._shown: dict[str, str] = {}
        self._title = f"mjhab train, {folder.path}"
        self._live = Live(
            console=Console(stderr=True), auto_refresh=False, transient=False
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
        self._live.__enter__()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._live.update(self._table(), refresh=True)
        self._live.__exit__(kind, error, trace)
        if not self._live.console.is_terminal:
            # In a file the table has no end of line, and an error message would follow its frame.
            self._live.console.line()
        self._board.close()
        self._file.close()


def _cpu_seconds() -> float:
    """CPU time of this process and of its children that have ended [s]."""
    return ordered_sum(os.times()[:4])
