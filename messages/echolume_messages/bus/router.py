"""A router in this process: what the router service and the tests open."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager

from echolume_messages.bus.session import open_router_session


@contextmanager
def open_router(endpoint: str, *, shared_memory: bool = False) -> Generator[None]:
    """Route between the clients of `endpoint`, e.g. ``tcp/127.0.0.1:7447``, until the block is left.

    Raises
    ------
    RouterUnreachableError
        The endpoint is in use or cannot be listened on.
    """
    session = open_router_session(endpoint, shared_memory)
    try:
        yield
    finally:
        session.close()
