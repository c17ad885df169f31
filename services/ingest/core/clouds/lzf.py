"""Bytes compressed with LibLZF, as PCD files have them (pure)."""


def decompressed(data: bytes, size: int) -> bytes:
    """The `size` bytes that were compressed. Raises ValueError."""
    out, at = bytearray(), 0
    try:
        while at < len(data):
            control = data[at]
            at += 1
            if control < 32:
                if at + control >= len(data):
                    raise ValueError("it is cut off")
                out += data[at : at + control + 1]
                at += control + 1
                continue
            length = control >> 5
            if length == 7:
                length += data[at]
                at += 1
            begin = len(out) - ((control & 31) << 8) - data[at] - 1
            at += 1
            _repeat(out, begin, length + 2)
            if len(out) > size:
                break
    except IndexError as error:
        raise ValueError("it is cut off") from error
    if len(out) != size:
        raise ValueError(f"it gives {len(out)} bytes instead of {size}")
    return bytes(out)


def _repeat(out: bytearray, begin: int, length: int) -> None:
    """Append what stands from `begin` on, which may reach into what is appended. Raises ValueError."""
    if begin < 0:
        raise ValueError("it refers to what lies before it")
    held = bytes(out[begin : begin + length])
    out += (held * -(-length // len(held)))[:length]
