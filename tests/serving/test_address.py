"""Addresses of policy servers: what they hold, and what is refused."""

from __future__ import annotations

import re

import pytest

from mjhab.serving.address import Address, with_options, without_password
from tests.refusals import refused


def test_options_stand_behind_the_address() -> None:
    spec = with_options(
        "ws://host:8000?execute=2", {"dialect": "behavior", "batch": "yes"}
    )
    address = Address.parse(spec)
    assert address == Address("ws://host:8000", "behavior", execute=2, batch=True)
    assert Address.parse("wss://host:1/path").uri == "wss://host:1/path"
    given = {"timeout": 2.0, "first_timeout": 5.0}
    assert Address.parse(with_options("ws://host:1", given)) == Address(
        "ws://host:1", timeout=2.0, first_timeout=5.0
    )
    # Like the address itself, the option --timeout leaves the wait for the first answer as it is.
    waits = Address.parse(with_options("ws://host:1", {"timeout": 2.0}))
    assert waits == Address.parse("ws://host:1?timeout=2")


@pytest.mark.parametrize(
    ("spec", "option"),
    [
        ("ws://host", "policy"),
        ("ws://host:99999", "policy"),
        ("ws://:8000", "policy"),
        ("ws://h:1?dialect=openpie", "dialect"),
        ("ws://h:1?execut=2", "option of a served policy"),
        ("ws://h:1?execute=0", "execute"),
        ("ws://h:1?execute=two", "execute"),
        ("ws://h:1?timeout=nan", "timeout"),
        ("ws://h:1?prompt=poem", "prompt"),
        ("ws://h:1?batch=yes", "batch"),
    ],
)
def test_bad_addresses_are_refused(spec: str, option: str) -> None:
    with refused(option):
        Address.parse(spec)


SECRET = "alpha/beta:gamma#delta?epsilon@zeta"


@pytest.mark.parametrize(
    "spec",
    [
        f"ws://me:{SECRET}@host:8000",
        f"ws://me:{SECRET}@host",
        "ws://me:alpha@host:port",
        "ws://me:alpha@[host:8000",
        "ws://me:alpha@host:8000?execute=two",
    ],
)
def test_no_message_shows_a_password(spec: str) -> None:
    with refused() as told:
        Address.parse(spec)
    message = str(told.value)
    assert "host" in message
    assert [part for part in re.split(r"\W", SECRET) if part in message] == []


def test_the_address_is_told_without_its_password() -> None:
    address = Address.parse("ws://me:secret@host:8000/path?dialect=roboarena")
    assert address.uri == "ws://me:secret@host:8000/path"
    assert address.shown == "ws://host:8000/path"
    assert without_password("FILE@home.py:Mine") == "FILE@home.py:Mine"


def test_options_are_for_served_policies() -> None:
    with refused(where="--dialect", said="for a served policy"):
        with_options("expert", {"dialect": "openpi"})
    assert with_options("expert", {}) == "expert"
