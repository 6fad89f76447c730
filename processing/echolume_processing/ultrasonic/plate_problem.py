"""The least-squares problem of pings over the reference plate: what is unknown, how far the mounting is believed, and
what the paths, the levels and the direct sound say."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from echolume_messages.geometry import Matrix, Points3, robot_from_flange, rotation_from_vector, transform
from echolume_processing.ultrasonic.air import ZERO_CELSIUS_K, speed_of_sound_mps
from echolume_processing.ultrasonic.plate_model import Levels, near_field_mm, path_slopes, plate_levels, plate_paths

CHANNEL_SIGMA_MM = 0.02
"""What a channel's path scatters by itself."""
COMMON_SIGMA_MM = 0.05
"""What all paths of a ping share: the robot's repeatability and the air."""
MOUNTING_SIGMA_MM = 1.0
MOUNTING_SIGMA_RAD = float(np.radians(1.0))
"""How well the array and the robot are mounted by hand: the nominal values are believed this far."""
PLACEMENT_SIGMA_MM = (0.3, 0.3, 0.1)
"""How well the receivers sit in the array's body, per axis of the array frame."""
SPEED_SIGMA = 0.01
LEVEL_SIGMA = 0.015
"""Of the natural logarithm of a ping's amplitude, averaged over its channels: air, and scatter of the plate."""
RADIUS_SIGMA = 0.05
DIRECT_SIGMA_MM = 0.5
"""How far the direct sound, which leaves the piston sideways, is believed to come from its centre."""

NAMES = (
    "flange_from_array x",
    "flange_from_array y",
    "flange_from_array z",
    "flange_from_array rx",
    "flange_from_array ry",
    "flange_from_array yaw",
    "rig_from_robot z",
    "rig_from_robot rx",
    "rig_from_robot ry",
    "speed of sound",
)
POSE, SPEED, RADIUS, LATENESS, FIXED = 9, 9, 10, 11, 12
"""Number of the pose's unknowns, places of speed, radius and lateness, and where the receivers' unknowns begin."""
LATENESS_SIGMA = 5.0
"""A disk that is tilted by t sends its echo later than an upright one, by an unknown number of times sin^2 t of its
near field's lateness: far-field beams do not tell how many times."""
UPRIGHT = 0.01
"""Square of the sine of the tilt up to which a ping counts as upright."""
FAINT = 1e-9
"""1/mm; a trial step may point a beam's null at the plate."""
STEP = 1e-4
"""Of a prior's sigma, for differences."""


def placement_basis(emitter_mm: NDArray[np.float64], receivers_mm: Points3) -> NDArray[np.float64]:
    """Independent ways in which the receivers can be off, (3 receivers, ways), each as likely as its mounting sigma.

    Notes
    -----
    A turn that all receivers share about the emitter is the array's own turn on the flange, and a shift that they share
    against the emitter passes, to first order, for half that shift of the array. Both are left out: the array frame is
    the one in which the receivers have none.
    """
    arms = receivers_mm - emitter_mm
    sigma = np.tile(PLACEMENT_SIGMA_MM, len(arms))
    turns = np.cross(np.eye(3)[:, None, :], arms).reshape(3, -1)
    shared = np.concatenate([turns, np.tile(np.eye(3), len(arms))]) * sigma
    strength, ways = np.linalg.svd(shared)[1:]
    rank = int(np.count_nonzero(strength > 1e-9 * strength[0]))
    return np.asarray(sigma[:, None] * ways[rank:].T, dtype=np.float64)


@dataclass(frozen=True)
class PlateData:
    """What was measured over the plate."""

    poses: NDArray[np.float64]  # (pings, 6)
    times_s: NDArray[np.float64]  # (pings, receivers)
    temperatures_c: NDArray[np.float64]  # (pings,)
    direct_s: NDArray[np.float64]  # (receivers,), not a number where unknown
    levels: Levels | None


class PlateProblem:
    """Residuals and their slopes over one vector of unknowns: each in units of its prior sigma, then the delays in mm
    and the level."""

    def __init__(
        self, data: PlateData, emitter_mm: NDArray[np.float64], receivers_mm: Points3, nominal_flange_from_array: Matrix
    ) -> None:
        self.data, self._emitter_mm, self._nominal_mm = data, emitter_mm, receivers_mm
        self._nominal_flange = nominal_flange_from_array
        self.receivers = len(receivers_mm)
        self.basis = placement_basis(emitter_mm, receivers_mm)
        self.priors = FIXED + self.basis.shape[1]
        """Number of unknowns with a prior; they come first."""
        self.size = self.priors + self.receivers + 1
        self.temperature_c = float(np.mean(data.temperatures_c))
        self.nominal_mps = speed_of_sound_mps(self.temperature_c)
        self._warmth = np.sqrt((data.temperatures_c + ZERO_CELSIUS_K) / (self.temperature_c + ZERO_CELSIUS_K))[:, None]
        self._robot = np.array([robot_from_flange(p) for p in data.poses])
        self.known = np.isfinite(data.times_s)
        upright = (self._robot @ nominal_flange_from_array)[:, 2, 2]
        self._tilt_squared = (1 - upright**2)[:, None]
        self._times_s = np.nan_to_num(data.times_s)
        self.sigmas = np.array(
            [MOUNTING_SIGMA_MM] * 3
            + [MOUNTING_SIGMA_RAD] * 3
            + [MOUNTING_SIGMA_MM]
            + [MOUNTING_SIGMA_RAD] * 2
            + [SPEED_SIGMA * self.nominal_mps]
        )
        self._whiten = np.array([_whitening(k) for k in self.known])
        self._apart_mm = np.linalg.norm(receivers_mm - emitter_mm, axis=1)
        self._heard = np.isfinite(data.direct_s)
        levels = data.levels
        means = np.full(len(data.poses), np.nan) if levels is None else np.log(_row_means(levels.amplitudes))
        self.loud = np.isfinite(means)
        self._heights = means[self.loud]
        self._radius_mm = 0.0 if levels is None else levels.radius_mm
        self._reference_mm = float(np.median(self._paths(np.zeros(self.size))))

    def without(self, slipped: NDArray[np.bool_]) -> PlateProblem:
        """The same less some paths, (pings, receivers)."""
        kept = replace(self.data, times_s=np.where(slipped, np.nan, self.data.times_s))
        return PlateProblem(kept, self._emitter_mm, self._nominal_mm, self._nominal_flange)

    def start(self) -> NDArray[np.float64]:
        """Nominal mounting, and the delays and the level that suit it."""
        at = np.zeros(self.size)
        left = np.where(self.known, self.paths_left_mm(at), np.nan)
        at[self.priors : -1] = np.nanmedian(left, axis=0)
        at[-1] = float(np.median(self._level_left(at))) if self.loud.any() else 0.0
        return at

    def transforms(self, at: NDArray[np.float64]) -> tuple[Matrix, Matrix]:
        """``flange_from_array`` and ``rig_from_robot``."""
        offsets = at[:POSE] * self.sigmas[:POSE]
        flange = self._nominal_flange @ transform(rotation_from_vector(offsets[3:6]), offsets[:3])
        turn = rotation_from_vector(np.array([offsets[7], offsets[8], 0.0]))
        return flange, transform(turn, np.array([0.0, 0.0, float(offsets[6])]))

    def receivers_mm(self, at: NDArray[np.float64]) -> Points3:
        """Places of the receivers in the array frame."""
        return self._nominal_mm + (self.basis @ at[FIXED : self.priors]).reshape(-1, 3)

    def speed_mps(self, at: NDArray[np.float64]) -> float:
        """Speed of sound at the mean temperature."""
        return self.nominal_mps + float(at[SPEED] * self.sigmas[SPEED])

    def radius_mm(self, at: NDArray[np.float64]) -> float:
        """Effective radius of the transducers; 0 where the levels are unknown."""
        return self._radius_mm * (1 + RADIUS_SIGMA * float(at[RADIUS]))

    def rig_from_array(self, at: NDArray[np.float64]) -> NDArray[np.float64]:
        """Poses of the array, (pings, 4, 4)."""
        flange, rig = self.transforms(at)
        return rig @ self._robot @ flange

    def _paths(self, at: NDArray[np.float64]) -> NDArray[np.float64]:
        return plate_paths(self.rig_from_array(at), self._emitter_mm, self.receivers_mm(at))

    def paths_left_mm(self, at: NDArray[np.float64]) -> NDArray[np.float64]:
        """Measured minus modelled path, (pings, receivers); 0 where none was measured."""
        paths = self._paths(at)
        paths = paths + near_field_mm(
            paths, self.radius_mm(at), self._reference_mm, LATENESS_SIGMA * at[LATENESS] * self._tilt_squared
        )
        measured = self._times_s * (1e3 * self.speed_mps(at)) * self._warmth
        return np.where(self.known, measured - at[self.priors : -1] - paths, 0.0)

    def delay_by_place(self, at: NDArray[np.float64]) -> NDArray[np.float64]:
        """What a receiver's place adds to its path over the plate, mm per mm, mean of the most upright pings,
        (receivers, 3): as much goes to the channel's delay where the place stays nominal."""
        slopes = path_slopes(self.rig_from_array(at), self._emitter_mm, self.receivers_mm(at))
        tilt = self._tilt_squared.ravel()
        return slopes[tilt <= tilt.min() + UPRIGHT].mean(axis=0)

    def scatter(self, at: NDArray[np.float64]) -> float:
        """How many times worse than expected the paths scatter, at least 1."""
        left = self.paths_left_mm(at)[self.known]
        return max(1.0, float(np.sqrt(np.mean(left**2) / (CHANNEL_SIGMA_MM**2 + COMMON_SIGMA_MM**2))))

    def level_left(self, at: NDArray[np.float64]) -> NDArray[np.float64]:
        """Logarithm of measured over modelled amplitude, (loud pings,)."""
        return self._level_left(at) - at[-1]

    def _level_left(self, at: NDArray[np.float64]) -> NDArray[np.float64]:
        levels = self.data.levels
        if levels is None:
            return np.zeros(0)
        model = plate_levels(
            self.rig_from_array(at)[self.loud],
            self._emitter_mm,
            self._nominal_mm,
            2e-3 * np.pi * levels.frequency_hz / self.nominal_mps,
            levels.weights,
            self.radius_mm(at),
        )
        return self._heights - np.log(np.maximum(model.mean(axis=1), FAINT))

    def _common(self, at: NDArray[np.float64]) -> NDArray[np.float64]:
        """How far the direct sound comes too late, mean of the channels, in its sigma."""
        if not self._heard.any():
            return np.zeros(1)
        late = np.nan_to_num(self.data.direct_s) * self.speed_mps(at) * 1e3 - self._apart_mm - at[self.priors : -1]
        return np.array([float(np.mean(late[self._heard])) / DIRECT_SIGMA_MM])

    def residuals(self, at: NDArray[np.float64]) -> NDArray[np.float64]:
        """Paths, levels, direct sound and priors, each in its sigma."""
        return np.concatenate(
            [
                self.whitened(self.paths_left_mm(at)),
                self.level_left(at) / LEVEL_SIGMA,
                self._common(at),
                at[: self.priors],
            ]
        )

    def whitened(self, paths_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Rows of the paths (pings, receivers), in their sigma."""
        return np.einsum("prs,ps->pr", self._whiten, np.where(self.known, paths_mm, 0.0)).ravel()

    def shared(self, pattern: NDArray[np.float64]) -> NDArray[np.float64]:
        """Rows of the paths when each ping's paths all grow by a pattern (pings, shapes) in mm."""
        by_ping = np.einsum("prs,ps->pr", self._whiten, self.known.astype(np.float64))
        return (by_ping[:, :, None] * pattern[:, None, :]).reshape(self.known.size, -1)

    def jacobian(self, at: NDArray[np.float64]) -> NDArray[np.float64]:
        """Slopes of `residuals` (rows, unknowns): differences for the poses, closed form for receivers and delays."""
        rows = self.known.size
        out = np.zeros((rows + len(self._heights) + 1 + self.priors, self.size))
        for k in range(FIXED):
            ahead, behind = at.copy(), at.copy()
            ahead[k] += STEP
            behind[k] -= STEP
            out[:, k] = (self.residuals(ahead) - self.residuals(behind)) / (2 * STEP)
        slopes = path_slopes(self.rig_from_array(at), self._emitter_mm, self.receivers_mm(at))
        slopes *= self.known[:, :, None]
        ways = self.basis.reshape(self.receivers, 3, -1)
        moved = np.einsum("pri,rik->prk", slopes, ways)
        out[:rows, FIXED : self.priors] = -np.einsum("prs,psk->prk", self._whiten, moved).reshape(rows, -1)
        out[:rows, self.priors : -1] = -(self._whiten * self.known[:, None, :]).reshape(rows, self.receivers)
        out[rows : rows + len(self._heights), -1] = -1 / LEVEL_SIGMA
        if self._heard.any():
            out[rows + len(self._heights), self.priors : -1] = self._heard / (-DIRECT_SIGMA_MM * self._heard.sum())
        at_prior = np.arange(FIXED, self.priors)
        out[at_prior - self.priors, at_prior] = 1.0
        return out


def _whitening(known: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Makes the known paths of a ping independent with sigma 1, (receivers, receivers)."""
    n = int(known.sum())
    values, vectors = np.linalg.eigh(CHANNEL_SIGMA_MM**2 * np.eye(n) + COMMON_SIGMA_MM**2 * np.ones((n, n)))
    out = np.zeros((len(known), len(known)))
    out[np.ix_(known, known)] = (vectors / np.sqrt(values)) @ vectors.T
    return out


def _row_means(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mean of the finite values of each row, not a number where there are none, (rows,)."""
    finite = np.isfinite(values)
    count = finite.sum(axis=1)
    return np.where(count > 0, np.where(finite, values, 0.0).sum(axis=1) / np.maximum(count, 1), np.nan)
