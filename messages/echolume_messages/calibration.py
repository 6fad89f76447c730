"""The calibration file: what the rig found out about itself, as JSON with a digest."""

from __future__ import annotations

import hashlib
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from echolume_messages.errors import CalibrationError, CalibrationMissingError
from echolume_messages.files import replace_bytes

Vector3 = tuple[float, float, float]
Rows = list[list[float]]


class CameraCalibration(msgspec.Struct, forbid_unknown_fields=True, kw_only=True):
    """A pinhole camera with distortion (k1, k2, p1, p2, k3)."""

    width_px: int
    height_px: int
    camera_matrix: Rows
    distortion: list[float]
    camera_from_rig: Rows
    rms_px: float

    @property
    def matrix(self) -> NDArray[np.float64]:
        """Intrinsic matrix (3, 3)."""
        return np.array(self.camera_matrix, dtype=np.float64)

    @property
    def pose(self) -> NDArray[np.float64]:
        """``camera_from_rig`` (4, 4)."""
        return np.array(self.camera_from_rig, dtype=np.float64)


class LaserCalibration(msgspec.Struct, forbid_unknown_fields=True, kw_only=True):
    """The moving laser plane: n.X = offset_mm + s (n.g), with s the guide's x_mm and g its direction."""

    normal: Vector3
    offset_mm: float
    guide_direction: Vector3
    rms_mm: float
    plane_covariance: Rows | msgspec.UnsetType = msgspec.UNSET
    """(4, 4) C in mm^2: at guide position s, y and z the plane's distance along its normal has the variance
    q C q with q = (1, s, y, z). Absent where nobody has estimated it."""

    def sigma_mm(self, x_mm: float, y_mm: float, z_mm: float) -> float | None:
        """Standard deviation of the plane's position there, along its normal; None where it is not known."""
        if isinstance(self.plane_covariance, msgspec.UnsetType):
            return None
        q = np.array([1.0, x_mm, y_mm, z_mm])
        return float(np.sqrt(q @ np.array(self.plane_covariance, dtype=np.float64) @ q))


class ArrayCalibration(msgspec.Struct, forbid_unknown_fields=True, kw_only=True):
    """The ultrasonic array: delays, gains, templates per channel, and where it sits."""

    emitter_mm: Vector3
    receivers_mm: list[Vector3]
    radius_mm: float
    low_hz: float
    high_hz: float
    delays_s: list[float]
    """Added by each channel to the acoustic time of flight."""
    gains: list[float]
    """Peak of each channel's envelope over a perpendicular plate at `reference_mm`, in counts."""
    templates: Rows
    """Band-limited echo of a perpendicular plate per channel, at `sample_rate_hz`; see `template_origin`."""
    template_origin: float
    """Sample index in the template that belongs to the acoustic arrival time plus the channel's delay."""
    sample_rate_hz: float
    reference_mm: float
    speed_of_sound_mps: float
    temperature_c: float
    flange_from_array: Rows
    rig_from_robot: Rows
    path_rms_mm: float
    receivers_sigma_mm: list[Vector3] | msgspec.UnsetType = msgspec.UNSET
    """Standard deviation of each receiver's place among the others. This and what follows is absent where nobody has
    estimated it."""
    delay_covariance_s2: Rows | msgspec.UnsetType = msgspec.UNSET
    """(receivers, receivers)."""
    gains_sigma: list[float] | msgspec.UnsetType = msgspec.UNSET
    radius_sigma_mm: float | msgspec.UnsetType = msgspec.UNSET
    speed_sigma_mps: float | msgspec.UnsetType = msgspec.UNSET
    footprint_mm: float | msgspec.UnsetType = msgspec.UNSET
    """Radius of the first Fresnel zone at `reference_mm` and `footprint_hz`, as an edge's echo shows it; it goes with
    the root of the distance."""
    footprint_sigma_mm: float | msgspec.UnsetType = msgspec.UNSET
    footprint_hz: float | msgspec.UnsetType = msgspec.UNSET
    pose_covariance: Rows | msgspec.UnsetType = msgspec.UNSET
    """(12, 12), mm and rad: x, y, z, rx, ry, yaw of `flange_from_array` in the array frame, then of `rig_from_robot` in
    the rig frame."""

    @property
    def array_pose(self) -> NDArray[np.float64]:
        """``flange_from_array`` (4, 4)."""
        return np.array(self.flange_from_array, dtype=np.float64)

    @property
    def robot_pose(self) -> NDArray[np.float64]:
        """``rig_from_robot`` (4, 4)."""
        return np.array(self.rig_from_robot, dtype=np.float64)


class Calibration(msgspec.Struct, forbid_unknown_fields=True, kw_only=True):
    """Everything a scan needs to turn raw data into millimetres."""

    rig: str
    version: int = 1
    left: CameraCalibration
    right: CameraCalibration
    stereo_rms_px: float
    laser: LaserCalibration
    array: ArrayCalibration

    @property
    def digest(self) -> str:
        """SHA-256 of the canonical JSON text, first 16 hex digits."""
        # Through the decoder once: a 0 in a list of floats is 0.0 after loading, and must be so before saving.
        canonical = msgspec.json.decode(msgspec.json.encode(self), type=Calibration)
        return hashlib.sha256(msgspec.json.encode(canonical)).hexdigest()[:16]


def parse(data: bytes, where: str, rig: str | None = None) -> Calibration:
    """Read a calibration from JSON, and refuse one of another rig."""
    try:
        found = msgspec.json.decode(data, type=Calibration)
    except msgspec.DecodeError as error:
        raise CalibrationMissingError(f"{where}: not a calibration: {error}; run `echolume calibrate`") from error
    if rig is not None and found.rig != rig:
        raise CalibrationMissingError(
            f"{where}: is of rig {found.rig!r}, this is {rig!r}; run `echolume calibrate` on this rig"
        )
    return found


def load(path: Path, rig: str | None = None) -> Calibration:
    """Read a calibration file."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise CalibrationMissingError(f"{path}: {error.strerror}; run `echolume calibrate`") from error
    return parse(data, str(path), rig)


def save(calibration: Calibration, path: Path) -> None:
    """Write a calibration file, readable by people.

    Raises
    ------
    CalibrationError
        The disk does not take it; a calibration that was there is unchanged.
    """
    try:
        replace_bytes(path, msgspec.json.format(msgspec.json.encode(calibration), indent=1))
    except OSError as error:
        raise CalibrationError(f"{path}: cannot write the calibration: {error.strerror}") from error
