"""What the benchmarks have in common as commands: options of one dataclass, output, exit codes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TypeVar

import tyro

from mjhab.cli.main import exit_code_of
from mjhab.core.files.outputs import check_output
from mjhab.core.typed.bounds import SEED, Bound, check_bound

Spec = TypeVar("Spec")
CONFIG = (tyro.conf.OmitArgPrefixes, tyro.conf.FlagCreatePairsOff)


def run_command(
    name: str,
    spec_type: type[Spec],
    work: Callable[[Spec], int],
    words: Sequence[str] | None = None,
    minima: Mapping[str, float] | None = None,
) -> int:
    """Parse the options of a benchmark and run it; errors end it with a line on stderr.

    Args:
        name: of its module.
        spec_type: dataclass of its options; their docstrings are the help.
        work: takes the options and returns the exit code.
        words: of the command line; those of ``sys.argv`` if None.
        minima: smallest value by option, where it is not 0; of every number of an option that takes several.

    Returns:
        The exit code, as those of ``mjhab``: 2 for an invalid request, 1 for a failure.
    """

    def parsed() -> int:
        spec = tyro.cli(
            spec_type, prog=f"python -m benchmarks.{name}", args=words, config=CONFIG
        )
        for option, value in vars(spec).items():
            told = f"--{option.replace('_', '-')}"
            if isinstance(value, Path):
                check_output(value, told)
            least = (minima or {}).get(option, 0)
            check_bound(told, value, SEED if option == "seed" else Bound(least))
        return work(spec)

    return exit_code_of(parsed)
