"""The archive's writer and reader, without a bus."""

from __future__ import annotations

import errno
import os
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader

from echolume_daemon.mcap_writer import ArchiveWriter
from echolume_messages import archive, topics
from echolume_messages.bus import Message
from echolume_messages.codec import json_array
from echolume_messages.errors import ArchiveError
from echolume_messages.header import Header, Source
from echolume_messages.topics import Topic

WALL_NS = 1_700_000_000_000_000_000


def record(topic: Topic, seq: int, array: np.ndarray, scan: str = "s1", boot: str = "b0") -> Message:
    header = Header(
        stream=topic.name,
        seq=seq,
        t_ns=1000 * seq,
        t_wall_ns=WALL_NS + seq,
        boot=boot,
        scan=scan,
        trigger=seq,
        source=Source(frame_id=seq),
    )
    return Message(header, topic, array)


def scan_records(n: int, height: int = 12, width: int = 16) -> list[Message]:
    rng = np.random.default_rng(1)
    out: list[Message] = []
    for k in range(n):
        for topic in (topics.CAMERA_LEFT, topics.CAMERA_RIGHT):
            out.append(record(topic, k, rng.integers(0, 255, (height, width), dtype="u1")))
        out.append(record(topics.ECHOES, k, rng.integers(-999, 999, (8, 32)).astype("<i2")))
        out.append(record(topics.RUN_STATE, k, json_array({"k": k})))
    return out


def same(a: Message, b: Message) -> bool:
    return a.header == b.header and a.payload.dtype == b.payload.dtype and np.array_equal(a.payload, b.payload)


def written(path: Path, records: list[Message], every: int = 3) -> None:
    writer = ArchiveWriter(path)
    for k, message in enumerate(records):
        writer.write(message)
        if k % every == every - 1:
            writer.sync()
    writer.close()


def test_what_is_written_is_read_back_in_order(tmp_path: Path) -> None:
    records = scan_records(5)
    written(tmp_path / "a.mcap", records)
    found = list(archive.read(tmp_path / "a.mcap"))
    assert len(found) == len(records)
    assert all(same(a, b) for a, b in zip(found, records, strict=True))
    assert archive.summary(tmp_path / "a.mcap") == archive.ArchiveSummary(
        {"cameras/left": 5, "cameras/right": 5, "array/echoes": 5, "conductor/state": 5},
        torn=False,
        bytes=(tmp_path / "a.mcap").stat().st_size,
    )


def test_topics_can_be_chosen(tmp_path: Path) -> None:
    written(tmp_path / "a.mcap", scan_records(3))
    found = list(archive.read(tmp_path / "a.mcap", {"array/echoes"}))
    assert [m.header.stream for m in found] == ["array/echoes"] * 3


def test_other_mcap_readers_read_it(tmp_path: Path) -> None:
    written(tmp_path / "a.mcap", scan_records(4))
    with (tmp_path / "a.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert summary.statistics.message_count == 4 * 6
        assert len(list(reader.iter_messages())) == 4 * 6
        assert len(list(reader.iter_messages(topics=["/cameras/left"]))) == 4
    with (tmp_path / "a.mcap").open("rb") as file:
        assert sum(type(r).__name__ == "Message" for r in StreamReader(file, validate_crcs=True).records) == 4 * 6


def test_the_image_is_what_foxglove_s_schema_says(tmp_path: Path) -> None:
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

    records = scan_records(1)
    written(tmp_path / "a.mcap", records)
    with (tmp_path / "a.mcap").open("rb") as file:
        ((schema, _, message),) = make_reader(file).iter_messages(topics=["/cameras/left"])
    assert (schema.name, schema.encoding) == ("foxglove.RawImage", "protobuf")
    pool = descriptor_pool.DescriptorPool()
    for proto in descriptor_pb2.FileDescriptorSet.FromString(schema.data).file:
        pool.Add(proto)
    image = message_factory.GetMessageClass(pool.FindMessageTypeByName("foxglove.RawImage")).FromString(message.data)
    assert (image.width, image.height, image.step, image.encoding) == (16, 12, 16, "mono8")
    assert image.timestamp.seconds * 10**9 + image.timestamp.nanos == WALL_NS
    assert image.data == records[0].payload.tobytes()


def test_an_archive_cut_anywhere_gives_a_prefix(tmp_path: Path) -> None:
    records = scan_records(3, height=4, width=5)
    written(tmp_path / "a.mcap", records, every=2)
    whole = (tmp_path / "a.mcap").read_bytes()
    cut = tmp_path / "cut.mcap"
    least = 0
    for size in sorted({*range(0, len(whole), 13), *range(len(whole) - 60, len(whole) + 1)}):
        cut.write_bytes(whole[:size])
        found = list(archive.read(cut))
        assert len(found) >= least
        least = len(found)
        assert all(same(a, b) for a, b in zip(found, records, strict=False))
        assert archive.summary(cut).torn == (size < len(whole))
    assert least == len(records)


def test_a_tail_of_zeros_or_noise_is_no_record(tmp_path: Path) -> None:
    records = scan_records(4)
    written(tmp_path / "a.mcap", records, every=4)
    whole = (tmp_path / "a.mcap").read_bytes()
    rng = np.random.default_rng(0)
    for size in range(200, len(whole), 397):
        for tail in (bytes(5000), rng.bytes(5000)):
            (tmp_path / "b.mcap").write_bytes(whole[:size] + tail)
            found = list(archive.read(tmp_path / "b.mcap"))
            assert all(same(a, b) for a, b in zip(found, records, strict=False))


def test_what_is_no_archive_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_bytes(b"PK\x03\x04 something else")
    with pytest.raises(ArchiveError, match="not an archive"):
        list(archive.read(tmp_path / "a.mcap"))
    with pytest.raises(ArchiveError, match=r"none\.mcap: cannot read"):
        list(archive.read(tmp_path / "none.mcap"))


def test_a_double_is_written_once(tmp_path: Path) -> None:
    writer = ArchiveWriter(tmp_path / "a.mcap")
    first, second = scan_records(1)[2], record(topics.ECHOES, 0, np.zeros((8, 4), "<i2"), boot="b1")
    assert [writer.write(first), writer.write(first), writer.write(second)] == [True, False, True]
    assert len(writer.close()) == 2
    assert archive.summary(tmp_path / "a.mcap").records == {"array/echoes": 2}


def test_an_archive_is_never_written_over(tmp_path: Path) -> None:
    written(tmp_path / "a.mcap", scan_records(1))
    with pytest.raises(ArchiveError, match="exists already"):
        ArchiveWriter(tmp_path / "a.mcap")


def test_a_writer_goes_on_after_a_crash_at_any_byte(tmp_path: Path) -> None:
    records = scan_records(4)
    written(tmp_path / "a.mcap", records, every=4)
    whole = (tmp_path / "a.mcap").read_bytes()
    for size in (0, 3, 20, *range(300, len(whole), 701), len(whole)):
        path = tmp_path / f"{size}.mcap"
        path.write_bytes(whole[:size])
        kept = len(list(archive.read(path)))
        writer = ArchiveWriter(path, resume=True)
        taken = [writer.write(message) for message in records]
        assert taken == [False] * kept + [True] * (len(records) - kept)
        assert len(writer.close()) == len(records)
        found = list(archive.read(path))
        assert all(same(a, b) for a, b in zip(found, records, strict=True))
        with path.open("rb") as file:
            assert len(list(make_reader(file, validate_crcs=True).iter_messages())) == 4 * 6


def test_after_a_failed_sync_nothing_is_acknowledged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    records = scan_records(2)
    writer = ArchiveWriter(tmp_path / "a.mcap")
    for message in records[:4]:
        writer.write(message)
    assert len(writer.sync()) == 4

    def fail(_: int) -> None:
        raise OSError(errno.EIO, "Input/output error")

    writer.write(records[4])
    with monkeypatch.context() as patch:
        patch.setattr(os, "fdatasync", fail)
        with pytest.raises(ArchiveError, match=r"a\.mcap: Input/output error"):
            writer.sync()
    for attempt in (writer.sync, lambda: writer.write(records[5]), writer.close):
        with pytest.raises(ArchiveError, match="nothing is acknowledged any more"):
            attempt()
    assert len(list(archive.read(tmp_path / "a.mcap"))) >= 4


def test_a_full_disk_is_named_and_loses_nothing_acknowledged(tmp_path: Path) -> None:
    path = tmp_path / "full.mcap"
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    writer = ArchiveWriter(path)
    acknowledged = 0
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (300_000, hard))
        with pytest.raises(ArchiveError, match=r"full\.mcap: .*Free space"):
            for message in scan_records(60, height=64, width=128):
                writer.write(message)
                acknowledged += len(writer.sync())
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, before)
        writer.abandon()
    assert acknowledged > 20
    assert len(list(archive.read(path))) == acknowledged


def test_a_full_file_system_is_named_and_loses_nothing_acknowledged(tmp_path: Path) -> None:
    disk = tmp_path / "disk"
    disk.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", str(disk)], capture_output=True, text=True, check=False
    )
    if mounted.returncode:
        pytest.skip(f"needs the right to mount a tmpfs: {mounted.stderr.strip()}")
    try:
        writer = ArchiveWriter(disk / "a.mcap")
        acknowledged = 0
        with pytest.raises(ArchiveError, match=r"a\.mcap: No space left on device"):
            for message in scan_records(200, height=64, width=128):
                writer.write(message)
                acknowledged += len(writer.sync())
        writer.abandon()
        assert acknowledged > 50
        assert len(list(archive.read(disk / "a.mcap"))) == acknowledged
    finally:
        subprocess.run(["umount", str(disk)], check=True)


_WRITE_FOR_EVER = """
import sys
from pathlib import Path
sys.path.insert(0, {tests!r})
from daemon.test_recorder_writer import ArchiveWriter, record, topics, np
writer, block = ArchiveWriter(Path({path!r})), np.zeros((8, 512), "<i2")
for k in range(10**6):
    writer.write(record(topics.ECHOES, k, block + k % 100))
    if k % 5 == 0:
        for made in writer.sync():
            print(made.seq, flush=True)
"""


def test_a_killed_writer_has_lost_no_acknowledged_record(tmp_path: Path) -> None:
    path = tmp_path / "killed.mcap"
    tests = str(Path(__file__).resolve().parents[1])
    program = _WRITE_FOR_EVER.format(tests=tests, path=str(path))
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        acknowledged = [int(process.stdout.readline()) for _ in range(60)]
        process.kill()
        acknowledged += [int(line) for line in process.stdout.read().split("\n")[:-1]]
    found = [message.header.seq for message in archive.read(path)]
    assert set(acknowledged) <= set(found)
    assert found == list(range(len(found)))


def test_syncing_in_groups_is_cheap_for_camera_frames(tmp_path: Path) -> None:
    frame = np.random.default_rng(0).poisson(4, (1024, 1280)).astype("u1")
    writer = ArchiveWriter(tmp_path / "fast.mcap")
    start_s = time.process_time()
    for k in range(20):
        writer.write(record(topics.CAMERA_LEFT, k, frame))
        writer.sync()
    spent_s = (time.process_time() - start_s) / 20
    writer.close()
    assert spent_s < 0.02  # a rig gives 30 frames a second
