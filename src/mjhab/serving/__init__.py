"""Policies that run elsewhere: messages over websockets, the two ends of the line, and the dialects that are spoken.

Protocol code alone: what an observation holds and what a policy is, `mjhab.evaluation.served` knows. Nothing is ever
unpickled.
"""

from __future__ import annotations

from mjhab.core.libraries import require_libraries


def require_serving() -> None:
    """Refuse to go on without the libraries of served policies.

    Raises:
        UsageError: one of them is not installed.
    """
    require_libraries("a served policy", ("msgpack", "websockets"), "serve")
