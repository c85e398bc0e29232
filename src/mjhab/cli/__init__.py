"""The ``mjhab`` command. Modules here import heavy libraries inside the commands, so that ``--help`` is quick."""
