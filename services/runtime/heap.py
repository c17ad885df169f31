"""The C library's heap."""

import contextlib
import ctypes


def give_back() -> None:
    """Give pages that hold nothing any more back to the machine: after what is done rarely, takes much and keeps
    little, such as a start, glibc keeps what was freed. Other C libraries have no such call and are left alone.
    """
    with contextlib.suppress(AttributeError):
        ctypes.CDLL(None).malloc_trim(0)
