"""Students that were trained apart, joined to one that reads the sentence."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from mjhab.core.errors import UsageError
from mjhab.learning.assigned.join import KnownRequest, join, joined
from mjhab.learning.assigned.mean import mean
from mjhab.learning.assigned.members import member_for
from mjhab.learning.assigned.spec import PolicyJoinSpec, PolicyMeanSpec
from mjhab.learning.checkpoint import (
    load_checkpoint,
    load_student,
    save_compact,
    save_student,
)
from mjhab.learning.configs import ACT, InputConfig, NetworkConfig
from mjhab.learning.observation.sentences import encode_sentence
from mjhab.learning.observation.spec import ObservationSpec, observation_spec_of
from mjhab.learning.reinforcement.agent_encoder import AgentObs
from mjhab.learning.reinforcement.configs import reinforcement_preset
from mjhab.learning.reinforcement.ppo.agent import Ppo
from mjhab.learning.runs.specs import Scene
from mjhab.learning.students import compact
from mjhab.learning.students.bc import BehaviourCloning
from mjhab.learning.students.heads import check_student, make_student
from mjhab.learning.students.members import Member
from mjhab.learning.students.routed import RoutedTrunk, fit_gate, secondary_weights
from mjhab.learning.students.student import Student
from tests.learning.small import SIZE, condition_of, config, layout
from tests.refusals import refused

WORLDS = 16
SAID = (
    ("pick up the bowl", "take the bowl"),
    ("open the drawer",),
    ("close the drawer",),
)
WHOLE = InputConfig(cameras=("fetch_head",), image_size=SIZE, base_velocity=True)
WIDE = NetworkConfig(channels=(4, 8), image_features=8, hidden=64, layers=2)
"""Of matrices that are worth to be stored as 16-bit numbers."""
FOVEAL = dataclasses.replace(WHOLE, whole_views=False, target_views=True)


def random_member(seed: int, inputs: InputConfig) -> BehaviourCloning:
    """A student with random weights and normalizers."""
    made = make_student(config(inputs=inputs), layout(inputs), seed)
    assert isinstance(made, BehaviourCloning)
    random = torch.Generator().manual_seed(seed)
    for normalizer in (made.action_normalizer, made.normalizer):
        few = len(normalizer.mean)
        if normalizer is made.normalizer:
            few = made.layout.measured_width
        normalizer.mean[:few] = torch.randn(few, generator=random)
        normalizer.scale[:few] = 0.5 + torch.rand(few, generator=random)
    return made.eval().requires_grad_(False)


def joined_students(*members: BehaviourCloning) -> BehaviourCloning:
    return joined([Member(member) for member in members], routes())


def routes() -> list[KnownRequest]:
    drawer, bowl = "kitchen_counter/drawer3", "024_bowl"
    asked = (("pick", bowl, 0), ("open", drawer, 1), ("close", drawer, 1))
    return [
        KnownRequest(Scene(subtask=subtask, target=target), target, said, member)
        for (subtask, target, member), said in zip(asked, SAID, strict=True)
    ]


def learn_routes(student: BehaviourCloning) -> RoutedTrunk:
    trunk = student.trunk
    assert isinstance(trunk, RoutedTrunk)
    weights, bias = fit_gate(SAID, encode_sentence, 0)
    trunk.gate.weight.data.copy_(weights)
    trunk.gate.bias.data.copy_(bias)
    return trunk


def acts(student: Student, vector: np.ndarray, images: np.ndarray) -> np.ndarray:
    shape = (len(vector), 0, student.config.chunk, len(student.layout.actions))
    return student.act(vector.astype(np.float32), images, np.zeros(shape, np.float32))


def test_the_joined_student_does_on_each_route_what_its_member_does() -> None:
    members = [random_member(1, FOVEAL), random_member(2, WHOLE)]
    one = joined_students(*members)
    learn_routes(one)
    random = np.random.default_rng(0)
    seen = {
        key: random.integers(0, 256, (WORLDS, SIZE, SIZE), np.uint8)
        for key in one.layout.image_keys
    }
    assert len(seen) == 2
    measured = random.normal(size=(WORLDS, members[0].layout.measured_width))
    for route in routes():
        member = members[route.member]
        code = condition_of(member.layout, route.scene.subtask, route.target)
        told = np.hstack([measured, np.tile(code, (WORLDS, 1))])
        images = np.stack([seen[key] for key in member.layout.image_keys], 1)
        wanted = acts(member, told, images)[:, : one.config.chunk]
        for sentence in route.sentences:
            said = np.tile(encode_sentence(sentence), (WORLDS, 1))
            every = np.stack([seen[key] for key in one.layout.image_keys], 1)
            done = acts(one, np.hstack([measured, said]), every)
            assert np.abs(done - wanted).max() < 1e-5


def test_more_views_change_nothing_until_they_are_learned_from() -> None:
    members = [random_member(1, FOVEAL), random_member(2, WHOLE)]
    before = joined_students(*members)
    more = joined([Member(member) for member in members], routes(), "both")
    random = np.random.default_rng(0)
    images = random.integers(0, 256, (WORLDS, 2, SIZE, SIZE), np.uint8)
    measured = random.normal(size=(WORLDS, before.layout.measured_width))
    for student in (before, more):
        learn_routes(student).requires_grad_(True)
    for said in SAID:
        told = np.hstack([measured, np.tile(encode_sentence(said[0]), (WORLDS, 1))])
        wanted = acts(before, told, images)
        assert np.abs(acts(more, told, images) - wanted).max() < 1e-5
    trunk = more.trunk
    assert isinstance(trunk, RoutedTrunk)
    state = trunk.state_dict()
    # What is new to a member begins as what another has learned of it.
    new = [name for name in state if name.startswith("experts.0.encoder.encoders.0")]
    assert new
    for name in new:
        assert torch.equal(state[name], state[name.replace("experts.0", "experts.1")])
    more.chunk_of(
        trunk(torch.tensor(told).float(), torch.tensor(images))
    ).sum().backward()
    first = dict(trunk.named_parameters())["experts.1.layers.0.weight"]
    assert first.grad is not None
    assert first.grad.any(dim=0)[: 2 * more.config.network.image_features].all()
    with pytest.raises(UsageError, match="views"):
        joined([Member(member) for member in members], routes(), "target")


def test_views_beside_those_of_the_target_are_stored_in_8_bits(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The matrices of these networks are small.
    monkeypatch.setattr(compact, "LEAST_NUMBERS", 16)
    members = [Member(random_member(1, FOVEAL)), Member(random_member(2, WHOLE))]
    student = joined(members, routes(), "both")
    large, small = tmp_path / "large.safetensors", tmp_path / "small.safetensors"
    save_student(large, student, {})
    save_compact(large, small)
    stored = load_file(small)
    encoders = "trunk.experts.0.encoder.encoders."
    matrices = [name for name in stored if name.endswith("head.0.weight")]
    kinds = {
        name.removeprefix(encoders)[0]: stored[name].dtype
        for name in matrices
        if name.startswith(encoders)
    }
    assert kinds == {"0": torch.int8, "1": torch.float16}
    again = load_checkpoint(small).tensors
    for name, tensor in student.state_dict().items():
        assert (again[name] - tensor).abs().max() <= 0.005 * tensor.abs().max() + 1e-6
    # A network that sees whole views alone acts by them.
    assert not secondary_weights(
        joined_students(random_member(1, FOVEAL), random_member(2, WHOLE))
    )


def test_a_network_of_a_joined_policy_can_be_exchanged() -> None:
    old = joined_students(random_member(1, FOVEAL), random_member(2, WHOLE))
    new = joined_students(random_member(3, FOVEAL), random_member(4, WHOLE))
    for student in (old, new):
        learn_routes(student)
        # Training moves the shared bias as well.
        student.head.bias.data += 0.1
    picked, drawer = routes()[0], routes()[1:]
    members = [member_for(new, picked), member_for(old, drawer[0])]
    assert member_for(old, drawer[1]) == members[1]
    mixed = joined(members, routes())
    learn_routes(mixed)
    random = np.random.default_rng(0)
    images = random.integers(0, 256, (WORLDS, 2, SIZE, SIZE), np.uint8)
    measured = random.normal(size=(WORLDS, old.layout.measured_width))
    for said, source in zip(SAID, (new, old, old), strict=True):
        told = np.hstack([measured, np.tile(encode_sentence(said[0]), (WORLDS, 1))])
        wanted = acts(source, told, images)
        assert np.abs(acts(mixed, told, images) - wanted).max() < 1e-5


def test_what_one_world_is_asked_changes_no_bit_of_what_another_does() -> None:
    one = joined_students(random_member(1, WHOLE), random_member(2, WHOLE))
    learn_routes(one)
    random = np.random.default_rng(0)
    images = random.integers(0, 256, (WORLDS, 1, SIZE, SIZE), np.uint8)
    measured = random.normal(size=(WORLDS, one.layout.measured_width))
    alike = np.tile(encode_sentence(SAID[1][0]), (WORLDS, 1))
    mixed = alike.copy()
    mixed[1::2] = encode_sentence(SAID[0][0])
    first = acts(one, np.hstack([measured, alike]), images)
    second = acts(one, np.hstack([measured, mixed]), images)
    assert np.array_equal(first[::2], second[::2])
    assert not np.allclose(first[1::2], second[1::2])


def test_a_gate_understands_sentences_with_new_words() -> None:
    trunk = learn_routes(
        joined_students(random_member(1, WHOLE), random_member(2, WHOLE))
    )
    for number, told in enumerate(
        (
            "would you kindly take that bowl",
            "please open my drawer",
            "now close it, the drawer",
        )
    ):
        vector = torch.tensor(encode_sentence(told))[None]
        assert int(trunk.route(vector)) == number


def _saved(folder: Path, name: str, student: Student, **scene: str) -> Path:
    path = folder / f"{name}.safetensors"
    told = Scene(home="builtin_m1_02", **scene).record()
    save_student(path, student, {"scene": told, "trained": True})
    return path


@pytest.fixture(scope="module")
def real(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two students with random weights for a real environment, and the file that names them."""
    from mjhab.envs import make

    folder = tmp_path_factory.mktemp("join")
    inputs = InputConfig(cameras=(), image_size=0, previous_action=False)
    drawer = "kitchen_counter/drawer3"
    named = {"task": "set_table", "home": "builtin_m1_02", "target": drawer}
    env = make(**named, subtask="open", obs_mode="state", num_envs=1, threads=1)
    seen = observation_spec_of(env, inputs, (drawer,))
    env.close()
    rows = []
    for seed, subtask in enumerate(("open", "close")):
        student = make_student(config(inputs=inputs, network=WIDE), seen, seed)
        path = _saved(folder, subtask, student, subtask=subtask, target=drawer)
        rows.append({"subtask": subtask, "target": drawer, "checkpoint": path.name})
    file = folder / "policies.json"
    file.write_text(json.dumps({"policies": rows}))
    return file


def test_join_reads_the_sentences_of_real_episodes(real: Path, tmp_path: Path) -> None:
    done = join(PolicyJoinSpec(real, tmp_path / "one.safetensors", episodes=8))
    assert done.members == 2
    assert done.unread == ()
    assert all(count >= 2 for count in done.requests.values())
    one = load_student(done.file)
    assert one.layout.inputs.sentence
    assert not one.layout.inputs.condition
    again = join(PolicyJoinSpec(real, tmp_path / "again.safetensors", episodes=8))
    assert again.file.read_bytes() == done.file.read_bytes()
    full = join(
        PolicyJoinSpec(real, tmp_path / "full.safetensors", episodes=8, full=True)
    )
    assert full.bytes > 1.3 * done.bytes


def test_members_that_do_not_fit_are_refused(real: Path, tmp_path: Path) -> None:
    def refused(**changes: str) -> str:
        rows = json.loads(real.read_text())["policies"]
        for row in rows:
            row["checkpoint"] = str(real.parent / row["checkpoint"])
        rows[1] |= changes
        file = tmp_path / "policies.json"
        file.write_text(json.dumps({"policies": rows}))
        with pytest.raises(UsageError) as error:
            join(PolicyJoinSpec(file, tmp_path / "one.safetensors", episodes=8))
        assert not (tmp_path / "one.safetensors").exists()
        return str(error.value)

    assert "was not trained for pick" in refused(subtask="pick")
    assert "no checkpoint" in refused(checkpoint="expert")
    seen = load_student(real.parent / "open.safetensors").layout
    wide = config(inputs=seen.inputs, network=WIDE, execute=1)
    other = _saved(tmp_path, "wide", make_student(wide, seen), subtask="close")
    assert "another number of executed actions" in refused(checkpoint=str(other))
    chunks = make_student(config(ACT, seen.inputs), seen)
    other = _saved(tmp_path, "act", chunks, subtask="close")
    assert "a student of act" in refused(checkpoint=str(other))
    told = dataclasses.replace(seen.inputs, condition=False, sentence=True)
    reads: ObservationSpec = dataclasses.replace(seen, inputs=told)
    other = _saved(
        tmp_path, "told", make_student(config(inputs=told), reads), subtask="close"
    )
    assert "inputs.condition=true" in refused(checkpoint=str(other))


def test_a_routed_network_is_not_trained_from_nothing() -> None:
    inputs = dataclasses.replace(WHOLE, condition=True)
    network = dataclasses.replace(config().network, experts=("whole",), routes=(0,))
    with pytest.raises(UsageError, match="sentence"):
        make_student(config(inputs=inputs, network=network), layout(inputs))
    told = dataclasses.replace(WHOLE, condition=False, sentence=True)
    with pytest.raises(UsageError, match="policy join"):
        check_student(config(inputs=told, network=network), layout(told))


def test_ppo_goes_on_from_a_joined_student_and_freezes_no_part_of_it() -> None:
    one = joined_students(random_member(1, WHOLE), random_member(2, WHOLE))
    learn_routes(one)
    one.requires_grad_(True)
    polish = reinforcement_preset("ppo", "polish")
    agent = Ppo(dataclasses.replace(polish, inputs=WHOLE), one.layout, 0, 0, one)
    random = np.random.default_rng(0)
    images = random.integers(0, 256, (WORLDS, 1, SIZE, SIZE), np.uint8)
    said = np.tile(encode_sentence(SAID[0][0]), (WORLDS, 1))
    vector = np.hstack([random.normal(size=(WORLDS, one.layout.measured_width)), said])
    seen = AgentObs(
        torch.from_numpy(vector.astype(np.float32)),
        torch.from_numpy(images),
        torch.zeros(WORLDS, 0),
    )
    agent.mean(seen).sum().backward()
    trunk = one.trunk
    assert isinstance(trunk, RoutedTrunk)
    touched = [
        any(p.grad is not None and p.grad.any() for p in expert.parameters())
        for expert in trunk.experts
    ]
    assert touched == [True, False]
    frozen = dataclasses.replace(polish.ppo, freeze_encoder=True)  # type: ignore[type-var]
    with pytest.raises(UsageError, match="policy join"):
        Ppo(dataclasses.replace(polish, ppo=frozen), one.layout, 0, 0, one)


def _file_of(path: Path, student: Student, **about: object) -> Path:
    save_student(path, student, {"scene": Scene(subtask="pick").record(), **about})
    return path


def test_the_mean_of_policies_has_the_mean_of_their_weights(tmp_path: Path) -> None:
    files = [
        _file_of(tmp_path / f"{n}.safetensors", random_member(n, FOVEAL)) for n in (1, 2)
    ]
    out = tmp_path / "mean.safetensors"
    done = mean(PolicyMeanSpec(policies=tuple(files), shares=(3.0, 1.0), out=out))
    assert done.shares == (0.75, 0.25) and done.bytes == out.stat().st_size
    first, second, made = (load_file(path) for path in (*files, out))
    assert all(
        torch.allclose(made[name], 0.75 * first[name] + 0.25 * second[name], atol=1e-6)
        for name in made
    )
    about = load_checkpoint(out).about
    assert about["algorithm"] == "mean" and len(about["members"]) == 2
    # Of equal shares, if none are given; the first one's views are seen.
    wider = _file_of(
        tmp_path / "wide.safetensors",
        random_member(3, dataclasses.replace(WHOLE, target_views=True)),
    )
    mean(PolicyMeanSpec(policies=(wider, files[0]), out=out))
    made, wide = load_file(out), load_file(wider)
    name = "head.bias"
    assert torch.allclose(made[name], (wide[name] + first[name]) / 2)
    # Image 0 is the whole one, which only the first policy sees: its encoder stays as it is.
    encoder = "trunk.encoder.encoders.{}.head.0.weight"
    assert torch.allclose(made[encoder.format(0)], wide[encoder.format(0)])
    seen = (wide[encoder.format(1)] + first[encoder.format(0)]) / 2
    assert torch.allclose(made[encoder.format(1)], seen)


def test_policies_that_do_not_fit_have_no_mean(tmp_path: Path) -> None:
    narrow = _file_of(tmp_path / "a.safetensors", random_member(1, FOVEAL))
    whole = _file_of(tmp_path / "b.safetensors", random_member(1, WHOLE))
    out = tmp_path / "mean.safetensors"
    with pytest.raises(UsageError, match=r"b\.safetensors: has another choice of views"):
        mean(PolicyMeanSpec(policies=(narrow, whole), out=out))
    assert not out.exists()
    for wrong in (
        {"policies": (narrow,)},
        {"shares": (1.0,)},
        {"shares": (1.0, 0.0)},
        {"shares": (1.0, math.nan)},
    ):
        with refused("policies" if "policies" in wrong else "shares"):
            PolicyMeanSpec(**{"policies": (narrow, whole), "out": out, **wrong})
