"""Remote policies: ``--policy ws://host:port`` of every command. See `evaluation.resolve.OpenedPolicy`."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import re
from typing import Any, cast

from mjhab.evaluation.resolve import (
    OpenedPolicy,
    PolicyFacts,
    PolicyOptions,
    no_style,
)
from mjhab.evaluation.served.metadata import (
    check_rate,
    env_options_of,
    own_part,
    space_of,
)
from mjhab.evaluation.served.real_time import Pace
from mjhab.rollout.loop import plain
from mjhab.rollout.policy import Policy, RolloutEnv
from mjhab.serving import require_serving
from mjhab.serving.address import Address, without_password


class ServerAddress(OpenedPolicy):
    """The policy of a server."""

    @property
    def facts(self) -> PolicyFacts:
        """Connect to the server and describe its policy from the metadata it sends.

        Raises:
            UsageError: there is no server, it requires a token, it uses another protocol, or its actions are for
                another rate of control.
        """
        require_serving()
        from mjhab.serving.client import Connection

        address = Address.parse(self.spec)
        connection = Connection(address)
        try:
            metadata = connection.greet()
        finally:
            # The description is asked for before the environment exists, and a run has connections of its own.
            connection.close()
        check_rate(address, metadata)
        own = own_part(metadata)
        pace = Pace.of(address)
        metadata_json = _as_json(metadata)
        digest = hashlib.sha256(
            json.dumps(metadata_json, sort_keys=True).encode()
        ).hexdigest()
        identity = {
            "dialect": address.dialect,
            "execute": address.execute,
            "prompt": address.prompt,
            **({"real_time": dataclasses.asdict(pace)} if pace else {}),
            "actions": space_of(address, metadata),
            "server_metadata_sha256": digest,
            "server": _as_json(own.get("identity", {})),
        }
        name = str(own.get("policy") or metadata.get("model_name") or address.dialect)
        return PolicyFacts(
            # The name becomes part of folders, and comes from the server.
            f"served-{re.sub(r'[^A-Za-z0-9_.-]', '-', name)[:60]}",
            identity,
            env_options_of(address, metadata),
        )

    def check(self, options: PolicyOptions) -> None:
        """See `OpenedPolicy.check`."""
        if options.style:
            server = without_password(self.spec)
            raise no_style(server, options.style, "Give it to its server (mjhab serve).")
        super().check(options)

    def _build(self, env: RolloutEnv, options: PolicyOptions) -> Policy:
        """Connect to the server.

        Raises:
            UsageError: as `facts`; or the environment's actions do not match the policy's.
        """
        require_serving()
        from mjhab.evaluation.served.policy import ServedPolicy

        return ServedPolicy(
            Address.parse(self.spec), cast("Any", env), options.instruction
        )


def _as_json(value: Any) -> Any:
    """Convert a server's metadata to JSON data; types unknown to JSON, such as bytes, become text."""
    return json.loads(json.dumps(plain(value), default=repr))
