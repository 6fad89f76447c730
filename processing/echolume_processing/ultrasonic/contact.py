"""Contact points from one emitter and N receivers, ping by ping: plane and point models, tested against each other.

All lengths are in mm, in a frame with the emitter at its origin and z towards the scene. A path is emitter -> surface
-> receiver. The arithmetic is that of `contacts`, for one ping.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from echolume_messages.geometry import Points3, require_shape
from echolume_messages.types import EchoKind
from echolume_processing.ultrasonic.contacts import MAX_CHI_SQUARED, MAX_TILT_RAD, Contacts, contacts, full


@dataclass(frozen=True)
class Plane:
    """A plane as the image of the emitter in it: foot of the perpendicular = image / 2."""

    image_mm: NDArray[np.float64]
    paths_mm: NDArray[np.float64]
    """What the model predicts for each receiver, (receivers,)."""

    @property
    def distance_mm(self) -> float:
        """Distance from the emitter."""
        return 0.5 * float(np.linalg.norm(self.image_mm))

    @property
    def normal(self) -> NDArray[np.float64]:
        """Unit normal towards the array, (3,)."""
        return -self.image_mm / np.linalg.norm(self.image_mm)


@dataclass(frozen=True)
class Contact:
    """What one ping says: model, contact point of each used receiver, and how well they agree."""

    kind: EchoKind
    points_mm: Points3
    normals: Points3
    used: NDArray[np.bool_]
    """Receivers that the contact rests on, (receivers,)."""
    chi_squared: float
    """Per degree of freedom."""
    batch: Contacts
    """The whole result, of one ping."""

    @property
    def point_covariances(self) -> NDArray[np.float64]:
        """Covariance of each contact point in mm^2, (receivers, 3, 3)."""
        return full(self.batch.point_covariance[0])

    @property
    def normal_covariance(self) -> NDArray[np.float64]:
        """Covariance of the normal, (3, 3), singular along it."""
        return full(self.batch.normal_covariance[0])

    @property
    def foot_mm(self) -> NDArray[np.float64]:
        """Foot of the perpendicular from the emitter on a plane, or the point, (3,)."""
        return self.batch.foot_mm[0]

    @property
    def foot_covariance(self) -> NDArray[np.float64]:
        """In mm^2, (3, 3)."""
        return full(self.batch.foot_covariance[0])


def fit_plane(receivers_mm: Points3, paths_mm: NDArray[np.float64], used: NDArray[np.bool_]) -> Plane | None:
    """Plane from path lengths in closed form; None where no plane has such paths.

    L_i^2 - |r_i|^2 = -2 r_i . E' + |E'|^2 is linear in E'x, E'y and |E'|^2, E' being the emitter's mirror image.
    Receivers on a line, as in R-E-R, leave the tilt about that line open: it is taken as none.
    """
    foot = _foot(receivers_mm[used], paths_mm[used], "plane")
    return None if foot is None else Plane(2 * foot, np.linalg.norm(receivers_mm - 2 * foot, axis=1))


def fit_point(
    receivers_mm: Points3, paths_mm: NDArray[np.float64], used: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Point target (3,) from path lengths in closed form, and the paths (receivers,) it predicts.

    2 r_i . P - 2 L_i R = |r_i|^2 - L_i^2 is linear in Px, Py and R = |P|.
    """
    point = _foot(receivers_mm[used], paths_mm[used], "point")
    if point is None:
        return None
    return point, np.linalg.norm(point) + np.linalg.norm(receivers_mm - point, axis=1)


def _foot(
    receivers_mm: Points3, paths_mm: NDArray[np.float64], model: Literal["plane", "point"]
) -> NDArray[np.float64] | None:
    found = contacts(
        receivers_mm,
        paths_mm[None],
        np.ones(len(receivers_mm)),
        max_chi_squared=np.inf,
        max_tilt_rad=0.5 * np.pi,
        model=model,
        untested=True,
    )
    return None if found.kind[0] == EchoKind.NONE else found.foot_mm[0].copy()


def plane_contacts(plane: Plane, receivers_mm: Points3) -> Points3:
    """Where the sound of each receiver met the plane: on the line image -> receiver, (receivers, 3)."""
    along = plane.distance_mm / (2 * plane.distance_mm + receivers_mm @ plane.normal)
    return plane.image_mm + along[:, None] * (receivers_mm - plane.image_mm)


def contact(
    receivers_mm: Points3,
    paths_mm: NDArray[np.float64],
    sigma_mm: NDArray[np.float64],
    *,
    common_sigma_mm: float = 0.0,
    max_chi_squared: float = MAX_CHI_SQUARED,
    max_tilt_rad: float = MAX_TILT_RAD,
) -> Contact:
    """Choose the model that explains a ping's path lengths, and give each receiver its contact point.

    Parameters
    ----------
    receivers_mm : (receivers, 3) float64
        Relative to the emitter.
    paths_mm : (receivers,) float64
        Not a number where a channel has no echo.
    sigma_mm : (receivers,) float64
    common_sigma_mm : float
        Of an error that all paths share; it enters the covariances only.
    max_chi_squared : float
        Per degree of freedom; a model above it is not believed.
    max_tilt_rad : float
        A target further than this off the array's axis cannot return an echo.

    Returns
    -------
    Contact
        `kind` NONE where neither model holds: then each receiver stands for itself, perpendicular to the axis.

    Notes
    -----
    See `contacts.contacts`.
    """
    require_shape("paths_mm", paths_mm, (len(receivers_mm),))
    require_shape("sigma_mm", sigma_mm, (len(receivers_mm),))
    found = contacts(
        receivers_mm,
        paths_mm[None],
        sigma_mm,
        common_sigma_mm=common_sigma_mm,
        max_chi_squared=max_chi_squared,
        max_tilt_rad=max_tilt_rad,
    )
    kind = EchoKind(int(found.kind[0]))
    scores = (np.inf, float(found.plane_chi_squared[0]), float(found.point_chi_squared[0]))
    normals = np.empty(receivers_mm.shape)
    normals[:] = found.normals[0]
    return Contact(kind, found.points_mm[0], normals, found.used[0], scores[kind], found)
