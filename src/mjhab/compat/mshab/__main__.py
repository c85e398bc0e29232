"""``python -m mjhab.compat.mshab SCRIPT.py ARGS...`` runs a script of MS-HAB; ``--check SCRIPT.py`` looks at it."""

from __future__ import annotations

import json
import sys

from mjhab.compat.mshab.running.check import ANSWERED, check_script
from mjhab.compat.mshab.running.script import find_script, run_module, run_script
from mjhab.core.errors import UsageError

USAGE = """usage: python -m mjhab.compat.mshab SCRIPT.py ARGS...
       python -m mjhab.compat.mshab -m MODULE ARGS...
       python -m mjhab.compat.mshab --check SCRIPT.py [--json]"""


def main(arguments: list[str]) -> int:
    """Run or check a script; the exit status."""
    if not arguments or arguments[0] in ("-h", "--help"):
        print(USAGE)
        return 0 if arguments else 2
    if arguments[0] == "--check":
        return _check(arguments[1:])
    if arguments[0] == "-m":
        if len(arguments) < 2:
            raise UsageError(f"-m needs the name of a module.\n{USAGE}")
        run_module(arguments[1], arguments[2:])
        return 0
    if arguments[0].startswith("-"):
        raise UsageError(f"unknown option {arguments[0]}.\n{USAGE}")
    run_script(find_script(arguments[0]), arguments[1:])
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
        print(f"error: {error}", file=sys.stderr)
        status = 2
    sys.exit(status)
