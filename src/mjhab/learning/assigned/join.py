"""Join students that were trained apart to one that knows by the sentence which of them is asked for.

What each member computes stays as it is, but for the last bits; see `students.routed`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from mjhab.core.errors import UsageError, fault
from mjhab.core.files.reading import is_file
from mjhab.core.typed.options import read_record
from mjhab.learning.assigned.entries import Entry
from mjhab.learning.assigned.files import entries_in, read_entries
from mjhab.learning.assigned.spec import PolicyJoinSpec
from mjhab.learning.checkpoint import (
    Checkpoint,
    load_checkpoint,
    save_compact,
    save_student,
    student_of,
)
from mjhab.learning.configs import BC, VIEWS, InputConfig
from mjhab.learning.networks import Trunk
from mjhab.learning.observation.parts import SubtaskConditioning, code_of
from mjhab.learning.observation.sentences import encode_sentence
from mjhab.learning.observation.spec import ObservationSpec
from mjhab.learning.runs.collection import make_env
from mjhab.learning.runs.specs import Resources, Scene
from mjhab.learning.students.bc import BehaviourCloning
from mjhab.learning.students.heads import make_student
from mjhab.learning.students.routed import RoutedTrunk, fit_gate

WORLDS = 8
"""Worlds of the environment that makes the sentences."""


@dataclass(frozen=True)
class KnownRequest:
    """A request that a joined policy knows.

    scene: where its member learned it. target: the type of its target. member: number of the policy that acts.
    sentences: with which it is asked for.
    """

    scene: Scene
    target: str
    member: int
    sentences: tuple[str, ...]


@dataclass(frozen=True)
class JoinedPolicy:
    """What `join` has made. requests: number of sentences of each; unread: those that the gate takes for another."""

    file: Path
    bytes: int
    members: int
    requests: dict[str, int]
    unread: tuple[str, ...]


def join(spec: PolicyJoinSpec) -> JoinedPolicy:
    """Join policies.

    Raises:
        UsageError: a policy cannot be read or is none of `mjhab train bc`, `dagger` or `ppo`; two differ in what they
            see or in their networks; a home pack is not found; or the same sentences ask for two of them.
    """
    read = entries_in if spec.policies.is_dir() else read_entries
    entries = read(spec.policies)
    # One member for all entries of a file, so that its weights are stored once.
    files = list(dict.fromkeys(entry.checkpoint for entry in entries))
    for file in files:
        if not is_file(Path(file)):
            raise fault(
                file, "is no checkpoint; only those of `mjhab train` can be joined."
            )
    # All are read before anything is made, so that a wrong one is refused at once.
    saved = [load_checkpoint(Path(file)) for file in files]
    members = [
        _member(Path(file), one, files[0], saved[0])
        for file, one in zip(files, saved, strict=True)
    ]
    routes = [
        route
        for entry in entries
        for route in _routes(entry, files.index(entry.checkpoint), saved, spec)
    ]
    _check_apart(routes)
    student = joined(members, routes)
    trunk = student.trunk
    assert isinstance(trunk, RoutedTrunk)
    _fit_gate_of(trunk, routes, spec.seed)
    first, *more = [
        dataclasses.replace(route.scene, target=route.target).record() for route in routes
    ]
    about = {
        "algorithm": "join",
        "trained": True,
        "scene": first,
        "also": more,
        "seed": spec.seed,
        "members": [dict(one.about) for one in saved],
    }
    save_student(spec.out, student, about)
    if not spec.full:
        save_compact(spec.out, spec.out)
    return JoinedPolicy(
        spec.out,
        spec.out.stat().st_size,
        len(members),
        {
            f"{route.scene.subtask} {route.target}": len(route.sentences)
            for route in routes
        },
        _unread(trunk, routes),
    )


def _fit_gate_of(trunk: RoutedTrunk, routes: Sequence[KnownRequest], seed: int) -> None:
    """Teach the gate which sentences ask for which route."""
    sentences = [route.sentences for route in routes]
    weights, bias = fit_gate(sentences, encode_sentence, seed)
    with torch.no_grad():
        trunk.gate.weight.copy_(weights)
        trunk.gate.bias.copy_(bias)


def _member(
    path: Path, saved: Checkpoint, first: str, wanted: Checkpoint
) -> BehaviourCloning:
    """A policy to join.

    Raises:
        UsageError: it is of another kind, or differs from the first one.
    """
    student = student_of(path, saved)
    if not (isinstance(student, BehaviourCloning) and isinstance(student.trunk, Trunk)):
        raise fault(
            path,
            f"cannot be joined: it is a student of {saved.config.algorithm} with the encoder "
            f"{saved.config.network.encoder}; give students of {BC}, dagger or ppo.",
        )
    if not saved.config.inputs.condition or saved.config.inputs.sentence:
        raise fault(
            path,
            "cannot be joined: give students with inputs.condition=true and inputs.sentence=false.",
        )
    # Compared with the first one: members act by one head and one layout.
    mine, others = saved.config, wanted.config
    told = {
        "inputs": (_apart_from_views(mine.inputs), _apart_from_views(others.inputs)),
        "number of images": (len(saved.layout.image_keys), len(wanted.layout.image_keys)),
        "network": (mine.network, others.network),
        "number of executed actions": (mine.execute, others.execute),
        "layout": (_apart_from_tasks(saved), _apart_from_tasks(wanted)),
    }
    wrong = [name for name, (its, theirs) in told.items() if its != theirs]
    if wrong:
        raise fault(
            path,
            f"cannot be joined with {first}: it has another {' and '.join(wrong)}.",
        )
    return student


def _apart_from_views(inputs: InputConfig) -> InputConfig:
    # Views may differ, since each member looks at its own.
    return dataclasses.replace(inputs, whole_views=True, target_views=True)


def _apart_from_tasks(saved: Checkpoint) -> ObservationSpec:
    inputs = _apart_from_views(saved.layout.inputs)
    # Targets and kinds are what members differ in by purpose.
    return dataclasses.replace(saved.layout, targets=(), kinds=(), inputs=inputs)


def _routes(
    entry: Entry, member: int, saved: Sequence[Checkpoint], spec: PolicyJoinSpec
) -> list[KnownRequest]:
    """The requests that an entry is for, with the sentences of episodes of its member's training.

    Raises:
        UsageError: the member was not trained for it, or its homes are not found.
    """
    about = saved[member].about
    try:
        scenes = [
            read_record(Scene, told, "scene")
            for told in (about.get("scene"), *about.get("also", ()))
        ]
    except (TypeError, ValueError) as error:
        raise fault(
            entry.checkpoint, f"does not say what it was trained for ({error})."
        ) from error
    found = []
    for scene in scenes:
        named = entry.target or scene.target
        if (
            scene.subtask != entry.subtask
            or entry.task not in ("", scene.task)
            or scene.target not in ("", named)
        ):
            continue
        # A member of all targets gets a route for each of them.
        targets = (named,) if named else _targets(scene)
        found += [(scene, target) for target in targets]
    if not found:
        raise fault(entry.checkpoint, f"was not trained for {entry.words}.")
    return [
        KnownRequest(scene, target, member, _sentences(scene, target, spec))
        for scene, target in found
    ]


def _targets(scene: Scene) -> tuple[str, ...]:
    """Types of targets that episodes of a scene are about."""
    from mjhab.episodes.starts import aims_of

    env = make_env(scene, {"obs_mode": "state"}, Resources(1, threads=1))
    try:
        return tuple(aims_of(env.config, env.layout))
    finally:
        env.close()


def _sentences(scene: Scene, target: str, spec: PolicyJoinSpec) -> tuple[str, ...]:
    """All wordings of the requests of some episodes."""
    # Starts of a file may be few; what is said does not depend on them.
    one = dataclasses.replace(scene, target=target, spawns="", randomise="")
    # No images: sentences come from the plan, and rendering would take most of the time.
    env = make_env(one, {"obs_mode": "state"}, Resources(WORLDS, threads=1))
    found: dict[str, None] = {}
    for start in range(0, spec.episodes, WORLDS):
        env.reset(seed=spec.seed + start)
        for world in range(WORLDS):
            # A dict, so that the gate is fitted to the same order every time.
            found |= dict.fromkeys(
                sentence for said in env.wordings(world) for sentence in said
            )
    env.close()
    return tuple(found)


def _check_apart(routes: Sequence[KnownRequest]) -> None:
    """Refuse requests in the same words.

    Raises:
        UsageError: names the sentence.
    """
    seen: dict[str, KnownRequest] = {}
    for route in routes:
        for sentence in route.sentences:
            # All routes, not only those of other members: a sentence with two routes has no right one.
            other = seen.setdefault(sentence, route)
            if other is not route:
                raise UsageError(
                    f"{sentence!r} asks for {route.scene.subtask} {route.target} and for {other.scene.subtask} "
                    f"{other.target}: no policy can know by the sentence which of the two is meant. Leave one out."
                )


def joined(
    members: Sequence[BehaviourCloning], routes: Sequence[KnownRequest]
) -> BehaviourCloning:
    """One student that does on each route what its member does; its gate is not fitted yet.

    Args:
        members: with the same inputs and networks. routes: requests, each of one member.
    """
    first = members[0]
    seen = [member.config.inputs for member in members]
    inputs = dataclasses.replace(
        first.config.inputs,
        condition=False,
        sentence=True,
        whole_views=any(each.whole_views for each in seen),
        target_views=any(each.target_views for each in seen),
    )
    layout = dataclasses.replace(
        first.layout,
        inputs=inputs,
        targets=tuple(dict.fromkeys(route.target for route in routes)),
    )
    called = {views: name for name, views in VIEWS.items()}
    network = dataclasses.replace(
        first.config.network,
        experts=tuple(called[each.whole_views, each.target_views] for each in seen),
        routes=tuple(route.member for route in routes),
    )
    # Nothing behind the executed actions of a chunk is ever used.
    config = dataclasses.replace(
        first.config, inputs=inputs, network=network, chunk=first.config.execute
    )
    made = make_student(config, layout)
    assert isinstance(made, BehaviourCloning)
    trunk = made.trunk
    assert isinstance(trunk, RoutedTrunk)
    width = trunk.width // len(members)
    with torch.no_grad():
        # Columns of the members that do not act must add nothing.
        made.head.weight.zero_()
        made.head.bias.zero_()
        for number, member in enumerate(members):
            expert = trunk.experts[number]
            assert isinstance(expert, Trunk)
            _take_over(expert, member, [_code(route, number, member) for route in routes])
            rows = len(made.head.weight)
            # Members normalize actions each by itself; the joined head gives them unnormalized.
            scale = member.action_normalizer.scale.repeat(config.chunk)
            mean = member.action_normalizer.mean.repeat(config.chunk)
            mine = made.head.weight[:, number * width : (number + 1) * width]
            # Column 0 of a member's features is 1 where it acts, so that its bias is switched as well.
            mine[:, 0] = member.head.bias[:rows] * scale + mean
            mine[:, 1:] = member.head.weight[:rows] * scale[:, None]
    return made.eval().requires_grad_(False)


def _code(route: KnownRequest, number: int, member: BehaviourCloning) -> Tensor:
    """What a member is told on a route; zeros on those of the others."""
    width = member.layout.conditioning_width
    if route.member != number:
        # The gate never sends these routes here, so that any value would do.
        return torch.zeros(width)
    asked = SubtaskConditioning(route.scene.subtask, route.target, "")
    return torch.from_numpy(code_of(asked, member.layout))


def _take_over(expert: Trunk, member: BehaviourCloning, codes: Sequence[Tensor]) -> None:
    """Copy the weights of a member's trunk to an expert that is told the number of the route in place of a code."""
    trunk = member.trunk
    assert isinstance(trunk, Trunk)
    measured = member.layout.measured_width
    table = torch.stack(list(codes), dim=1)
    old = trunk.state_dict()
    images = 0 if member.config.network.state_features else expert.encoder.cameras
    before = images * member.config.network.image_features
    first = "encoder.state" if member.config.network.state_features else "layers.0"
    first += ".weight" if f"{first}.weight" in old else ".0.weight"
    weight = old[first]
    steps = expert.encoder.vector_width // (measured + len(codes))
    parts = [weight[:, :before]]
    for step in weight[:, before:].unflatten(1, (steps, -1)).unbind(1):
        parts += [step[:, :measured], step[:, measured:] @ table]
    new = {**old, first: torch.cat(parts, dim=1)}
    for name, filler in (("mean", 0.0), ("scale", 1.0)):
        key = f"encoder.normalizer.{name}"
        # Codes are not normalized: mean 0 and scale 1 leave them as they are.
        rest = torch.full((len(codes),), filler)
        new[key] = torch.cat([old[key][:measured], rest])
    expert.load_state_dict(new)


def _unread(trunk: RoutedTrunk, routes: Sequence[KnownRequest]) -> tuple[str, ...]:
    """Sentences that the gate takes for those of another route."""
    wrong = []
    for number, route in enumerate(routes):
        for sentence in route.sentences:
            if int(trunk.route(torch.tensor(encode_sentence(sentence))[None])) != number:
                wrong.append(sentence)
    return tuple(wrong)
