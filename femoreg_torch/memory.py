"""Freed memory that a process keeps, rather than to give it back to the system and ask for it again."""

import ctypes
import os
from contextlib import suppress

_NEVER = 2**30  # bytes: less is not given back from the end of the heap, and smaller arrays do not lie outside it
# Settings of glibc's malloc: the variable that a process reads when it starts, mallopt's number (malloc.h), the value.
# One arena: what one thread frees, the next one takes.
_SETTINGS = (
    ("MALLOC_TRIM_THRESHOLD_", -1, _NEVER),
    ("MALLOC_MMAP_THRESHOLD_", -3, _NEVER),
    ("MALLOC_ARENA_MAX", -8, 1),
)


def keep_freed_memory() -> None:
    """Let glibc's allocator keep freed memory, in this process and in those that it starts.

    Images and volumes of some MB come and go a thousand times in a registration. By itself the allocator gives most of
    them back, and the system clears every page anew: a second of twelve, with the same peak. What the environment says
    of `malloc` stands. Call it before threads are started. Other allocators than glibc's are left alone.
    """
    if any(name in os.environ for name, _, _ in _SETTINGS):
        return
    os.environ.update({name: str(value) for name, _, value in _SETTINGS})
    with suppress(AttributeError, OSError, TypeError):  # no mallopt, or no C library by that name
        mallopt = ctypes.CDLL(None).mallopt
        for _, number, value in _SETTINGS:
            mallopt(number, value)
