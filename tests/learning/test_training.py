"""Students, their updates, checkpoints: losses fall, files come back, training goes on bit by bit."""

from __future__ import annotations

import copy
import dataclasses
import json
import logging
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from mjhab.core import errors
from mjhab.core.errors import UsageError
from mjhab.learning.assigned.join import KnownRequest, joined
from mjhab.learning.batches import BatchSampler, take_chunks
from mjhab.learning.changes import with_changes
from mjhab.learning.checkpoint import (
    load_checkpoint,
    load_student,
    save_compact,
    save_student,
    save_tensors,
)
from mjhab.learning.configs import (
    BFLOAT16,
    FLOAT32,
    HEADS,
    PRECISIONS,
    PRESETS,
    DaggerConfig,
    InputConfig,
    NetworkConfig,
    OptimizerConfig,
    preset_of,
    student_from_plain,
    to_plain,
)
from mjhab.learning.devices import reduced
from mjhab.learning.reinforcement.configs import PpoConfig, reinforcement_preset
from mjhab.learning.resuming import as_begun_now
from mjhab.learning.runs.evaluation import EvaluationClock
from mjhab.learning.runs.imitation import ImitationSession
from mjhab.learning.runs.request import start_of
from mjhab.learning.runs.run import Logbook, TrainingFolder
from mjhab.learning.runs.session import Session
from mjhab.learning.runs.specs import ImitationSpec, Scene, TrainSpec
from mjhab.learning.runs.train import open_session
from mjhab.learning.runs.training import BrokenLossError, Trainer
from mjhab.learning.students import compact
from mjhab.learning.students.bc import BehaviourCloning
from mjhab.learning.students.heads import check_student, make_student
from mjhab.learning.students.members import Member
from mjhab.learning.students.routed import RoutedTrunk
from mjhab.learning.students.student import Batch
from mjhab.reports.compared.trainings import read_metrics, success_curves
from mjhab.rollout.records import EpisodeRecord
from tests.data.make import record_pictures
from tests.data.select.test_query import GOOD
from tests.learning.small import (
    INPUTS,
    config,
    demonstrations,
    layout,
    train_config,
    train_in,
)
from tests.refusals import refused


@pytest.fixture(autouse=True)
def one_thread() -> None:
    torch.set_num_threads(1)


def trainer_of(algorithm: str = "bc", **changes: Any) -> Trainer:
    trainer = Trainer(
        make_student(config(algorithm, **changes), layout(), seed=1), seed=2, updates=100
    )
    trainer.student.fit_normalizers(demonstrations())
    trainer.restart_average()
    return trainer


def batch(step: int = 0) -> Batch:
    return Batch.of(
        BatchSampler([demonstrations()], 8, 1.0, 0).batch(step, 4, InputConfig())
    )


def loss_of(trainer: Trainer, one: Batch) -> float:
    """With the same noise every time."""
    with torch.no_grad():
        return float(trainer.student.loss(one, torch.Generator().manual_seed(0)))


@pytest.mark.parametrize("algorithm", HEADS)
def test_every_student_learns_and_gives_chunks(algorithm: str) -> None:
    trainer = trainer_of(algorithm)
    data = demonstrations()
    every = Batch.of(take_chunks(data, data.usable, 4))
    before = loss_of(trainer, every)
    for _ in range(60):
        trainer.update(every)
    assert loss_of(trainer, every) < 0.9 * before
    student = trainer.average
    noise = np.zeros((3, student.draws, 4, 13), np.float32)
    chunk = student.act(every.vector[:3].numpy(), every.images[:3].numpy(), noise)
    assert chunk.shape == (3, student.config.chunk, 13) and np.abs(chunk).max() <= 1.0
    assert (student.draws == 0) == (
        algorithm in ("bc", "act", "gaussian", "gaussian_actions")
    )


@pytest.mark.parametrize("algorithm", HEADS)
def test_updates_in_bfloat16_learn_and_leave_weights_of_float32(algorithm: str) -> None:
    data = demonstrations()
    every = Batch.of(take_chunks(data, data.usable, 4))
    losses = {}
    for precision in PRECISIONS:
        own = config(algorithm)
        network = dataclasses.replace(own.network, precision=precision)
        trainer = trainer_of(algorithm, network=network)
        losses[precision] = [trainer.update(every).loss for _ in range(40)]
        assert {p.dtype for p in trainer.student.parameters()} == {torch.float32}
    exact, rounded = losses[FLOAT32], losses[BFLOAT16]
    assert exact[0] != rounded[0] == pytest.approx(exact[0], rel=0.05)
    assert rounded[-1] == pytest.approx(exact[-1], rel=0.3) and rounded[-1] < rounded[0]


@pytest.mark.parametrize("has", [True, False])
def test_bfloat16_on_a_processor_without_it_is_told_once(
    has: bool, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"amx_bf16": has})
    monkeypatch.setattr(errors, "_warned", set())
    with caplog.at_level(logging.WARNING, "mjhab"):
        for precision in (FLOAT32, BFLOAT16, BFLOAT16):
            reduced(precision, torch.device("cpu"))
    assert [BFLOAT16 in record.message for record in caplog.records] == [True] * (not has)


def test_an_unknown_precision_is_refused() -> None:
    with refused("network.precision", "half", BFLOAT16):
        with_changes(preset_of("bc"), ["network.precision=half"])
    with refused("network.precision", BFLOAT16, FLOAT32):
        with_changes(reinforcement_preset("sac", "fast"), ["network.precision=bfloat16"])


def test_what_lies_behind_the_end_is_not_learned() -> None:
    student = trainer_of().student
    one = batch()
    hidden = ~one.valid
    assert hidden.any()
    other = dataclasses.replace(
        one, actions=torch.where(hidden[..., None], torch.tensor(9.0), one.actions)
    )
    random = torch.Generator()
    assert torch.equal(student.loss(one, random), student.loss(other, random))


def test_normalized_numbers_have_mean_zero_and_spread_one() -> None:
    data = demonstrations(lengths=(200, 300))
    student = make_student(config(), layout())
    student.fit_normalizers(data)
    measured = layout().measured_width
    seen = student.normalizer(torch.from_numpy(data.vector)).numpy()
    np.testing.assert_allclose(seen[:, :measured].mean(axis=0), 0.0, atol=1e-3)
    np.testing.assert_allclose(seen[:, :measured].std(axis=0), 1.0, atol=1e-2)
    np.testing.assert_array_equal(seen[:, measured:], data.vector[:, measured:])
    actions = torch.from_numpy(data.actions)
    normal = student.action_normalizer
    torch.testing.assert_close(normal.restore(normal(actions)), actions)
    plain = make_student(
        config(inputs=dataclasses.replace(INPUTS, normalize=False)), layout()
    )
    plain.fit_normalizers(data)
    assert not plain.normalizer.mean.any() and (plain.normalizer.scale == 1).all()


@pytest.mark.parametrize("normalize", [False, True])
def test_diffusion_reaches_the_limits_of_actions(
    normalize: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its network asks for actions far beyond the range, on both sides."""
    inputs = dataclasses.replace(INPUTS, normalize=normalize)
    student = make_student(config("diffusion", inputs=inputs), layout(inputs))
    student.fit_normalizers(demonstrations(lengths=(200, 300)))
    one = batch()
    for sign in (-1.0, 1.0):
        monkeypatch.setattr(
            student.unet,
            "forward",
            lambda point, *_, sign=sign: torch.full_like(point, -sign * 1e4),
        )
        noise = torch.zeros(8, student.draws, 4, 13)
        with torch.no_grad():
            chunk = student.chunk(one.vector, one.images, noise)
        torch.testing.assert_close(chunk, torch.full_like(chunk, sign))


def test_the_average_follows_the_weights() -> None:
    trainer = trainer_of()
    before = [value.clone() for value in trainer.average.parameters()]
    trainer.update(batch())
    changed = 0
    for old, kept, new in zip(
        before, trainer.average.parameters(), trainer.student.parameters(), strict=True
    ):
        low = torch.minimum(old, new) - 1e-6
        high = torch.maximum(old, new) + 1e-6
        assert ((kept >= low) & (kept <= high)).all()
        changed += int((kept != old).any())
    assert changed
    optimizer = dataclasses.replace(config().optimizer, ema=0.0)
    raw = trainer_of(optimizer=optimizer)
    raw.update(batch())
    for kept, new in zip(raw.average.parameters(), raw.student.parameters(), strict=True):
        torch.testing.assert_close(kept, new)


@pytest.mark.parametrize("algorithm", HEADS)
def test_training_goes_on_bit_by_bit(algorithm: str, tmp_path: Path) -> None:
    whole = trainer_of(algorithm)
    part = trainer_of(algorithm)
    for step in range(4):
        whole.update(batch(step))
    for step in range(2):
        part.update(batch(step))
    save_tensors(
        tmp_path / "t.safetensors", part.student, part.tensors(), {"step": part.step}
    )
    saved = load_checkpoint(tmp_path / "t.safetensors")
    again = Trainer(
        make_student(saved.config, saved.layout, seed=77), seed=2, updates=100
    )
    again.restore(dict(saved.tensors), saved.about["step"])
    for step in range(2, 4):
        again.update(batch(step))
    other = again.tensors()
    for name, value in whole.tensors().items():
        assert torch.equal(value, other[name]), name
    assert again.step == 4


def test_a_student_comes_back_from_its_file(tmp_path: Path) -> None:
    trainer = trainer_of()
    trainer.update(batch())
    path = tmp_path / "s.safetensors"
    save_student(path, trainer.average, {"scene": "here"})
    saved = load_checkpoint(path)
    assert (
        saved.about == {"scene": "here"}
        and saved.layout == layout()
        and saved.config == config()
    )
    one = batch()
    noise = np.zeros((8, 0, 4, 13), np.float32)
    before = trainer.average.act(one.vector.numpy(), one.images.numpy(), noise)
    np.testing.assert_array_equal(
        before, load_student(path).act(one.vector.numpy(), one.images.numpy(), noise)
    )
    assert [entry.name for entry in tmp_path.iterdir()] == ["s.safetensors"]


@pytest.mark.parametrize(
    ("most", "size", "error"), [(1_000_000, 0.6, 1e-3), (1024, 0.5, 0.02)]
)
def test_a_compact_student_acts_nearly_the_same(
    most: int, size: float, error: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(compact, "MOST_HALVES", most)
    told = config(network=NetworkConfig(channels=(16, 32), image_features=32, hidden=64))
    student = make_student(told, layout(), seed=1)
    large, small = tmp_path / "student.safetensors", tmp_path / "small.safetensors"
    save_student(large, student, {"step": 4})
    save_compact(large, small)
    assert small.stat().st_size < size * large.stat().st_size
    assert load_checkpoint(small).about == {"step": 4}
    every = Batch.of(take_chunks(demonstrations(), np.arange(20), 4))
    chunks = [
        load_student(path).act(
            every.vector.numpy(), every.images.numpy(), np.zeros((20, 0))
        )
        for path in (large, small)
    ]
    np.testing.assert_allclose(chunks[1], chunks[0], atol=error)


def test_a_checkpoint_has_the_permissions_of_other_new_files(tmp_path: Path) -> None:
    save_student(tmp_path / "student.safetensors", make_student(config(), layout()), {})
    (tmp_path / "other").touch()
    modes = {path.stat().st_mode for path in tmp_path.iterdir()}
    assert len(modes) == 1


def test_files_that_are_no_students_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "x.safetensors"
    with pytest.raises(UsageError, match="does not exist"):
        load_student(path)
    path.write_bytes(b"\x80\x04nonsense")
    with pytest.raises(UsageError, match="cannot be read as a checkpoint"):
        load_student(path)
    save_file({"a": torch.zeros(1)}, path)
    with pytest.raises(UsageError, match="not a checkpoint of `mjhab train`"):
        load_student(path)
    trainer = trainer_of()
    save_tensors(path, trainer.student, trainer.tensors(), {"step": 0})
    with pytest.raises(
        UsageError, match=r"a student alone\. A training file .* student.safetensors"
    ):
        load_student(path)
    beside = tmp_path / "student.safetensors"
    beside.touch()
    with pytest.raises(UsageError, match=rf"a student alone\. Give {beside}\.$"):
        load_student(path)


def test_a_broken_loss_changes_nothing_and_names_the_batch() -> None:
    trainer = trainer_of()
    trainer.update(batch())
    before = {name: value.clone() for name, value in trainer.tensors().items()}
    bad = dataclasses.replace(batch(), actions=torch.full((8, 4, 13), torch.nan))
    with pytest.raises(BrokenLossError, match="nan in batch 2"):
        trainer.update(bad)
    assert all(
        torch.equal(value, before[name]) for name, value in trainer.tensors().items()
    )


def test_presets_are_plain_data_and_come_back() -> None:
    for algorithm, presets in PRESETS.items():
        for name, preset in presets.items():
            assert preset.algorithm == algorithm and preset_of(algorithm, name) is preset
            told = json.loads(json.dumps(to_plain(preset.student)))
            assert student_from_plain(told) == preset.student
            make_student(
                dataclasses.replace(preset.student, inputs=preset.student.inputs),
                layout(preset.student.inputs),
            )
    with pytest.raises(
        UsageError, match=r"unknown preset of bc 'smal'\. Did you mean 'small'"
    ):
        preset_of("bc", "smal")


# -- whole runs on recorded episodes of a fake environment ---------------------------------------------------------


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("source")
    record_pictures(folder / "picks.h5", range(4))
    return folder


def request(source: Path, **changes: Any) -> ImitationSpec:
    options: dict[str, Any] = {
        "out": source / "run",
        "preset": train_config(),
        "subtask": "pick",
        "target": "024_bowl",
        "worlds": 1,
        "threads": 1,
        "data": source,
        "where": "success or not success",
        "eval_episodes": 0,
        "round_episodes": 0,
        "eval_split": "train",
    }
    return ImitationSpec.of(**(options | changes))


def test_demonstrations_must_be_of_what_is_judged(source: Path, tmp_path: Path) -> None:
    others = request(source, subtask="open", target="fridge/top_door", eval_episodes=4)
    told = r"evaluated in open fridge/top_door, but the demonstrations are of .*pick 024_bowl"
    with pytest.raises(UsageError, match=told):
        train_in(others, tmp_path / "others")
    assert not (tmp_path / "others").exists()
    # Without evaluations it does not matter what the scene says.
    train_in(dataclasses.replace(others, eval_episodes=0), tmp_path / "unjudged")


def weights(path: Path) -> dict[str, torch.Tensor]:
    return dict(load_checkpoint(path).tensors)


def test_a_run_begins_with_the_weights_of_another(source: Path, tmp_path: Path) -> None:
    """With its normalizers, too; of another network or other inputs it is refused before anything is written."""
    train_in(request(source), tmp_path / "first")
    student = tmp_path / "first" / "student.safetensors"
    still = train_config(optimizer=OptimizerConfig(batch=8, learning_rate=1e-12))
    train_in(request(source, preset=still, start=student), tmp_path / "second")
    # The weights that act: those of the first run, at a rate at which nothing moves.
    first, second = weights(student), weights(tmp_path / "second" / "student.safetensors")
    assert all(torch.allclose(first[k], second[k], atol=1e-6) for k in first)
    resolved = json.loads((tmp_path / "second" / "config.json").read_text())
    assert resolved["start"] == str(student)
    network = dataclasses.replace(config().network, hidden=24)
    other = train_config(network=network)
    with pytest.raises(
        UsageError, match=r"which has another network \(hidden\): give a student"
    ):
        train_in(request(source, preset=other, start=student), tmp_path / "third")
    assert not (tmp_path / "third").exists()


def test_a_run_begins_with_the_network_of_a_joined_student(
    source: Path, tmp_path: Path
) -> None:
    """The one that its gate chooses for the run's sentences among those for the run's subtask."""
    train_in(request(source), tmp_path / "first")
    plain = load_student(tmp_path / "first" / "student.safetensors")
    assert isinstance(plain, BehaviourCloning)
    other = copy.deepcopy(plain)
    other.head.bias.data += 1.0
    scenes = [Scene(subtask=name, target="024_bowl") for name in ("pick", "pick", "open")]
    routes = [
        KnownRequest(scene, "024_bowl", (), n % 2) for n, scene in enumerate(scenes)
    ]
    one = joined([Member(plain), Member(other)], routes)
    assert isinstance(one.trunk, RoutedTrunk)
    # Whatever is said: route 2 above all, then 1.
    one.trunk.gate.weight.data.zero_()
    one.trunk.gate.bias.data = torch.arange(3.0)
    about = {
        "also": [scene.record() for scene in scenes[1:]],
        "scene": scenes[0].record(),
    }
    save_student(tmp_path / "one.safetensors", one, about)
    still = train_config(optimizer=OptimizerConfig(batch=8, learning_rate=1e-12))
    begun = request(source, preset=still, start=tmp_path / "one.safetensors")
    train_in(begun, tmp_path / "second")
    made = weights(tmp_path / "second" / "student.safetensors")
    width = len(plain.layout.actions)
    scale, mean = plain.action_normalizer.scale, plain.action_normalizer.mean
    wanted = other.head.bias[:width] * scale + mean
    assert torch.allclose(made["head.bias"][:width], wanted, atol=1e-5)
    inputs = dataclasses.replace(config().inputs, condition=False)
    untold = train_config(inputs=inputs)
    with pytest.raises(UsageError, match=r"another inputs\.condition: a joined"):
        train_in(dataclasses.replace(begun, preset=untold), tmp_path / "third")


def test_a_run_cannot_begin_with_a_student_that_sees_more(
    source: Path, tmp_path: Path
) -> None:
    train_in(request(source), tmp_path / "first")
    inputs = dataclasses.replace(config().inputs, whole_views=False, target_views=True)
    fewer = request(source, start=tmp_path / "first" / "student.safetensors")
    saved = load_checkpoint(tmp_path / "first" / "student.safetensors")
    wanted = dataclasses.replace(saved.layout, inputs=inputs)
    blind = dataclasses.replace(fewer, preset=train_config(inputs=inputs))
    told = r"another choice of views \(whole; target here\)"
    with pytest.raises(UsageError, match=told):
        start_of(blind, wanted)


def test_a_run_leaves_its_folder_and_resumes_exactly(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = train_in(request(source), tmp_path / "whole")
    assert (
        whole.summary["steps"] == 4
        and whole.summary["samples"] == 32
        and not whole.interrupted
    )
    found = {entry.name for entry in (tmp_path / "whole").iterdir()}
    assert found >= {
        "config.json",
        "metrics.jsonl",
        "tensorboard",
        "student.safetensors",
        "summary.json",
        "report.html",
    }
    make_updates = Trainer.update

    def stop_after_two(trainer: Trainer, one: Batch, rate: float = 1.0) -> object:
        if trainer.step == 2:
            raise KeyboardInterrupt
        return make_updates(trainer, one, rate)

    monkeypatch.setattr("mjhab.learning.runs.imitation.CHECKPOINT_SECONDS", -1.0)
    monkeypatch.setattr(Trainer, "update", stop_after_two)
    stopped = train_in(request(source), tmp_path / "part")
    assert stopped.interrupted and stopped.summary["steps"] == 2
    monkeypatch.setattr(Trainer, "update", make_updates)
    done = train_in(request(source), tmp_path / "part", resume=True)
    assert done.summary["steps"] == 4 and done.summary["samples"] == 32
    one, other = (
        weights(tmp_path / name / "training.safetensors") for name in ("whole", "part")
    )
    assert one.keys() == other.keys() and all(
        torch.equal(one[name], other[name]) for name in one
    )
    with pytest.raises(UsageError, match="it was started with seed = 0, now it is 1"):
        train_in(request(source, seed=1), tmp_path / "part", resume=True)
    with refused("out", expected="empty"):
        train_in(request(source), tmp_path / "part")


def test_which_runs_may_become_longer() -> None:
    """Those whose learning rate does not depend on their length; and options that are new since have their defaults."""
    plain = json.loads(
        json.dumps({"algorithm": "bc", "config": dataclasses.asdict(train_config())})
    )
    longer = json.loads(json.dumps(plain))
    longer["config"]["student"]["updates"] += 4
    assert as_begun_now(plain, longer) == longer
    assert as_begun_now(longer, plain) == longer, "shorter ones stay refused"
    ending = dataclasses.replace(
        reinforcement_preset("ppo"), ppo=PpoConfig(learning_rate_end=0.1)
    )
    tapering = {"algorithm": "ppo", "config": dataclasses.asdict(ending)}
    cosine = json.loads(json.dumps(plain))
    cosine["config"]["student"]["optimizer"]["schedule"] = "cosine"
    rounds = json.loads(json.dumps(plain))
    rounds["config"]["dagger"] = dataclasses.asdict(DaggerConfig())
    for old, path, reason in (
        (tapering, ("samples",), "ppo.learning_rate_end"),
        (cosine, ("student", "updates"), "optimizer.schedule"),
        (rounds, ("student", "updates"), "the rounds of DAgger"),
    ):
        now = json.loads(json.dumps(old))
        *parents, name = path
        place = now["config"]
        for parent in parents:
            place = place[parent]
        place[name] += 1
        with refused(name, given=place[name], advice=reason):
            as_begun_now(old, now)
    older = json.loads(json.dumps(plain))
    del older["config"]["student"]["inputs"]["images"]
    assert as_begun_now(older, json.loads(json.dumps(plain))) == plain
    changed = json.loads(json.dumps(plain))
    changed["config"]["student"]["inputs"]["images"] = "rgb"
    assert as_begun_now(older, changed) != changed


def test_nan_keeps_the_last_good_checkpoint(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain = ImitationSession._batch

    def broken(session: ImitationSession, sampler: BatchSampler) -> Batch:
        one = plain(session, sampler)
        return (
            dataclasses.replace(one, actions=one.actions * torch.nan)
            if session.trainer.step == 3
            else one
        )

    monkeypatch.setattr(ImitationSession, "_batch", broken)
    monkeypatch.setattr("mjhab.learning.runs.imitation.CHECKPOINT_SECONDS", -1.0)
    with pytest.raises(BrokenLossError, match="batch 4"):
        train_in(request(source), tmp_path / "run")
    kept = load_checkpoint(tmp_path / "run" / "training.safetensors")
    assert kept.about["step"] == 3
    assert all(torch.isfinite(value).all() for value in kept.tensors.values())


def test_a_spent_budget_ends_training(source: Path, tmp_path: Path) -> None:
    done = train_in(request(source, budget_minutes=1e-8), tmp_path / "run")
    assert done.summary["steps"] == 0 and done.summary["trained"] is False
    # Random weights are no policy.
    assert done.summary["checkpoint"] is None
    assert not (tmp_path / "run" / "student.safetensors").exists()
    more = train_in(request(source), tmp_path / "run", resume=True)
    assert more.summary["steps"] == 4 and more.summary["checkpoint"]


def test_the_layout_of_a_run_is_that_of_its_data(source: Path, tmp_path: Path) -> None:
    with open_session(request(source, out=tmp_path / "run")) as session:
        assert session.layout.targets == ("024_bowl",)


def test_two_processes_do_not_train_in_one_folder(source: Path, tmp_path: Path) -> None:
    with open_session(request(source, out=tmp_path / "run")):
        with pytest.raises(UsageError, match="is being written by process"):
            train_in(request(source), tmp_path / "run", resume=True)
        with pytest.raises(UsageError, match="is being written by process"):
            TrainingFolder.open(tmp_path / "run", {}, resume=True)
    done = train_in(request(source), tmp_path / "run", resume=True)
    assert done.summary["steps"] == 4
    assert not list((tmp_path / "run").glob("*.lock"))


def test_data_that_do_not_fit_leave_no_folder(source: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no episode passes"):
        train_in(request(source, where="steps > 1000"), tmp_path / "run")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("algorithm", "words"),
    [
        ("bc", ["inputs.image_size=2"]),
        ("bc", ["network.encoder=nature"]),
        ("act", ["network.hidden=130"]),
        ("act", ["network.layers=0"]),
        ("diffusion", ["chunk=6", "execute=2"]),
        ("diffusion", ["network.unet=60,100"]),
        ("diffusion", ["inputs.cameras="]),
    ],
)
def test_sizes_that_do_not_fit_together_are_refused(
    algorithm: str, words: list[str]
) -> None:
    told = with_changes(preset_of(algorithm), words).student
    with pytest.raises(UsageError, match="give no network that can act"):
        check_student(told, layout(told.inputs))


def test_a_network_that_a_checkpoint_could_not_hold_is_refused() -> None:
    told = with_changes(preset_of("bc"), ["network.hidden=20000"]).student
    with pytest.raises(UsageError, match=r"hidden: expected .* to 16,384, got 20000"):
        check_student(told, layout(told.inputs))


@pytest.mark.parametrize("algorithm", ["bc", "flow"])
def test_a_student_needs_no_hidden_layers(algorithm: str) -> None:
    network = dataclasses.replace(config(algorithm).network, layers=0)
    trainer_of(algorithm, network=network).update(batch())


def test_a_network_that_cannot_act_leaves_no_folder(source: Path, tmp_path: Path) -> None:
    network = NetworkConfig(encoder="nature", channels=(4, 8))
    with pytest.raises(UsageError, match="give no network that can act"):
        train_in(request(source, preset=train_config(network=network)), tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_the_learning_rate_falls_to_zero_in_the_end(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[float] = []
    make_updates = Trainer.update

    def note(trainer: Trainer, one: Batch, rate: float = 1.0) -> object:
        asked.append(rate)
        return make_updates(trainer, one, rate)

    monkeypatch.setattr(Trainer, "update", note)
    dagger = DaggerConfig(rounds=0, final_updates=4)
    done = train_in(
        request(source, preset=dataclasses.replace(train_config(), dagger=dagger)),
        tmp_path / "run",
    )
    assert asked == [1.0] * 4 + [1.0, 0.75, 0.5, 0.25]
    assert (
        done.summary["steps"],
        done.summary["rounds"],
        done.summary["demonstrations"],
    ) == (
        8,
        0,
        4,
    )


def test_the_cosine_schedule_ends_with_the_last_round(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    used: list[float] = []
    make_updates = Trainer.update

    def note(trainer: Trainer, one: Batch, rate: float = 1.0) -> object:
        report = make_updates(trainer, one, rate)
        used.append(trainer.optimizer.param_groups[0]["lr"])
        return report

    monkeypatch.setattr(Trainer, "update", note)
    monkeypatch.setattr(
        ImitationSession, "collect", lambda session, _: session.load(source)
    )
    optimizer = dataclasses.replace(
        config().optimizer, schedule="cosine", warmup=0, learning_rate=1.0
    )
    told = dataclasses.replace(
        train_config(optimizer=optimizer),
        dagger=DaggerConfig(rounds=2, updates=4, final_updates=0),
    )
    train_in(request(source, preset=told, where=None), tmp_path / "run")
    # Of 4 updates of the first round and 4 of each of the others.
    wanted = 0.5 * (1.0 + np.cos(np.pi * np.arange(12) / 12))
    np.testing.assert_allclose(used, wanted, rtol=1e-6)


# -- what a run says of itself ---------------------------------------------------------------------------------------


def judge_without_simulation(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Every evaluation succeeds in half of its episodes; returns a list that gets the split of each."""
    asked: list[str] = []

    def pretended(
        session: Session, scene: Scene, split: str, episodes: int, films: int, out: Path
    ) -> list[Any]:
        asked.append(split)
        return [
            dataclasses.replace(GOOD, success_once=number % 2 == 0)
            for number in range(episodes)
        ]

    monkeypatch.setattr(Session, "_evaluate_in", pretended)
    monkeypatch.setattr("mjhab.learning.runs.request._check_judged", bool)
    return asked


@pytest.mark.parametrize(("last", "split"), [(0, "train"), (6, "val")])
def test_the_split_told_is_that_of_the_episodes_behind_the_rate(
    last: int, split: str, source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = judge_without_simulation(monkeypatch)
    told = request(source, eval_episodes=last, round_episodes=2, eval_split="val")
    summary = train_in(told, tmp_path / "run").summary
    assert asked == ["train"] * 3 + ["val"] * bool(last)
    assert (summary["split"], summary["episodes"]) == (split, last or 2)
    assert summary["success_once"] == 0.5
    assert summary["evaluated_samples"] == (32 if last else 24)
    page = (tmp_path / "run" / "report.html").read_text(encoding="utf-8")
    assert f"{last or 2} episodes in homes of split {split}" in page
    rows = read_metrics(tmp_path / "run")
    told_rows = [
        (row["evaluation"], row["evaluated_split"], row["evaluated_episodes"])
        for row in rows
        if "success_once" in row
    ]
    assert told_rows == [("on_the_way", "train", 2)] * 3 + [("final", "val", 6)] * bool(
        last
    )
    names = ["on the way, 2 episodes, train homes", "final, 6 episodes, val homes"]
    for x in ("samples", "seconds"):
        series = success_curves(rows, x)["data"]
        assert [trace["name"] for trace in series] == names[: 1 + bool(last)]
        assert [len(trace["x"]) for trace in series] == [3, 1][: 1 + bool(last)]
        # A point of other episodes is not joined to the curve.
        assert [trace["mode"] for trace in series][1:] == ["markers"] * bool(last)
    assert names[0] in page and (names[1] in page) == bool(last)


def test_rows_of_older_versions_make_one_curve() -> None:
    rows = [
        {"samples": n, "success_once": 0.1 * n, "evaluated_episodes": 4} for n in (1, 2)
    ]
    (trace,) = success_curves([*rows, {"samples": 3, "loss": 1.0}], "samples")["data"]
    assert (trace["x"], trace["name"]) == ([1, 2], "on the way, 4 episodes")


def test_a_resumed_run_makes_the_evaluation_that_was_interrupted(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = judge_without_simulation(monkeypatch)
    judge = Session._evaluate_in

    def interrupted(session: Session, *given: Any) -> Any:
        if session.state.updates == 2:
            raise KeyboardInterrupt
        return judge(session, *given)

    told = request(source, round_episodes=2)
    with monkeypatch.context() as patch:
        patch.setattr(Session, "_evaluate_in", interrupted)
        assert train_in(told, tmp_path / "run").interrupted
    train_in(told, tmp_path / "run", resume=True)
    rows = read_metrics(tmp_path / "run")
    assert [row["step"] for row in rows if "success_once" in row] == [1, 2, 3]
    assert len(asked) == 3
    about = load_checkpoint(tmp_path / "run" / "training.safetensors").about
    assert about["evaluated"] == [1, 2, 3]


@pytest.mark.parametrize("films", [None, 0])
def test_the_report_shows_films_of_the_first_and_the_last_evaluation(
    films: int | None, source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    judge_without_simulation(monkeypatch)
    judge = Session._evaluate_in
    filmed: list[int] = []

    def with_films(
        session: Session, scene: Scene, split: str, episodes: int, films: int, out: Path
    ) -> list[EpisodeRecord]:
        filmed.append(films)
        for index in range(films):
            path = out / "films" / f"episode_{index:05d}.mp4"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(b"film")
            # A process that was killed has left a part of another.
            path.with_name(f".episode_{index:05d}.7.part.mp4").write_bytes(b"part")
        return judge(session, scene, split, episodes, films, out)

    monkeypatch.setattr(Session, "_evaluate_in", with_films)
    told = request(source, eval_episodes=6, round_episodes=2)
    several = dataclasses.replace(told, also=("set_table/open/fridge/top_door",))
    for asked, scenes in ((told, 1), (several, 2)):
        if films is not None:
            asked = dataclasses.replace(asked, films=films)
        most = TrainSpec.films if films is None else films
        filmed.clear()
        train_in(asked, tmp_path / f"{scenes}")
        wanted = [most, 0, 0, most]
        assert filmed == [count for count in wanted for _ in range(scenes)]
        page = (tmp_path / f"{scenes}" / "report.html").read_text(encoding="utf-8")
        assert page.count("<video") == 2 * most * scenes
    if films is None:
        assert "latest, set_table.open.fridge.top_door, episode_00001" in page


def test_without_an_evaluation_no_split_is_told(source: Path, tmp_path: Path) -> None:
    done = train_in(request(source, eval_split="val"), tmp_path / "run")
    told = {
        name: done.summary[name]
        for name in ("split", "success_once", "interval", "episodes")
    }
    assert told == {"split": None, "success_once": None, "interval": None, "episodes": 0}
    assert "not evaluated" in done.report.read_text(encoding="utf-8")


def test_a_run_counts_no_processor_time_of_an_earlier_run_in_its_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = [100.0, 20.0, 3.0, 0.0, 0.0]
    monkeypatch.setattr("os.times", lambda: tuple(clock))
    folder = TrainingFolder.open(tmp_path / "run", {})
    log = Logbook(folder)
    clock[0] += 5.0
    log.report(1, 8, {"loss": 1.0})
    assert log.cpu_seconds == 5.0
    folder.close()
    resumed = Logbook(TrainingFolder.open(tmp_path / "run", {}, resume=True), step=1)
    clock[2] += 2.0
    assert resumed.cpu_seconds == 7.0


def test_ctrl_c_during_an_update_keeps_whole_updates(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make_updates = Trainer.update

    def interrupted(trainer: Trainer, one: Batch, rate: float = 1.0) -> object:
        if trainer.step == 1:
            signal.raise_signal(signal.SIGINT)
        return make_updates(trainer, one, rate)

    whole = train_in(request(source), tmp_path / "whole")
    # A shell starts processes in the background with Ctrl-C ignored.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    with monkeypatch.context() as patch:
        patch.setattr(Trainer, "update", interrupted)
        stopped = train_in(request(source), tmp_path / "part")
    signal.signal(signal.SIGINT, before)
    assert (
        stopped.interrupted
        and stopped.summary["steps"] == 2
        and stopped.summary["trained"]
    )
    assert Path(stopped.summary["checkpoint"]).is_file()
    assert load_checkpoint(tmp_path / "part" / "training.safetensors").about["step"] == 2
    train_in(request(source), tmp_path / "part", resume=True)
    one, other = (weights(Path(run) / "training.safetensors") for run in (
        tmp_path / "whole", tmp_path / "part"))  # fmt: skip
    assert whole.summary["steps"] == 4 and all(
        torch.equal(one[name], other[name]) for name in one
    )


def test_before_the_data_are_read_there_is_no_checkpoint(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(session: Session, *_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(ImitationSession, "load", interrupted)
    stopped = train_in(request(source), tmp_path / "run")
    assert stopped.interrupted and stopped.summary["checkpoint"] is None
    assert stopped.summary["trained"] is False
    assert not list((tmp_path / "run").glob("*.safetensors"))


def test_nan_in_the_second_batch_leaves_the_first_update(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make_updates = Trainer.update

    def broken(trainer: Trainer, one: Batch, rate: float = 1.0) -> object:
        if trainer.step == 1:
            one = dataclasses.replace(one, actions=one.actions * torch.nan)
        return make_updates(trainer, one, rate)

    monkeypatch.setattr(Trainer, "update", broken)
    with pytest.raises(BrokenLossError, match="batch 2"):
        train_in(request(source), tmp_path / "run")
    assert load_student(tmp_path / "run" / "student.safetensors")
    assert load_checkpoint(tmp_path / "run" / "training.safetensors").about["step"] == 1


def test_time_is_reserved_before_an_evaluation_is_measured(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a budget of 10 s half is reserved for 100 episodes, and every update takes 2 s."""
    judge_without_simulation(monkeypatch)
    now = [0.0]
    make_updates = Trainer.update

    def slow(trainer: Trainer, one: Batch, rate: float = 1.0) -> object:
        now[0] += 2.0
        return make_updates(trainer, one, rate)

    monkeypatch.setattr(Logbook, "seconds", property(lambda log: now[0]))
    monkeypatch.setattr(Trainer, "update", slow)
    told = request(source, budget_minutes=1.0 / 6.0, eval_episodes=100)
    summary = train_in(told, tmp_path / "run").summary
    assert summary["steps"] == 3 and summary["episodes"] == 100
    clock = EvaluationClock(10.0)
    assert clock.reserve(2) == 1.0 and clock.reserve(1000) == 5.0
    clock.guess(0.1)
    assert clock.reserve(10) == pytest.approx(1.0)
    clock.measured(2.0)
    clock.guess(0.1)
    assert clock.reserve(10) == 20.0
