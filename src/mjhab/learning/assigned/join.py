"""Join students that were trained apart to one that knows by the sentence which of them is asked for.

What each member computes stays as it is, but for the last bits; see `students.routed`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from mjhab.core.errors import UsageError, fault, wrong_value
from mjhab.core.files.reading import is_file
from mjhab.learning.assigned.entries import Entry
from mjhab.learning.assigned.files import entries_in, read_entries
from mjhab.learning.assigned.members import (
    Asked,
    code,
    member_for,
    readable,
    scenes_of,
    unasked,
)
from mjhab.learning.assigned.spec import PolicyJoinSpec
from mjhab.learning.checkpoint import (
    Checkpoint,
    load_checkpoint,
    save_compact,
    save_student,
)
from mjhab.learning.configs import VIEWS
from mjhab.learning.networks import Trunk
from mjhab.learning.observation.sentences import encode_sentence
from mjhab.learning.runs.collection import make_env, wordings_of
from mjhab.learning.runs.specs import Resources, Scene
from mjhab.learning.students.bc import BehaviourCloning
from mjhab.learning.students.heads import make_student
from mjhab.learning.students.members import Member, keys_of, loses_images, take_over
from mjhab.learning.students.routed import RoutedTrunk, fit_gate

SEED = 0
"""Of the random words that a gate learns to ignore."""


@dataclass(frozen=True)
class KnownRequest(Asked):
    """A request that a joined policy knows. member: number of the network that acts."""

    member: int


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
    files = list(dict.fromkeys(entry.checkpoint for entry in entries))
    for file in files:
        if not is_file(Path(file)):
            raise fault(
                file, "is no checkpoint; only those of `mjhab train` can be joined."
            )
    # All are read before anything is made, so that a wrong one is refused at once.
    saved = dict(zip(files, [load_checkpoint(Path(file)) for file in files], strict=True))
    students = dict(zip(files, readable(files, list(saved.values())), strict=True))
    members: list[Member] = []
    routes: list[KnownRequest] = []
    for entry in entries:
        for asked in _asked(entry, saved[entry.checkpoint], spec):
            acts = member_for(students[entry.checkpoint], asked)
            # One member for all requests of a network, so that its weights are stored once.
            if acts not in members:
                members.append(acts)
            routes.append(
                KnownRequest(
                    asked.scene, asked.target, asked.sentences, members.index(acts)
                )
            )
    _check_apart(routes)
    student = joined(members, routes, spec.views)
    trunk = student.trunk
    assert isinstance(trunk, RoutedTrunk)
    _fit_gate_of(trunk, routes)
    first, *more = [
        dataclasses.replace(route.scene, target=route.target).record() for route in routes
    ]
    about = {
        "algorithm": "join",
        "trained": True,
        "scene": first,
        "also": more,
        "members": [dict(one.about) for one in saved.values()],
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


def _fit_gate_of(trunk: RoutedTrunk, routes: Sequence[KnownRequest]) -> None:
    """Teach the gate which sentences ask for which route."""
    sentences = [route.sentences for route in routes]
    weights, bias = fit_gate(sentences, encode_sentence, SEED)
    with torch.no_grad():
        trunk.gate.weight.copy_(weights)
        trunk.gate.bias.copy_(bias)


def _asked(entry: Entry, saved: Checkpoint, spec: PolicyJoinSpec) -> list[Asked]:
    """The requests that an entry is for, with the sentences of episodes of its policy's training.

    Raises:
        UsageError: the policy was not trained for it, or its homes are not found.
    """
    found = []
    for scene in scenes_of(entry.checkpoint, saved):
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
        Asked(scene, target, wordings_of(scene, target, spec.episodes))
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
    members: Sequence[Member], routes: Sequence[KnownRequest], views: str = ""
) -> BehaviourCloning:
    """One student that does on each route what its member does; its gate is not fitted yet.

    Args:
        members: with the same inputs and networks. routes: requests, each of one member.
        views: what every member sees, one of VIEWS; if not given, what it has seen so far. The weights of images that
            are new to a member are zero, and their encoder is that of a member that knows them, if there is one.

    Raises:
        UsageError: a member would lose images.
    """
    made = _joined_network(members, routes, views)
    trunk = made.trunk
    assert isinstance(trunk, RoutedTrunk)
    width = trunk.width // len(members)
    known = {
        key: encoder
        for member in reversed(members)
        for key, encoder in member.encoders.items()
    }
    with torch.no_grad():
        # Columns of the members that do not act must add nothing; actions are given unnormalized, as heads of members
        # give them.
        made.head.weight.zero_()
        made.head.bias.zero_()
        for number, member in enumerate(members):
            expert = trunk.experts[number]
            assert isinstance(expert, Trunk)
            # The gate never sends the routes of others here, so that any code would do.
            codes = [
                code(member, route) if route.member == number else unasked(member)
                for route in routes
            ]
            keys = keys_of(made.config.inputs, VIEWS[made.config.network.experts[number]])
            seen = {key: known.get(key) for key in keys}
            take_over(expert, member, torch.stack(codes, dim=1), seen)
            weight, bias = member.head
            rows = len(made.head.weight)
            mine = made.head.weight[:, number * width : (number + 1) * width]
            # Column 0 of a member's features is 1 where it acts, so that its bias is switched as well.
            mine[:, 0] = bias[:rows]
            mine[:, 1:] = weight[:rows]
    return made.eval().requires_grad_(False)


def _joined_network(
    members: Sequence[Member], routes: Sequence[KnownRequest], views: str
) -> BehaviourCloning:
    """The network of a joined policy, with random weights; arguments and errors as `joined`."""
    first = members[0].student
    for member in members:
        if views and loses_images(member.sees, VIEWS[views]):
            raise wrong_value(
                "views",
                views,
                f"those that every member sees, {member.views!r} among them",
            )
    named = tuple(views or member.views for member in members)
    inputs = dataclasses.replace(
        first.config.inputs,
        condition=False,
        sentence=True,
        whole_views=any(VIEWS[name][0] for name in named),
        target_views=any(VIEWS[name][1] for name in named),
    )
    layout = dataclasses.replace(
        first.layout,
        inputs=inputs,
        targets=tuple(dict.fromkeys(route.target for route in routes)),
    )
    network = dataclasses.replace(
        first.config.network,
        experts=named,
        routes=tuple(route.member for route in routes),
    )
    # Nothing behind the executed actions of a chunk is ever used.
    config = dataclasses.replace(
        first.config, inputs=inputs, network=network, chunk=first.config.execute
    )
    made = make_student(config, layout)
    assert isinstance(made, BehaviourCloning)
    return made


def _unread(trunk: RoutedTrunk, routes: Sequence[KnownRequest]) -> tuple[str, ...]:
    """Sentences that the gate takes for those of another route."""
    wrong = []
    for number, route in enumerate(routes):
        for sentence in route.sentences:
            if int(trunk.route(torch.tensor(encode_sentence(sentence))[None])) != number:
                wrong.append(sentence)
    return tuple(wrong)
