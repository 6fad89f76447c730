"""Each fault of the emulated camera becomes the right error, within its deadline; the wire is as documented."""

from __future__ import annotations

import socket
import threading
import time
import zlib
from collections.abc import Iterator

import numpy as np
import pytest

from echolume_drivers.cameras import Camera, open_camera
from echolume_drivers.cameras.wire import HEADER, LEADER, PACKET_BYTES, TRAILER, Kind, WireReader, pack
from echolume_drivers.emulated.camera_peer import FAULTS, CameraPeer
from echolume_drivers.emulated.optics import optical_truth
from echolume_drivers.emulated.scene import SCENES, plate
from echolume_drivers.emulated.stage import Stage
from echolume_messages.errors import DeviceAbsentError, DeviceSilentError, ProtocolError
from echolume_messages.rig import CameraSettings

READ_S = 0.3
TRUTH = optical_truth(1)


@pytest.fixture
def peer() -> Iterator[CameraPeer]:
    found = CameraPeer(Stage(1, plate(), laser_on=True), "left", TRUTH)
    found.start()
    yield found
    found.close()


@pytest.fixture
def camera(peer: CameraPeer) -> Iterator[Camera]:
    found = open_camera(CameraSettings(address=peer.address), "left")
    try:
        found.start()
        peer.fire(1e-3)
        assert found.read(100.0).frame_id == 1  # the renderers are compiled now
        yield found
    finally:
        found.close()


def test_a_dropped_frame_is_silence_and_then_a_gap_in_the_ids(peer: CameraPeer, camera: Camera) -> None:
    peer.inject("drop")
    peer.fire(1e-3)
    begin_s = time.monotonic()
    with pytest.raises(DeviceSilentError, match=r"no complete frame within 0.3 s"):
        camera.read(READ_S)
    assert time.monotonic() - begin_s < READ_S + 0.3
    peer.fire(1e-3)
    assert camera.read(5.0).frame_id == 3


def test_a_duplicate_repeats_its_id(peer: CameraPeer, camera: Camera) -> None:
    peer.inject("duplicate")
    peer.fire(1e-3)
    first, second = camera.read(5.0), camera.read(5.0)
    assert first.frame_id == second.frame_id == 2
    assert np.array_equal(first.pixels, second.pixels)


def test_a_late_frame_still_comes_with_its_own_id(peer: CameraPeer, camera: Camera) -> None:
    peer.inject("late", delay_s=0.3)
    peer.fire(1e-3)
    with pytest.raises(DeviceSilentError):
        camera.read(0.1)
    assert camera.read(5.0).frame_id == 2


def test_a_truncated_frame_is_a_broken_protocol_and_then_the_camera_is_gone(peer: CameraPeer, camera: Camera) -> None:
    peer.inject("truncate")
    peer.fire(1e-3)
    with pytest.raises(ProtocolError, match=r"hung up in the middle of a frame"):
        camera.read(5.0)
    with pytest.raises(DeviceAbsentError, match=r"open the camera again"):
        camera.read(READ_S)
    camera.close()
    camera.open()
    camera.start()
    peer.fire(1e-3)
    assert camera.read(5.0).frame_id == 1


def test_a_damaged_frame_fails_its_checksum_and_the_next_one_is_good(peer: CameraPeer, camera: Camera) -> None:
    peer.inject("corrupt")
    peer.fire(1e-3)
    with pytest.raises(ProtocolError, match=r"frame 2: checksum differs"):
        camera.read(5.0)
    peer.fire(1e-3)
    assert camera.read(5.0).frame_id == 3


def test_a_frame_of_the_wrong_size_says_what_was_expected_and_seen(peer: CameraPeer, camera: Camera) -> None:
    peer.inject("wrong_size")
    peer.fire(1e-3)
    with pytest.raises(ProtocolError, match=r"expected 1280 x 1024 px .*got 1280 x 512 px"):
        camera.read(5.0)


def test_a_hung_camera_is_silent_until_it_recovers(peer: CameraPeer, camera: Camera) -> None:
    peer.inject("hang")
    peer.fire(1e-3)
    with pytest.raises(DeviceSilentError):
        camera.read(READ_S)
    begin_s = time.monotonic()
    with pytest.raises(DeviceSilentError, match=r"AcquisitionStop"):
        camera.stop()
    assert time.monotonic() - begin_s < 2.5
    peer.inject("recover")
    camera.close()
    camera.open()


def test_an_absent_camera_refuses_and_comes_back_at_the_same_address(peer: CameraPeer, camera: Camera) -> None:
    address = peer.address
    peer.inject("absent")
    with pytest.raises(DeviceAbsentError):
        camera.read(5.0)
    camera.close()
    with pytest.raises(DeviceAbsentError, match=f"camera left .*{address}"):
        camera.open()
    peer.inject("recover")
    deadline_s = time.monotonic() + 5
    while True:
        try:
            camera.open()
            break
        except DeviceAbsentError:
            assert time.monotonic() < deadline_s
    assert peer.address == address


def test_a_second_host_is_refused_and_the_first_keeps_its_camera(peer: CameraPeer, camera: Camera) -> None:
    with pytest.raises(DeviceAbsentError, match=r"another host controls this camera"):
        open_camera(CameraSettings(address=peer.address), "left")
    peer.fire(1e-3)
    assert camera.read(5.0).frame_id == 2


def test_pulses_without_acquisition_are_counted_as_missed(peer: CameraPeer) -> None:
    peer.fire(1e-3)
    assert peer.missed == 1


def test_an_unknown_fault_is_refused_with_the_known_ones(peer: CameraPeer) -> None:
    with pytest.raises(ValueError, match=r", ".join(FAULTS)):
        peer.inject("explode")


def test_what_a_frame_shows_is_fixed_when_the_pulse_comes(peer: CameraPeer, camera: Camera) -> None:
    stage = peer.stage
    peer.fire(4e-3)
    stage.place(scene=SCENES["demo"]())
    stage.laser_on = False
    of_plate = camera.read(5.0).pixels
    peer.fire(4e-3)
    dark = camera.read(5.0).pixels
    assert (of_plate.max(axis=1) > 60).mean() > 0.9
    assert dark.std() < 4


def test_text_commands_follow_the_sfnc_names(peer: CameraPeer) -> None:
    transcript = [
        ("get Width", "ok 1280"),
        ("get PixelFormat", "ok Mono8"),
        ("set ExposureTime 2500", "ok"),
        ("get ExposureTime", "ok 2500"),
        ("set ExposureTime long", "error ExposureTime cannot be 'long'"),
        ("set Width 640", "error Width cannot be written"),
        ("get Colour", "error unknown feature Colour"),
        ("dance", "error unknown verb dance"),
        ("run AcquisitionStart", "ok"),
        ("run AcquisitionStop", "ok"),
    ]
    with socket.create_connection(("127.0.0.1", int(peer.address.rpartition(":")[2])), timeout=5) as port:
        reader = WireReader(port)
        for line, answer in transcript:
            port.sendall(line.encode() + b"\n")
            message = reader.next(time.monotonic() + 5)
            assert (message.kind, message.body.decode()) == (Kind.REPLY, answer)


def test_a_frame_is_leader_payloads_and_trailer_under_one_block_id(peer: CameraPeer) -> None:
    with socket.create_connection(("127.0.0.1", int(peer.address.rpartition(":")[2])), timeout=5) as port:
        reader = WireReader(port)
        for line in ("set TriggerMode On", "run AcquisitionStart"):
            port.sendall(line.encode() + b"\n")
            reader.next(time.monotonic() + 5)
        peer.fire(2e-3)
        parts = [reader.next(time.monotonic() + 20)]
        while parts[-1].kind is not Kind.TRAILER:
            parts.append(reader.next(time.monotonic() + 5))
    assert [p.kind for p in parts] == [Kind.LEADER, *[Kind.PAYLOAD] * 5, Kind.TRAILER]
    assert {p.block for p in parts} == {1}
    _, width, height, exposure_s, size = LEADER.unpack(parts[0].body)
    payload = b"".join(p.body for p in parts[1:-1])
    assert (width, height, exposure_s, size) == (1280, 1024, 2e-3, len(payload))
    assert TRAILER.unpack(parts[-1].body) == (len(payload), zlib.crc32(payload))


@pytest.mark.parametrize(
    ("answer", "complaint"),
    [
        (b"HTTP/1.1 400 Bad Request\r\n\r\n", "starts with b'HTTP'"),
        (HEADER.pack(b"ELCV", 3, 0, 1, PACKET_BYTES + 1), "promises"),
        (HEADER.pack(b"ELCV", 9, 0, 1, 0), "unknown kind 9"),
    ],
)
def test_bytes_that_are_not_the_wire_are_a_broken_protocol(answer: bytes, complaint: str) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:

        def serve() -> None:
            host, _ = server.accept()
            with host:
                host.recv(100)
                host.sendall(answer)
                host.recv(100)

        thread = threading.Thread(target=serve)
        thread.start()
        with pytest.raises(ProtocolError, match=complaint):
            open_camera(CameraSettings(address=f"127.0.0.1:{server.getsockname()[1]}"), "left")
        thread.join(5)
        assert not thread.is_alive()


def test_a_message_that_comes_in_pieces_is_put_together_after_a_timeout() -> None:
    near, far = socket.socketpair()
    with near, far:
        reader = WireReader(near)
        whole = pack(Kind.REPLY, 0, b"ok 42")
        far.sendall(whole[:22])
        with pytest.raises(TimeoutError):
            reader.next(time.monotonic() + 0.02)
        far.sendall(whole[22:])
        assert reader.next(time.monotonic() + 5).body == b"ok 42"


def test_nothing_is_left_after_close() -> None:
    before = set(threading.enumerate())
    peer = CameraPeer(Stage(1, plate()), "right", TRUTH)
    peer.start()
    port = int(peer.address.rpartition(":")[2])
    peer.inject("hang")
    peer.close()
    peer.close()
    assert set(threading.enumerate()) == before
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.1", port), timeout=1)
