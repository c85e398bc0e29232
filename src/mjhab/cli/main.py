"""Entry point of the ``mjhab`` command: parse, run the command, turn errors into exit codes."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable, Sequence
from typing import Any, NoReturn

import tyro

from mjhab import register_all
from mjhab.cli import commands
from mjhab.cli.exits import BROKEN_PIPE, FAILED, INTERRUPTED, OK, USAGE
from mjhab.cli.options.limits import check_limits
from mjhab.cli.parsing import TYRO, Parsed, parse_spec
from mjhab.cli.renamed import with_new_names
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
CONFIG = "config"
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
    args = with_new_names(args)
    if args[0] == CONFIG:
        if len(args) == 1 or args[1] in HELP:
            _print_help(f"mjhab {CONFIG} COMMAND", CONFIG_DESCRIPTION, "")
        return Parsed(commands.BY_WORDS[(CONFIG,)], parse(args[1:]))
    group = commands.GROUPS.get(args[0])
    if group and (len(args) == 1 or args[1] in HELP):
        _print_help(
            f"mjhab {args[0]} COMMAND", f"{group[0].upper()}{group[1:]}.", args[0]
        )
    command, rest = commands.find(args)
    options = commands.load(command.options)
    prog = f"mjhab {command.name}"
    if command.spec:
        return parse_spec(command, options, prog, rest)
    parsed = tyro.cli(options, prog=prog, args=rest, config=TYRO)
    check_limits(parsed)
    limit = getattr(parsed, "cache_mb", None)
    return Parsed(command, parsed, json=getattr(parsed, "json", False), cache_mb=limit)


def _print_help(usage: str, description: str, group: str) -> NoReturn:
    print(f"usage: {usage} [OPTIONS]\n\n{description}\n\ncommands:")
    print(commands.overview(group))
    print("\nEach command tells its options: COMMAND --help")
    sys.exit(0)


def with_pack_request(options: Any) -> Any:
    """Merge ``articulate`` and ``stage_mesh`` of the options into ``assets``, as JSON data of a `PackRequest`."""
    furniture = getattr(options, "articulate", None)
    stage = getattr(options, "stage_mesh", None)
    if furniture is None and stage is None:
        return options
    from mjhab.scenes.pack_source import PackRequest

    request = PackRequest(
        options.assets,
        articulate=tuple(furniture.split(",")) if furniture else (),
        stage_mesh=str(stage) if stage else "",
    )
    return dataclasses.replace(
        options, assets=request.as_json(), stage_mesh=None, articulate=None
    )


def run(parsed: Parsed) -> int:
    """Run a parsed command and return the exit code."""
    register_all()
    if parsed.cache_mb is not None:
        set_memory_limit(parsed.cache_mb)
    function = parsed.command.load_run()
    if parsed.command.spec:
        return function(parsed.spec, parsed.json)
    return function(with_pack_request(parsed.spec))


if __name__ == "__main__":
    sys.exit(main())
