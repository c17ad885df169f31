"""Parts of an MCAP file, found one by one, so that one that is damaged does not hide the others."""

import mmap
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
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
HEAD = struct.Struct("<BQ")  # of a record: its kind, and the length of its content
FOOTER, CRC = struct.Struct("<BQQQI"), struct.Struct("<I")  # the footer ends with the sum of the index
BEGINNING = MCAP0_MAGIC + bytes([Opcode.HEADER])
READERS: dict[Opcode, Any] = {Opcode.CHUNK: Chunk, Opcode.ATTACHMENT: Attachment, Opcode.METADATA: Metadata}
DAMAGE = (
    McapError, ValueError, LookupError, struct.error, zstandard.ZstdError, RuntimeError, MemoryError, OverflowError,
)  # fmt: skip


@dataclass(frozen=True)
class Unread:
    """What lies behind the last complete record of a file, and whether that was its footer. `another` is the byte at
    which one more log begins, None = none does.
    """

    size_bytes: int
    ended: bool
    another: int | None


def index_of(file: BinaryIO) -> Summary | None:
    """The index at the end of the file; None when the file was cut off, or the index is damaged or of another file."""
    size = file.seek(0, 2)
    if not is_ended(file):
        return None
    try:
        _check_index(file, size)
        file.seek(0)
        return SeekingReader(file, record_size_limit=size).get_summary()
    except DAMAGE:
        return None


def is_ended(file: BinaryIO) -> bool:
    """Whether the file ends as one that was closed."""
    if file.seek(0, 2) < 3 * len(MCAP0_MAGIC):
        return False
    file.seek(-len(MCAP0_MAGIC), 2)
    return file.read() == MCAP0_MAGIC


def _check_index(file: BinaryIO, size: int) -> None:
    """Raises ValueError where the sum of the index is not the one written with it; 0 is none."""
    start = size - len(MCAP0_MAGIC) - FOOTER.size
    file.seek(max(start, 0))
    opcode, length, summary_start, _, told = FOOTER.unpack(file.read(FOOTER.size))
    if opcode != Opcode.FOOTER or length != FOOTER.size - HEAD.size or summary_start > start:
        raise ValueError("it has no footer")
    if told and summary_start:
        file.seek(summary_start)
        if zlib.crc32(file.read(start + FOOTER.size - CRC.size - summary_start)) != told:
            raise ValueError("its sum is wrong")


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
    record = kind.read(ReadDataStream(file))
    if kind is Attachment:
        _check_attachment(file, offset)
    return record


def _check_attachment(file: BinaryIO, offset: int) -> None:
    """For the file just behind an attachment, which MCAP's own reader does not check. Raises ValueError."""
    length = file.tell() - offset - CRC.size
    file.seek(offset)
    content, (told,) = file.read(length), CRC.unpack(file.read(CRC.size))
    if told and zlib.crc32(content) != told:
        raise ValueError("its sum is wrong")


def indexed_chunks(file: BinaryIO, index: Summary, wanted: set[str] | None) -> Iterator[Callable[[], Chunk]]:
    """What reads each chunk, for one that is damaged must not hide those behind it."""
    ids = {i for i, channel in index.channels.items() if wanted is None or channel.metadata.get("topic") in wanted}

    def holds(chunk: ChunkIndex) -> bool:
        return not ids.isdisjoint(chunk.message_index_offsets)

    for chunk in sorted(filter(holds, index.chunk_indexes), key=lambda chunk: chunk.chunk_start_offset):
        yield partial(_chunk_of, file, chunk)


def _chunk_of(file: BinaryIO, told: ChunkIndex) -> Chunk:
    """The chunk that an index tells of. Raises what is in DAMAGE."""
    chunk = record_at(file, Chunk, told.chunk_start_offset + HEAD.size)
    if chunk.uncompressed_size != told.uncompressed_size:  # zeros would be read as a chunk without messages
        raise ValueError(f"it tells of {chunk.uncompressed_size} bytes, its index of {told.uncompressed_size}")
    return chunk


def records(file: BinaryIO, wanted: Opcode) -> Iterator[Callable[[], Any]]:
    """What reads each complete record of one kind, in file order, without the help of an index."""
    for opcode, start, _ in _complete(file):
        if opcode == wanted:
            yield partial(record_at, file, READERS[wanted], start)


def appended(file: BinaryIO, index: Summary | None, wanted: Opcode) -> Iterator[Callable[[], Any]]:
    """What reads each attachment or each metadata record: by the index, else one after the other."""
    if index is None:
        yield from records(file, wanted)
        return
    for told in index.attachment_indexes if wanted == Opcode.ATTACHMENT else index.metadata_indexes:
        yield partial(record_at, file, READERS[wanted], told.offset + HEAD.size)


def unread(file: BinaryIO) -> Unread:
    """What one reads no more who goes from record to record."""
    size, end, ended = file.seek(0, 2), len(MCAP0_MAGIC), False
    for opcode, start, length in _complete(file):
        ended = opcode == Opcode.FOOTER
        end = start + length + ended * len(MCAP0_MAGIC)
    if end >= size:
        return Unread(0, ended, None)
    with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as held:
        another = held.find(BEGINNING, 1)  # a chunk that was cut off seems to reach into what follows
    return Unread(size - end, ended, another if another >= 0 else None)


def _complete(file: BinaryIO) -> Iterator[tuple[int, int, int]]:
    """Kind, place of the content and its length of all records up to the footer or to one that is not complete."""
    size, start, opcode = file.seek(0, 2), len(MCAP0_MAGIC), 0
    while opcode != Opcode.FOOTER:
        file.seek(start)
        head = file.read(HEAD.size)
        if len(head) < HEAD.size:
            return
        opcode, length = HEAD.unpack(head)
        start += len(head) + length
        if start > size or opcode == 0:
            return
        yield opcode, start - length, length
