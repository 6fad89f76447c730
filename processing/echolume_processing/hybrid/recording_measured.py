"""What was measured at each trigger, as entities of the recording: cameras, stripes, laser plane, array, echoes."""

from __future__ import annotations

from bisect import bisect_right

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from echolume_messages import geometry
from echolume_messages.calibration import CameraCalibration, LaserCalibration
from echolume_messages.types import EchoKind, OpticalSource, Structured
from echolume_processing.evidence import Evidence
from echolume_processing.optical.camera import Camera
from echolume_processing.ping import Ping
from echolume_processing.ultrasonic.pipeline import (
    MAX_PATH_MM,
    UltrasonicPipeline,
    speed_of_sound_mps,
    waveforms_from_counts,
)

SETS = {
    OpticalSource.STEREO: ("rig/map/st", (235, 200, 120)),
    OpticalSource.ACTIVE_LEFT: ("rig/map/at_left", (120, 200, 140)),
    OpticalSource.ACTIVE_RIGHT: ("rig/map/at_right", (200, 140, 190)),
}
SIDES = {"left": OpticalSource.ACTIVE_LEFT, "right": OpticalSource.ACTIVE_RIGHT}
KIND_RGB = {int(EchoKind.PLANE): (90, 160, 235), int(EchoKind.POINT): (240, 150, 70)}
USED_RGB, IDLE_RGB, EMITTER_RGB = (120, 230, 255), (70, 80, 95), (240, 110, 90)
LASER_RGBA = (255, 60, 60, 70)
PLANE_MM = (130.0, 90.0)
"""Half width along the line, and height, of the drawn piece of the laser plane."""
IMAGE_PLANE_MM = 300.0
NORMAL_MM = 8.0


def log(recording: rr.RecordingStream, evidence: Evidence) -> None:
    """Log all evidence of a scan and what belongs to its review."""
    clock = _Clock(recording, evidence)
    recording.log("tf/rig", rr.Transform3D(parent_frame="tf#/", child_frame="rig"), static=True)
    for side, camera in (("left", evidence.calibration.left), ("right", evidence.calibration.right)):
        _log_camera(recording, side, camera)
        _log_pictures(recording, clock, evidence, side, Camera.of(camera))
    _log_stripes(recording, clock, evidence)
    _log_array(recording, clock, evidence)
    _log_contacts(recording, clock, evidence)
    _log_echoes(recording, clock, evidence)
    for line in evidence.review.lines:
        clock.at_time(line.t_ns)
        recording.log("log", rr.TextLog(line.text, level=line.level))
    recording.reset_time()


class _Clock:
    """Sets a recording's three timelines; those that are not known are left out."""

    def __init__(self, recording: rr.RecordingStream, evidence: Evidence) -> None:
        self._recording = recording
        self._offset_ns = evidence.review.utc_offset_ns
        self._moments = evidence.review.moments
        self._steps = sorted((moment.t_ns, trigger) for trigger, moment in self._moments.items())

    def at(self, trigger: int, t_ns: int | None = None) -> None:
        """What follows belongs to a trigger, captured at `t_ns` if that is not when its points were."""
        moment = self._moments.get(trigger)
        self._set(trigger, moment.t_ns if t_ns is None and moment else t_ns)

    def at_time(self, t_ns: int) -> None:
        """What follows belongs to no trigger; its step is the last one before."""
        before = bisect_right(self._steps, t_ns, key=lambda step: step[0])
        self._set(self._steps[before - 1][1] if before else 0, t_ns)

    def _set(self, step: int, t_ns: int | None) -> None:
        self._recording.reset_time()
        self._recording.set_time("scan_step", sequence=step)
        if t_ns is not None:
            self._recording.set_time("rig_time", duration=np.timedelta64(t_ns, "ns"))
            if self._offset_ns is not None:
                self._recording.set_time("utc", timestamp=np.datetime64(t_ns + self._offset_ns, "ns"))


def _xyz(points: Structured) -> NDArray[np.float32]:
    """Positions (n, 3) of points."""
    return np.column_stack((points["x_mm"], points["y_mm"], points["z_mm"]))


def _log_camera(recording: rr.RecordingStream, side: str, camera: CameraCalibration) -> None:
    """A camera where the calibration found it; its images are in its own frame."""
    body, image = f"cam_{side}", f"cam_{side}_img"
    rig_from_camera = geometry.invert(camera.pose)
    recording.log(f"tf/{body}", _moved(rig_from_camera, body), static=True)
    recording.log(
        f"rig/{body}",
        rr.CoordinateFrame(image),
        rr.Pinhole(
            image_from_camera=camera.matrix,
            resolution=[camera.width_px, camera.height_px],
            parent_frame=body,
            child_frame=image,
            image_plane_distance=IMAGE_PLANE_MM,
        ),
        static=True,
    )
    for part in ("image", "stripe"):
        recording.log(f"rig/{body}/{part}", rr.CoordinateFrame(image), static=True)


def _moved(rig_from_body: NDArray[np.float64], body: str) -> rr.Transform3D:
    return rr.Transform3D(
        translation=rig_from_body[:3, 3], mat3x3=rig_from_body[:3, :3], parent_frame="rig", child_frame=body
    )


def _log_pictures(recording: rr.RecordingStream, clock: _Clock, evidence: Evidence, side: str, camera: Camera) -> None:
    """Raw frames of one camera, and on them the peaks that its active points were made of."""
    for trigger in sorted(t for s, t in evidence.review.pictures if s == side):
        picture = evidence.review.pictures[side, trigger]
        clock.at(trigger, picture.t_ns)
        recording.log(f"rig/cam_{side}/image", rr.EncodedImage(contents=picture.jpeg, media_type="image/jpeg"))
        if trigger in evidence.optical:
            points = evidence.optical[trigger][1]
            own = points[points["source"] == SIDES[side]]
            peaks_px = camera.project(_xyz(own).astype(np.float64))
            colour = SETS[SIDES[side]][1]
            recording.log(f"rig/cam_{side}/stripe", rr.Points2D(peaks_px, colors=[colour], radii=[1.0]))


def _log_stripes(recording: rr.RecordingStream, clock: _Clock, evidence: Evidence) -> None:
    """The three optical point sets and the laser's plane, one step a stripe."""
    for trigger in sorted(evidence.optical):
        points = evidence.optical[trigger][1]
        clock.at(trigger)
        for source, (entity, colour) in SETS.items():
            own = points[points["source"] == source]
            recording.log(
                entity,
                rr.Points3D(_xyz(own), colors=[colour], radii=[0.25]),
                rr.AnyValues(sigma_z_mm=own["sigma_z_mm"], row_px=own["row"]),
            )
        moment = evidence.review.moments.get(trigger)
        if moment is not None and moment.guide_x_mm is not None:
            corners_mm = laser_corners_mm(evidence.calibration.laser, moment.guide_x_mm)
            recording.log(
                "rig/laser_plane",
                rr.Mesh3D(
                    vertex_positions=corners_mm, triangle_indices=[[0, 1, 2], [0, 2, 3]], albedo_factor=LASER_RGBA
                ),
            )


def laser_corners_mm(laser: LaserCalibration, guide_x_mm: float) -> NDArray[np.float64]:
    """Corners (4, 3) in the rig frame of a piece of the laser's plane n.X = offset + s (n.g) at one guide position."""
    normal, along = np.array(laser.normal), np.array(laser.guide_direction)
    foot_mm = laser.offset_mm * normal + guide_x_mm * along
    across = np.array([0.0, 1.0, 0.0]) - normal[1] * normal
    across /= np.linalg.norm(across)
    up = np.cross(normal, across)
    up *= np.sign(up[2]) or 1.0
    half_mm, high_mm = PLANE_MM
    return np.array([foot_mm + y * half_mm * across + z * high_mm * up for y, z in ((-1, 0), (1, 0), (1, 1), (-1, 1))])


def _log_array(recording: rr.RecordingStream, clock: _Clock, evidence: Evidence) -> None:
    """The array where the robot held it at each ping; the receivers that contact points rest on are bright."""
    array, pipeline = evidence.calibration.array, UltrasonicPipeline(evidence.calibration)
    for first, trigger in enumerate(sorted(evidence.pings)):
        clock.at(trigger)
        if trigger - 1 in evidence.optical:  # the laser is out while the array listens
            recording.log("rig/laser_plane", rr.Clear(recursive=False))
        pose = pipeline.rig_from_array(evidence.pings[trigger][1].robot_pose)
        recording.log("tf/us_array", _moved(pose, "us_array"))
        if first == 0:  # not static: before the first ping the array has no place
            frame, radii = rr.CoordinateFrame("us_array"), [0.8 * array.radius_mm]
            recording.log("rig/us_array/receivers", frame, rr.Points3D(array.receivers_mm, radii=radii))
            emitter = rr.Points3D([array.emitter_mm], radii=radii, colors=[EMITTER_RGB])
            recording.log("rig/us_array/emitter", frame, emitter)
        colours = np.full((len(array.receivers_mm), 3), IDLE_RGB, dtype=np.uint8)
        if trigger in evidence.ultrasonic:
            used = evidence.ultrasonic[trigger][1]["receiver"]
            colours[used[used < len(colours)]] = USED_RGB
        recording.log("rig/us_array/receivers", rr.Points3D.from_fields(colors=colours))


def _log_contacts(recording: rr.RecordingStream, clock: _Clock, evidence: Evidence) -> None:
    """Contact points with their normals, coloured by the kind of echo, one step a ping."""
    for trigger in sorted(evidence.ultrasonic):
        points = evidence.ultrasonic[trigger][1]
        normals = np.column_stack((points["nx"], points["ny"], points["nz"]))
        colours = [KIND_RGB.get(int(kind), IDLE_RGB) for kind in points["kind"]]
        clock.at(trigger)
        recording.log(
            "rig/map/us",
            rr.Points3D(_xyz(points), colors=colours, radii=[0.8]),
            rr.AnyValues(
                sigma_mm=points["sigma_mm"],
                path_mm=points["path_mm"],
                energy=points["energy"],
                lobes=points["lobes"],
                receiver=points["receiver"],
            ),
        )
        recording.log(
            "rig/map/us_normals", rr.Arrows3D(vectors=NORMAL_MM * normals, origins=_xyz(points), colors=colours)
        )


def _log_echoes(recording: rr.RecordingStream, clock: _Clock, evidence: Evidence) -> None:
    """Raw echoes and their level; where contact points were looked for, the compressed echoes and their paths."""
    pipeline = UltrasonicPipeline(evidence.calibration)
    channels = len(evidence.calibration.array.receivers_mm)
    names = [f"receiver {k}" for k in range(channels)]
    for entity in ("us/level", "us/path"):
        recording.log(entity, rr.SeriesPoints(names=names, marker_sizes=[1.5] * channels), static=True)
    for trigger in sorted(evidence.pings):
        ping = evidence.pings[trigger][1]
        clock.at(trigger)
        recording.log("us/echoes", rr.Tensor(ping.echoes, dim_names=("receiver", "sample")))
        recording.log("us/level", rr.Scalars(ping.echoes.astype(np.float64).std(axis=1)))
        if trigger in evidence.ultrasonic:
            points = evidence.ultrasonic[trigger][1]
            points = points[points["receiver"] < channels]
            paths_mm = np.full(channels, np.nan)
            paths_mm[points["receiver"]] = points["path_mm"]
            recording.log("us/path", rr.Scalars(paths_mm))
            strength, path_mm = envelope(pipeline, ping)
            recording.log("us/envelope", rr.BarChart(strength, abscissa=path_mm))


def envelope(pipeline: UltrasonicPipeline, ping: Ping) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Compressed echoes (n,), mean of all receivers, 1 at the reference plate, and the path (n,) of each in mm."""
    compressed = pipeline.compress(waveforms_from_counts(ping.echoes), ping.sample_rate_hz)
    step = compressed.shape[1] // ping.echoes.shape[1]
    strength = np.abs(compressed).mean(axis=0)
    strength = strength[: len(strength) // step * step].reshape(-1, step).max(axis=1)
    speed = 1e3 * speed_of_sound_mps(pipeline.calibration, ping.air_temperature_c)
    time_s = np.arange(len(strength)) / ping.sample_rate_hz + ping.start_s - np.mean(pipeline.calibration.delays_s)
    path_mm = time_s * speed
    heard = (path_mm > 0) & (path_mm < MAX_PATH_MM)
    return strength[heard].astype(np.float32), path_mm[heard].astype(np.float32)
