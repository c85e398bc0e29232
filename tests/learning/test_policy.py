"""A student in the rollout loop: what it sees, when it thinks, what it refuses."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mjhab.cli.output import tell_caution
from mjhab.core import libraries
from mjhab.core.errors import UsageError
from mjhab.evaluation.evaluate import EvalSpec, resolved_config
from mjhab.evaluation.generate import resolved_config as generated_config
from mjhab.evaluation.resolve import inspect_policy, resolve_policy
from mjhab.evaluation.specs import GenerateSpec
from mjhab.learning.assigned.entries import Entry
from mjhab.learning.assigned.files import entries_text
from mjhab.learning.checkpoint import load_checkpoint, save_student, save_tensors
from mjhab.learning.observation.depth import nearness, pooled
from mjhab.learning.observation.encoder import EncodedObs, ObservationEncoder
from mjhab.learning.policy import StudentEnsemble, StudentPolicy
from mjhab.learning.policy_kind import joined
from mjhab.learning.require import require_learn
from mjhab.learning.runs.training import Trainer
from mjhab.learning.students.heads import make_student
from mjhab.sim.backends import cuda_devices
from tests.learning.small import (
    INPUTS,
    SIZE,
    TARGETS,
    condition_of,
    config,
    fake_env,
    layout,
)
from tests.refusals import refused


def scene(worlds: int, step: int) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Observations and info of a step; world w is in episode w."""
    randoms = [np.random.default_rng([step, w]) for w in range(worlds)]
    obs = {
        "state": np.stack([random.normal(size=5) for random in randoms]).astype(
            np.float32
        ),
        "sensor_data/fetch_head/depth": np.stack(
            [r.integers(0, 3000, (SIZE, SIZE, 1), np.int16) for r in randoms]
        ),
    }
    plan = ({"kind": "pick", "target": f"{TARGETS[0]}_:0000", "goal": None},)
    specs = [{"index": w, "seed": 0, "plan": plan} for w in range(worlds)]
    return obs, {"episode_spec": specs, "pointer": np.zeros(worlds, np.int64)}


def actions_of(
    worlds: int, steps: int, algorithm: str = "bc", **changes: Any
) -> np.ndarray:
    policy = StudentPolicy(
        make_student(config(algorithm, **changes), layout()), fake_env(worlds)
    )
    policy.reset(np.ones(worlds, bool))
    return np.stack([policy.act(*scene(worlds, step)) for step in range(steps)])


@pytest.mark.parametrize("algorithm", ["bc", "flow", "diffusion"])
def test_what_it_does_in_an_episode_does_not_depend_on_the_other_worlds(
    algorithm: str,
) -> None:
    few = actions_of(3, 5, algorithm)
    many = actions_of(21, 5, algorithm)
    np.testing.assert_array_equal(few, many[:, :3])


def test_a_policy_whose_action_was_replaced_plans_anew() -> None:
    acting, corrected = (
        StudentPolicy(make_student(config(chunk=4, execute=3), layout()), fake_env(2))
        for _ in range(2)
    )
    for policy in (acting, corrected):
        policy.reset(np.ones(2, bool))
    first = acting.act(*scene(2, 0))
    np.testing.assert_array_equal(first, corrected.act(*scene(2, 0)))
    corrected.replace_action(first, replan=True)
    # The same was executed: only the one that plans anew looks at what it sees now.
    assert (acting.act(*scene(2, 1)) != corrected.act(*scene(2, 1))).any()


def test_the_first_actions_of_every_chunk_are_executed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    student = make_student(config(chunk=4, execute=3), layout())
    asked: list[np.ndarray] = []

    def count(vector: np.ndarray, images: np.ndarray, noise: np.ndarray) -> np.ndarray:
        asked.append(vector.copy())
        return np.broadcast_to(
            np.arange(4.0, dtype=np.float32)[None, :, None] / 10, (len(vector), 4, 13)
        ).copy()

    monkeypatch.setattr(student, "act", count)
    policy = StudentPolicy(student, fake_env(1))
    policy.reset(np.ones(1, bool))
    taken = [float(policy.act(*scene(1, step))[0, 0]) for step in range(5)]
    np.testing.assert_allclose(taken, [0.0, 0.1, 0.2, 0.0, 0.1])
    assert len(asked) == 2
    previous = slice(5, 18)
    assert not asked[0][0, previous].any()
    np.testing.assert_allclose(asked[1][0, previous], 0.2)


def test_it_sees_what_the_demonstrations_hold(monkeypatch: pytest.MonkeyPatch) -> None:
    inputs = dataclasses.replace(INPUTS, history=2)
    policy = StudentPolicy(
        make_student(config(inputs=inputs), layout(inputs)), fake_env(2, layout(inputs))
    )
    policy.reset(np.ones(2, bool))
    (first, info) = scene(2, 0)
    (second, _) = scene(2, 1)
    asked: list[EncodedObs] = []
    encode = policy._encoder.encode

    def noted(obs: Any, info: Any) -> EncodedObs:
        asked.append(encode(obs, info))
        return asked[-1]

    monkeypatch.setattr(policy._encoder, "encode", noted)
    before = policy.act(first, info)
    policy.act(second, info)
    begun, seen = asked[0], asked[-1]
    np.testing.assert_array_equal(begun.vector[:, :5], first["state"])
    np.testing.assert_array_equal(seen.vector[:, :5], first["state"])
    now = seen.vector[:, layout().width :]
    np.testing.assert_array_equal(now[:, :5], second["state"])
    np.testing.assert_array_equal(now[:, 5:18], before)
    assert (now[:, 18:] == condition_of(layout(), "pick", TARGETS[0])).all()
    depth = second["sensor_data/fetch_head/depth"][..., 0]
    np.testing.assert_array_equal(seen.images[:, 1], nearness(depth))


def test_a_reset_forgets_one_world_alone() -> None:
    encoder = ObservationEncoder(fake_env(2), layout())
    encoder.encode(*scene(2, 0))
    encoder.executed(np.ones((2, 13), np.float32))
    encoder.begin(np.array([True, False]))
    previous = encoder.encode(*scene(2, 1)).vector[:, 5:18]
    assert not previous[0].any() and previous[1].all()


def test_an_environment_that_shows_something_else_is_refused_by_name() -> None:
    student = make_student(config(), layout())
    env = fake_env()
    env.observer.table[0].shape = (7,)
    env.observer.table[1].key = "extra/new"
    env.single_observation_space["state"].shape = (8,)
    env.action_table.pop()
    env.config.base = "holonomic"
    env.observer.table[-1].shape = (64, 64, 1)
    with pytest.raises(UsageError) as error:
        StudentPolicy(student, env)
    for words in (
        "agent/qpos has 7 numbers instead of 4",
        "state has no extra/is_grasped",
        "extra/new, which the student does not know",
        "action has no a12",
        "holonomic",
        "fetch_head/depth is 64x64 px instead of 16x16",
        "camera_size=16",
    ):
        assert words in str(error.value)


def test_an_unknown_target_is_refused_by_name() -> None:
    policy = StudentPolicy(make_student(config(), layout()), fake_env(1))
    policy.reset(np.ones(1, bool))
    obs, info = scene(1, 0)
    info["episode_spec"][0]["plan"] = (
        {"kind": "pick", "target": "013_apple_:0000", "goal": None},
    )
    with refused("target of this student", "013_apple"):
        policy.act(obs, info)


def test_a_checkpoint_is_a_policy_by_its_path(tmp_path: Path) -> None:
    path = tmp_path / "mine.safetensors"
    save_student(path, make_student(config(), layout()), {})
    facts = inspect_policy(str(path))
    assert facts.name == "mine" and len(facts.identity["policy_sha256"]) == 64
    assert (
        facts.env_options["obs_mode"] == "depth"
        and facts.env_options["camera_size"] == SIZE
    )
    policy = resolve_policy(str(path), fake_env(2))
    policy.reset(np.ones(2, bool))
    assert policy.act(*scene(2, 0)).shape == (2, 13)


@pytest.mark.parametrize(
    ("about", "warns"),
    [
        ({"step": 0}, True),
        ({"step": 3}, False),
        ({}, False),
        # Imitation and --start train an actor before the first update of reinforcement.
        ({"step": 0, "trained": True}, False),
        ({"step": 0, "trained": False}, True),
    ],
)
def test_a_checkpoint_that_was_never_trained_is_told(
    about: dict[str, Any],
    warns: bool,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    path = tmp_path / "mine.safetensors"
    save_student(path, make_student(config(), layout()), about)
    facts = inspect_policy(str(path))
    assert ("never trained (0 updates)" in facts.caution) == warns
    told = resolved_config(EvalSpec.of(policy=str(path), subtask="pick"), facts)
    assert told.get("policy_caution", "") == facts.caution
    spec = GenerateSpec.of(
        policy=str(path), subtask="pick", episodes=1, out=tmp_path / "data"
    )
    made = generated_config(spec, facts)
    assert made.get("policy_caution", "") == facts.caution
    several = entries_text(tmp_path / "all.json", [Entry("pick", "", str(path))])
    (tmp_path / "all.json").write_text(several, encoding="utf-8")
    assert inspect_policy(str(tmp_path / "all.json")).caution == facts.caution
    tell_caution(made)
    assert ("mjhab: " + facts.caution in capsys.readouterr().err) == warns


def test_without_torch_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "importlib.util.find_spec", lambda name: None if name == "torch" else object()
    )
    with refused("learning"):
        inspect_policy("any.safetensors")


@pytest.mark.parametrize(
    "error",
    [
        OSError(
            "libtorch_cpu.so: cannot open shared object file: No such file or directory"
        ),
        ImportError("/lib/libstdc++.so.6: version `GLIBCXX_3.4.32' not found"),
        RuntimeError("module compiled against another ABI version"),
    ],
    ids=lambda error: type(error).__name__,
)
def test_a_torch_that_cannot_be_imported_is_told_in_one_line(
    error: Exception, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def broken(name: str) -> object:
        raise error

    monkeypatch.setattr(libraries.importlib, "import_module", broken)
    with refused(said="torch is installed but cannot be imported") as told:
        require_learn()
    assert str(error) in str(told.value) and "pip install" in str(told.value)
    with refused(said=("warp is installed but cannot be imported", "[gpu]'")):
        cuda_devices()


@pytest.mark.parametrize("number", [np.nan, np.inf], ids=str)
def test_weights_that_are_not_finite_are_refused_by_name(
    number: float, tmp_path: Path
) -> None:
    student = make_student(config(), layout())
    name, weights = next(iter(student.named_parameters()))
    weights.data.view(-1)[:2] = number
    path = tmp_path / "bad.safetensors"
    save_student(path, student, {})
    told = f"cannot act: 2 of the .* numbers of its tensor {name} are not finite"
    with pytest.raises(UsageError, match=told):
        inspect_policy(str(path))
    trainer = Trainer(student, seed=0, updates=1)
    save_tensors(path, student, trainer.tensors(), {"step": 0})
    with pytest.raises(UsageError, match=f"tensor .*{name} are not finite"):
        load_checkpoint(path)


def test_several_students_execute_the_mean_of_their_actions(tmp_path: Path) -> None:
    files = []
    for seed in (1, 2):
        files.append(tmp_path / f"{seed}.safetensors")
        save_student(files[-1], make_student(config(), layout(), seed=seed), {})
    spec = "+".join(map(str, files))
    facts = inspect_policy(spec)
    assert facts.name == "1+2" and facts.env_options["camera_size"] == SIZE
    assert (
        facts.identity["policy_sha256"]
        != inspect_policy(str(files[0])).identity["policy_sha256"]
    )
    together = resolve_policy(spec, fake_env(2))
    alone = [resolve_policy(str(file), fake_env(2)) for file in files]
    for policy in (together, *alone):
        policy.reset(np.ones(2, bool))
    first = together.act(*scene(2, 0))
    means = np.mean([policy.act(*scene(2, 0)) for policy in alone], axis=0)
    np.testing.assert_allclose(first, means, atol=1e-6)
    assert isinstance(together, StudentEnsemble)
    obs, info = scene(2, 1)
    for member in together.members:
        previous = member._encoder.encode(obs, info).vector[:, 5:18]
        np.testing.assert_array_equal(previous, first)


def test_small_images_are_means_of_larger_ones() -> None:
    images = np.arange(2 * 4 * 4, dtype=np.uint8).reshape(2, 4, 4)
    assert pooled(images, 1) is images
    np.testing.assert_array_equal(pooled(images, 2)[0], [[2, 4], [10, 12]])
    half = dataclasses.replace(INPUTS, image_size=SIZE // 2)
    student = make_student(config(inputs=half), layout(half))
    with refused(said="16x16 px instead of 8x8"):
        StudentPolicy(student, fake_env(1))
    assert student.layout.pool_in(fake_env(1)) == 2
    policy = StudentPolicy(student, fake_env(1), pool=2)
    policy.reset(np.ones(1, bool))
    assert policy.act(*scene(1, 0)).shape == (1, 13)


def test_students_together_get_the_largest_of_their_images() -> None:
    small = {"camera_size": 32, "profile": "ms_hab"}
    assert joined("both", [("a", small), ("b", {**small, "camera_size": 64})]) == {
        **small,
        "camera_size": 64,
    }
    with refused(said="camera_size is 32 for one and 48 for b"):
        joined("both", [("a", small), ("b", {**small, "camera_size": 48})])
    with refused(said="profile is 'ms_hab' for one and 'mjhab' for b"):
        joined("both", [("a", small), ("b", {**small, "profile": "mjhab"})])
