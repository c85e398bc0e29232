"""Entry point of the ``mjhab`` command: parse, run the command, turn errors into exit codes."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable, Sequence
from typing import NoReturn

from mjhab import register_all
from mjhab.cli import commands
from mjhab.cli.exits import BROKEN_PIPE, FAILED, INTERRUPTED, OK, USAGE
from mjhab.cli.parsing import Parsed, parse_words
from mjhab.cli.renamed import with_command
from mjhab.cli.streams import (
    described,
    drop_unwritable_stdout,
    make_streams_sturdy,
    show_own_warnings_plainly,
)
from mjhab.core.errors import MjhabError, UsageError
from mjhab.core.files.outputs import DISK_ERRORS
from mjhab.core.files.reading import reason
from mjhab.core.memory_cache import set_memory_limit
from mjhab.core.version import __version__

DESCRIPTION = f"""mjhab {__version__}: home assistant tasks with low-level whole-body control, on MuJoCo.

A robot tidies furnished homes with real physics. Start with `mjhab demo`; `mjhab doctor` shows what is installed."""

HELP = ("-h", "--help")
CONFIG_DESCRIPTION = """Print what a command line means, with all defaults, as one line of JSON, without running it.

`mjhab config eval --subtask pick --profile ms_hab`"""


def main(args: Sequence[str] | None = None) -> int:
    """Run the command line ``args`` (``sys.argv`` if None) and return the exit code.

    0: success; 1: the command failed; 2: the request is invalid; 130: Ctrl-C; 141: the reader of stdout has closed it.
    """
    given = list(sys.argv[1:] if args is None else args)

    def work() -> int:
        if given == ["--version"]:
            print(f"mjhab {__version__}")
            return OK
        return run(parse(given))

    return exit_code_of(work)


def exit_code_of(work: Callable[[], int]) -> int:
    """Do the work of a command; an error that it raises is told in a line on stderr and becomes the exit code."""
    # First of all: even a message about a wrong option may meet a closed stream.
    make_streams_sturdy()
    show_own_warnings_plainly()
    try:
        try:
            return work()
        finally:
            # Flush here, where a closed pipe can be distinguished from other errors.
            sys.stdout.flush()
    except UsageError as error:
        return _end(USAGE, str(error))
    except MjhabError as error:
        return _end(FAILED, f"failed: {error}")
    except MemoryError as error:
        return _end(
            FAILED,
            f"failed: not enough memory ({reason(error)}). Ask for less at a time.",
        )
    except BrokenPipeError:
        # The reader has closed the pipe, as in `mjhab homes list | head`.
        drop_unwritable_stdout()
        return BROKEN_PIPE
    except OSError as error:
        return _end(_code_of(error), f"failed: {described(error)}")
    except KeyboardInterrupt:
        return _end(INTERRUPTED, "interrupted.")


def _end(code: int, message: str) -> int:
    """Print to stderr, if possible, why a command ended; returns ``code``."""
    print(f"mjhab: {message}", file=sys.stderr, flush=True)
    # Otherwise the interpreter tries to flush it at its end, and tells a second error.
    drop_unwritable_stdout()
    return code


def _code_of(error: OSError) -> int:
    """Exit code of an OSError: a full or broken disk is a failure; an unusable file or folder is an invalid request."""
    return FAILED if error.errno in DISK_ERRORS or error.filename is None else USAGE


def parse(args: Sequence[str]) -> Parsed:
    """Parse a command line; prints help and exits where it asks for it.

    Raises:
        UsageError: there is no such command, or a value does not fit; where tyro refuses a word, it exits with code 2.
    """
    if not args:
        names = ", ".join(dict.fromkeys(c.words[0] for c in commands.COMMANDS))
        raise UsageError(f"name a command: {names}. `mjhab --help` tells what each does.")
    if args[0] in HELP:
        _print_help("mjhab COMMAND", DESCRIPTION, "")
    args = with_command(args)
    if args[0] == commands.CONFIG:
        if len(args) == 1 or args[1] in HELP:
            _print_help(f"mjhab {commands.CONFIG} COMMAND", CONFIG_DESCRIPTION, "")
        return dataclasses.replace(parse(args[1:]), tells=True)
    group = commands.GROUPS.get(args[0])
    if group and (len(args) == 1 or args[1] in HELP):
        _print_help(
            f"mjhab {args[0]} COMMAND", f"{group[0].upper()}{group[1:]}.", args[0]
        )
    command, rest = commands.find(args)
    return parse_words(command, rest)


def _print_help(usage: str, description: str, group: str) -> NoReturn:
    print(f"usage: {usage} [OPTIONS]\n\n{description}\n\ncommands:")
    print(commands.overview(group))
    print("\nEach command tells its options: COMMAND --help")
    # As tyro ends after its own help.
    sys.exit(0)


def run(parsed: Parsed) -> int:
    """Run a parsed command and return the exit code."""
    # Before the specification is made, whose checks know names of tasks and robots of plugins.
    register_all()
    if parsed.cache_mb is not None:
        set_memory_limit(parsed.cache_mb)
    if parsed.tells:
        return commands.load("cli.machine.config:run_config")(parsed)
    function = parsed.command.load_run()
    return function(parsed.spec, parsed.json)


if __name__ == "__main__":
    sys.exit(main())
