"""The cameras service: owns the trigger unit and both cameras, and gives every frame the number of its trigger."""

from __future__ import annotations

import threading
import time
from collections import Counter
from typing import NamedTuple, Protocol

from echolume_daemon.body import Json, flag, number, text, whole
from echolume_daemon.device import Slot
from echolume_daemon.matching import Armed, FrameMatcher, Verdict
from echolume_daemon.service import Loop, Service, run_service
from echolume_messages.bus import Bus, Publisher
from echolume_messages.errors import DeviceAbsentError, DeviceError, DeviceSilentError
from echolume_messages.header import Source
from echolume_messages.rig import CameraSettings, Rig, TriggerSettings
from echolume_messages.topics import CAMERA_LEFT, CAMERA_RIGHT, Topic
from echolume_messages.types import Frame

MAX_OUTSTANDING = 4
"""Triggers that may be fired ahead of their frames."""
FRAME_TIMEOUT_S = 3.0
"""Beyond its exposure, a frame has this long to arrive before its trigger is missing."""
BEGIN_S = 15.0
"""Longest exposure and its frame, of the scan before."""
_READ_S = 0.2
_COMMAND_LIMIT_S = 30.0


class CameraFrame(Protocol):
    """A frame as a driver returns it."""

    @property
    def pixels(self) -> Frame: ...
    @property
    def frame_id(self) -> int: ...
    @property
    def device_t_ns(self) -> int | None: ...
    @property
    def exposure_s(self) -> float | None: ...


class Camera(Protocol):
    """A camera, as the service needs it."""

    def open(self) -> None: ...
    def close(self) -> None: ...
    def start(self) -> object: ...
    def read(self, timeout_s: float) -> CameraFrame | None: ...


class Trigger(Protocol):
    """The trigger unit, as the service needs it."""

    def open(self) -> None: ...
    def close(self) -> None: ...
    def arm_external(self, exposure_s: float) -> object: ...
    def fire(self, exposure_s: float) -> object: ...
    def disarm(self) -> object: ...
    def count(self) -> int: ...


class Devices(NamedTuple):
    """Devices that somebody else made (tests)."""

    trigger: Trigger
    left: Camera
    right: Camera


class _Eye:
    """One camera: its slot, its matcher, its publisher, its counts."""

    def __init__(self, topic: Topic, slot: Slot[Camera], publisher: Publisher) -> None:
        self.topic, self.slot, self.publisher = topic, slot, publisher
        self.matcher = FrameMatcher()
        self.missing: list[Armed] = []
        self.counts: Counter[tuple[str, str]] = Counter()


class CamerasService:
    """Commands of the cameras, and one reading thread for each."""

    def __init__(self, service: Service, devices: Devices | None = None) -> None:
        self._service, rig = service, service.rig
        self._scan = self._calibration = self._pass = ""
        self._external_s: float | None = None
        self._pulse = 0
        self._last: Armed | None = None
        self._changed = threading.Condition()
        self._trigger: Slot[Trigger] = Slot(
            "trigger",
            lambda: devices.trigger if devices else _trigger_driver(rig.trigger),
            self._prepare_trigger,
            lambda d: d.count(),
        )
        self._eyes = (
            self._eye(CAMERA_LEFT, rig.cameras.left, devices.left if devices else None),
            self._eye(CAMERA_RIGHT, rig.cameras.right, devices.right if devices else None),
        )
        for slot in (self._trigger, *(eye.slot for eye in self._eyes)):
            slot.watch(service)
        for eye in self._eyes:
            service.thread(eye.topic.stream, lambda _loop, eye=eye: self._read(eye), 10.0)
        service.thread("deadlines", self._deadlines, 5.0)
        service.serve({"begin": self._begin, "arm": self._arm}, _COMMAND_LIMIT_S)
        service.serve({"disarm": self._disarm, "status": self._status}, _COMMAND_LIMIT_S)

    def health(self) -> Json:
        """Device states, awaited frames and publishing queues."""
        slots = (self._trigger, *(eye.slot for eye in self._eyes))
        with self._changed:
            outstanding = {eye.topic.name: eye.matcher.outstanding for eye in self._eyes}
        return {
            "devices": {slot.name: slot.status() for slot in slots},
            "outstanding": outstanding,
            "queues": {eye.topic.name: eye.publisher.stats for eye in self._eyes},
        }

    def close(self) -> None:
        """Disarm the trigger unit, then let go of everything."""
        if self._trigger.present:
            try:
                with self._trigger.use() as unit:
                    unit.disarm()
            except DeviceError as error:
                self._service.log.error("disarming at the end failed: %s", error)
        self._trigger.close()
        for eye in self._eyes:
            eye.slot.close()

    def _eye(self, topic: Topic, settings: CameraSettings, device: Camera | None) -> _Eye:
        name = f"camera-{topic.stream}"

        def prepare(camera: Camera) -> None:
            with self._changed:
                eye.missing.extend(eye.matcher.abandon())
                self._changed.notify_all()
            camera.start()

        slot: Slot[Camera] = Slot(name, lambda: device or _camera_driver(settings, topic.stream), prepare)
        eye = _Eye(topic, slot, self._service.bus.publisher(topic))
        return eye

    def _prepare_trigger(self, unit: Trigger) -> None:
        """A unit that was opened anew may count from anywhere."""
        unit.disarm()
        count = unit.count()
        with self._changed:
            for eye in self._eyes:
                eye.missing.extend(eye.matcher.abandon())
            self._external_s, self._pulse, self._last = None, count, None

    # -- commands

    def _begin(self, body: Json) -> Json:
        """Another scan: what is still under way of the one before comes to its end first."""
        scan, calibration = text(body, "scan"), text(body, "calibration", "")
        self._disarm({})
        with self._changed:
            if not self._changed.wait_for(lambda: not any(e.matcher.outstanding for e in self._eyes), BEGIN_S):
                raise DeviceSilentError(f"cameras: frames of scan {self._scan} are still awaited after {BEGIN_S:.0f} s")
            self._scan, self._calibration, self._last = scan, calibration, None
            for eye in self._eyes:
                eye.matcher.revoked.clear()
                eye.missing.clear()
                eye.counts.clear()
        return {}

    def _arm(self, body: Json) -> Json:
        external, exposure_s = flag(body, "external"), number(body, "exposure_s")
        absent = [eye.slot for eye in self._eyes if not eye.slot.present]
        if absent:
            raise DeviceAbsentError("; ".join(str(slot.status()["error"]) for slot in absent))
        with self._trigger.use() as unit:
            self._reconcile(unit)
        self._await_room(exposure_s)
        with self._trigger.use() as unit:
            if external and self._external_s != exposure_s:
                unit.arm_external(exposure_s)
                self._external_s = exposure_s
            item = self._await_frames(body, exposure_s)
            if not external:
                self._external_s = None
                unit.fire(exposure_s)
        return {"pulse": item.pulse}

    def _await_room(self, exposure_s: float) -> None:
        """Wait until another trigger may be fired: few are awaited; none while the ids are not proven."""
        limit_s = exposure_s + FRAME_TIMEOUT_S + 2.0

        def room() -> bool:
            busy = max(eye.matcher.outstanding for eye in self._eyes)
            return busy == 0 or (busy < MAX_OUTSTANDING and all(eye.matcher.proven for eye in self._eyes))

        with self._changed:
            if not self._changed.wait_for(room, limit_s):
                raise DeviceSilentError(f"cameras: frames awaited for {limit_s:.1f} s did not come; is a camera stuck?")

    def _await_frames(self, body: Json, exposure_s: float) -> Armed:
        self._pulse += 1
        x_mm = None if body.get("x_mm") is None else number(body, "x_mm")
        item = Armed(
            scan=self._scan,
            pulse=self._pulse,
            trigger=whole(body, "trigger"),
            pass_name=text(body, "pass"),
            attempt=whole(body, "attempt"),
            exposure_s=exposure_s,
            laser_on=flag(body, "laser_on"),
            x_mm=x_mm,
            sigma_mm=None if x_mm is None else number(body, "sigma_mm"),
        )
        deadline_s = time.monotonic() + exposure_s + FRAME_TIMEOUT_S
        with self._changed:
            self._pass, self._last = item.pass_name, item
            for eye in self._eyes:
                eye.matcher.arm(item, deadline_s)
        return item

    def _reconcile(self, unit: Trigger) -> None:
        """The unit's own count has the last word: what it did not fire is missing, what nobody armed is in doubt."""
        count = unit.count()
        with self._changed:
            for eye in self._eyes:
                eye.missing.extend(eye.matcher.withdraw(count))
            if count > self._pulse:
                self._service.log.warning("trigger unit: %d pulses that nobody asked for", count - self._pulse)
                for eye in self._eyes:
                    eye.matcher.revoked.extend([self._last] if self._last is not None else [])
            self._pulse = count
            self._changed.notify_all()

    def _disarm(self, _body: Json) -> Json:
        """Take back what was armed and not fired."""
        with self._trigger.use() as unit:
            unit.disarm()
            self._external_s = None
            self._reconcile(unit)
        return {"count": self._pulse}

    def _status(self, _body: Json) -> Json:
        out = self.health()
        with self._changed:
            out["scan"] = self._scan
            out["missing"] = [[e.topic.name, m.trigger, m.attempt] for e in self._eyes for m in e.missing]
            out["revoked"] = [[e.topic.name, m.trigger, m.attempt] for e in self._eyes for m in e.matcher.revoked]
            counts = self._eyes[0].counts + self._eyes[1].counts
            out["counts"] = [[name, kind, n] for (name, kind), n in counts.items()]
        return out

    # -- loops

    def _read(self, eye: _Eye) -> None:
        """Read one frame, if one comes, and publish it under its trigger."""
        if not eye.slot.present:
            self._service.stop.wait(_READ_S)
            return
        try:
            with eye.slot.use() as camera:
                try:
                    frame = camera.read(_READ_S)
                except DeviceSilentError:
                    frame = None  # no frame in time is ordinary: nobody fired
        except DeviceError as error:
            self._service.log.warning("%s: %s", eye.slot.name, error)
            return
        if frame is not None:
            self._publish(eye, frame)

    def _publish(self, eye: _Eye, frame: CameraFrame) -> None:
        t_ns = time.monotonic_ns()
        with self._changed:
            verdict, item = eye.matcher.frame(frame.frame_id, t_ns * 1e-9)
            if item is None:
                eye.counts[self._pass, verdict.value] += 1
            elif item in eye.missing:
                eye.missing.remove(item)
            self._changed.notify_all()
        if item is not None and item.scan != self._scan:
            self._service.log.info("%s: a late frame of scan %s is left out", eye.slot.name, item.scan)
            return
        if item is None or verdict is not Verdict.MATCHED:
            self._service.log.warning("%s: frame id %d is %s", eye.slot.name, frame.frame_id, verdict)
            return
        source = Source(
            frame_id=frame.frame_id,
            device_t_ns=frame.device_t_ns,
            exposure_s=item.exposure_s if frame.exposure_s is None else frame.exposure_s,
            laser_on=item.laser_on,
            x_mm=item.x_mm,
            sigma_mm=item.sigma_mm,
            method=None if item.x_mm is None else "step",
        )
        eye.publisher.put(
            frame.pixels,
            scan=self._scan,
            pass_name=item.pass_name,
            trigger=item.trigger,
            attempt=item.attempt,
            calibration=self._calibration,
            source=source,
            t_ns=t_ns,
        )

    def _deadlines(self, _loop: Loop) -> None:
        """Name the triggers whose frames did not come in time."""
        self._service.stop.wait(0.05)
        with self._changed:
            for eye in self._eyes:
                late = eye.matcher.expire(time.monotonic())
                eye.missing.extend(late)
                for item in late:
                    self._service.log.warning(
                        "%s: no frame for trigger %d (attempt %d) of %s within %.1f s",
                        eye.slot.name,
                        item.trigger,
                        item.attempt,
                        item.pass_name,
                        item.exposure_s + FRAME_TIMEOUT_S,
                    )
            self._changed.notify_all()


def _trigger_driver(settings: TriggerSettings) -> Trigger:
    from echolume_drivers.trigger import TriggerUnit

    return TriggerUnit(settings)


def _camera_driver(settings: CameraSettings, name: str) -> Camera:
    from echolume_drivers.cameras import make_camera

    return make_camera(settings, name)


def main(
    bus: Bus | None = None,
    rig: Rig | None = None,
    device: Devices | None = None,
    stop: threading.Event | None = None,
) -> int:
    """Run the cameras service until it is told to stop; returns the exit code."""
    return run_service("cameras", lambda service: CamerasService(service, device), bus, rig, stop)
