"""What a set of measurements leaves undetermined, in plain words."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from echolume_messages.geometry import require_shape

MISSING_POSES = "tilted by 5 to 12 degrees about both axes, at several heights and places"
ADVICE = {
    "flange_from_array x": "tilted about y by 10 to 18 degrees to both sides (ry)",
    "flange_from_array y": "tilted about x by 10 to 18 degrees to both sides (rx)",
    "flange_from_array rx": "tilted about x by 10 to 18 degrees to both sides (rx)",
    "flange_from_array ry": "tilted about y by 10 to 18 degrees to both sides (ry)",
    "flange_from_array yaw": "tilted about x and about y (rx, ry)",
    "rig_from_robot rx": "perpendicular, at places 100 mm and more apart along y",
    "rig_from_robot ry": "perpendicular, at places 100 mm and more apart along x",
    "speed of sound": "perpendicular, at heights from 70 to 250 mm",
}
IN_COMMON = 0.3
"""Share of a direction that a parameter must have to be named in it."""


def poses_to_add(undetermined: Sequence[str]) -> list[str]:
    """Poses over the plate that would determine these parameters, each said once."""
    return list(dict.fromkeys(ADVICE[name] for name in undetermined if name in ADVICE))


def loose_directions(
    information: NDArray[np.float64], names: Sequence[str], threshold: float = 1.0
) -> list[tuple[float, str]]:
    """Directions in which an information matrix falls short, weakest first.

    Parameters
    ----------
    information : (n, n) float64
        In units in which 1 is wanted of each parameter: scale rows and columns by the sigma that would be good enough.
    names : n words
    threshold : float
        Eigenvalues below this are undetermined.

    Returns
    -------
    List of (eigenvalue, words): one parameter by its name, or a mixture: ``a together with b`` where both may grow
    unseen, ``a against b`` where one may grow as the other shrinks.
    """
    n = len(names)
    require_shape("information", information, (n, n))
    values, vectors = np.linalg.eigh(information)
    return [(float(v), _words(vectors[:, k], names)) for k, v in enumerate(values.tolist()) if v < threshold]


def _words(direction: NDArray[np.float64], names: Sequence[str]) -> str:
    order = [int(k) for k in np.argsort(-np.abs(direction)) if abs(direction[k]) > IN_COMMON]
    first = order[0]
    same = [str(names[k]) for k in order[1:] if direction[k] * direction[first] > 0]
    other = [str(names[k]) for k in order[1:] if direction[k] * direction[first] < 0]
    words = " together with ".join([names[first], *same])
    return words + (f" against {' and '.join(other)}" if other else "")
