"""What a training run leaves."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class TrainingResult:
    """Result of a training run.

    summary: results as JSON data. report: path of the HTML report. interrupted: Ctrl-C ended the run.
    """

    summary: dict[str, Any]
    report: Path
    interrupted: bool
