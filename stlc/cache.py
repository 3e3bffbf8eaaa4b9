"""The cache folder: files that can be computed again, shared by processes, protected from other users.

Code is loaded from here. So the folder and each file read from it must belong to the user, and only the user
may be able to write to them. They must not be links. Otherwise, or if no such folder can be created, a
temporary folder of the process is used (`temporary`), or nothing is cached.
"""

from __future__ import annotations

import atexit
import os
import stat
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from stlc.diagnostics import Diagnostic, notice, os_reason
from stlc.stopping import undoing

MOST_BYTES = 256_000_000
"""Size limit of the cache in bytes; the least recently used files are removed first."""
MOST_DAYS = 60
"""Days without use after which a file is removed."""
KINDS = ("kernel-", "grammar-", "trouble-")
"""Prefixes of file names in the cache; other files in the folder are never removed."""

_OTHERS = stat.S_IWGRP | stat.S_IWOTH
_DAY = 86_400.0
_UNFINISHED = ".new-"
_OPEN_FOLDERS = Path("/proc/self/fd")


class Unusable(Exception):  # noqa: N818 - an answer that callers catch
    """Error: a folder cannot be used as the cache.

    Attributes:
        why: reason, printed after the name of the folder.
        distrusted: whether the reason is that another user could have changed its content.
    """

    def __init__(self, why: str, *, distrusted: bool = False) -> None:
        super().__init__(why)
        self.why = why
        self.distrusted = distrusted


@dataclass(frozen=True, slots=True)
class Cache:
    """A cache folder that only the user can write to.

    Attributes:
        shown: path of the folder, for messages.
        folder: path used to read and write. On systems with `/proc` it is the path of an open file
            descriptor. This path leads to the folder that was checked, even if a parent folder is replaced
            later.
    """

    shown: Path
    folder: Path

    def read(self, name: str) -> bytes | None:
        """Return the content of a file; None if it is missing, or if another user may have changed it.

        In the second case the file is removed, with a warning.
        """
        flags = os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
        path = self.folder / name
        try:
            if stat.S_ISLNK(path.lstat().st_mode):
                raise Unusable("is a symbolic link", distrusted=True)
            with open(os.open(path, flags), "rb") as file:  # noqa: PTH123 - of a descriptor
                found = os.fstat(file.fileno())
                _require_own(found, stat.S_ISREG(found.st_mode), "is no regular file")
                data = file.read()
        except OSError:
            return None
        except Unusable as refused:
            self.refuse(name, refused.why)
            return None
        if time.time() - found.st_mtime > _DAY:
            with suppress(OSError):
                os.utime(path)  # files are pruned by when they were last used
        return data

    def refuse(self, name: str, why: str) -> None:
        """Remove the file `name`, which is not trusted, and warn about it with the reason `why`."""
        with suppress(OSError):
            (self.folder / name).unlink()
        notice(Diagnostic("W701", f"`{self.shown / name}` {why}; it is made anew"))

    def write(self, name: str, data: bytes) -> bool:
        """Write `data` to the file `name`; return False if that fails.

        The file is written atomically: a temporary file is written, then renamed.
        """
        beside = self.folder / f"{_UNFINISHED}{os.urandom(8).hex()}"
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_NOFOLLOW", 0)
        try:
            with open(os.open(beside, flags, 0o600), "wb") as file:  # noqa: PTH123 - of a descriptor
                file.write(data)
            beside.replace(self.folder / name)
        except OSError:
            with suppress(OSError):
                beside.unlink(missing_ok=True)
            return False
        _prune_once(self)
        return True

    def names(self, start: str) -> list[str]:
        """Names of the files that begin with `start`; empty if the folder cannot be read."""
        try:
            return sorted(name for name in os.listdir(self.folder) if name.startswith(start))  # noqa: PTH208 - fast
        except OSError:
            return []

    def size(self) -> tuple[int, int]:
        """Number and total size in bytes of the files that stlc has written to the folder."""
        sizes = [found.st_size for _, found in _entries(self)]
        return len(sizes), sum(sizes)


def _require_own(found: os.stat_result, right_kind: bool, otherwise: str) -> None:
    """Raise Unusable if another user could have changed a file or folder.

    Args:
        found: status of the file or folder.
        right_kind: whether it is of the expected kind (file or folder).
        otherwise: reason given in the error if it is of another kind.
    """
    if not right_kind:
        raise Unusable(otherwise, distrusted=True)
    if os.name != "posix":
        return
    if found.st_uid != os.geteuid():
        raise Unusable(f"belongs to another user ({found.st_uid})", distrusted=True)
    if found.st_mode & _OTHERS:
        raise Unusable(f"may be written by others (mode {found.st_mode & 0o777:o})", distrusted=True)


# ---------------------------------------------------------------------- persistent cache


def place() -> Path:
    """Path of the cache folder: `$XDG_CACHE_HOME/stlc`, else `~/.cache/stlc`.

    Raises:
        Unusable: there is no home directory.
    """
    home = os.environ.get("XDG_CACHE_HOME", "")
    if home and Path(home).is_absolute():  # relative ones are to be ignored, says the XDG specification
        return Path(home) / "stlc"
    try:
        home = str(Path.home())
    except (RuntimeError, OSError):
        home = ""
    if not os.environ.get("HOME", home) or not Path(home).is_absolute():
        raise Unusable("there is no home directory")
    return Path(home) / ".cache" / "stlc"


def persistent() -> Cache | None:
    """The user's cache folder, created if missing; None if it cannot be used.

    A folder that another user could have changed causes a warning, once per command.
    """
    try:
        return opened()
    except Unusable as refused:
        if refused.distrusted:
            advice = "remove it, or set `XDG_CACHE_HOME` to a folder of your own"
            message = f"the cache folder `{place()}` {refused.why}; it is not used"
            notice(Diagnostic("W701", message, help=(advice,)))
        return None


def why_not() -> str:
    """Reason why there is no persistent cache; "" if there is one."""
    try:
        opened()
    except Unusable as refused:
        with suppress(Unusable):
            return f"`{place()}` {refused.why}"
        return refused.why
    return ""


def opened() -> Cache:
    """Open the user's cache folder and return it; it is created if missing.

    Raises:
        Unusable: the folder cannot be created, or another user could have changed its content.
    """
    return private(place())


_descriptors: dict[Path, int] = {}
"""Open folders; their paths below `_OPEN_FOLDERS` are valid as long as the process lives."""


def private(path: Path) -> Cache:
    """Open the folder `path` as a cache to which only the user can write; it is created if missing.

    Raises:
        Unusable: the folder cannot be created, or another user could have changed its content.
    """
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        with suppress(FileExistsError):
            path.mkdir(mode=0o700)
        if stat.S_ISLNK(path.lstat().st_mode):
            raise Unusable("is a symbolic link", distrusted=True)
        if os.name != "posix":
            return Cache(path, path)
        return Cache(path, _checked_folder(path))
    except OSError as error:
        raise Unusable(f"cannot be used: {os_reason(error)}") from error
    except ValueError as error:  # a zero byte in the name
        raise Unusable("cannot be used: it is no name of a folder") from error


def _checked_folder(path: Path) -> Path:
    """Check the owner of the folder `path`, set its mode to 0700, and return a path to the folder.

    On systems with `/proc`, the returned path is that of an open file descriptor, which cannot be redirected
    to another folder. On other systems, `path` is returned. Raises Unusable if the folder has another owner.
    """
    open_one = _descriptors.get(path)
    fresh = open_one is None or not os.path.samestat(os.fstat(open_one), path.lstat())
    folder = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW) if fresh else open_one
    assert folder is not None
    try:
        found = os.fstat(folder)
        _require_own(found, stat.S_ISDIR(found.st_mode), "is no folder")
        if found.st_mode & 0o077:
            os.fchmod(folder, 0o700)
    except BaseException:
        if fresh:
            os.close(folder)
        raise
    if not _OPEN_FOLDERS.is_dir():
        if fresh:
            os.close(folder)
        return path
    if fresh:
        if open_one is not None:
            os.close(open_one)
        _descriptors[path] = folder
    return _OPEN_FOLDERS / str(folder)


# ---------------------------------------------------------------------- cache of this process


def temporary() -> Cache | None:
    """A temporary cache folder, removed when the process ends; None if none can be created."""
    return _temporary(os.getpid())


@cache
def _temporary(process: int) -> Cache | None:
    import shutil
    import tempfile

    try:
        folder = tempfile.mkdtemp(prefix="stlc-")  # 0700
        made = private(Path(folder).resolve())
    except (OSError, Unusable):
        return None

    def clear() -> None:
        if os.getpid() == process:  # not in a process that was forked off
            shutil.rmtree(folder, ignore_errors=True)

    atexit.register(clear)
    undoing(lambda _code: clear())
    return made


# ---------------------------------------------------------------------- pruning


@cache
def _prune_once(store: Cache) -> None:
    """Remove old files from the cache, only at the first call in a process; see `prune`."""
    prune(store)


def prune(store: Cache, *, most_bytes: int = MOST_BYTES, most_days: float = MOST_DAYS) -> None:
    """Remove files that were not used for `most_days` days; of the others, keep the newest.

    The files that are kept have at most `most_bytes` bytes in total.
    """
    now, left = time.time(), most_bytes
    for name, found in sorted(_entries(store), key=lambda entry: entry[1].st_mtime, reverse=True):
        days = (now - found.st_mtime) / _DAY
        left -= found.st_size
        if left < 0 or days > (1 if name.startswith(_UNFINISHED) else most_days):
            with suppress(OSError):
                (store.folder / name).unlink()


def _entries(store: Cache) -> Iterator[tuple[str, os.stat_result]]:
    """Yield name and status of the files in the cache folder that stlc has written."""
    with suppress(OSError), os.scandir(store.folder) as entries:
        for entry in entries:
            if entry.name.startswith((*KINDS, _UNFINISHED)):
                with suppress(OSError):
                    yield entry.name, entry.stat(follow_symlinks=False)
