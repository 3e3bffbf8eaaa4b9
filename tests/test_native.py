"""Building, caching, and going on without a compiler."""

from __future__ import annotations

import hashlib
import os
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

from stlc import native, toolchain
from stlc.cache import persistent
from stlc.diagnostics import Notice
from stlc.toolchain import CompilerError

pytestmark = pytest.mark.skipif(native.compiler() is None, reason="there is no C compiler here")
SMALL = "int answer(void) { return 42; }\n"
EVIL = "int answer(void) { return 666; }\n"
as_root = pytest.mark.skipif(os.geteuid() != 0, reason="only root gives files away")


@pytest.fixture
def cache(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(native, "_temporary", {})
    monkeypatch.setattr(toolchain, "_known", {})
    return tmp_path / "cache/stlc"


def answer(text: str = SMALL) -> int:
    library = native.load(text)
    assert library is not None
    found: int = library.answer()
    return found


def test_a_kernel_is_built_once(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert answer() == 42
    (built,) = cache.iterdir()
    assert built.stat().st_mode & 0o777 == 0o600
    assert cache.stat().st_mode & 0o777 == 0o700
    monkeypatch.setattr(native, "_compile", None)  # it must not be built again
    assert answer() == 42
    assert list(cache.iterdir()) == [built]


def test_no_compiler_no_kernel(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(native, "compiler", lambda: None)
    assert native.load(SMALL) is None
    assert not cache.exists()


def test_a_compiler_that_fails_is_not_tried_again_at_once(
    cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(native, "compiler", lambda: "/bin/false")
    with pytest.warns(Notice, match="W702: the C compiler `/bin/false` fails with exit code 1"):
        assert native.load(SMALL) is None
    assert [path.name[:8] for path in cache.iterdir()] == ["trouble-"]
    monkeypatch.setattr(native, "_compile", None)
    for _ in "as this process", "as another":
        with pytest.warns(Notice, match="fails with exit code 1"):
            assert native.load(SMALL) is None
        toolchain._known.clear()
    assert native.why_none(SMALL) == "the C compiler fails with exit code 1"


@pytest.mark.usefixtures("cache")
def test_a_compilation_whose_folder_a_forced_exit_removed_is_no_failure(tmp_path: Path) -> None:
    removing = tmp_path / "cc"
    removing.write_text('#!/bin/sh\nfor each; do test -f "$each" && rm "$each"; done\nexit 1\n')
    removing.chmod(0o755)
    with pytest.raises(CompilerError, match="was interrupted"):
        native._built(SMALL, str(removing), "key")
    assert toolchain.trouble("key") == ""


def test_another_version_of_the_compiler_has_another_kernel(
    cache: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    compiler = tmp_path / "cc"
    monkeypatch.setenv("CC", str(compiler))
    for number in (1, 2):
        said = f'if [ "$1" = --version ]; then echo {number}; exit; fi'
        compiler.write_text(f'#!/bin/sh\n{said}\nexec /usr/bin/cc "$@"\n')
        compiler.chmod(0o755)
        os.utime(compiler, (1, 1))  # neither its size nor its date tells
        monkeypatch.setattr(toolchain, "_versions", {})
        assert answer() == 42
        assert len(list(cache.iterdir())) == number


# ---------------------------------------------------------------------- a cache that was tampered with


def library(text: str) -> tuple[str, bytes]:
    """The name and the content of a library, which is not loaded: a process keeps what it has loaded."""
    using = native.compiler()
    assert using is not None
    key = native._key(text, using)
    data = native._built(text, using, key)
    assert data is not None
    return f"kernel-{key}-{hashlib.sha256(data).hexdigest()[:32]}.so", data


@dataclass(frozen=True)
class Built:
    """A library in the cache that was not loaded yet, and one with another answer that is not there."""

    text: str
    path: Path
    evil: bytes

    @property
    def folder(self) -> Path:
        return self.path.parent

    def refused(self, why: str) -> None:
        """Check that a library in the cache is not loaded."""
        with pytest.warns(Notice, match=why):
            assert answer(self.text) == 42

    def folder_refused(self, why: str) -> None:
        """The library is built elsewhere; what is in the folder stays as it is."""
        before = [(path, path.stat()) for path in self.folder.iterdir()]
        with pytest.warns(Notice, match="kernels in C are built anew"):
            self.refused(why)
        self.refused(why)  # from the folder of this process
        assert [(path, path.stat()) for path in self.folder.iterdir()] == before

    def replace(self, data: bytes) -> None:
        """Another file in the place of the library."""
        self.path.unlink()
        self.path.touch(0o600)
        self.path.write_bytes(data)


@pytest.fixture
def built(cache: Path) -> Built:
    text = f"{SMALL}/* {cache} */"
    name, data = library(text)
    kept = persistent()
    assert kept is not None
    assert kept.write(name, data)
    return Built(text, cache / name, library(f"{EVIL}/* {cache} */")[1])


def test_what_was_built_is_loaded(built: Built, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(native, "_compile", None)
    assert answer(built.text) == 42


def test_a_library_with_another_content_is_built_anew(built: Built) -> None:
    built.replace(built.evil)
    built.refused("is not what was written there; it is made anew")
    assert answer(built.text) == 42
    assert built.path.read_bytes() != built.evil


def test_a_torn_library_is_built_anew(built: Built) -> None:
    built.replace(built.path.read_bytes()[:1000])
    built.refused("is not what was written there")


def test_a_link_in_the_place_of_a_library_is_not_followed(built: Built, tmp_path: Path) -> None:
    built.path.rename(tmp_path / "copy.so")
    built.path.symlink_to(tmp_path / "copy.so")
    built.refused("is a symbolic link; it is made anew")
    assert not built.path.is_symlink()


def test_a_library_that_others_may_write_is_built_anew(built: Built) -> None:
    built.path.chmod(0o620)
    built.refused(r"may be written by others \(mode 620\)")
    assert built.path.stat().st_mode & 0o777 == 0o600


def test_a_pipe_in_the_place_of_a_library_is_not_waited_for(built: Built) -> None:
    built.path.unlink()
    os.mkfifo(built.path, 0o600)
    built.refused("is no regular file")


@as_root
def test_a_library_of_another_user_is_built_anew(built: Built) -> None:
    os.chown(built.path, 4711, 4711)
    built.refused(r"belongs to another user \(4711\)")


@as_root
def test_a_folder_of_another_user_is_not_used(built: Built) -> None:
    os.chown(built.folder, 4711, 4711)
    built.folder_refused(r"the cache folder .* belongs to another user \(4711\); it is not used")


@pytest.mark.parametrize("mode", [0o770, 0o707, 0o722])
def test_a_folder_that_others_may_write_is_not_used(built: Built, mode: int) -> None:
    built.folder.chmod(mode)
    built.folder_refused(rf"the cache folder .* may be written by others \(mode {mode:o}\); it is not used")


def test_a_link_in_the_place_of_the_folder_is_not_followed(built: Built, tmp_path: Path) -> None:
    built.folder.rename(tmp_path / "elsewhere")
    built.folder.symlink_to(tmp_path / "elsewhere")
    built.folder_refused("the cache folder .* is a symbolic link; it is not used")


def test_a_folder_that_is_replaced_later_is_looked_at_again(built: Built, tmp_path: Path) -> None:
    built.folder.rename(tmp_path / "old")
    built.folder.mkdir(mode=0o700)
    assert answer(built.text) == 42
    assert len(list(built.folder.iterdir())) == 1


# ---------------------------------------------------------------------- no place for a cache


def test_without_a_home_directory_kernels_are_built_for_the_process(
    cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def homeless() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.delenv("HOME")
    monkeypatch.setattr(Path, "home", homeless)
    with pytest.warns(Notice, match="there is no home directory; kernels in C are built anew in every"):
        assert answer() == 42
    monkeypatch.setattr(native, "_compile", None)
    assert answer() == 42  # nothing is said again, and nothing is built
    assert not cache.exists()


def test_a_compiler_that_hangs_in_one_text_is_not_asked_about_others(
    cache: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    compiler = tmp_path / "cc"
    compiler.write_text('#!/bin/sh\n[ "$1" = --version ] && echo 1 && exit\necho . >> ${0}.asked\nsleep 99\n')
    compiler.chmod(0o755)
    monkeypatch.setenv("CC", str(compiler))
    monkeypatch.setattr(toolchain, "IDLE", 0.2)
    monkeypatch.setattr(toolchain, "_versions", {})
    for text in (SMALL, EVIL, SMALL):
        with pytest.warns(
            Notice, match=r"W702: .*/cc` did nothing for 0\.2 s and was ended; the same is done"
        ):
            assert native.load(text) is None
        assert native.why_none(text) == "the C compiler did nothing for 0.2 s and was ended"
    assert (tmp_path / "cc.asked").read_text() == ".\n"
    assert not list(cache.glob("kernel-*"))


BUSY_CC = """#!/bin/sh
[ "$1" = --version ] && echo 1 && exit
echo "$1" >> ${0}.asked
for each; do case "$each" in *.c) grep -q 42 "$each" && case "$1" in
  %s) while :; do :; done;; esac;; esac; done
exec cc "$@"
"""
"""It takes for ever over `SMALL`, at some levels."""


@pytest.fixture
def busy(cache: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A compiler that is to be told at which levels it takes for ever."""
    compiler = tmp_path / "busy-cc"
    compiler.touch(0o755)
    assert not cache.exists()
    monkeypatch.setenv("CC", str(compiler))
    monkeypatch.setattr(toolchain, "BUSY", 0.3)
    monkeypatch.setattr(toolchain, "_versions", {})
    return compiler


@pytest.mark.skipif(sys.platform != "linux", reason="needs to know the processor time")
def test_a_text_that_takes_too_long_is_built_as_slow_code(busy: Path) -> None:
    busy.write_text(BUSY_CC % "-O[123]")
    assert answer() == 42
    assert (busy.parent / "busy-cc.asked").read_text() == "-O3\n-O0\n"
    assert answer() == 42
    assert (busy.parent / "busy-cc.asked").read_text() == "-O3\n-O0\n"


@pytest.mark.skipif(sys.platform != "linux", reason="needs to know the processor time")
def test_a_text_that_is_too_much_is_named_and_left_alone_and_others_are_not(
    busy: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    busy.write_text(BUSY_CC % "*")
    said = r"did not end within 0\.3 s of the processor and was ended"
    for _ in "as this process", "as another", "an hour later":
        with pytest.warns(Notice, match=f"W702: .*{said}; the same is done"):
            assert native.load(SMALL) is None
        assert native.why_none(SMALL).startswith("the C compiler did not end within 0.3 s")
        toolchain._known.clear()
        monkeypatch.setattr(toolchain, "REMEMBERED", 0.0)
    assert (busy.parent / "busy-cc.asked").read_text() == "-O3\n-O0\n"
    monkeypatch.setattr(toolchain, "BUSY", 30.0)
    assert answer(EVIL) == 666
