"""Where a served policy is, and how to talk to it: ``ws://host:port?dialect=openpi&execute=8``."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated
from urllib.parse import parse_qsl, urlencode, urlsplit, urlunsplit

from mjhab.core.errors import fault, unknown_name, wrong_value
from mjhab.core.typed.bounds import Bound
from mjhab.core.typed.checks import check, check_between, check_least
from mjhab.core.typed.flags import Flag
from mjhab.serving.dialects.names import dialect_named

SCHEMES = ("ws://", "wss://")
PROMPTS = ("subtask", "task")
CHUNK = "chunk"
LAST = "last"
STILL = "still"
MEANWHILE = (CHUNK, LAST, STILL)
TOKEN_VARIABLE = "MJHAB_POLICY_TOKEN"
"""Environment variable with the token that a server asks for, at both ends."""
MAX_LATENCY_MS = 60_000
MAX_HZ = 1000
"""Largest numbers that are no mistake."""
_CREDENTIALS = re.compile(r"(?<=://).*@")
_FORM = "ws://host:port, as in ws://localhost:8000"


@dataclass(frozen=True)
class Address:
    """A policy server and how it is asked.

    Raises:
        UsageError: an unknown name or a number out of range.
    """

    uri: str
    """Where the server is: ws://host:port."""
    dialect: Annotated[str, Flag(metavar="openpi|roboarena|behavior|lerobot")] = "openpi"
    """With --policy ws://host:port: message format of the server, see `serving.dialects`."""
    execute: Annotated[int, Bound(1)] = 8
    """With --policy ws://host:port: actions of a chunk that are executed before the next request."""
    prompt: Annotated[str, Flag(metavar="subtask|task")] = "subtask"
    """With --policy ws://host:port: instruction in requests: of the active subtask, or of the whole task."""
    actions: Annotated[str, Flag(shown="default: that of the server, else joint")] = ""
    """With --policy ws://host:port: action space: joint (13 numbers), ee (end effector, gripper, base: 9),
    joint_position or joint_velocity (arm, gripper: 8)."""
    timeout: Annotated[float, Flag(metavar="SECONDS")] = 30.0
    """With --policy ws://host:port: longest wait for an answer [s], for each world that is asked about at once."""
    first_timeout: Annotated[float, Flag(metavar="SECONDS")] = 300.0
    """With --policy ws://host:port: longest wait for the first answer over a connection, before which servers compile,
    and for a connection until the server has answered once [s]. Never shorter than the timeout."""
    reconnect: Annotated[float, Flag(metavar="SECONDS")] = 20.0
    """With --policy ws://host:port: how long a lost server is looked for [s]."""
    real_time: bool = False
    """With --policy ws://host:port: the world goes on while the policy thinks, see --meanwhile."""
    latency_ms: Annotated[float | None, Flag(metavar="MS", shown="default: measured")] = (
        None
    )
    """With --real-time: every answer is there so long after its observation [ms]. Without it that is as long as its
    request takes."""
    hz: Annotated[
        float | None, Flag(metavar="HZ", shown="default: that of the control, 20")
    ] = None
    """With --real-time: control steps per second of the robot, by which a latency becomes a number of steps."""
    meanwhile: Annotated[str, Flag(metavar="chunk|last|still")] = CHUNK
    """With --real-time: what acts while the policy thinks: the rest of the chunk before, and its answer goes on from
    where the steps have got to; the last action once more; or the robot stands still."""
    batch: bool = False
    """With --policy ws://host:port and the dialect behavior or lerobot: one request for all worlds; arrays have the
    worlds in front, also when one is left."""

    def __post_init__(self) -> None:
        dialect = dialect_named(self.dialect)
        if self.prompt not in PROMPTS:
            raise unknown_name("prompt", self.prompt, PROMPTS)
        check_least("execute", self.execute, 1)
        for name in ("timeout", "first_timeout", "reconnect"):
            value = getattr(self, name)
            check(0.0 < value < float("inf"), name, value, "a number of seconds above 0")
        if self.meanwhile not in MEANWHILE:
            raise unknown_name("meanwhile", self.meanwhile, MEANWHILE)
        if self.latency_ms is not None:
            check_between("latency_ms", self.latency_ms, 0, MAX_LATENCY_MS)
        if self.hz is not None:
            good = 0.0 < self.hz <= MAX_HZ
            check(good, "hz", self.hz, f"above 0, and at most {MAX_HZ:g}")
        if not self.real_time:
            # Silently without effect, they would let a run be taken for one in real time.
            for name in ("latency_ms", "hz", "meanwhile"):
                value = getattr(self, name)
                if value != getattr(type(self), name):
                    raise wrong_value(
                        name,
                        value,
                        "left out: the world waits for every answer",
                        "Or add --real-time (in an address real_time=yes).",
                    )
        if self.batch and not dialect.batches:
            raise wrong_value(
                "batch",
                self.batch,
                f"left out: the dialect {self.dialect} has no batches",
            )

    @classmethod
    def parse(cls, spec: str) -> Address:
        """Read ``ws://host:port?name=value&...``; the names are those of the fields.

        Raises:
            UsageError: it is no such address, or see the class.
        """
        given = without_password(spec)
        try:
            parts = urlsplit(spec)
            port = parts.port
        except ValueError:
            # What Python says may hold a part of a password.
            raise wrong_value("policy", given, _FORM) from None
        if not spec.startswith(SCHEMES) or not parts.hostname or port is None:
            raise wrong_value("policy", given, _FORM)
        values: dict[str, object] = {}
        for name, text in parse_qsl(parts.query, keep_blank_values=True):
            if name not in _READERS:
                raise unknown_name("option of a served policy", name, _READERS)
            try:
                values[name] = _READERS[name](text)
            except ValueError as error:
                raise wrong_value(name, text, "another text", where=given) from error
        uri = urlunsplit((parts.scheme, parts.netloc, parts.path, "", ""))
        return cls(uri, **values)  # type: ignore[arg-type]

    @property
    def shown(self) -> str:
        """``uri`` for messages, without user name and password."""
        return without_password(self.uri)

    @property
    def port(self) -> int | None:
        """The port of ``uri``."""
        return urlsplit(self.uri).port


def without_password(spec: str) -> str:
    """A policy specification for messages and results: an address without user name and password."""
    # Other specifications may have an @ in a path.
    return _CREDENTIALS.sub("", spec) if spec.startswith(SCHEMES) else spec


def with_options(spec: str, options: Mapping[str, object]) -> str:
    """The address with options written into it; they replace those that it has.

    Raises:
        UsageError: it is no address of a server.
    """
    if not options:
        return spec
    if not spec.startswith(SCHEMES):
        names = ", ".join(f"--{name.replace('_', '-')}" for name in options)
        raise fault(names, f"for a served policy, --policy ws://host:port; got {spec}.")
    parts = urlsplit(spec)
    given = dict(parse_qsl(parts.query))
    given.update({name: str(value) for name, value in options.items()})
    return urlunsplit(parts._replace(query=urlencode(given)))


def _truth(text: str) -> bool:
    if text.lower() not in ("yes", "no", "true", "false", "1", "0"):
        raise ValueError(text)
    return text.lower() in ("yes", "true", "1")


_READERS = {
    "dialect": str,
    "execute": int,
    "prompt": str,
    "actions": str,
    "timeout": float,
    "first_timeout": float,
    "reconnect": float,
    "real_time": _truth,
    "latency_ms": float,
    "hz": float,
    "meanwhile": str,
    "batch": _truth,
}
