"""``mjhab config COMMAND ...``: what a command line means, without running it."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mjhab.cli.output import print_json
from mjhab.cli.parsing import Parsed
from mjhab.config.env_spec import EnvSpec


def run_config(parsed: Parsed) -> int:
    """Print the resolved specification of a parsed command line; returns 0.

    Raises:
        UsageError: the specification refuses a value.
    """
    spec = parsed.spec
    options = {name: _plain(value) for name, value in _fields_of(spec).items()}
    # The given options alone would hide what the profile decides.
    if isinstance(spec, EnvSpec):
        options["env"] = _plain(_fields_of(spec.asked))
    print_json({"command": parsed.command.name, "options": options})
    return 0


def _fields_of(record: Any) -> dict[str, Any]:
    return {
        field.name: getattr(record, field.name) for field in dataclasses.fields(record)
    }


def _plain(value: Any) -> Any:
    """JSON data of a value; other objects in words."""
    if isinstance(value, Mapping):
        return {str(key): _plain(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(one) for one in value]
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return _plain(_fields_of(value))
    if isinstance(value, Path):
        return str(value)
    return value if isinstance(value, str | int | float | None) else repr(value)
