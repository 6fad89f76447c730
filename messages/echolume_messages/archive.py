"""Read the raw archive of a scan, also one whose end is missing."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from echolume_messages import mcap_stream
from echolume_messages.archive_format import CHANNEL_BY_NAME, Assembler, Channel
from echolume_messages.bus.message import Message
from echolume_messages.errors import ArchiveError, PayloadError


@dataclass(frozen=True)
class ArchiveSummary:
    """What an archive holds."""

    records: dict[str, int]
    """Records per topic name."""
    torn: bool
    """Whether its end is missing; everything counted is before the tear."""
    bytes: int


class ChunkReader:
    """Turns an archive's chunks, fed in file order, into records."""

    def __init__(
        self, path: Path, wanted: Collection[str] | None = None, known: Mapping[int, Channel] | None = None
    ) -> None:
        self._path = path
        self._wanted = wanted
        self._channels = {n: c for n, c in (known or {}).items() if wanted is None or c.topic.name in wanted}
        self._assembler = Assembler()

    def raw(self, chunk: mcap_stream.Chunk) -> Iterator[tuple[Channel, mcap_stream.RawMessage]]:
        """Messages of the wanted topics, before they are decoded."""
        for opcode, offset, body in mcap_stream.split(chunk.data):
            if opcode == mcap_stream.CHANNEL:
                number, name = mcap_stream.channel_name(body)
                channel = CHANNEL_BY_NAME.get(name)
                if channel is not None and (self._wanted is None or channel.topic.name in self._wanted):
                    self._channels[number] = channel
            elif opcode == mcap_stream.MESSAGE:
                message = mcap_stream.message_of(body, offset)
                channel = self._channels.get(message.channel)
                if channel is not None:
                    yield channel, message

    def records(self, chunk: mcap_stream.Chunk) -> Iterator[Message]:
        """Records that this chunk completes."""
        for channel, raw in self.raw(chunk):
            try:
                record = self._assembler.feed(channel, raw.data)
            except PayloadError as error:
                raise ArchiveError(f"{self._path}: chunk at byte {chunk.start}: {error}") from error
            if record is not None:
                yield record


def read(path: Path, topics: Collection[str] | None = None) -> Iterator[Message]:
    """Records of an archive in file order; a file cut anywhere yields what is complete before the cut.

    Parameters
    ----------
    path
        The ``.mcap`` file.
    topics
        Topic names (``cameras/left``) to read; all, if not given.

    Raises
    ------
    ArchiveError
        There is no such file, it is no archive, or a record in it is not of this program's topics.
    """
    reader = ChunkReader(path, topics)
    try:
        with path.open("rb") as stream:
            for chunk in mcap_stream.chunks(stream, mcap_stream.Scan(path)):
                yield from reader.records(chunk)
    except OSError as error:
        raise ArchiveError(f"{path}: cannot read the archive: {error.strerror}") from error


def summary(path: Path) -> ArchiveSummary:
    """Records per topic, and whether the end is missing.

    Raises
    ------
    ArchiveError
        There is no such file, or it is no archive.
    """
    counts: dict[str, int] = {}
    scan = mcap_stream.Scan(path)
    reader = ChunkReader(path)
    try:
        with path.open("rb") as stream:
            for chunk in mcap_stream.chunks(stream, scan):
                for channel, _ in reader.raw(chunk):
                    if channel.part != "header":
                        counts[channel.topic.name] = counts.get(channel.topic.name, 0) + 1
            size = stream.seek(0, 2)
    except OSError as error:
        raise ArchiveError(f"{path}: cannot read the archive: {error.strerror}") from error
    return ArchiveSummary(counts, not scan.complete, size)
