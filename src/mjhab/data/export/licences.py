"""Licences in the head of a card, as the hub knows them."""

from __future__ import annotations

import re

_KNOWN = (
    (r"CC BY-NC 4\.0", "cc-by-nc-4.0"),
    (r"CC BY 4\.0", "cc-by-4.0"),
    (r"Apache-2\.0", "apache-2.0"),
    (r"MIT\b", "mit"),
)
"""How licences of assets are written, and the hub's names of them; the stricter ones first."""


def licence_head(licence: str) -> list[str]:
    """Lines of a card's YAML head: the hub's name of a licence, or "other" and its words.

    Terms of several assets are told as they are: the hub knows a single licence.
    """
    parts = [part for part in licence.split("; ") if part]
    names = {_name(part) for part in parts}
    if len(names) == 1 and (name := names.pop()):
        return [f"license: {name}"]
    # The words stand in a quoted YAML string, which these signs would end.
    words = re.sub(r'["\n\\]', " ", licence) or "unknown"
    return ["license: other", f'license_name: "{words}"']


def _name(licence: str) -> str:
    return next((name for words, name in _KNOWN if re.search(words, licence)), "")
