"""The ``mjhab`` command. Its modules import heavy libraries inside the commands, so that ``--help`` is fast."""
