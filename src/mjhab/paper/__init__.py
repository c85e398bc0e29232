"""The MS-HAB paper: its policies, and the training and evaluations for its tables.

Nothing imports this package: commands and kinds of policies name its modules.
"""
