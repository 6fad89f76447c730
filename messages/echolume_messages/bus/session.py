"""zenoh sessions: explicit endpoints, no scouting, bounded waits."""

from __future__ import annotations

import json

import zenoh

from echolume_messages.errors import RouterUnreachableError

MAX_MESSAGE_BYTES = 128 << 20


def _settings(shared_memory: bool) -> dict[str, object]:
    return {
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "timestamping": {"enabled": True},
        "adminspace": {"enabled": False},
        "transport": {
            "shared_memory": {"enabled": shared_memory},
            "link": {
                "tx": {"lease": 2000, "queue": {"congestion_control": {"block": {"wait_before_close": 100_000}}}},
                "rx": {"max_message_size": MAX_MESSAGE_BYTES},
            },
        },
    }


def open_client(endpoint: str, timeout_s: float, shared_memory: bool) -> zenoh.Session:
    """Session of a client of the router at `endpoint`; it reconnects by itself when the router comes back.

    Raises
    ------
    RouterUnreachableError
        No router answered within `timeout_s`, or it refused this client.
    """
    settings = _settings(shared_memory) | {
        "mode": "client",
        "connect": {"endpoints": [endpoint], "timeout_ms": round(timeout_s * 1e3), "exit_on_failure": True},
        "listen": {"endpoints": []},
    }
    try:
        return zenoh.open(zenoh.Config.from_json5(json.dumps(settings)))
    except zenoh.ZError as error:
        raise RouterUnreachableError(
            f"no router at {endpoint} within {timeout_s:g} s: is `echolume serve router` running, "
            f"and is the endpoint of the rig file the right one? ({error})"
        ) from error


def open_router_session(endpoint: str, shared_memory: bool) -> zenoh.Session:
    """Session that routes between the clients that connect to `endpoint`.

    Raises
    ------
    RouterUnreachableError
        The endpoint cannot be listened on, e.g. because its port is in use.
    """
    settings = _settings(shared_memory) | {
        "mode": "router",
        "connect": {"endpoints": []},
        "listen": {"endpoints": [endpoint], "exit_on_failure": True},
    }
    try:
        return zenoh.open(zenoh.Config.from_json5(json.dumps(settings)))
    except zenoh.ZError as error:
        raise RouterUnreachableError(
            f"the router cannot listen on {endpoint}: is another router running, or the port in use? ({error})"
        ) from error
