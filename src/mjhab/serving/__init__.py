"""Policies that run elsewhere: messages over websockets, the two ends of the line, and the dialects that are spoken.

Protocol code alone: what an observation holds and what a policy is, `mjhab.evaluation.served` knows. Nothing is ever
unpickled.
"""

from __future__ import annotations

from importlib.util import find_spec

from mjhab.core.errors import fault
from mjhab.core.machine import install_extra


def require_serving() -> None:
    """Refuse to go on without the libraries of served policies.

    Raises:
        UsageError: one of them is not installed.
    """
    lacking = [name for name in ("msgpack", "websockets") if find_spec(name) is None]
    if lacking:
        raise fault(
            f"served policies need {' and '.join(lacking)}", f"{install_extra('serve')}."
        )
