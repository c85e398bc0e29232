"""Join students that were trained apart to one that knows by the sentence which of them is asked for.

What each member computes stays as it is, but for the last bits; see `students.routed`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor, nn

from mjhab.core.errors import UsageError, fault, wrong_value
from mjhab.core.files.reading import is_file
from mjhab.core.typed.options import read_record
from mjhab.learning.assigned.entries import Entry
from mjhab.learning.assigned.files import entries_in, read_entries
from mjhab.learning.assigned.members import (
    Asked,
    Member,
    keys_of,
    member_for,
    readable,
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
from mjhab.learning.runs.collection import make_env
from mjhab.learning.runs.specs import Resources, Scene
from mjhab.learning.students.bc import BehaviourCloning
from mjhab.learning.students.heads import make_student
from mjhab.learning.students.routed import RoutedTrunk, fit_gate

WORLDS = 8
"""Worlds of the environment that makes the sentences."""
SEED = 0
"""Of the episodes whose sentences the gate learns, and of the random words that it learns to ignore."""


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
    about = saved.about
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
        Asked(scene, target, _sentences(scene, target, spec)) for scene, target in found
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
        env.reset(seed=SEED + start)
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
                member.code(route) if route.member == number else member.unasked
                for route in routes
            ]
            keys = keys_of(made.config.inputs, made.config.network.experts[number])
            seen = {key: known.get(key) for key in keys}
            _take_over(expert, member, codes, seen)
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
        if views and any(
            its and not all_see
            for its, all_see in zip(VIEWS[member.views], VIEWS[views], strict=True)
        ):
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


def _take_over(
    expert: Trunk,
    member: Member,
    codes: Sequence[Tensor],
    images: Mapping[str, nn.Module | None],
) -> None:
    """Copy a member's network to an expert that is told the number of the route in place of a code.

    Args:
        expert: the new network. member: what it is to do. codes: what the member is told on each route.
        images: keys of those that the expert sees, all of the member's among them, with the encoder of one that is new
            to the member; None if nobody has one.
    """
    trunk, mine = member.trunk, member.encoders
    measured = len(trunk.normalizer.mean) - len(codes[0])
    table = torch.stack(list(codes), dim=1)
    old = trunk.state_dict()
    new = {k: v for k, v in old.items() if not k.startswith("encoder.encoders.")}
    features = trunk.encoder.image_features
    weight = old["layers.0.weight"]
    own = {
        key: weight[:, number * features : (number + 1) * features]
        for number, key in enumerate(mine)
    }
    behind = weight[:, len(mine) * features :]
    # With a layer of its own for the state, the code enters there.
    stated = not isinstance(trunk.encoder.state, nn.Identity)
    if stated:
        key = "encoder.state.weight"
        key = key if key in old else "encoder.state.0.weight"
        new[key] = _recoded(old[key], measured, table)
    else:
        behind = _recoded(behind, measured, table)
    for number, (key, known) in enumerate(images.items()):
        if encoder := mine.get(key, known):
            new |= {
                f"encoder.encoders.{number}.{name}": value
                for name, value in encoder.state_dict().items()
            }
    unread = weight.new_zeros(len(weight), features)
    seen = [own.get(key, unread) for key in images]
    new["layers.0.weight"] = torch.cat([*seen, behind], dim=1)
    for name, filler in (("mean", 0.0), ("scale", 1.0)):
        key = f"encoder.normalizer.{name}"
        # Codes are not normalized: mean 0 and scale 1 leave them as they are.
        rest = torch.full((len(codes),), filler)
        new[key] = torch.cat([old[key][:measured], rest])
    # Encoders that nobody has keep their random weights.
    expert.load_state_dict({**expert.state_dict(), **new})


def _recoded(weight: Tensor, measured: int, table: Tensor) -> Tensor:
    """Weights of a vector with a code at the end of every step for one with the route (R): ``table`` (T, R)."""
    parts = []
    for step in weight.unflatten(1, (-1, measured + len(table))).unbind(1):
        parts += [step[:, :measured], step[:, measured:] @ table]
    return torch.cat(parts, dim=1)


def _unread(trunk: RoutedTrunk, routes: Sequence[KnownRequest]) -> tuple[str, ...]:
    """Sentences that the gate takes for those of another route."""
    wrong = []
    for number, route in enumerate(routes):
        for sentence in route.sentences:
            if int(trunk.route(torch.tensor(encode_sentence(sentence))[None])) != number:
                wrong.append(sentence)
    return tuple(wrong)
