"""Options of `mjhab serve`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import tyro

from mjhab.bench.specs import ServingSpec
from mjhab.cli.options.common import Assets, MaybeName, Name, Number, PolicyName


@dataclass(frozen=True)
class ServeOptions:
    """Serve a policy of mjhab over websockets, for `mjhab eval --policy ws://host:port` on this or another machine.

    For instance: `mjhab serve expert --port 8000`, or `mjhab serve my.safetensors --dialect behavior`

    The first line printed is the port. Ctrl-C ends it. Beyond this machine (--host 0.0.0.0) only clients with the token
    are let in: that of the environment variable MJHAB_POLICY_TOKEN, or one that is made up and printed.
    """

    policy: Annotated[tyro.conf.Positional[PolicyName], tyro.conf.arg(metavar="NAME")]
    """What is served: expert, student (with --task, --subtask and --target), random, zero, a CHECKPOINT.safetensors, or
    FILE.py:CLASS."""
    dialect: Name = "openpi"
    """What is spoken: openpi, roboarena or behavior."""
    host: Name = "127.0.0.1"
    """Where to listen; 0.0.0.0 for every network of this machine."""
    port: Number = 8000
    """Port to listen on; the next one that is free if it is in use. 0 for any that is free."""
    style: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME=VALUE ...")] = ()
    """How the expert acts, see `mjhab eval --help`."""
    seed: Number = 0
    """Seed of the policy, where it draws numbers."""
    task: Name = "set_table"
    """With student: the task."""
    subtask: MaybeName = None
    """With student: the subtask."""
    target: MaybeName = None
    """With student: the object or link."""
    assets: Assets = "builtin"
    """Asset pack of the homes that may be asked for: builtin, or the folder of another pack."""
    max_message_mb: Number = 16
    """Largest message that is read [MiB]; who sends a larger one is cut off."""
    json: bool = False
    """Print one line of JSON at the end: port, requests answered, requests refused."""


@dataclass(frozen=True)
class BenchServingOptions(ServingSpec):
    """Measure what a policy behind a websocket costs, and what becomes of episodes whose server is killed.

    Fails if an episode is lost, or if a request with two images takes more than 5 ms on this machine.
    """

    worlds: Number = ServingSpec.worlds
    """Worlds that ask at the same time."""
    requests: Number = ServingSpec.requests
    """Requests per dialect that are timed."""
    steps: Number = ServingSpec.steps
    """Control steps against a server that is killed; episodes are finished."""
    restarts: Number = ServingSpec.restarts
    """So often it is killed and started again."""
    json: bool = False
    """Print one line of JSON instead of tables."""
