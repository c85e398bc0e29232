"""``mjhab serve``: serve a policy of mjhab over websockets."""

from __future__ import annotations

import os
import secrets
import signal
import sys
import threading
from typing import TYPE_CHECKING

from mjhab.cli.options.policies.serve import ServeOptions
from mjhab.cli.output import at_least, print_json
from mjhab.core.errors import UsageError
from mjhab.evaluation.resolve import PolicyOptions, full_spec
from mjhab.serving import require_serving
from mjhab.serving.address import SCHEMES, TOKEN_VARIABLE, without_password

if TYPE_CHECKING:
    from mjhab.serving.server import PolicyServer


def run_serve(options: ServeOptions) -> int:
    """Serve until Ctrl-C or SIGTERM; returns 0."""
    at_least("seed", options.seed, 0)
    at_least("max-message-mb", options.max_message_mb, 1)
    if options.policy.startswith(SCHEMES):
        raise UsageError(f"{without_password(options.policy)} is served already.")
    require_serving()
    from mjhab.evaluation.served.twin import TwinResponder
    from mjhab.serving.dialects.names import dialect_named
    from mjhab.serving.server import LOCAL_HOSTS, PolicyServer, ServerOptions

    dialect = dialect_named(options.dialect)
    spec = full_spec(options.policy, options.task, options.subtask, options.target)
    responder = TwinResponder(
        spec, PolicyOptions(options.seed, options.style), options.assets
    )
    token = os.environ.get(TOKEN_VARIABLE, "")
    made_up = not token and options.host not in LOCAL_HOSTS
    if made_up:
        token = secrets.token_urlsafe(24)
    limit = options.max_message_mb << 20
    server = PolicyServer(
        responder, dialect, ServerOptions(options.host, options.port, token, limit)
    )
    print(server.port, flush=True)
    if options.port not in (0, server.port):
        _tell(f"port {options.port} is in use; listening on {server.port} instead.")
    if made_up:
        _tell(f"clients need this token: export {TOKEN_VARIABLE}={token}")
    _tell(
        f"{responder.facts.name} at ws://{options.host}:{server.port}, dialect {dialect.name}; Ctrl-C ends it."
    )
    _run(server)
    if options.json:
        counts = {"requests": server.requests, "refused": server.refused}
        print_json({"port": server.port, **counts})
    return 0


def _run(server: PolicyServer) -> None:
    """Serve until SIGINT or SIGTERM."""
    ended = threading.Event()
    signals = (signal.SIGINT, signal.SIGTERM)
    before = [signal.signal(number, lambda *_: ended.set()) for number in signals]
    thread = threading.Thread(target=server.run, daemon=True)
    thread.start()
    try:
        ended.wait()
    finally:
        for number, handler in zip(signals, before, strict=True):
            signal.signal(number, handler)
        server.shutdown()


def _tell(text: str) -> None:
    print(f"mjhab: {text}", file=sys.stderr, flush=True)
