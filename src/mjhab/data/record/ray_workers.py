"""Workers as Ray actors on a cluster. Needs the extra ``scale``.

A node that sees the folder of the results writes into it. On any other node a worker writes into a temporary folder,
and its files travel with its messages, through Ray's object store, to the machine that asked.
"""

from __future__ import annotations

import contextlib
import importlib
import platform
import shutil
import socket
import tempfile
import threading
import time
import uuid
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

from mjhab.core.arithmetic.digest import arithmetic_digest
from mjhab.core.errors import UsageError
from mjhab.core.files.cache import write_atomic
from mjhab.core.files.code_digest import code_digest
from mjhab.core.libraries import missing_library
from mjhab.core.machine import install_extra
from mjhab.core.names import below
from mjhab.core.version import __version__
from mjhab.data.record.messages import (
    Message,
    Request,
    WorkerExited,
    WorkerFailed,
    failure,
)
from mjhab.data.record.workers import Stopped, Work, WorkSpec
from mjhab.data.store.episode_files import INDEX
from mjhab.data.store.storage import not_written

LOCAL = "local"
FOLDER = "folder"
_SHOWN = 12
"""Digits of a hash that are compared and shown."""
_LONGEST_STOP = 15.0
_LONGEST_CALL = 10.0
"""Time until an actor that does not stop is killed, and time limit for connecting to an address [s]."""


def node_identity() -> dict[str, str]:
    """What must be equal on all nodes: versions, code, and the last bits of arithmetic, see `arithmetic_digest`."""
    return {
        "mjhab": __version__,
        "mujoco": version("mujoco"),
        "code": code_digest("").hex()[:_SHOWN],
        "arithmetic": arithmetic_digest().hex()[:_SHOWN],
    }


def check_node(theirs: Mapping[str, str]) -> None:
    """Refuse a node that would compute other numbers; ``theirs``: what `_Actor.identity` says.

    Raises:
        UsageError: names what differs, on both sides.
    """
    for name, ours in node_identity().items():
        if theirs[name] != ours:
            raise UsageError(
                f"node {theirs['node']} of the Ray cluster has {name} {theirs[name]}, this machine {ours}: episodes "
                "would depend on who made them. Install the same mjhab and libraries on all nodes, on processors of "
                "one kind."
            )


@dataclass(frozen=True)
class _Answer:
    """What a request to an actor returns. files: (number of the folder, path in it, content) of each file carried."""

    messages: list[Message]
    files: list[tuple[int, str, bytes]] = field(default_factory=list)


class _Carrier:
    """Temporary folders of an actor whose node does not see those of the results."""

    def __init__(self, count: int) -> None:
        self._root = Path(tempfile.mkdtemp(prefix="mjhab-"))
        self.folders = tuple(self._root / str(number) for number in range(count))

    def take(self) -> list[tuple[int, str, bytes]]:
        """Contents of the files that were written since the last call, which are deleted; see `_Answer`."""
        found = [
            (number, path.relative_to(folder).as_posix(), path.read_bytes())
            for number, folder in enumerate(self.folders)
            for path in sorted(folder.rglob("*"))
            # The table of a folder tells sizes and times of files of this disk, and is made anew where they arrive.
            # Files with a dot are unfinished ones of a request that was stopped.
            if path.is_file() and path.name != INDEX and not path.name.startswith(".")
        ]
        # An actor ends by being killed: what it leaves behind is an empty folder at most.
        shutil.rmtree(self._root, ignore_errors=True)
        return found


class _Actor:
    """A worker as a Ray actor; its messages are returned together at the end of a request."""

    def __init__(self) -> None:
        self._stop = threading.Event()
        self._worker: Work | None = None
        self._carrier: _Carrier | None = None

    def identity(self, mark: Path) -> dict[str, str]:
        """What runs on this node, see `node_identity`, and whether it sees the file ``mark``."""
        # Texts alone, which every version of Python can unpickle.
        return {**node_identity(), "node": platform.node(), FOLDER: str(mark.is_file())}

    def begin(self, spec: WorkSpec, folder: Path, sees: bool) -> _Answer:
        """Make the worker; ``sees``: this node sees the folders of the results."""
        try:
            if not sees:
                self._carrier = _Carrier(1 + len(spec.more_folders))
                folder, *more = self._carrier.folders
                spec = spec.moved(tuple(more))
            self._worker = spec.start(folder)
            return _Answer([self._worker.ready])
        except Exception as error:
            return _Answer([failure(error)])

    def run(self, request: Request) -> _Answer:
        """Execute a request."""
        assert self._worker is not None, "begin was not called, or failed"
        said: list[Message] = []
        try:
            self._worker.run(request, said.append, self._stop.is_set)
        # What it had said so far still holds: those episodes are on the disk.
        except Stopped:
            pass
        except Exception as error:
            said.append(failure(error))
        return _Answer(said, self._carrier.take() if self._carrier else [])

    def stop(self) -> None:
        """Abort the current request after the next control step; runs in a second thread."""
        self._stop.set()


class RayPool:
    """Workers that are actors of a Ray cluster, one CPU each. See `WorkerPool`.

    Args:
        address: of the cluster; LOCAL starts one on this machine.

    Raises:
        UsageError: Ray is not installed, or there is no cluster at the address.
    """

    def __init__(self, address: str) -> None:
        try:
            ray: Any = importlib.import_module("ray")
        except ImportError as error:
            raise missing_library("--ray", ("Ray",), install_extra("scale")) from error
        self._ray = ray
        _check_reachable(address)
        try:
            ray.init(
                address=None if address == LOCAL else address,
                # Lines of the nodes would run through the progress display.
                log_to_driver=False,
                configure_logging=False,
            )
        except (ConnectionError, ValueError, RuntimeError) as error:
            raise UsageError(
                f"no Ray cluster can be reached at {address!r}: {error}"
            ) from error
        # Two threads: one works, the other receives the request to stop.
        self._class = ray.remote(num_cpus=1, max_concurrency=2, max_restarts=0)(_Actor)
        self._actors: dict[int, Any] = {}
        self._calls: dict[Any, int] = {}
        self._beginning: dict[int, tuple[WorkSpec, Path]] = {}
        """Work of actors whose node has not told its identity yet, and a file that tells whether it sees the folder."""
        self._folders: dict[int, tuple[Path, ...]] = {}
        """Where the files that an actor carries belong."""

    def start(self, number: int, spec: WorkSpec, folder: Path) -> None:
        """See `WorkerPool`."""
        # Workers may have another current directory.
        folder = folder.resolve()
        folder.mkdir(parents=True, exist_ok=True)
        # A name of its own, so that a folder of the same path on a node's own disk is told apart.
        mark = folder / f".{uuid.uuid4().hex}"
        mark.touch()
        self._actors[number] = self._class.remote()
        self._folders[number] = (folder, *spec.more_folders)
        self._beginning[number] = (spec, mark)
        # Before anything else is sent: another version might not be able to read it.
        self._calls[self._actors[number].identity.remote(mark)] = number

    def send(self, number: int, request: Request) -> None:
        """See `WorkerPool`."""
        self._calls[self._actors[number].run.remote(request)] = number

    def messages(self, seconds: float) -> list[tuple[int, Message]]:
        """See `WorkerPool`."""
        # One at a time, since Ray would wait for all of a larger number.
        ready, _ = self._ray.wait(list(self._calls), num_returns=1, timeout=seconds)
        found: list[tuple[int, Message]] = []
        for call in ready:
            number = self._calls.pop(call)
            try:
                answer = self._ray.get(call)
                hear = self._greet if number in self._beginning else self._received
                found += [(number, message) for message in hear(number, answer)]
            except self._ray.exceptions.RayActorError:
                # The file is no episode and would stay in the folder for good.
                self._forget_mark(number)
                # The process may still run on a node that cannot be reached.
                with contextlib.suppress(self._ray.exceptions.RayError):
                    self._ray.kill(self._actors[number])
                found.append((number, WorkerExited()))
            except self._ray.exceptions.RayError as error:
                found.append((number, WorkerFailed("error", str(error))))
        return found

    def _greet(self, number: int, theirs: Mapping[str, str]) -> list[Message]:
        """Let a worker begin whose node fits; a message if it does not."""
        spec, mark = self._beginning.pop(number)
        mark.unlink(missing_ok=True)
        try:
            check_node(theirs)
        except UsageError as error:
            return [failure(error)]
        begun = self._actors[number].begin.remote(
            spec, mark.parent, theirs[FOLDER] == str(True)
        )
        self._calls[begun] = number
        return []

    def _received(self, number: int, answer: _Answer) -> list[Message]:
        """Write the files that an actor carries; its messages, which tell of them."""
        try:
            for folder, name, content in answer.files:
                path = below(self._folders[number][folder], name)
                write_atomic(
                    path, lambda file, content=content: file.write_bytes(content)
                )
        except OSError as error:
            return [failure(not_written(self._folders[number][0], error))]
        return answer.messages

    def _forget_mark(self, number: int) -> None:
        """Delete the file that the node of a worker should have seen, if it did not come to that."""
        _, mark = self._beginning.pop(number, (None, None))
        if mark is not None:
            mark.unlink(missing_ok=True)

    def stop(self) -> None:
        """See `WorkerPool`. Also closes the connection to the cluster."""
        for actor in self._actors.values():
            with contextlib.suppress(self._ray.exceptions.RayError):
                # Nobody waits for the answer: the second thread sets the event at once.
                actor.stop.remote()
        end = time.monotonic() + _LONGEST_STOP
        # Requests end after their control step, and their files are then whole.
        while self._calls and time.monotonic() < end:
            ready, _ = self._ray.wait(
                list(self._calls), num_returns=1, timeout=_LONGEST_STOP
            )
            for call in ready:
                number = self._calls.pop(call)
                with contextlib.suppress(self._ray.exceptions.RayError):
                    # Finished episodes of a request that was stopped: a node that sees the folder has written them.
                    answer = self._ray.get(call)
                    if isinstance(answer, _Answer):
                        self._received(number, answer)
        for actor in self._actors.values():
            self._ray.kill(actor)
        for number in list(self._beginning):
            self._forget_mark(number)
        self._ray.shutdown()


def _check_reachable(address: str) -> None:
    """Check an address quickly, because Ray itself would try for minutes.

    Raises:
        UsageError: no server listens at the "host:port" or "ray://host:port".
    """
    host, _, port = address.rpartition("://")[2].rpartition(":")
    # "local", "auto" and others are not addresses to knock at.
    if not host or not port.isdigit():
        return
    try:
        # A refused connection fails in milliseconds here.
        socket.create_connection((host, int(port)), _LONGEST_CALL).close()
    except OSError as error:
        raise UsageError(
            f"no Ray cluster can be reached at {address!r}: {error}."
        ) from error
