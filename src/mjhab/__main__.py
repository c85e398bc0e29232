"""``python -m mjhab``: the ``mjhab`` command."""

from mjhab.cli.main import main

if __name__ == "__main__":
    raise SystemExit(main())
