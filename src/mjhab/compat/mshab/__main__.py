"""``python -m mjhab.compat.mshab SCRIPT.py ARGS...`` runs a script of MS-HAB; ``--check SCRIPT.py`` looks at it."""

from __future__ import annotations

import json
import sys

from mjhab.compat.mshab.running.check import ANSWERED, check_script
from mjhab.compat.mshab.running.script import (
    find_script,
    read_constant,
    run_module,
    run_script,
)
from mjhab.core.errors import UsageError
from mjhab.core.progress import say

USAGE = """usage: python -m mjhab.compat.mshab [--set NAME=VALUE ...] SCRIPT.py ARGS...
       python -m mjhab.compat.mshab [--set NAME=VALUE ...] -m MODULE ARGS...
       python -m mjhab.compat.mshab --check SCRIPT.py [--json]

--set gives a constant of the script, such as NUM_ENVS of the data generators, another value."""


def main(arguments: list[str]) -> int:
    """Run or check a script; the exit status."""
    if not arguments or arguments[0] in ("-h", "--help"):
        print(USAGE)
        return 0 if arguments else 2
    if arguments[0] == "--check":
        return _check(arguments[1:])
    constants = {}
    while arguments[:1] == ["--set"]:
        name, value = read_constant((arguments[1:2] or [""])[0])
        constants[name] = value
        arguments = arguments[2:]
    if not arguments or arguments == ["-m"]:
        raise UsageError(f"there is no script to run.\n{USAGE}")
    if arguments[0] == "-m":
        run_module(arguments[1], arguments[2:], constants)
        return 0
    if arguments[0].startswith("-"):
        raise UsageError(f"unknown option {arguments[0]}.\n{USAGE}")
    run_script(find_script(arguments[0]), arguments[1:], constants)
    return 0


def _check(arguments: list[str]) -> int:
    """Tell what a script imports; status 1 if something is missing."""
    as_json = "--json" in arguments
    scripts = [argument for argument in arguments if argument != "--json"]
    if len(scripts) != 1:
        raise UsageError(f"--check takes one script.\n{USAGE}")
    found = check_script(find_script(scripts[0]))
    if as_json:
        print(json.dumps(found))
    else:
        for name, state in found["imports"].items():
            print(f"{state:9} {name}")
        print(f"ids: {', '.join(found['ids']) or 'none'}")
    return int(any(state != ANSWERED for state in found["imports"].values()))


if __name__ == "__main__":
    try:
        status = main(sys.argv[1:])
    except UsageError as error:
        say(f"error: {error}")
        status = 2
    sys.exit(status)
