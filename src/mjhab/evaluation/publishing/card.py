"""The card (README.md) of a data set, made of its record."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from mjhab.data.export.licences import licence_head

_SIZES = ((1_000, "n<1K"), (10_000, "1K<n<10K"), (100_000, "10K<n<100K"))
"""Size categories of the hub by number of episodes."""
_READ = """
One line reads it (`pip install mjhab`):

```python
from mjhab.data.store.places import episodes; from pathlib import Path; episode = next(episodes(Path("demonstrations")))
```

So does h5py alone (docs/data/format.md of mjhab). For LeRobot, with point clouds:
`mjhab export lerobot demonstrations --splits splits.json --points 1024 --out exported`; in another size:
`mjhab replay demonstrations --render rgbd --camera-size 224 --out larger.h5`.
"""


def card(about: Mapping[str, Any]) -> str:
    """Text of README.md; ``about``: the record, see `about.describe`."""
    sections = {
        "": _summary(about),
        "What is in it": _contents(about),
        "Read it": _READ.strip(),
        "Sentences": _sentences(about["sentences"]),
        "Skills": _skills(about["skills"]),
        f"Actions (`{about.get('control_mode', '')}`)": _actions(about["actions"]),
        "State": columns_table(about["state"]),
        "Velocity of the base": _base_velocity(about.get("base_velocity", ())),
        "Images": _images(about),
        "Licence of the assets": about["licence"] or "none is known",
    }
    title = f"# {about['name']}: demonstrations of household subtasks"
    body = [
        f"## {name}\n\n{text}" if name else text
        for name, text in sections.items()
        if text
    ]
    return "\n\n".join([_head(about), title, *body]) + "\n"


def _head(about: Mapping[str, Any]) -> str:
    size = next((name for most, name in _SIZES if about["episodes"] < most), "100K<n<1M")
    lines = [
        *licence_head(about["licence"]),
        f"pretty_name: mjhab {about['name']}",
        "tags: [robotics, mobile-manipulation, mjhab, vision-language-action]",
        "task_categories: [robotics]",
        f"size_categories: [{size}]",
    ]
    return "\n".join(["---", *lines, "---"])


def _summary(about: Mapping[str, Any]) -> str:
    cost = about["per_1000_episodes"]
    stage = f" (walls: {about['stage']})" if about.get("stage") else ""
    homes = f"the homes {about.get('assets') or 'builtin'}{stage}"
    return "\n".join(
        [
            f"{about['episodes']} demonstrations, {about['frames']} control steps at {about['hz']} Hz, by "
            f"`{about.get('policy', '')}` with the robot {about.get('robot', '')} in {homes}; {about['gb']} GB.",
            f"Physics, rules (profile `{about.get('profile', '')}`) and recording: mjhab {about.get('mjhab', '')}.",
            "",
            "```bash",
            about["command"],
            "```",
            "",
            f"It took {about['hours']} hours ({about['cpu_hours']} CPU hours); per 1,000 recorded episodes "
            f"{cost['cpu_hours']} CPU hours and {cost['gb']} GB. Episodes end by the rule `{about.get('until', '')}`.",
        ]
    )


def _contents(about: Mapping[str, Any]) -> str:
    targets = [(name, *each.values()) for name, each in about["per_target"].items()]
    splits = [
        (name, len(each["homes"]), each["episodes"])
        for name, each in about["splits"].items()
    ]
    labels = ", ".join(f"{name} {count}" for name, count in about["labels"].items())
    return "\n".join(
        [
            _table(
                ("target", "demonstrations", "frames", "failures", "recoveries"), targets
            ),
            "",
            f"- `demonstrations`: {about['subsets']['demonstrations']}; labels: {labels}",
            "- `failures`, `recoveries`: what was tried before the last demonstration of its row and failed, or "
            "succeeded after a mishap such as a dropped object",
            "",
            _table(("split", "homes", "demonstrations"), splits),
            "",
            "No home is in two splits (`splits.json`); homes that the benchmark evaluates in are in neither.",
        ]
    )


def _sentences(told: Mapping[str, Any]) -> str:
    return "\n".join(
        [
            f"Each episode has one instruction, {told['distinct']} different ones in all, and in `annotations` every "
            f"other wording of it, {told['wordings']} sentences in all.",
            "",
            *(f"- {text}" for text in told["examples"]),
        ]
    )


def _skills(skills: Mapping[str, Mapping[str, Any]]) -> str:
    if not skills:
        return "Who demonstrates does not tell what it is doing."
    rows = [(name, *each.values()) for name, each in skills.items()]
    heads = ("skill", "segments", "control steps", "median length")
    return f"`annotations` tell them with first and last control step, and in words.\n\n{_table(heads, rows)}"


def _actions(actions: Sequence[Mapping[str, Any]]) -> str:
    return (
        "An action is held for a control step. Where the table has values at -1 and 1 it is in that range.\n\n"
        + columns_table(actions)
    )


def _base_velocity(columns: Sequence[Mapping[str, Any]]) -> str:
    if not columns:
        return ""
    return (
        "The state lacks it; it follows from the stored states "
        "(`mjhab.data.select.own_state.base_velocity(episode)`), and exports have it as a column.\n\n"
        + columns_table(columns)
    )


def _images(about: Mapping[str, Any]) -> str:
    images = ", ".join(f"`{name}`" for name in about.get("images", ())) or "none"
    return (
        f"{images}. Calibration of the cameras and hashes of all files: `dataset.json`."
    )


def columns_table(columns: Sequence[Mapping[str, Any]]) -> str:
    """A table of columns of states or actions, with whatever is told of them."""
    heads = {"low": "at -1", "high": "at 1", "normalized": ""}
    keys = list(dict.fromkeys(key for each in columns for key in each))
    shown = [key for key in keys if heads.get(key, key)]
    rows = [(k, *(each.get(key, "") for key in shown)) for k, each in enumerate(columns)]
    return _table(("", *(heads.get(key, key) for key in shown)), rows)


def _table(heads: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    lines = [heads, ["---"] * len(heads), *rows]
    return "\n".join("| " + " | ".join(map(_cell, line)) + " |" for line in lines)


def _cell(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
