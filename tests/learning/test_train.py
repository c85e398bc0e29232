"""`mjhab.train`: the example of its docstring, what it refuses, and where its options are declared."""

from __future__ import annotations

import dataclasses
import doctest
import subprocess
import sys
from pathlib import Path

import pytest

import mjhab
from mjhab.core.typed.bounds import Bound
from mjhab.core.typed.flags import field_docs, mark_of
from mjhab.learning import configs
from mjhab.learning.changes import Sets, settable
from mjhab.learning.reinforcement.configs import PRESETS, reinforcement_preset
from mjhab.learning.reinforcement.specs import PpoSpec, RlpdSpec
from mjhab.learning.runs.specs import BcSpec, DaggerSpec, ImitationSpec
from mjhab.learning.train import SPECS
from tests.refusals import refused


def test_the_example_of_the_docstring(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (example,) = doctest.DocTestFinder(recurse=False).find(
        mjhab.train, "mjhab.train", globs={}
    )
    assert len(example.examples) > 3
    assert doctest.DocTestRunner().run(example).failed == 0
    assert (tmp_path / "runs" / "close" / "report.html").exists()


@pytest.mark.parametrize(
    ("algorithm", "options", "option"),
    [
        ("dager", {}, "algorithm"),
        ("bc", {"preset": "smal"}, "preset of bc"),
        ("bc", {"subtask": "clos"}, "subtask"),
        ("bc", {"roundz": 3}, "option of a training run"),
        ("bc", {"rounds": 3}, "option of a training run"),
        ("bc", {"demos": 0}, "demos"),
        ("bc", {"demos": "many"}, "demos"),
        ("bc", {"set": ("chunk=0",)}, "--set chunk"),
        ("bc", {"preset": configs.preset_of("dagger")}, "preset"),
        ("bc", {"demos": 3, "data": "here"}, "demos"),
        ("bc", {"also": ("set_table",)}, "also"),
        ("bc", {"budget_minutes": -1.0}, "budget_minutes"),
        ("dagger", {"prefix_growth": -1}, "prefix_growth"),
        ("ppo", {"samples": 0, "preset": "scratch"}, "samples"),
        ("ppo", {"worlds": 7, "preset": "scratch"}, None),
        ("ppo", {"data": "here"}, "data"),
        ("rlpd", {"demonstrations": 0}, "demonstrations"),
        ("rlpd", {"capacity": 2}, "capacity of the replay buffer"),
    ],
)
def test_what_is_wrong_is_told_before_anything_is_written(
    algorithm: str, options: dict, option: str | None, tmp_path: Path
) -> None:
    if option is None:
        SPECS[algorithm].of(out=tmp_path / "run", **options)
    else:
        with refused(option):
            mjhab.train(algorithm, out=tmp_path / "run", **options)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("algorithm", SPECS)
def test_every_option_has_a_docstring_and_names_a_field_that_there_is(
    algorithm: str,
) -> None:
    kind = SPECS[algorithm]
    names = [field.name for field in dataclasses.fields(kind)]
    assert [name for name in names if not field_docs(kind).get(name)] == []
    for presets in (configs.PRESETS, PRESETS):
        for preset in presets.get(algorithm, {}).values():
            known = settable(preset)
            marks = [mark_of(kind, name, Sets) for name in names]
            assert [mark for mark in marks if mark and mark.field not in known] == []


def test_options_are_set_together_with_changes() -> None:
    """One of the two alone would be refused."""
    spec = PpoSpec(out=Path("run"), worlds=48, set=("ppo.minibatches=6",))
    assert spec.config.ppo is not None
    assert (spec.config.worlds, spec.config.ppo.minibatches) == (48, 6)
    # An option goes before a change of the same field.
    both = BcSpec(out=Path("run"), updates=3, set=("updates=4",))
    assert both.config.student.updates == 3


def test_what_is_learned_from_is_perturbed_and_what_is_judged_is_not() -> None:
    for kind in (DaggerSpec, PpoSpec):
        scene = kind.of(out="run", randomise={"noise": 2}).scene
        assert scene.env_options()["randomise"] == "noise:2"
        assert scene.record()["randomise"] == "noise:2"
        # What evaluations of a run are told besides task, homes and profile.
        assert scene.apart_from_profile() == {}
    # Runs without are recorded as those of older versions.
    assert "randomise" not in DaggerSpec.of(out="run").scene.record()
    with refused(where="randomise", said="unknown axis of perturbation"):
        DaggerSpec.of(out="run", randomise="nosie:2")


def test_a_configuration_of_ones_own_is_a_preset() -> None:
    own = configs.preset_of("dagger", "quick")
    spec = DaggerSpec.of(out="run", preset=own, rounds=1, worlds=3, seed=7)
    assert spec.config.dagger is not None and spec.config.dagger.rounds == 1
    assert (spec.resources.worlds, spec.seed) == (3, 7)
    assert ImitationSpec.of(out="run", preset=own).config == own
    demos = reinforcement_preset("rlpd")
    assert RlpdSpec.of(out="run", preset=demos, data="here").data == (Path("here"),)


def test_bounds_stand_at_their_fields() -> None:
    assert mark_of(configs.DaggerConfig, "rounds", Bound) == Bound(0)
    assert mark_of(configs.StudentConfig, "hold_steps", Bound) == Bound(-1)
    assert mark_of(configs.StudentConfig, "chunk", Bound) is None


@pytest.mark.parametrize("algorithm", ["dagger", "ppo"])
def test_help_loads_no_torch(algorithm: str) -> None:
    code = (
        "import sys; from mjhab.cli.main import main\n"
        f"try: main(['train', '{algorithm}', '--help'])\n"
        "except SystemExit: pass\n"
        "print(sorted({'torch', 'h5py', 'mujoco'} & set(sys.modules)))"
    )
    told = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert told.stdout.splitlines()[-1] == "[]"
