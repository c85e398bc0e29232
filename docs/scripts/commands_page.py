"""The page of all commands, docs/commands.md: ``python docs/scripts/commands_page.py``.

Summaries are those of the table of commands; options, defaults and meanings are those of the specifications.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from mjhab.cli.commands import COMMANDS, Command
from mjhab.cli.parsing import Option, options_of
from mjhab.core.typed.flags import summary_of

PAGE = Path(__file__).parents[1] / "commands.md"
HEAD = """# All commands

Made by `python docs/scripts/commands_page.py` from what the commands themselves know. `mjhab COMMAND --help` tells the
same. Every command has `--json`: one JSON object as the last line of stdout. Exit codes: 0 success, 1 the command
failed, 2 the request is invalid, 130 Ctrl-C. `mjhab config COMMAND ...` prints what a command line means, with all
defaults, without running it.
"""


def page() -> str:
    """The text of the page."""
    parts = [HEAD, _overview()]
    parts += [_section(command) for command in COMMANDS]
    return "\n".join(parts)


def _overview() -> str:
    rows = ["| command | what it does |", "|---|---|"]
    for command in COMMANDS:
        rows.append(f"| `mjhab {command.name}` | {_cell(command.summary)} |")
    return "\n".join(rows) + "\n"


def _section(command: Command) -> str:
    spec = command.spec_type
    rows = [
        f"| `{_flag(option)}` | {_cell(option.default_text)} | {_cell(option.help)} |"
        for option in options_of(spec)
    ]
    if rows:
        rows = ["| option | default | meaning |", "|---|---|---|", *rows]
    return f"## mjhab {command.name}\n\n{summary_of(spec)}\n\n" + "\n".join(rows) + "\n"


def _flag(option: Option) -> str:
    name = option.name.replace("_", "-")
    if not option.takes_value and not option.is_switch:
        name = f"no-{name}"
    if option.keyed is not None:
        name = f"{name}.{option.keyed.key}"
    return f"{name.upper()} ..." if option.flag.positional else f"--{name}"


def _cell(text: str) -> str:
    return text.replace("|", "\\|")


def main() -> None:
    argparse.ArgumentParser(description=__doc__).parse_args()
    PAGE.write_text(page(), encoding="utf-8")


if __name__ == "__main__":
    main()
