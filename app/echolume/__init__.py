"""The front door: the ``echolume`` program, ``echolume.connect``, the demo and its scoring."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from echolume_messages.bus import Bus

__all__ = ["connect"]


def connect(endpoint: str = "tcp/127.0.0.1:7447", rig: str = "demo") -> Bus:
    """Join a rig's bus, e.g. from a notebook on a lab PC.

    Parameters
    ----------
    endpoint
        The router, e.g. ``"tcp/192.168.7.2:7447"``.
    rig
        The rig's name, as in its rig file.

    Raises
    ------
    RouterUnreachableError
        Nobody answers there.

    Examples
    --------
    ::

        from echolume_messages import topics
        with echolume.connect() as bus:
            points = bus.subscribe([topics.OPTICAL_POINTS])
            while message := points.get(timeout_s=60):
                print(message.header.trigger, message.payload["z_mm"].mean())
    """
    from echolume_messages.bus import connect as join

    return join(endpoint, rig)
