"""``mjhab serve``: serve a policy of mjhab over websockets."""

from __future__ import annotations

import os
import secrets
import signal
import threading
from typing import TYPE_CHECKING

from mjhab.cli.output import print_json
from mjhab.core.progress import say
from mjhab.evaluation.resolve import PolicyOptions, full_spec
from mjhab.evaluation.served.spec import ServeSpec
from mjhab.serving import require_serving
from mjhab.serving.address import TOKEN_VARIABLE

if TYPE_CHECKING:
    from mjhab.serving.server import PolicyServer


def run_serve(spec: ServeSpec, json: bool) -> int:
    """Serve until Ctrl-C or SIGTERM; returns 0."""
    require_serving()
    from mjhab.evaluation.served.twin import TwinResponder
    from mjhab.serving.dialects.names import dialect_named
    from mjhab.serving.server import LOCAL_HOSTS, PolicyServer, ServerOptions

    dialect = dialect_named(spec.dialect)
    asked = spec.asked
    policy = full_spec(spec.policy, asked.task, asked.subtask, asked.target)
    responder = TwinResponder(policy, PolicyOptions(asked.seed, spec.style), asked.assets)
    token = os.environ.get(TOKEN_VARIABLE, "")
    # Who serves beyond this machine without a token would let anybody use it.
    made_up = not token and spec.host not in LOCAL_HOSTS
    if made_up:
        token = secrets.token_urlsafe(24)
    limit = spec.max_message_mb << 20
    server = PolicyServer(
        responder, dialect, ServerOptions(spec.host, spec.port, token, limit)
    )
    # First and alone on its line: scripts that ask for port 0 read it from there.
    print(server.port, flush=True)
    if spec.port not in (0, server.port):
        _tell(f"port {spec.port} is in use; listening on {server.port} instead.")
    if made_up:
        _tell(f"clients need this token: export {TOKEN_VARIABLE}={token}")
    _tell(
        f"{responder.facts.name} at ws://{spec.host}:{server.port}, dialect {dialect.name}; Ctrl-C ends it."
    )
    _run(server)
    if json:
        counts = {"requests": server.requests, "refused": server.refused}
        print_json({"port": server.port, **counts})
    return 0


def _run(server: PolicyServer) -> None:
    """Serve until SIGINT or SIGTERM."""
    ended = threading.Event()
    signals = (signal.SIGINT, signal.SIGTERM)
    # A handler, because SIGTERM would end the process in the middle of an answer.
    before = [signal.signal(number, lambda *_: ended.set()) for number in signals]
    # Signals reach the main thread alone, so that one waits and another serves.
    thread = threading.Thread(target=server.run, daemon=True)
    thread.start()
    try:
        ended.wait()
    finally:
        for number, handler in zip(signals, before, strict=True):
            # Tests serve several times in one process.
            signal.signal(number, handler)
        server.shutdown()


def _tell(text: str) -> None:
    say(f"mjhab: {text}")
