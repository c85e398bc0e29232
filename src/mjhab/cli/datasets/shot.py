"""``mjhab shot``: a picture of an episode."""

from __future__ import annotations

from mjhab.cli.output import report
from mjhab.evaluation.shots.shoot import take_shot
from mjhab.evaluation.shots.spec import ShotSpec


def run_shot(spec: ShotSpec, json: bool) -> int:
    """Take the picture and write it."""
    taken = take_shot(spec, spec.file)
    shading = spec.shading
    facts = {
        **taken.facts(),
        "shader": spec.asked.shader,
        "samples": None if shading is None else shading.samples,
    }
    where = ", ".join(f"{x:.2f}" for x in taken.view.eye)
    said = (
        f"episode {taken.episode}, step {taken.step} of {taken.steps} in {taken.home}, "
        f"from {where}: {taken.file}"
    )
    report(json, facts, said)
    return 0
