"""The Dockerfiles build from this repository and a package registry; read as text, since tests have no Docker."""

from __future__ import annotations

import json
import re
import shlex
import tomllib
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from mjhab.cli.main import parse

ROOT = Path(__file__).parents[2]
DOCKERFILES = ("Dockerfile", "Dockerfile.gpu")
LOCAL_PROGRAMS = {"useradd", "mkdir", "chown"}
"""Programs of a RUN line that never use the network."""
OFFLINE_COMMANDS = {"warmup", "doctor", "--help"}
"""Commands of mjhab that never use the network."""
PIP_COMMANDS = {"wheel", "install"}
OTHER_INDEX = {
    "-i",
    "--index-url",
    "--extra-index-url",
    "-f",
    "--find-links",
    "--trusted-host",
}


@dataclass
class Stage:
    """One build stage: its name, its instructions and the values of its ARG and ENV lines."""

    name: str
    base: str
    lines: list[tuple[str, str]] = field(default_factory=list)
    values: dict[str, str] = field(default_factory=dict)


def instructions(text: str) -> list[tuple[str, str]]:
    """Keyword and rest of every instruction, with continued lines joined and comments removed."""
    lines = [line for line in text.splitlines() if not line.lstrip().startswith("#")]
    joined = re.sub(r"\\\n", " ", "\n".join(lines))
    pairs = [line.split(None, 1) for line in joined.splitlines() if line.strip()]
    return [
        (pair[0].upper(), pair[1].strip() if len(pair) == 2 else "") for pair in pairs
    ]


def stages(text: str) -> list[Stage]:
    """Stages in order; ARGs before the first FROM count for the FROM lines only, as Docker has it."""
    found: list[Stage] = []
    outer: dict[str, str] = {}
    for keyword, rest in instructions(text):
        if keyword == "FROM":
            words = expand(rest, outer).split()
            name = words[2] if len(words) == 3 else ""
            found.append(Stage(name, words[0]))
        elif keyword == "ARG":
            name, _, value = rest.partition("=")
            (found[-1].values if found else outer)[name] = value
        else:
            found[-1].lines.append((keyword, rest))
    return found


def expand(words: str, values: dict[str, str]) -> str:
    """Words with ``$NAME`` and ``${NAME}`` replaced; unknown names stay as they are."""
    return re.sub(r"\$\{?(\w+)\}?", lambda m: values.get(m[1], m[0]), words)


def ignored(path: str, patterns: list[str]) -> bool:
    """Whether .dockerignore leaves a path out: the last pattern that matches it or a folder above decides."""
    out = False
    for line in patterns:
        wanted = line.lstrip("!").strip("/")
        regex = re.escape(wanted).replace(r"\*\*/", "(.*/)?").replace(r"\*", "[^/]*")
        if re.fullmatch(f"{regex}(/.*)?", path):
            out = not line.startswith("!")
    return out


def copied(stage: Stage) -> list[str]:
    """Sources of the COPY lines that read the repository."""
    words = [rest.split() for keyword, rest in stage.lines if keyword == "COPY"]
    own = [line for line in words if not any(word.startswith("--from=") for word in line)]
    return [word for line in own for word in line[:-1] if not word.startswith("--")]


def commands(stage: Stage) -> list[list[str]]:
    """Words of every command of the RUN lines; ``$(...)`` counts as one word."""
    found = []
    for keyword, rest in stage.lines:
        if keyword != "RUN":
            continue
        shell = re.sub(r"^(--\w+=\S+\s+)+", "", expand(rest, stage.values))
        shell = re.sub(r"\$\([^)]*\)", "FOUND", shell)
        found += [shlex.split(part) for part in re.split(r"&&|\|\||[;|]", shell)]
    return found


def copy_faults(stage: Stage) -> list[str]:
    """Sources that are missing or that .dockerignore leaves out, whole or in part."""
    text = (ROOT / ".dockerignore").read_text(encoding="utf-8")
    patterns = [line for line in text.split() if not line.startswith("#")]
    faults = []
    for source in copied(stage):
        path = ROOT / source
        if not path.exists():
            faults.append(f"COPY {source}: it does not exist")
        made = ("__pycache__", ".egg-info")
        files = [path, *path.rglob("*")] if path.is_dir() else [path]
        names = [file.relative_to(ROOT).as_posix() for file in files]
        kept = [name for name in names if not any(word in name for word in made)]
        faults += [
            f"COPY {name}: .dockerignore leaves it out"
            for name in kept
            if ignored(name, patterns)
        ]
    return faults


def wheel_faults(stage: Stage, project: dict) -> list[str]:
    """Files that a stage needs to build the wheel and does not copy."""
    if not any(words[:2] == ["pip", "wheel"] for words in commands(stage)):
        return []
    needed = {"pyproject.toml", "src", project["readme"], *project["license-files"]}
    return [f"pip wheel needs {name}" for name in sorted(needed - set(copied(stage)))]


def pip_faults(words: list[str], stage: Stage, project: dict) -> list[str]:
    """Faults of a pip command: other indexes, unknown extras, no constraints."""
    faults = [f"pip uses {word}" for word in words if word.split("=")[0] in OTHER_INDEX]
    if words[1] not in PIP_COMMANDS:
        return [*faults, f"pip {words[1]}"]
    if words[1] == "wheel":
        return (
            faults if "--no-deps" in words else [*faults, "pip wheel without --no-deps"]
        )
    if not ({"-c", "--constraint"} & set(words)) or "constraints.txt" not in copied(
        stage
    ):
        faults.append("pip install without constraints.txt")
    extras = re.findall(r"mjhab\[([^]]*)\]", " ".join(words))
    if not extras:
        faults.append("pip install names no extras")
    known = project["optional-dependencies"]
    asked = {extra for part in extras for extra in part.split(",")}
    return [*faults, *(f"no extra {extra}" for extra in sorted(asked - set(known)))]


def mjhab_faults(words: list[str]) -> list[str]:
    """Faults of a command of mjhab: unknown options, commands that might use the network."""
    try:
        parse(words)
    except SystemExit as end:
        if end.code != 0:
            return [f"mjhab {' '.join(words)}: no such command"]
    online = words[0] not in OFFLINE_COMMANDS
    return [f"mjhab {words[0]} may use the network"] if online else []


def run_faults(stage: Stage, project: dict) -> list[str]:
    """Faults of the RUN lines; a program that is not known to stay offline is one."""
    faults = []
    for words in commands(stage):
        program = words[0]
        if program == "pip":
            faults += pip_faults(words, stage, project)
        elif program == "mjhab":
            faults += mjhab_faults(words[1:])
        elif program not in LOCAL_PROGRAMS:
            faults.append(f"RUN {program} may use the network")
    return faults


def stage_faults(stage: Stage, earlier: set[str], project: dict) -> list[str]:
    """Faults of one stage; earlier: names of the stages before it."""
    faults = [
        *copy_faults(stage),
        *wheel_faults(stage, project),
        *run_faults(stage, project),
    ]
    if not stage.base.startswith("python:") and stage.base not in earlier:
        faults.append(f"FROM {stage.base}: no Python image")
    for keyword, rest in stage.lines:
        if keyword == "ADD":
            faults.append("ADD may use the network, COPY does not")
        if re.search(r"(?<!file)://|git\+|git@", rest):
            faults.append(f"{keyword} names an address: {rest}")
        sources = re.findall(r"\bfrom=([\w.:/-]+)", rest)
        faults += [f"no stage {name}" for name in sources if name not in earlier]
    return faults


def find_faults(text: str) -> list[str]:
    """Everything that is wrong with a Dockerfile of this repository."""
    with (ROOT / "pyproject.toml").open("rb") as file:
        project = tomllib.load(file)["project"]
    built = stages(text)
    faults = []
    for number, stage in enumerate(built):
        faults += stage_faults(
            stage, {earlier.name for earlier in built[:number]}, project
        )
    last = dict(built[-1].lines)
    if json.loads(last.get("ENTRYPOINT", "[]")) != ["mjhab"]:
        faults.append("the entry point is not mjhab")
    if last.get("USER") in (None, "root"):
        faults.append("the container runs as root")
    return [*faults, *mjhab_faults(json.loads(last.get("CMD", '["--help"]')))]


@pytest.mark.parametrize("name", DOCKERFILES)
def test_a_dockerfile_needs_the_repository_and_a_package_registry_alone(
    name: str,
) -> None:
    assert find_faults((ROOT / name).read_text(encoding="utf-8")) == []


def replace(old: str, new: str) -> Callable[[str], str]:
    """A change of a Dockerfile's text, which must have ``old`` in it."""

    def change(text: str) -> str:
        assert old in text
        return text.replace(old, new)

    return change


def add(line: str) -> Callable[[str], str]:
    """A change of a Dockerfile's text: one more instruction in its last stage."""
    return replace("WORKDIR /work\n", f"WORKDIR /work\n{line}\n")


CHANGES = {
    "it does not exist": replace("COPY src src", "COPY src sources src"),
    ".dockerignore leaves it out": add("COPY tests tests"),
    "pip wheel needs LICENSE": replace(" LICENSE ./", " ./"),
    "no extra": replace("ARG EXTRAS=", "ARG EXTRAS=colour,"),
    "pip install names no extras": replace("mjhab[${EXTRAS}]", "mjhab"),
    "pip install without constraints.txt": replace("-c /tmp/constraints.txt ", ""),
    "pip uses --extra-index-url": replace(
        "pip install", "pip install --extra-index-url here"
    ),
    "pip download": add("RUN pip download torch"),
    "RUN curl may use the network": add("RUN mkdir a && curl -O there"),
    "RUN git may use the network": add("RUN git clone there"),
    "RUN apt-get may use the network": add("RUN apt-get install -y git"),
    "RUN names an address": replace("file://", "https://"),
    "ADD may use the network": add("ADD https://example.com/a.zip /a.zip"),
    "mjhab assets may use the network": replace(
        "warmup --task set_table", "assets fetch ycb"
    ),
    "no such command": replace("warmup --task", "warmup --tusk"),
    "no stage builder": replace("from=wheel", "from=builder"),
    "no Python image": replace("FROM python:", "FROM debian:"),
    "the entry point is not mjhab": replace(
        'ENTRYPOINT ["mjhab"]', 'ENTRYPOINT ["bash"]'
    ),
    "the container runs as root": replace("USER mjhab\n", ""),
}
"""Words of a fault, and a change of each Dockerfile that has it."""


@pytest.mark.parametrize("fault", CHANGES)
@pytest.mark.parametrize("name", DOCKERFILES)
def test_a_fault_of_a_dockerfile_is_found(name: str, fault: str) -> None:
    changed = CHANGES[fault]((ROOT / name).read_text(encoding="utf-8"))
    assert any(fault in found for found in find_faults(changed)), find_faults(changed)


@pytest.mark.parametrize(
    ("path", "patterns", "out"),
    [
        ("src/a.py", ["src"], True),
        ("src/a.py", ["**/a.py"], True),
        ("src/a.py", ["*.py"], False),
        ("src/a.py", ["src", "!src/a.py"], False),
        ("README.md", ["*.md"], True),
        (".venv-wheel/x", [".venv*"], True),
    ],
)
def test_dockerignore_is_read_as_docker_does(
    path: str, patterns: list[str], out: bool
) -> None:
    assert ignored(path, patterns) is out
