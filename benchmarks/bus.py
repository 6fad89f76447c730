"""The bus: payload codec beside NumPy's and memcpy, and a record's way over loopback beside bare zenoh and TCP."""

from __future__ import annotations

import io
import pickle
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
from comparison import Comparison

from echolume_messages import topics
from echolume_messages.bus import connect
from echolume_messages.bus.router import open_router
from echolume_messages.bus.session import open_client
from echolume_messages.codec import decode, encode
from echolume_messages.topics import Topic

RIG = "benchmark"
WAIT_S = 5.0


def payloads() -> dict[str, tuple[Topic, np.ndarray]]:
    """A record of each kind that there are many of."""
    rng = np.random.default_rng(0)
    return {
        "frame 1.3 MB": (topics.CAMERA_LEFT, rng.integers(0, 256, (1024, 1280), dtype=np.uint8)),
        "echoes 16 kB": (topics.ECHOES, rng.integers(-9000, 9000, (8, 1024), dtype=np.int16)),
        "points 54 kB": (topics.OPTICAL_POINTS, np.zeros(2700, dtype=topics.OPTICAL_POINTS.dtype)),
    }


def saved(array: np.ndarray) -> bytes:
    """NPY bytes by NumPy."""
    file = io.BytesIO()
    np.save(file, array)
    return file.getvalue()


def codec(compare: Comparison, name: str, topic: Topic, array: np.ndarray) -> None:
    """Array to bytes, and back."""
    data = encode(array)
    assert data == saved(array)
    pickled = pickle.dumps(array, protocol=5)
    raw = array.reshape(-1).view(np.uint8)
    target = np.empty_like(raw)
    compare.section(
        f"encode {name}",
        f"Array to bytes: {name}",
        {
            "memcpy": lambda: np.copyto(target, raw),
            "memcpy to new memory": array.tobytes,
            "echolume encode": lambda: encode(array),
            "np.save": lambda: saved(array),
            "pickle 5": lambda: pickle.dumps(array, protocol=5),
        },
    )
    compare.section(
        f"decode {name}",
        f"Bytes to array: {name}",
        {
            "np.frombuffer, unchecked": lambda: np.frombuffer(data, array.dtype, array.size, len(data) - array.nbytes),
            "echolume decode": lambda: decode(data, topic),
            "np.load": lambda: np.load(io.BytesIO(data)),
            "pickle 5": lambda: pickle.loads(pickled),
        },
    )


def free_endpoint() -> str:
    """A loopback endpoint that nobody uses."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


@contextmanager
def tcp_echo() -> Iterator[socket.socket]:
    """A socket whose other end sends back whatever comes, as a router passes it on: two ways over loopback."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        near = socket.create_connection(listener.getsockname())
        far, _ = listener.accept()
    for end in (near, far):
        end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def pass_on() -> None:
        while data := far.recv(1 << 20):
            far.sendall(data)

    thread = threading.Thread(target=pass_on)
    thread.start()
    try:
        yield near
    finally:
        near.shutdown(socket.SHUT_WR)
        thread.join(WAIT_S)
        near.close()
        far.close()


def over_loopback(compare: Comparison, endpoint: str) -> None:
    """From put to the array at a subscriber, through a router."""
    with (
        connect(endpoint, RIG) as sender,
        connect(endpoint, RIG) as receiver,
        open_client(endpoint, WAIT_S, False) as bare_sender,
        open_client(endpoint, WAIT_S, False) as bare_receiver,
        tcp_echo() as wire,
    ):
        bare = bare_receiver.declare_subscriber("bare")
        for name, (topic, array) in payloads().items():
            publisher, subscription = sender.publisher(topic), receiver.subscribe([topic])
            data = encode(array)

            def through_bus(publisher=publisher, subscription=subscription, array=array) -> None:
                publisher.put(array)
                assert subscription.get(WAIT_S) is not None

            def through_zenoh(data: bytes = data) -> None:
                bare_sender.put("bare", data)
                assert len(bytes(bare.recv().payload)) == len(data)

            def through_tcp(data: bytes = data) -> None:
                sending = threading.Thread(target=wire.sendall, args=(data,))
                sending.start()
                left = len(data)
                while left:
                    left -= len(wire.recv(min(left, 1 << 20)))
                sending.join()

            ways = {"TCP, there and back": through_tcp, "bare zenoh": through_zenoh, "echolume bus": through_bus}
            note = {"echolume bus": "headers, sequence, journal, checks"}
            compare.section(f"way {name}", f"One record over loopback: {name}", ways, note)
            subscription.close()


def orders(compare: Comparison, endpoint: str) -> None:
    """A command and its answer."""
    with connect(endpoint, RIG) as service, connect(endpoint, RIG) as client, tcp_echo() as wire:
        service.serve("guide", {"status": lambda _: {"state": "Idle", "x_mm": 1.0}})

        def through_tcp() -> None:
            wire.sendall(b'{"state": "Idle", "x_mm": 1.0}')
            wire.recv(64)

        ways = {"TCP, there and back": through_tcp, "echolume request": lambda: client.request("guide", "status")}
        compare.section("order", "A command and its answer over loopback", ways)


def main() -> None:
    """Run all sections; everything stays on 127.0.0.1."""
    compare = Comparison("Speed of the bus beside its peers.", seconds=1.5)
    for name, (topic, array) in payloads().items():
        codec(compare, name, topic, array)
    endpoint = free_endpoint()
    with open_router(endpoint):
        over_loopback(compare, endpoint)
        orders(compare, endpoint)
    compare.finish()


if __name__ == "__main__":
    main()
