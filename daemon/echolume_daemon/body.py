"""Read the fields of a command's body; what is missing or of the wrong kind is named."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TypeAlias, cast

from echolume_messages.errors import ConfigError
from echolume_messages.plan import Pose6

Body: TypeAlias = Mapping[str, object]
Json: TypeAlias = dict[str, object]
"""A command's body, its answer, and every other JSON object on the bus."""


def number(body: Body, key: str) -> float:
    """A finite number."""
    value = body.get(key)
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ConfigError(f"$.{key}: expected a finite number, got {value!r}")
    return float(value)


def whole(body: Body, key: str) -> int:
    """An integer."""
    value = body.get(key)
    if isinstance(value, bool) or not isinstance(value, int):
        raise ConfigError(f"$.{key}: expected an integer, got {value!r}")
    return value


def text(body: Body, key: str, default: str | None = None) -> str:
    """A string; `default` where the key is absent or null."""
    value = body.get(key)
    if value is None and default is not None:
        return default
    if not isinstance(value, str):
        raise ConfigError(f"$.{key}: expected a string, got {value!r}")
    return value


def flag(body: Body, key: str) -> bool:
    """True or false."""
    value = body.get(key)
    if not isinstance(value, bool):
        raise ConfigError(f"$.{key}: expected true or false, got {value!r}")
    return value


def pose6(body: Body, key: str) -> Pose6:
    """Six finite numbers: x, y, z in mm, rx, ry, rz in rad."""
    value = body.get(key)
    if not isinstance(value, list) or len(cast("list[object]", value)) != 6:
        raise ConfigError(f"$.{key}: expected six numbers, got {value!r}")
    fields = {f"{key}[{i}]": v for i, v in enumerate(cast("list[object]", value))}
    x, y, z, rx, ry, rz = (number(fields, k) for k in fields)
    return x, y, z, rx, ry, rz
