"""The bus over a real router on a free loopback port."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from echolume_messages import topics
from echolume_messages.bus import Bus, Subscription, connect
from echolume_messages.bus.router import open_router
from echolume_messages.clock import VirtualClock
from echolume_messages.codec import decode_header
from echolume_messages.errors import (
    CommandRefusedError,
    DeviceSilentError,
    NoReplyError,
    PayloadError,
    RouterUnreachableError,
)
from echolume_messages.header import Source
from loopback import free_endpoint

DEADLINE_S = 10.0


@pytest.fixture(scope="module")
def endpoint() -> Iterator[str]:
    at = free_endpoint()
    with open_router(at):
        yield at


@pytest.fixture
def rig(request: pytest.FixtureRequest) -> str:
    """A rig name of its own for each test, so that tests share the router and nothing else."""
    return request.node.name.translate(str.maketrans("[]-. ", "_____"))


def echoes(k: int) -> np.ndarray:
    return np.full((8, 16), k, dtype="<i2")


def collect(sub: Subscription, n: int) -> list[int]:
    out: list[int] = []
    deadline = time.monotonic() + DEADLINE_S
    while len(out) < n and time.monotonic() < deadline:
        message = sub.get(timeout_s=0.5)
        if message is not None:
            out.append(message.header.seq)
    return out


def until(condition: Callable[[], bool], what: str) -> None:
    deadline = time.monotonic() + DEADLINE_S
    tick = threading.Event()
    while not condition():
        assert time.monotonic() < deadline, f"not within {DEADLINE_S} s: {what}"
        tick.wait(0.005)


def drop_puts(bus: Bus, lost: set[int]) -> None:
    """Let the network lose the records with these seq numbers."""
    outbox = bus._outbox
    send = outbox._send

    def lossy(key: str, payload: bytes, header: bytes | None, encoding: str) -> None:
        if header is not None and decode_header(header).seq in lost:
            return
        send(key, payload, header, encoding)

    outbox._send = lossy  # type: ignore[method-assign]


def test_a_record_arrives_with_its_header_and_payload(endpoint: str, rig: str) -> None:
    with connect(endpoint, rig) as a, connect(endpoint, rig) as b, b.subscribe([topics.ECHOES]) as sub:
        source = Source(frame_id=7, robot_pose=(1.0, 2.0, 3.0, 0.1, 0.2, 0.3))
        block = np.arange(8 * 16, dtype="<i2").reshape(8, 16)
        a.publisher(topics.ECHOES).put(block, scan="s", pass_name="p", trigger=17, attempt=1, source=source, t_ns=5)
        message = sub.get(DEADLINE_S)
        assert message is not None
        assert (message.header.scan, message.header.pass_name, message.header.trigger) == ("s", "p", 17)
        assert (message.header.attempt, message.header.t_ns, message.header.boot) == (1, 5, a.boot)
        assert message.header.source == source
        np.testing.assert_array_equal(message.payload, block)
        assert message.payload.dtype == np.dtype("<i2")


def test_a_camera_frame_crosses_the_router(endpoint: str, rig: str) -> None:
    frame = np.random.default_rng(0).integers(0, 255, (1024, 1280), dtype="u1")
    with connect(endpoint, rig) as a, connect(endpoint, rig) as b, b.subscribe([topics.CAMERA_LEFT]) as sub:
        a.publisher(topics.CAMERA_LEFT).put(frame, trigger=0)
        message = sub.get(DEADLINE_S)
        assert message is not None
        np.testing.assert_array_equal(message.payload, frame)


def test_json_topics_carry_objects(endpoint: str, rig: str) -> None:
    with connect(endpoint, rig) as a, connect(endpoint, rig) as b, b.subscribe([topics.RUN_STATE]) as sub:
        a.publisher(topics.RUN_STATE).put_json({"state": "idle", "planned": 3})
        message = sub.get(DEADLINE_S)
        assert message is not None
        assert message.json() == {"state": "idle", "planned": 3}


def test_what_the_table_does_not_allow_is_not_published(endpoint: str, rig: str) -> None:
    with connect(endpoint, rig) as a:
        with pytest.raises(PayloadError, match="array/echoes: expected shape"):
            a.publisher(topics.ECHOES).put(np.zeros((7, 16), dtype="<i2"))
        with pytest.raises(PayloadError, match="expected dtype int16"):
            a.publisher(topics.ECHOES).put(np.zeros((8, 16), dtype="<f4"))


def test_records_lost_by_the_network_are_refilled_in_order(endpoint: str, rig: str) -> None:
    with connect(endpoint, rig) as a, connect(endpoint, rig) as b, b.subscribe([topics.ECHOES], depth=64) as sub:
        drop_puts(a, {0, 3, 4, 5, 11})
        pub = a.publisher(topics.ECHOES)
        for k in range(20):
            pub.put(echoes(k), trigger=k)
        assert collect(sub, 20) == list(range(20))
        assert sub.stats["refilled"] >= 5
        assert sub.stats["lost"] == 0


def test_a_lost_last_record_is_noticed_by_the_beat(endpoint: str, rig: str) -> None:
    with connect(endpoint, rig) as a, connect(endpoint, rig) as b, b.subscribe([topics.LEDGER]) as sub:
        drop_puts(a, {1})
        pub = a.publisher(topics.LEDGER)
        pub.put_json({"k": 0})
        pub.put_json({"k": 1})
        assert collect(sub, 2) == [0, 1]


def test_a_late_subscriber_gets_what_the_journal_holds(endpoint: str, rig: str) -> None:
    with connect(endpoint, rig) as a, connect(endpoint, rig) as b:
        for k in range(10):
            a.publisher(topics.SCAN_START).put_json({"k": k})
        until(lambda: a.publisher(topics.SCAN_START).stats["queued"] == 0, "the queue is sent")
        with b.subscribe([topics.SCAN_START]) as sub:
            assert collect(sub, 10) == list(range(10))


def test_a_subscriber_without_refill_gets_the_newest(endpoint: str, rig: str) -> None:
    with (
        connect(endpoint, rig) as a,
        connect(endpoint, rig) as b,
        b.subscribe([topics.ECHOES], depth=2, refill=False) as sub,
    ):
        pub = a.publisher(topics.ECHOES)
        for k in range(50):
            pub.put(echoes(k), trigger=k)
            until(lambda k=k: _sees(sub, k), f"record {k} seen or overwritten")
        assert collect(sub, 2)[-1] == 49
        assert sub.stats["dropped"] > 0


def test_who_only_looks_on_gets_every_fourth_frame(endpoint: str, rig: str) -> None:
    with (
        connect(endpoint, rig) as a,
        connect(endpoint, rig) as b,
        b.subscribe([topics.CAMERA_LEFT, topics.LEDGER], depth=16, decimated=True) as sub,
    ):
        for k in range(18):
            a.publisher(topics.CAMERA_LEFT).put(np.zeros((4, 6), dtype="u1"), trigger=k)
        a.publisher(topics.LEDGER).put_json({})
        until(lambda: sub.stats["received"] == 6, "five frames and a ledger")
        found = [message for _ in range(6) if (message := sub.get(0.0)) is not None]
    assert sorted(m.header.trigger for m in found if m.topic == topics.CAMERA_LEFT) == [0, 4, 8, 12, 16]
    assert sum(m.topic == topics.LEDGER for m in found) == 1


def _sees(sub: Subscription, k: int) -> bool:
    return any(m.header.seq == k for m in list(sub._queue))


def test_a_reader_that_sleeps_loses_nothing_that_the_journal_holds(endpoint: str, rig: str) -> None:
    with connect(endpoint, rig) as a, connect(endpoint, rig) as b, b.subscribe([topics.ECHOES], depth=4) as sub:
        pub = a.publisher(topics.ECHOES)
        for k in range(60):
            pub.put(echoes(k), trigger=k)
        until(lambda: sub.stats["dropped"] > 0, "the queue overflows")
        assert collect(sub, 60) == list(range(60))
        assert sub.stats["lost"] == 0


def test_what_no_journal_holds_any_more_is_counted_lost(endpoint: str, rig: str) -> None:
    frame = np.zeros((1024, 1280), dtype="u1")
    with (
        connect(endpoint, rig, journal_mib=4) as a,
        connect(endpoint, rig) as b,
        b.subscribe([topics.CAMERA_LEFT], depth=32, archive=False) as sub,
    ):
        pub = a.publisher(topics.CAMERA_LEFT)
        pub.put(frame, trigger=0)
        assert collect(sub, 1) == [0]
        drop_puts(a, {1, 2})
        for k in range(1, 9):
            pub.put(frame, trigger=k)
            if k >= 3:
                until(lambda k=k: _high(sub) >= k, f"frame {k} arrives")
        assert collect(sub, 6)[-1] == 8
        assert sub.stats["lost"] in (0, 2)


def _high(sub: Subscription) -> int:
    return max((t.high for t in sub._tracks.values()), default=-1)


def test_put_never_waits_for_a_reader_that_does_not_read(endpoint: str, rig: str) -> None:
    frame = np.zeros((1024, 1280), dtype="u1")
    with (
        connect(endpoint, rig, journal_mib=32) as a,
        connect(endpoint, rig) as b,
        b.subscribe([topics.CAMERA_LEFT], depth=2),
    ):
        pub = a.publisher(topics.CAMERA_LEFT)
        longest_s = 0.0
        for k in range(60):
            start = time.perf_counter()
            pub.put(frame, trigger=k)
            longest_s = max(longest_s, time.perf_counter() - start)
        assert longest_s < 0.25
        assert pub.stats["journal_bytes"] <= 32 << 20


def test_a_restarted_publisher_is_told_from_the_one_before(endpoint: str, rig: str) -> None:
    with connect(endpoint, rig) as b, b.subscribe([topics.RUN_STATE]) as sub:
        boots = []
        for _ in range(2):
            with connect(endpoint, rig) as a:
                a.publisher(topics.RUN_STATE).put_json({"boot": a.boot})
                message = sub.get(DEADLINE_S)
                assert message is not None
                assert message.header.seq == 0
                boots.append(message.header.boot)
        assert len(set(boots)) == 2


def test_a_payload_that_lies_is_counted_and_goes_no_further(endpoint: str, rig: str) -> None:
    with connect(endpoint, rig) as a, connect(endpoint, rig) as b, b.subscribe([topics.ECHOES]) as sub:
        a._session.put(topics.key(rig, "data", topics.ECHOES, 0), b"\x93NUMPY\x01\x00nonsense", attachment=b"{}")
        until(lambda: sub.stats["rejected"] == 1, "the record is rejected")
        a.publisher(topics.ECHOES).put(echoes(0), trigger=0)
        assert collect(sub, 1) == [0]
        assert sub.last_error


def test_a_command_is_answered(endpoint: str, rig: str) -> None:
    with connect(endpoint, rig) as a, connect(endpoint, rig) as b:
        a.serve("guide", {"move": lambda body: {"x_mm": body["x_mm"]}})
        assert b.request("guide", "move", {"x_mm": 12.5}) == {"x_mm": 12.5}


def test_no_reply_is_a_failure(endpoint: str, rig: str) -> None:
    with connect(endpoint, rig) as b, pytest.raises(NoReplyError, match=r"guide\.move: nobody answered"):
        b.request("guide", "move", timeout_s=1.0)


def test_a_service_that_hangs_is_a_failure_within_the_timeout(endpoint: str, rig: str) -> None:
    let_go = threading.Event()
    with connect(endpoint, rig) as a, connect(endpoint, rig) as b:
        a.serve("guide", {"move": lambda _: {"hung": let_go.wait(DEADLINE_S)}})
        with pytest.raises(NoReplyError, match=r"within 0\.2 s"):
            b.request("guide", "move", timeout_s=0.2)
        let_go.set()


def test_a_refusal_is_carried_through(endpoint: str, rig: str) -> None:
    def silent(_: dict[str, object]) -> dict[str, object]:
        raise DeviceSilentError("guide on /dev/x: no answer to `?` within 1 s; is it powered?")

    def broken(_: dict[str, object]) -> dict[str, object]:
        raise ZeroDivisionError("by zero")

    with connect(endpoint, rig) as a, connect(endpoint, rig) as b:
        a.serve("guide", {"home": silent, "move": broken})
        with pytest.raises(DeviceSilentError, match="is it powered"):
            b.request("guide", "home")
        with pytest.raises(CommandRefusedError, match="internal error: by zero") as caught:
            b.request("guide", "move")
        assert caught.value.error_name == "ZeroDivisionError"


def test_a_command_that_nobody_waits_for_is_not_executed(endpoint: str, rig: str) -> None:
    let_go, done = threading.Event(), []
    with connect(endpoint, rig) as a, connect(endpoint, rig) as b:
        a.serve("guide", {"hold": lambda _: {"": let_go.wait(DEADLINE_S)}, "fire": lambda _: {"n": done.append(1)}})
        with pytest.raises(NoReplyError):
            b.request("guide", "hold", timeout_s=0.2)
        with pytest.raises(NoReplyError):
            b.request("guide", "fire", timeout_s=0.2)
        let_go.set()
        b.request("guide", "hold", timeout_s=DEADLINE_S)
        assert done == []


def test_an_urgent_command_passes_one_that_blocks(endpoint: str, rig: str) -> None:
    let_go = threading.Event()
    with connect(endpoint, rig) as a, connect(endpoint, rig) as b:
        a.serve("guide", {"move": lambda _: {"moved": let_go.wait(DEADLINE_S)}})
        a.serve("guide", {"stop": lambda _: {"stopped": let_go.set() is None}})
        moving: list[dict[str, object]] = []
        mover = threading.Thread(target=lambda: moving.append(b.request("guide", "move", timeout_s=DEADLINE_S)))
        mover.start()
        assert b.request("guide", "stop") == {"stopped": True}
        mover.join(DEADLINE_S)
        assert moving == [{"moved": True}]


def test_alive_tokens_come_and_go_with_their_session(endpoint: str, rig: str) -> None:
    seen: list[tuple[str, bool]] = []
    with connect(endpoint, rig) as b:
        b.watch_alive(lambda service, alive: seen.append((service, alive)))
        with connect(endpoint, rig) as a:
            a.declare_alive("guide")
            until(lambda: ("guide", True) in seen, "the token is seen")
            assert b.alive() == {"guide"}
        until(lambda: ("guide", False) in seen, "the token goes")
        assert b.alive() == set()


def test_the_loss_of_the_router_is_seen_and_survived() -> None:
    at = free_endpoint()
    seen: list[tuple[str, bool]] = []
    with open_router(at):
        a, b = connect(at, "r"), connect(at, "r")
        a.declare_alive("guide")
        b.watch_alive(lambda service, alive: seen.append((service, alive)))
        until(lambda: ("guide", True) in seen, "the token is seen")
        sub = b.subscribe([topics.RUN_STATE])
    with a, b:
        until(lambda: ("guide", False) in seen, "the router's end is seen")
        assert not b.connected
        a.publisher(topics.RUN_STATE).put_json({"while": "away"})
        with open_router(at):
            assert collect(sub, 1) == [0]
            assert sub.stats["lost"] == 0


def test_no_router_is_named_with_what_to_do() -> None:
    at = free_endpoint()
    with pytest.raises(RouterUnreachableError, match=r"no router at .* serve router"):
        connect(at, "r", timeout_s=0.3)


def test_a_port_in_use_is_named(endpoint: str) -> None:
    with pytest.raises(RouterUnreachableError, match="port in use"), open_router(endpoint):
        pass


def test_close_sends_what_is_queued(endpoint: str, rig: str) -> None:
    with connect(endpoint, rig) as b, b.subscribe([topics.ECHOES], depth=256) as sub:
        with connect(endpoint, rig) as a:
            pub = a.publisher(topics.ECHOES)
            for k in range(100):
                pub.put(echoes(k), trigger=k)
        assert len(collect(sub, 100)) == 100


_PUBLISH_AND_LEAVE = """
import sys, numpy as np
from echolume_messages import topics
from echolume_messages.bus import connect
bus = connect(sys.argv[1], sys.argv[2])
bus.serve("guide", {"move": lambda body: body})
bus.watch_alive(lambda service, alive: None)
bus.subscribe([topics.ECHOES, topics.RUN_STATE])
bus.publisher(topics.LEDGER).put_json({"last": "words"})
if sys.argv[3] == "close":
    bus.close()
"""


@pytest.mark.parametrize("how", ["close", "forget"])
def test_a_process_ends_promptly_and_its_last_words_arrive(endpoint: str, rig: str, how: str) -> None:
    with connect(endpoint, rig) as b, b.subscribe([topics.LEDGER]) as sub:
        start_s = time.monotonic()
        subprocess.run([sys.executable, "-c", _PUBLISH_AND_LEAVE, endpoint, rig, how], check=True, timeout=DEADLINE_S)
        assert time.monotonic() - start_s < 5.0
        message = sub.get(DEADLINE_S)
        assert message is not None
        assert message.json() == {"last": "words"}


_SUBSCRIBE_AND_HANG = """
import sys, time
from echolume_messages import topics
from echolume_messages.bus import connect
with connect(sys.argv[1], sys.argv[2]) as bus, bus.subscribe([topics.CAMERA_LEFT], depth=8) as sub:
    sub.get(10.0)
    print("hangs", flush=True)
    sub.get(60.0)
"""


def test_a_process_that_is_stopped_stalls_nobody(endpoint: str, rig: str) -> None:
    frame = np.zeros((1024, 1280), dtype="u1")
    pace = threading.Event()
    with (
        subprocess.Popen([sys.executable, "-c", _SUBSCRIBE_AND_HANG, endpoint, rig], stdout=subprocess.PIPE) as hung,
        connect(endpoint, rig) as a,
        connect(endpoint, rig) as b,
        b.subscribe([topics.CAMERA_LEFT], depth=32) as sub,
    ):
        assert hung.stdout is not None
        pub = a.publisher(topics.CAMERA_LEFT)
        pub.put(frame, trigger=0)
        assert hung.stdout.readline() == b"hangs\n"
        hung.send_signal(signal.SIGSTOP)
        longest_s, found = 0.0, collect(sub, 1)
        for k in range(1, 61):
            start_s = time.perf_counter()
            pub.put(frame, trigger=k)
            longest_s = max(longest_s, time.perf_counter() - start_s)
            pace.wait(0.03)
            found += collect(sub, 1)
        found += collect(sub, 61 - len(found))
        hung.kill()
        assert found == list(range(61))
        assert sub.stats["lost"] == 0
        assert longest_s < 0.25


def test_a_wall_clock_that_jumps_changes_its_own_stamp_and_nothing_else(endpoint: str, rig: str) -> None:
    clock = VirtualClock()
    with connect(endpoint, rig) as lab, connect(endpoint, rig, clock=clock) as device:
        sub = lab.subscribe([topics.ECHOES])
        pub = device.publisher(topics.ECHOES)
        for k in range(6):
            if k == 3:
                clock.jump_wall(-3600.0)
            clock.advance(0.1)
            pub.put(echoes(k), trigger=k)
        found = [message.header for _ in range(6) if (message := sub.get(DEADLINE_S)) is not None]
    assert [h.trigger for h in found] == list(range(6))
    assert np.diff([h.t_ns for h in found]).tolist() == [10**8] * 5
    assert np.diff([h.t_wall_ns for h in found]).tolist() == [10**8] * 2 + [10**8 - 3600 * 10**9] + [10**8] * 2
