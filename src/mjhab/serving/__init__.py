"""Policies that run elsewhere: messages over websockets, the two ends of the line, and the dialects that are spoken.

Protocol code alone: what an observation holds and what a policy is, `mjhab.evaluation` knows. Nothing is ever unpickled.
"""
