"""Wrappers that pass on what they do not have, as those of Gymnasium before 1.0, for which scripts were written."""

from __future__ import annotations

from typing import Any

import gymnasium


class ForwardingWrapper(gymnasium.Wrapper):
    """A wrapper whose missing attributes are those of the environment below; ``_...`` are its own."""

    def __getattr__(self, name: str) -> Any:
        # Before __init__ has set `env`, looking below it would never end.
        if name.startswith("_") or name == "env":
            raise AttributeError(f"{type(self).__name__} has no attribute {name!r}")
        return getattr(self.env, name)
