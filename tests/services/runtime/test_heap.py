"""Freed memory goes back to the machine."""

import platform
import subprocess
import sys

import pytest

# Between blocks that are kept, so that the heap does not shrink by itself.
FREED = """
import ctypes, psutil
from prior_sg.services.runtime import heap

library = ctypes.CDLL(None)
library.malloc.restype, library.free.argtypes = ctypes.c_void_p, [ctypes.c_void_p]
blocks = [library.malloc(10_000) for _ in range(6000)]
for block in blocks:
    ctypes.memset(block, 1, 10_000)
for block in blocks[:-1]:
    library.free(block)
before = psutil.Process().memory_info().rss
heap.give_back()
print(before - psutil.Process().memory_info().rss > 40e6)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="the call is glibc's")
def test_what_was_freed_between_what_is_kept_is_given_back():
    done = subprocess.run([sys.executable, "-c", FREED], capture_output=True, text=True, check=True)
    assert done.stdout == "True\n"
