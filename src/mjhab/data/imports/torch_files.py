"""Files that ``torch.save`` wrote: tensors and plain data of others, of which no code is executed."""

from __future__ import annotations

import pickle
import warnings
from pathlib import Path
from typing import Any

from mjhab.core.errors import fault


def read_torch(path: Path, what: str, remedy: str) -> Any:
    """The content of a file of torch, on the CPU.

    Args:
        path: the file.
        what: what it should be, for messages: "a checkpoint of torch".
        remedy: how to make one that needs nothing but tensors, a sentence.

    Raises:
        UsageError: there is no such file, it is damaged, or it needs more than tensors; the message then tells what it
            asks for.
    """
    import torch

    if not path.is_file():
        raise fault(path, f"does not exist or is no file; give {what}.")
    try:
        # Torch warns of files that it then refuses, and its errors advise to load them with weights_only=False.
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            # A checkpoint from the internet must not run code, and may name a GPU that is not here.
            return torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        needed = _unsafe_names(path)
        if not needed:
            raise fault(
                path,
                f"cannot be read as {what}: it is none, or holds more than tensors. Nothing in it was "
                f"executed. {remedy}",
            ) from error
        raise fault(
            path,
            "needs more than tensors and was refused; nothing in it was executed. It asks for: "
            f"{', '.join(needed)}. {remedy}",
        ) from error
    except (
        Exception
    ) as error:  # a damaged pickle ends in any error: IndexError, TypeError, struct.error
        text = (str(error).splitlines() or [type(error).__name__])[0]
        raise fault(path, f"cannot be read as {what}: {text}") from error


def _unsafe_names(path: Path) -> list[str]:
    """Names that unpickling the file would import besides tensors, found without loading it."""
    import torch

    try:
        return sorted(torch.serialization.get_unsafe_globals_in_checkpoint(str(path)))
    except (RuntimeError, ValueError, OSError, pickle.UnpicklingError):
        return []
