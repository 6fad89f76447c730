"""zenoh sessions: explicit endpoints, no scouting, bounded waits."""

from __future__ import annotations

import json
import re

import zenoh

from echolume_messages.errors import RouterUnreachableError

MAX_MESSAGE_BYTES = 128 << 20


QUEUE_BATCHES = 16
"""Batches of 64 KiB that a link's queue of each data priority holds: most of a frame instead of a tenth."""
CLIENT_PATIENCE_US = 100_000
"""A client's puts come from a thread of their own, which may wait this long for its link before it drops a record."""


def _drop(client: bool) -> dict[str, int]:
    """When a full link drops a record. A router waits as shortly as zenoh's defaults do: others need it meanwhile."""
    if not client:
        return {"wait_before_drop": 1000, "max_wait_before_drop_fragments": 50_000}
    return {"wait_before_drop": CLIENT_PATIENCE_US, "max_wait_before_drop_fragments": 10 * CLIENT_PATIENCE_US}


def _settings(shared_memory: bool, client: bool) -> dict[str, object]:
    queue = {
        "size": {"data_high": QUEUE_BATCHES, "data": QUEUE_BATCHES, "data_low": QUEUE_BATCHES},
        "congestion_control": {"drop": _drop(client), "block": {"wait_before_close": 100_000}},
    }
    return {
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "timestamping": {"enabled": True},
        "adminspace": {"enabled": False},
        "transport": {
            "shared_memory": {"enabled": shared_memory},
            "link": {
                "tx": {"lease": 2000, "queue": queue},
                "rx": {"max_message_size": MAX_MESSAGE_BYTES},
            },
        },
    }


def _reason(error: zenoh.ZError) -> str:
    """What zenoh says, without the places in its source."""
    return re.sub(r" at /\S+\.rs:\d+\.?", "", str(error))


def open_client(endpoint: str, timeout_s: float, shared_memory: bool) -> zenoh.Session:
    """Session of a client of the router at `endpoint`; it reconnects by itself when the router comes back.

    Raises
    ------
    RouterUnreachableError
        No router answered within `timeout_s`, or it refused this client.
    """
    settings = _settings(shared_memory, client=True) | {
        "mode": "client",
        "connect": {"endpoints": [endpoint], "timeout_ms": round(timeout_s * 1e3), "exit_on_failure": True},
        "listen": {"endpoints": []},
    }
    try:
        return zenoh.open(zenoh.Config.from_json5(json.dumps(settings)))
    except zenoh.ZError as error:
        raise RouterUnreachableError(
            f"no router at {endpoint} within {timeout_s:g} s: is `echolume serve router` running, "
            f"and is the endpoint of the rig file the right one? ({_reason(error)})"
        ) from error


def open_router_session(endpoint: str, shared_memory: bool) -> zenoh.Session:
    """Session that routes between the clients that connect to `endpoint`.

    Raises
    ------
    RouterUnreachableError
        The endpoint cannot be listened on, e.g. because its port is in use.
    """
    settings = _settings(shared_memory, client=False) | {
        "mode": "router",
        "connect": {"endpoints": []},
        "listen": {"endpoints": [endpoint], "exit_on_failure": True},
    }
    try:
        return zenoh.open(zenoh.Config.from_json5(json.dumps(settings)))
    except zenoh.ZError as error:
        raise RouterUnreachableError(
            f"the router cannot listen on {endpoint}: is another router running, or the port in use? ({_reason(error)})"
        ) from error
