"""Allocator settings that keep freed memory in the process between rollouts."""

from __future__ import annotations

import ctypes
import sys
from functools import cache

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # of <malloc.h>
_ALL = 2**31 - 1
_LARGEST = 32 * 2**20  # the most that glibc accepts


@cache
def keep_freed_memory() -> bool:
    """Tell the C library not to return freed memory to the system; True if it accepted.

    A rollout allocates and frees the same few arrays of some 100 kB in every step. By default glibc returns
    them, and each time their pages have to be mapped and cleared again, which takes as long as the rollout
    itself. This holds for the whole process, so it is for programs to call (`stlc train`), not for imports.
    """
    if not sys.platform.startswith("linux"):
        return False
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError):
        return False
    return bool(mallopt(_MMAP_THRESHOLD, _LARGEST)) and bool(mallopt(_TRIM_THRESHOLD, _ALL))
