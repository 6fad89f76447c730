"""The rules by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from echolume_messages.calibration import Calibration
from echolume_messages.errors import ConfigError
from echolume_messages.plan import MapField
from echolume_messages.types import Structured
from echolume_processing.hybrid.fuse import fuse
from echolume_processing.hybrid.model import HybridMap
from echolume_processing.hybrid.rules.forward import forward_model_gate
from echolume_processing.hybrid.rules.gates import constant_gate, footprint_gate
from echolume_processing.hybrid.rules.names import DESCRIPTIONS, SYNTHESIS
from echolume_processing.hybrid.rules.plain import inverse_variance, optical, ultrasonic, union
from echolume_processing.hybrid.rules.scan import Scan
from echolume_processing.hybrid.witnesses import Triggers
from echolume_processing.ping import Ping

Rule = Callable[[Scan], HybridMap]


def synthesis(scan: Scan) -> HybridMap:
    """Analysis by synthesis of the echoes; see `fuse`."""
    return fuse(scan.optical, scan.pings, scan.calibration, scan.field, scan.stripes)


RULES: Mapping[str, Rule] = {
    "optical": optical,
    "ultrasonic": ultrasonic,
    "union": union,
    "inverse-variance": inverse_variance,
    "constant-gate": constant_gate,
    "footprint-gate": footprint_gate,
    "forward-model-gate": forward_model_gate,
    SYNTHESIS: synthesis,
}


def named(name: str) -> Rule:
    """The rule of a name.

    Raises
    ------
    ConfigError
        There is none; the message lists those that there are.
    """
    if name not in RULES:
        known = "\n".join(f"  {each}: {text}" for each, text in DESCRIPTIONS.items())
        raise ConfigError(f"unknown fusion rule {name!r}; there are\n{known}")
    return RULES[name]


def fuse_by(
    name: str,
    optical: Structured,
    ultrasonic: Structured,
    pings: Sequence[Ping],
    calibration: Calibration,
    field: MapField,
    stripes: Triggers | None = None,
    soundings: Triggers | None = None,
) -> HybridMap:
    """Make the map of a scan by a rule.

    Parameters
    ----------
    name
        One of `RULES`.
    optical
        ``OPTICAL_POINT`` (n,).
    ultrasonic
        ``ULTRASONIC_POINT`` (m,).
    pings
        All pings, of one digitiser setting.
    calibration
        What the scan was made with.
    field
        Cells of the map.
    stripes, soundings
        Trigger of the stripe of each optical point (n,), and of the ping of each contact point (m,); without them the
        cells name none.

    Returns
    -------
    HybridMap
        The same bits for any order of the points and pings. A height names the senses that it rests on; cells without
        evidence have none.

    Raises
    ------
    ConfigError
        There is no such rule.
    """
    return named(name)(Scan(optical, ultrasonic, pings, calibration, field, stripes, soundings))
