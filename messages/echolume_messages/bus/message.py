"""A record as a subscriber or a reader of an archive gets it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from echolume_messages.codec import json_of
from echolume_messages.header import Header
from echolume_messages.topics import Topic


@dataclass(frozen=True, eq=False)
class Message:
    """Header, topic and payload of one record; the payload is read-only."""

    header: Header
    topic: Topic
    payload: NDArray[np.generic]

    def json(self) -> object:
        """Object of a JSON topic's payload."""
        return json_of(self.payload)
