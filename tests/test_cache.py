"""The cache folder: where it is, who may have written to it, what is removed from it."""

from __future__ import annotations

import os
import stat
import subprocess
import sys
import time
from pathlib import Path

import pytest

from stlc import cache
from stlc.diagnostics import Notice

as_root = pytest.mark.skipif(os.geteuid() != 0, reason="only root can be somebody else")


@pytest.fixture
def kept(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "deep/down"))
    return cache.persistent()


def mode(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


def test_the_folder_and_its_files_are_the_user_s_alone(kept, tmp_path):
    before = os.umask(0)
    try:
        assert kept.write("kernel-1", b"code")
    finally:
        os.umask(before)
    assert kept.shown == tmp_path / "deep/down/stlc"
    assert mode(kept.shown) == 0o700
    assert mode(kept.shown / "kernel-1") == 0o600
    assert kept.read("kernel-1") == b"code"
    assert kept.read("kernel-2") is None
    assert [path.name for path in kept.shown.iterdir()] == ["kernel-1"]


def test_a_folder_that_others_may_read_is_closed(kept):
    kept.shown.chmod(0o755)
    assert cache.persistent() is not None
    assert mode(kept.shown) == 0o700


def test_the_folder_stays_the_one_that_was_looked_at(kept, tmp_path):
    kept.write("kernel-1", b"mine")
    kept.shown.rename(tmp_path / "away")
    kept.shown.mkdir()
    (kept.shown / "kernel-1").write_bytes(b"theirs")
    if Path("/proc/self/fd").is_dir():
        assert kept.read("kernel-1") == b"mine"


@pytest.mark.parametrize(
    ("variables", "expected"),
    [
        ({"XDG_CACHE_HOME": "/caches", "HOME": "/home/me"}, "/caches/stlc"),
        ({"HOME": "/home/me"}, "/home/me/.cache/stlc"),
        ({"XDG_CACHE_HOME": "relative", "HOME": "/home/me"}, "/home/me/.cache/stlc"),
        ({"XDG_CACHE_HOME": "", "HOME": ""}, None),
        ({"HOME": "here"}, None),
    ],
)
def test_where_it_belongs(monkeypatch, variables, expected):
    for name in ("XDG_CACHE_HOME", "HOME"):
        monkeypatch.delenv(name, raising=False)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    if expected is None:
        assert cache.persistent() is None
        assert cache.why_not() == "there is no home directory"
    else:
        assert cache.place() == Path(expected)


def test_no_folder_can_be_made(monkeypatch, tmp_path):
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    assert cache.persistent() is None
    assert cache.why_not() == f"`{tmp_path}/file/stlc` cannot be used: file exists"
    monkeypatch.setenv("XDG_CACHE_HOME", "/proc/nothing")
    assert cache.persistent() is None


def test_what_is_distrusted_is_told(kept):
    kept.shown.chmod(0o777)
    with pytest.warns(Notice, match=r"W701: the cache folder .* may be written by others .* your own"):
        assert cache.persistent() is None


def test_the_temporary_folder_ends_with_its_process(tmp_path):
    script = (
        "import os; from stlc.cache import temporary; t = temporary(); t.write('kernel-1', b'x')\n"
        "if os.fork() == 0: raise SystemExit\n"  # a forked process leaves it alone
        "os.wait(); assert t.read('kernel-1') == b'x'; print(t.shown)"
    )
    done = subprocess.run(
        [sys.executable, "-c", script],
        env={**os.environ, "TMPDIR": str(tmp_path)},
        capture_output=True,
        text=True,
        check=True,
    )
    assert Path(done.stdout.strip()).parent == tmp_path
    assert list(tmp_path.iterdir()) == []


def test_old_files_go_and_then_the_oldest(kept):
    day = 86_400
    ages = {
        "kernel-new": 0,
        "kernel-week": 7,
        "grammar-old": 61,
        ".new-torn": 2,
        "kernel-big": 8,
        "notes": 900,
    }
    for name, age in ages.items():
        path = kept.shown / name
        path.write_bytes(bytes(100 if name != "kernel-big" else 500))
        os.utime(path, (time.time() - age * day,) * 2)
    cache.prune(kept, most_bytes=600)
    assert {path.name for path in kept.shown.iterdir()} == {"kernel-new", "kernel-week", "notes"}


def test_what_is_used_is_not_old(kept):
    kept.write("kernel-1", b"code")
    os.utime(kept.shown / "kernel-1", (1, 1))
    kept.read("kernel-1")
    cache.prune(kept)
    assert kept.read("kernel-1") == b"code"


@pytest.mark.apart
@as_root
@pytest.mark.parametrize("home", [None, "/nonexistent", "/root"])
def test_commands_of_a_user_without_a_home_or_a_name(home, tmp_path):
    tmp_path.chmod(0o755)
    variables = {**os.environ, "TMPDIR": str(tmp_path / "none"), "XDG_CACHE_HOME": str(tmp_path)}
    script = (
        "import os; from stlc.cli.framework.app import main\n"
        "main(['doctor', '--quick'])\n"  # what is imported has been: Python may lie where only root reads
        "os.setgroups([]); os.setgid(54321); os.setuid(54321)\n"
        "for name in ('HOME', 'XDG_CACHE_HOME'): os.environ.pop(name, None)\n"
        f"if {home!r} is not None: os.environ['HOME'] = {home!r}\n"
        "print('now'); raise SystemExit(main(['doctor', '--quick']))"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], env=variables, cwd="/", capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    (line,) = [line for line in done.stdout.split("now\n")[1].splitlines() if line.split()[:1] == ["cache"]]
    assert line.split()[1] == "off"
