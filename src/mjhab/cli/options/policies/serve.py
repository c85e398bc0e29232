"""Options of `mjhab serve`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import tyro

from mjhab.cli.options.common import Assets, MaybeName, Name, Number, PolicyName


@dataclass(frozen=True)
class ServeOptions:
    """Serve a policy of mjhab over websockets, for `mjhab eval --policy ws://host:port` on this or another machine.

    For instance: `mjhab serve expert --port 8000`, or `mjhab serve my.safetensors --dialect behavior`

    The first printed line contains the port. Ctrl-C ends the server. On other networks (--host 0.0.0.0) clients need a
    token: that of the environment variable MJHAB_POLICY_TOKEN, or else a random one, which is printed.
    """

    policy: Annotated[tyro.conf.Positional[PolicyName], tyro.conf.arg(metavar="NAME")]
    """The policy: expert, student (with --task, --subtask and --target), random, zero, a CHECKPOINT.safetensors, or
    FILE.py:CLASS."""
    dialect: Name = "openpi"
    """Message format: openpi, roboarena or behavior."""
    host: Name = "127.0.0.1"
    """Address to listen on; 0.0.0.0 for all networks of this machine."""
    port: Number = 8000
    """Port to listen on; if it is in use, the next free one. 0 for any free port."""
    style: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME=VALUE ...")] = ()
    """Style of the expert, see `mjhab eval --help`."""
    seed: Number = 0
    """Seed of the policy's random numbers."""
    task: Name = "set_table"
    """With student: the task."""
    subtask: MaybeName = None
    """With student: the subtask."""
    target: MaybeName = None
    """With student: the object or link."""
    assets: Assets = "builtin"
    """Asset pack of the homes that clients may use: builtin, or the folder of another pack."""
    max_message_mb: Number = 16
    """Largest accepted message [MiB]; clients that send a larger one are disconnected."""
    json: bool = False
    """Print one line of JSON at the end: port, requests answered, requests refused."""
