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
    """Tell the C library not to return freed memory to the system; True on success.

    A rollout allocates and frees the same few arrays of some 100 kB in every step. By default glibc returns
    them, and mapping and clearing their pages again takes as long as the rollout itself. The setting affects
    the whole process, so programs (`stlc train`) call this, not imports.
    """
    if not sys.platform.startswith("linux"):
        return False
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError):
        return False
    return bool(mallopt(_MMAP_THRESHOLD, _LARGEST)) and bool(mallopt(_TRIM_THRESHOLD, _ALL))
