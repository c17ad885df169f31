"""Parts of an MCAP file, found one by one, so that one that is damaged does not hide the others."""

import struct
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, BinaryIO

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Attachment, Chunk, ChunkIndex, Metadata
from mcap.summary import Summary
from mcap.writer import MCAP0_MAGIC

from prior_sg.schemas.topics import LARGEST, MB

MOST_BYTES = LARGEST + MB  # of an unpacked chunk: one is written when it is full, after its last message
DAMAGE = (
    McapError, ValueError, LookupError, struct.error, zstandard.ZstdError, RuntimeError, MemoryError, OverflowError,
)  # fmt: skip


def index_of(file: BinaryIO) -> Summary | None:
    """The index at the end of the file; None when the file was cut off."""
    size = file.seek(0, 2)
    if size < 3 * len(MCAP0_MAGIC):
        return None
    file.seek(-len(MCAP0_MAGIC), 2)
    if file.read() != MCAP0_MAGIC:
        return None
    file.seek(0)
    try:
        return SeekingReader(file, record_size_limit=size).get_summary()
    except DAMAGE:
        return None


def bounded(chunk: Chunk) -> Chunk:
    """The chunk, unless unpacking it would take more than a chunk of one largest message. Raises ValueError."""
    packed = chunk.compression == "zstd"
    size = max(chunk.uncompressed_size, zstandard.frame_content_size(chunk.data) if packed else 0)
    if size > MOST_BYTES:
        raise ValueError(f"it would take {size} bytes")
    return chunk


def record_at(file: BinaryIO, kind: Any, offset: int) -> Any:
    """The record of a kind whose content begins there. Raises what is in DAMAGE."""
    file.seek(offset)
    return kind.read(ReadDataStream(file))


def indexed_chunks(file: BinaryIO, index: Summary, wanted: set[str] | None) -> Iterator[Callable[[], Chunk]]:
    """What reads each chunk, for one that is damaged must not hide those behind it."""
    ids = {i for i, channel in index.channels.items() if wanted is None or channel.metadata.get("topic") in wanted}

    def holds(chunk: ChunkIndex) -> bool:
        return not ids.isdisjoint(chunk.message_index_offsets)

    for chunk in sorted(filter(holds, index.chunk_indexes), key=lambda chunk: chunk.chunk_start_offset):
        yield partial(record_at, file, Chunk, chunk.chunk_start_offset + struct.calcsize("<BQ"))


def records(file: BinaryIO, wanted: Opcode) -> Iterator[Callable[[], Any]]:
    """What reads each complete record of one kind, in file order, without the help of an index."""
    readers: dict[Opcode, Any] = {Opcode.CHUNK: Chunk, Opcode.ATTACHMENT: Attachment, Opcode.METADATA: Metadata}
    size = file.seek(0, 2)
    start = len(MCAP0_MAGIC)
    while True:
        file.seek(start)
        head = file.read(struct.calcsize("<BQ"))
        if len(head) < struct.calcsize("<BQ"):
            return
        opcode, length = struct.unpack("<BQ", head)
        start += len(head) + length
        if start > size or opcode in (0, Opcode.DATA_END):
            return
        if opcode == wanted:
            yield partial(record_at, file, readers[wanted], start - length)
