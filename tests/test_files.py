"""Reading with care, writing beside and then renaming, finding by name."""

from __future__ import annotations

import io
import os
import shlex
import signal
import struct
import subprocess
import sys
from pathlib import Path

import pytest

from stlc import files
from stlc.cli.framework.render import render_text
from stlc.diagnostics import MissingError, RunError, SpecError, StlcError, UsageError
from stlc.files import (
    MAX_BYTES,
    atomic_path,
    find_spec,
    find_system,
    find_trace,
    has_wildcard,
    matching_traces,
    named_in,
    place,
    read_regular,
    read_source,
    within,
    write_atomic,
)
from stlc.source import Source

ROOT = Path(__file__).resolve().parent.parent
FULL = Path("/dev/full")


def finding(error: pytest.ExceptionInfo[StlcError]):
    (diagnostic,) = error.value.diagnostics
    return diagnostic


# ------------------------------------------------------------------------------ reading


def test_a_text_is_read_under_the_name_it_was_given(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("a.stl").write_bytes(b"\xef\xbb\xbfspec a\n# gr\xc3\xb6\xc3\x9fe\n")
    source = read_source("a.stl")
    assert (source.name, source.text) == ("a.stl", "spec a\n# größe\n")


def test_the_standard_input_is_a_file_too(monkeypatch):
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(b"spec a")))
    source = read_source("-")
    assert (source.name, source.text) == ("<stdin>", "spec a")


def test_a_missing_file(tmp_path):
    (tmp_path / "traffic.stl").touch()
    with pytest.raises(UsageError) as caught:
        read_source(tmp_path / "trafic.stl")
    assert finding(caught).code == "U102"
    assert finding(caught).help == (f"did you mean `{tmp_path / 'traffic.stl'}`?",)


def test_a_missing_folder_and_a_folder_for_a_file(tmp_path):
    for path in (tmp_path / "no" / "a.stl", tmp_path):
        with pytest.raises(UsageError) as caught:
            read_source(path)
        assert finding(caught).code == "U102"


def test_an_ascii_mesh_is_shown(tmp_path):
    path = tmp_path / "part.stl"
    path.write_text("solid bracket_v2\n  facet normal 0 0 1\n    outer loop\n", encoding="ascii")
    with pytest.raises(SpecError) as caught:
        read_source(path)
    assert render_text(caught.value.diagnostics, color=False).splitlines() == [
        f"error[E003]: `{path}` is a 3-D mesh, not a specification",
        f" --> {path}:1:1",
        "  |",
        "1 | solid bracket_v2",
        "  | ^^^^^ ASCII stereolithography starts like this",
        "  |",
        "  = note: both formats use the suffix .stl; stlc specifications are UTF-8 text that start with a "
        "declaration or `spec NAME`",
    ]


def test_a_specification_may_speak_of_solids(tmp_path):
    path = tmp_path / "a.stl"
    path.write_text("# solid ground\nsignal solid\n", encoding="utf-8")
    assert read_source(path).text.startswith("# solid")


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (b"\0" * 80 + struct.pack("<I", 2) + b"\x01" * 100, "is a 3-D mesh"),
        (b"PK\x03\x04\x00\x00\xff\xfe" * 20, "is a binary file"),
        (b"spec a\0\0", "is a binary file"),
        (b"spec a\nconst caf\xe9 = 1\n", "is not UTF-8: byte 0xe9 in line 2"),
    ],
)
def test_what_is_no_text(tmp_path, data, says):
    path = tmp_path / "a.stl"
    path.write_bytes(data)
    with pytest.raises(SpecError) as caught:
        read_source(path)
    assert finding(caught).code == "E003"
    assert says in finding(caught).message


def test_a_large_file_is_not_read(tmp_path):
    path = tmp_path / "a.stl"
    with path.open("wb") as file:
        file.truncate(MAX_BYTES + 1)
    with pytest.raises(SpecError) as caught:
        read_source(path)
    assert finding(caught).code == "E005"


# ------------------------------------------------------------------------------ writing


def listed(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_texts_and_bytes_are_written_whole(tmp_path):
    path = tmp_path / "new" / "folder" / "a.json"
    write_atomic(path, "größe")
    assert path.read_text(encoding="utf-8") == "größe"
    write_atomic(str(path), b"\x00\x01")
    assert path.read_bytes() == b"\x00\x01"
    assert listed(path.parent) == ["a.json"]


def test_a_file_is_readable_as_the_user_wants_it(tmp_path):
    before = os.umask(0o027)
    try:
        write_atomic(tmp_path / "a", "x")
    finally:
        os.umask(before)
    assert (tmp_path / "a").stat().st_mode & 0o777 == 0o640


@pytest.mark.parametrize("mode", [0o600, 0o640, 0o444, 0o755])
def test_a_file_that_is_replaced_keeps_its_permissions(tmp_path, mode):
    path = tmp_path / "a"
    path.write_text("old")
    path.chmod(mode)
    with atomic_path(path) as temporary:
        assert temporary.stat().st_mode & 0o077 == 0
        temporary.write_text("new")
    assert path.read_text() == "new"
    assert path.stat().st_mode & 0o777 == mode


def test_a_link_is_written_through(tmp_path):
    write_atomic(tmp_path / "real.txt", "old")
    (tmp_path / "link.txt").symlink_to("real.txt")
    write_atomic(tmp_path / "link.txt", "new")
    assert (tmp_path / "link.txt").is_symlink()
    assert (tmp_path / "real.txt").read_text(encoding="utf-8") == "new"


def test_a_loop_of_links_is_a_diagnostic(tmp_path):
    (tmp_path / "loop").symlink_to("loop")
    with pytest.raises(MissingError, match=r"cannot write .*loop"):
        write_atomic(tmp_path / "loop" / "file.txt", "new")


def test_the_temporary_file_has_the_suffix_and_the_folder(tmp_path):
    with atomic_path(tmp_path / "trace.npz") as temporary:
        assert (temporary.suffix, temporary.parent) == (".npz", tmp_path)
        temporary.write_bytes(b"1")
        assert not (tmp_path / "trace.npz").exists()
    assert (tmp_path / "trace.npz").read_bytes() == b"1"


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_whatever_happens_the_old_file_survives(tmp_path, error):
    write_atomic(tmp_path / "a", "old")

    def interrupted() -> None:
        with atomic_path(tmp_path / "a") as temporary:
            temporary.write_text("half", encoding="utf-8")
            raise error

    with pytest.raises(error):
        interrupted()
    assert (tmp_path / "a").read_text(encoding="utf-8") == "old"
    assert listed(tmp_path) == ["a"]


def test_a_full_disk_is_reported_and_leaves_nothing(tmp_path, monkeypatch):
    write_atomic(tmp_path / "a", "old")

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(files.os, "fsync", full)
    with pytest.raises(MissingError) as caught:
        write_atomic(tmp_path / "a", "new")
    assert finding(caught).code == "R201"
    assert finding(caught).message == f"cannot write `{tmp_path / 'a'}`: no space left on device"
    assert caught.value.exit_code == 5
    assert (tmp_path / "a").read_text(encoding="utf-8") == "old"
    assert listed(tmp_path) == ["a"]


@pytest.mark.skipif(not FULL.exists(), reason="needs /dev/full")
def test_devices_are_written_in_place():
    with pytest.raises(MissingError):
        write_atomic(FULL, "x" * 100_000)
    assert FULL.exists()
    write_atomic(os.devnull, "x")
    assert not Path(os.devnull).is_file()


def test_a_folder_is_not_replaced(tmp_path):
    (tmp_path / "a").mkdir()
    with pytest.raises(MissingError) as caught:
        write_atomic(tmp_path / "a", "x")
    assert finding(caught).code == "R201"
    assert listed(tmp_path) == ["a"]


def test_a_file_in_the_way_of_a_folder(tmp_path):
    (tmp_path / "a").touch()
    with pytest.raises(MissingError):
        write_atomic(tmp_path / "a" / "b", "x")


def test_a_kill_in_the_middle_of_a_save_leaves_the_old_file(tmp_path):
    path = tmp_path / "state"
    write_atomic(path, "old")
    script = (
        "import os, signal, sys\nfrom stlc.files import atomic_path\n"
        "with atomic_path(sys.argv[1]) as temporary:\n"
        "    temporary.write_text('half')\n    os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    done = subprocess.run([sys.executable, "-c", script, str(path)], check=False)
    assert done.returncode == -signal.SIGKILL
    assert path.read_text(encoding="utf-8") == "old"


# ------------------------------------------------------------------------------ finding


@pytest.fixture
def project(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("specs/traffic.stl", "examples/car.yaml", "examples/maze.yml", "specs/own.yaml"):
        write_atomic(name, "")
    return tmp_path


def test_a_system_is_found_as_given_beside_the_spec_and_in_folders_of_systems(project):
    spec = Path("specs/traffic.stl")
    assert find_system("examples/car.yaml") == Path("examples/car.yaml")
    assert find_system("own", spec) == Path("specs/own.yaml")
    assert find_system("car.yaml", spec) == Path("examples/car.yaml")
    assert find_system("maze") == Path("examples/maze.yml")
    write_atomic("systems/maze.yaml", "")
    assert find_system("maze") == Path("systems/maze.yaml")
    assert find_system("../examples/car.yaml", spec) == Path("examples/car.yaml")
    assert find_system(str(project / "examples/car.yaml")) == project / "examples/car.yaml"
    write_atomic("car.yaml", "")
    assert find_system("car.yaml", spec) == Path("car.yaml")


@pytest.mark.usefixtures("project")
def test_an_installed_system_is_found_last(tmp_path, monkeypatch):
    library = tmp_path / "installed"
    write_atomic(library / "ship.yaml", "")
    monkeypatch.setattr(files, "SYSTEMS", library)
    assert find_system("ship") == library / "ship.yaml"


@pytest.mark.usefixtures("project")
def test_an_installed_specification_is_found_last(tmp_path, monkeypatch):
    library = tmp_path / "installed"
    write_atomic(library / "specs/ship.stl", "")
    monkeypatch.setattr(files, "LIBRARY", library)
    monkeypatch.setattr(files, "SPECS", library / "specs")
    for name in ("ship.stl", "specs/ship.stl", Path("specs/ship.stl")):
        assert find_spec(name) == library / "specs/ship.stl"
    for name in ("specs/traffic.stl", "-", "nowhere.stl", "../installed/specs/ship.stl", "a\0b.stl"):
        assert find_spec(name) == Path(name)


@pytest.mark.usefixtures("project")
def test_a_missing_system_says_where_it_looked():
    with pytest.raises(UsageError) as caught:
        find_system("cra.yaml", Path("specs/traffic.stl"))
    told = finding(caught)
    assert (told.code, told.message) == ("U102", "there is no system `cra.yaml`")
    assert told.help == ("did you mean `examples/car.yaml`?",)
    assert told.note == (
        "looked at: cra.yaml, specs/cra.yaml, systems/cra.yaml, examples/cra.yaml, installed: cra.yaml",
    )


@pytest.mark.usefixtures("project")
def test_a_trace_is_found_as_given_and_then_in_the_newest_run():
    write_atomic("runs/traffic/0001/trace.npz", "")
    Path("runs/latest").symlink_to("traffic/0001")
    assert find_trace("trace.npz") == Path("runs/latest/trace.npz")
    write_atomic("trace.npz", "")
    assert find_trace("trace.npz") == Path("trace.npz")
    with pytest.raises(UsageError) as caught:
        find_trace("trase.npz")
    assert finding(caught).help == ("did you mean `trace.npz`?",)
    assert finding(caught).note == ("looked at: trase.npz, runs/latest/trase.npz",)


def test_a_name_that_no_file_can_have():
    with pytest.raises(UsageError) as caught:
        read_source("a\0b.stl")
    assert finding(caught).message == r"no file can be called 'a\x00b.stl'"


def test_patterns_of_names(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("z.csv", "a/1.csv", "a/b/2.csv", "a/b/.3.csv", ".h/x.csv", "a/b/c/[4].csv", "a/t.txt"):
        Path(name).parent.mkdir(parents=True, exist_ok=True)
        Path(name).touch()
    Path("bag").mkdir()
    for name in ("bag/metadata.yaml", "bag/x.db3"):
        Path(name).touch()
    for link in ("a/again", "a/b/again"):  # without end, if links were followed
        Path(link).symlink_to(tmp_path / "a")
    deep = ["a/1.csv", "a/b/2.csv", "a/b/c/[4].csv"]
    assert matching_traces("**/*.csv") == [*deep, "z.csv"]
    assert matching_traces(f"{tmp_path}/a/**/*.csv") == [f"{tmp_path}/{name}" for name in deep]
    assert matching_traces("a/**") == [*deep, "a/t.txt"]
    assert matching_traces("*") == ["bag", "z.csv"]
    assert matching_traces("**/*.db3") == ["bag/x.db3"]
    assert matching_traces("a/b/*/[[]4].csv") == ["a/b/c/[4].csv"]
    assert matching_traces(".h/*.csv") == [".h/x.csv"]
    assert matching_traces("a**/?.csv") == ["a/1.csv"]
    assert has_wildcard("a/*.csv")
    assert not has_wildcard("a/b/c/[4].csv")
    for pattern in ("none/*.csv", "a/**/*.npz"):
        with pytest.raises(UsageError, match="U102: no file matches"):
            matching_traces(pattern)


@pytest.mark.parametrize("codec", ["utf-16", "utf-16-be", "utf-16-le"])
def test_a_text_in_utf_16_is_told_by_name(tmp_path, codec):
    path = tmp_path / "wide.stl"
    mark = "" if codec == "utf-16" else "\ufeff"
    path.write_bytes((mark + "signal x\n").encode(codec))
    with pytest.raises(SpecError) as caught:
        read_source(path)
    assert "is UTF-16" in finding(caught).message
    assert "UTF-8" in finding(caught).help[0]


@pytest.mark.parametrize("name", ["tank.yaml", "my tank.yml", "-x.yaml"])
def test_a_system_file_is_no_specification(name):
    with pytest.raises(UsageError) as caught:
        files.find_spec(name)
    assert "is a system file" in finding(caught).message
    option, word = shlex.split(finding(caught).help[0].partition(", and ")[2])
    assert (option, word) == ("--system", name if not name.startswith("-") else f"./{name}")


# ------------------------------------------------------------------ regular files, within a folder


def test_what_could_wait_or_never_end_is_not_read(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.stl")
    for name, noun in (("pipe.stl", "a pipe"), ("/dev/zero", "a device"), (".", "a folder")):
        with pytest.raises(UsageError, match=f"cannot read .*it is {noun}"):
            read_source(tmp_path / name)
    (tmp_path / "main.stl").write_text('import "pipe.stl" as p\nsignal x\nrequire r: x > 0\n')
    from stlc.compile.frontend.modules import library_of
    from stlc.grammar.parser import parse

    with pytest.raises(SpecError, match="it is a pipe"):
        library_of(parse(read_source(tmp_path / "main.stl")))


def test_a_pipe_of_the_shell_is_read() -> None:
    reader, writer = os.pipe()
    with os.fdopen(writer, "w") as end:
        end.write("spec piped\n")
    try:
        assert read_source(f"/dev/fd/{reader}").text == "spec piped\n"
    finally:
        os.close(reader)


def test_a_name_in_a_run_stays_in_its_folder(tmp_path: Path) -> None:
    root, outside = tmp_path / "run", tmp_path / "outside"
    for path in (root / "sub/a.py", root / "b.py", outside / "a.py", outside / "c.py"):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    text = Source(str(root / "system.yaml"), "", root=str(root))
    assert named_in(text, "sub/a.py") == root / "sub/a.py"
    assert named_in(text, "../outside/b.py") == named_in(text, str(outside / "b.py")) == root / "b.py"
    assert named_in(text, "../outside/c.py") == root / "c.py"  # which does not exist
    (root / "c.py").symlink_to(outside / "c.py")
    (root / "far").symlink_to(outside)
    for name in ("c.py", "../outside/c.py", "far/a.py", "..", "sub"):
        with pytest.raises(RunError, match="R110"):
            named_in(text, name)
    free = Source(str(root / "system.yaml"), "")
    assert named_in(free, "../outside/c.py").resolve() == outside / "c.py"


@pytest.mark.parametrize("name", ["../x", "/x", "a/../../x", "", "a\0b"])
def test_a_name_that_leads_out_is_refused(tmp_path: Path, name: str) -> None:
    for door in (within, place):
        with pytest.raises(RunError, match="leads out of the folder"):
            door(tmp_path, name)


def test_nothing_is_written_where_a_link_leads(tmp_path: Path) -> None:
    root, outside = tmp_path / "run", tmp_path / "outside"
    root.mkdir()
    outside.mkdir()
    (outside / "keys").write_text("mine")
    (root / "report.html").symlink_to(outside / "keys")
    (root / "new").symlink_to(outside / "new")
    (root / "eval").symlink_to(outside)
    os.mkfifo(root / "pipe")
    for name in ("report.html", "new", "pipe", "deep/er/file"):
        write_atomic(place(root, name), "content")
        assert not (root / name).is_symlink()
        assert (root / name).read_text() == "content"
    with pytest.raises(RunError, match="it is a link"):
        place(root, "eval/simulate.json")
    assert [path.name for path in outside.iterdir()] == ["keys"]
    assert (outside / "keys").read_text() == "mine"


def test_a_file_of_a_run_has_a_largest_size(tmp_path: Path) -> None:
    (tmp_path / "x").touch()
    os.truncate(tmp_path / "x", 10**12)
    with pytest.raises(RunError, match="larger than 3 MB"):
        within(tmp_path, "x", 3_000_000)
    with pytest.raises(OSError, match="larger than 3 MB"):
        read_regular(tmp_path / "x", 3_000_000)
