"""Reuse of a demonstration buffer that an earlier start of the same run has filled."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import torch

from mjhab.core.files.run_folder import write_text
from mjhab.learning.reinforcement.replay import ReplayBuffer, ReplayShape

COMPLETE = "complete.json"
"""File that marks a complete buffer; it holds the buffer's shape and ring positions."""


def kept_demonstrations(folder: Path, fill: Callable[[], ReplayBuffer]) -> ReplayBuffer:
    """The buffer in ``folder`` if an earlier start of the run has completed it, else the result of ``fill``.

    On a GPU buffers are not files and the folder does not exist, so every start fills the buffer anew.
    """
    done = folder / COMPLETE
    if done.is_file():
        kept = json.loads(done.read_text(encoding="ascii"))
        buffer = ReplayBuffer(
            ReplayShape.from_plain(kept["shape"]), torch.device("cpu"), folder
        )
        # An array that was deleted was made anew, empty: then all is filled again.
        if not buffer.is_new:
            buffer.position.copy_(torch.tensor(kept["position"]))
            return buffer
    buffer = fill()
    if folder.is_dir():
        kept = {"shape": asdict(buffer.shape), "position": buffer.position.tolist()}
        # Last: the mark says that the arrays are complete.
        write_text(done, json.dumps(kept) + "\n")
    return buffer
