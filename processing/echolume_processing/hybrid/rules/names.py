"""What the rules are called; loads nothing, so that help can name them."""

from __future__ import annotations

from collections.abc import Mapping

SYNTHESIS = "synthesis"
DEFAULT = SYNTHESIS

DESCRIPTIONS: Mapping[str, str] = {
    "optical": "light alone: the height of a cell's optical points at its centre",
    "ultrasonic": "sound alone: the nearest contact point within 20 mm that stands over what it hears",
    "union": "the paper's hybrid image: the mean of all points in a cell, whichever sense they come from",
    "inverse-variance": "light and the nearest contact point, weighted by their stated variances",
    "constant-gate": "sound of 1 mm standard deviation against light: what it finds higher is transparent",
    "footprint-gate": "the same, with what light says of the beam's footprint as variance, and only whole regions "
    "(the safe choice with a wide band)",
    "forward-model-gate": "contact points of the measured echoes against those of the echoes that light predicts",
    SYNTHESIS: "echoes predicted from light, and explained by plates where they contradict it (the default)",
}
