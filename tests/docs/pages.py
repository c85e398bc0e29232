"""The code that documentation pages show: fenced blocks, and the commands in them.

A block that cannot run on any machine says why in a comment before it, which readers do not see:

    <!-- not run: needs a GPU -->
"""

from __future__ import annotations

import re
import shlex
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
README = ROOT / "README.md"
PAGES = [README, ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
LANGUAGES = ("bash", "python", "json", "toml", "yaml", "text")
BLOCK = re.compile(
    r'^(?:<!-- not run: (?P<reason>[^\n]+) -->\n)?```(?P<language>\w*)(?: title="(?P<file>[^"]+)")?\n'
    r"(?P<code>.*?)^```$",
    re.DOTALL | re.MULTILINE,
)
COMMAND = re.compile(r"(?:\w+=\S+ )*(?:\S*/)?(?:mjhab|make|pip|python|git|ssh) ")
ASSIGNMENT = re.compile(r"^(\w+)=(.*)$")


@dataclass(frozen=True)
class Block:
    """A piece of code in a page.

    file: the name it is to be saved under, or "". reason: why it is not run, "" where it is.
    """

    language: str
    file: str
    code: str
    reason: str


@dataclass(frozen=True)
class Command:
    """A command line: variables of the environment, and words, the first of which is the program."""

    variables: dict[str, str]
    words: tuple[str, ...]

    @property
    def program(self) -> str:
        """Its name without folders."""
        return Path(self.words[0]).name


def name_of(page: Path) -> str:
    """A page relative to the repository."""
    return str(page.relative_to(ROOT))


def blocks(page: Path) -> list[Block]:
    """The blocks of a page from top to bottom."""
    text = page.read_text(encoding="utf-8")
    parts = [found.groupdict(default="") for found in BLOCK.finditer(text)]
    return [Block(p["language"], p["file"], p["code"], p["reason"]) for p in parts]


def saved(page: Path) -> list[Block]:
    """The blocks of a page that its readers save as files."""
    return [block for block in blocks(page) if block.file]


def commands(block: Block) -> list[Command]:
    """The commands of a shell block, without comments."""
    found = []
    for line in block.code.replace("\\\n", " ").splitlines():
        words = shlex.split(line, comments=True)
        if not words:
            continue
        variables = {}
        while match := ASSIGNMENT.match(words[0]):
            variables[match[1]] = match[2]
            words.pop(0)
        found.append(Command(variables, tuple(words)))
    return found


def hidden_commands(page: Path) -> list[str]:
    """Indented lines outside of fences that look like commands: nothing would check them."""
    outside = BLOCK.sub("", page.read_text(encoding="utf-8"))
    lines = [line.strip() for line in outside.splitlines() if line.startswith("    ")]
    return [line for line in lines if COMMAND.match(line)]
