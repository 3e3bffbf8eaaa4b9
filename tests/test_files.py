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
from stlc.files import File, named_in, place, read_regular, within
from stlc.grammar.spec import Spec
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
    source = File("a.stl").read()
    assert (source.name, source.text) == ("a.stl", "spec a\n# größe\n")


def test_the_standard_input_is_a_file_too(monkeypatch):
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(b"spec a")))
    source = File("-").read()
    assert (source.name, source.text) == ("<stdin>", "spec a")


def test_a_missing_file(tmp_path):
    (tmp_path / "traffic.stl").touch()
    with pytest.raises(UsageError) as caught:
        File(tmp_path / "trafic.stl").read()
    assert finding(caught).code == "U102"
    assert finding(caught).help == (f"did you mean `{tmp_path / 'traffic.stl'}`?",)


def test_a_missing_folder_and_a_folder_for_a_file(tmp_path):
    for path in (tmp_path / "no" / "a.stl", tmp_path):
        with pytest.raises(UsageError) as caught:
            File(path).read()
        assert finding(caught).code == "U102"


def test_an_ascii_mesh_is_shown(tmp_path):
    path = tmp_path / "part.stl"
    path.write_text("solid bracket_v2\n  facet normal 0 0 1\n    outer loop\n", encoding="ascii")
    with pytest.raises(SpecError) as caught:
        File(path).read()
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
    assert File(path).read().text.startswith("# solid")


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
        File(path).read()
    assert finding(caught).code == "E003"
    assert says in finding(caught).message


def test_a_large_file_is_not_read(tmp_path):
    path = tmp_path / "a.stl"
    with path.open("wb") as file:
        file.truncate(File.MAX_BYTES + 1)
    with pytest.raises(SpecError) as caught:
        File(path).read()
    assert finding(caught).code == "E005"


# ------------------------------------------------------------------------------ writing


def listed(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_texts_and_bytes_are_written_whole(tmp_path):
    path = tmp_path / "new" / "folder" / "a.json"
    File(path).write("größe")
    assert path.read_text(encoding="utf-8") == "größe"
    File(str(path)).write(b"\x00\x01")
    assert path.read_bytes() == b"\x00\x01"
    assert listed(path.parent) == ["a.json"]


def test_a_file_is_readable_as_the_user_wants_it(tmp_path):
    before = os.umask(0o027)
    try:
        File(tmp_path / "a").write("x")
    finally:
        os.umask(before)
    assert (tmp_path / "a").stat().st_mode & 0o777 == 0o640


@pytest.mark.parametrize("mode", [0o600, 0o640, 0o444, 0o755])
def test_a_file_that_is_replaced_keeps_its_permissions(tmp_path, mode):
    path = tmp_path / "a"
    path.write_text("old")
    path.chmod(mode)
    with File(path).replaced() as temporary:
        assert temporary.stat().st_mode & 0o077 == 0
        temporary.write_text("new")
    assert path.read_text() == "new"
    assert path.stat().st_mode & 0o777 == mode


def test_a_link_is_written_through(tmp_path):
    File(tmp_path / "real.txt").write("old")
    (tmp_path / "link.txt").symlink_to("real.txt")
    File(tmp_path / "link.txt").write("new")
    assert (tmp_path / "link.txt").is_symlink()
    assert (tmp_path / "real.txt").read_text(encoding="utf-8") == "new"


def test_a_loop_of_links_is_a_diagnostic(tmp_path):
    (tmp_path / "loop").symlink_to("loop")
    with pytest.raises(MissingError, match=r"cannot write .*loop"):
        File(tmp_path / "loop" / "file.txt").write("new")


def test_the_temporary_file_has_the_suffix_and_the_folder(tmp_path):
    with File(tmp_path / "trace.npz").replaced() as temporary:
        assert (temporary.suffix, temporary.parent) == (".npz", tmp_path)
        temporary.write_bytes(b"1")
        assert not (tmp_path / "trace.npz").exists()
    assert (tmp_path / "trace.npz").read_bytes() == b"1"


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_whatever_happens_the_old_file_survives(tmp_path, error):
    File(tmp_path / "a").write("old")

    def interrupted() -> None:
        with File(tmp_path / "a").replaced() as temporary:
            temporary.write_text("half", encoding="utf-8")
            raise error

    with pytest.raises(error):
        interrupted()
    assert (tmp_path / "a").read_text(encoding="utf-8") == "old"
    assert listed(tmp_path) == ["a"]


def test_a_full_disk_is_reported_and_leaves_nothing(tmp_path, monkeypatch):
    File(tmp_path / "a").write("old")

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(files.os, "fsync", full)
    with pytest.raises(MissingError) as caught:
        File(tmp_path / "a").write("new")
    assert finding(caught).code == "R201"
    assert finding(caught).message == f"cannot write `{tmp_path / 'a'}`: no space left on device"
    assert caught.value.exit_code == 5
    assert (tmp_path / "a").read_text(encoding="utf-8") == "old"
    assert listed(tmp_path) == ["a"]


@pytest.mark.skipif(not FULL.exists(), reason="needs /dev/full")
def test_devices_are_written_in_place():
    with pytest.raises(MissingError):
        File(FULL).write("x" * 100_000)
    assert FULL.exists()
    File(os.devnull).write("x")
    assert not Path(os.devnull).is_file()


def test_a_folder_is_not_replaced(tmp_path):
    (tmp_path / "a").mkdir()
    with pytest.raises(MissingError) as caught:
        File(tmp_path / "a").write("x")
    assert finding(caught).code == "R201"
    assert listed(tmp_path) == ["a"]


def test_a_file_in_the_way_of_a_folder(tmp_path):
    (tmp_path / "a").touch()
    with pytest.raises(MissingError):
        File(tmp_path / "a" / "b").write("x")


def test_a_kill_in_the_middle_of_a_save_leaves_the_old_file(tmp_path):
    path = tmp_path / "state"
    File(path).write("old")
    script = (
        "import os, signal, sys\nfrom stlc.files import File\n"
        "with File(sys.argv[1]).replaced() as temporary:\n"
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
        File(name).write("")
    return tmp_path


def test_a_system_is_found_as_given_beside_the_spec_and_in_folders_of_systems(project):
    spec = Path("specs/traffic.stl")
    assert File("examples/car.yaml").system() == Path("examples/car.yaml")
    assert File("own").system(spec) == Path("specs/own.yaml")
    assert File("car.yaml").system(spec) == Path("examples/car.yaml")
    assert File("maze").system() == Path("examples/maze.yml")
    File("systems/maze.yaml").write("")
    assert File("maze").system() == Path("systems/maze.yaml")
    assert File("../examples/car.yaml").system(spec) == Path("examples/car.yaml")
    assert File(str(project / "examples/car.yaml")).system() == project / "examples/car.yaml"
    File("car.yaml").write("")
    assert File("car.yaml").system(spec) == Path("car.yaml")


@pytest.mark.usefixtures("project")
def test_an_installed_system_is_found_last(tmp_path, monkeypatch):
    library = tmp_path / "installed"
    File(library / "ship.yaml").write("")
    monkeypatch.setattr(File, "SYSTEMS", library)
    assert File("ship").system() == library / "ship.yaml"


@pytest.mark.usefixtures("project")
def test_an_installed_specification_is_found_last(tmp_path, monkeypatch):
    library = tmp_path / "installed"
    File(library / "specs/ship.stl").write("")
    monkeypatch.setattr(files, "LIBRARY", library)
    monkeypatch.setattr(File, "SPECS", library / "specs")
    for name in ("ship.stl", "specs/ship.stl", Path("specs/ship.stl")):
        assert File(name).spec() == library / "specs/ship.stl"
    for name in ("specs/traffic.stl", "-", "nowhere.stl", "../installed/specs/ship.stl", "a\0b.stl"):
        assert File(name).spec() == Path(name)


@pytest.mark.usefixtures("project")
def test_a_missing_system_says_where_it_looked():
    with pytest.raises(UsageError) as caught:
        File("cra.yaml").system(Path("specs/traffic.stl"))
    told = finding(caught)
    assert (told.code, told.message) == ("U102", "there is no system `cra.yaml`")
    assert told.help == ("did you mean `examples/car.yaml`?",)
    assert told.note == (
        "looked at: cra.yaml, specs/cra.yaml, systems/cra.yaml, examples/cra.yaml, installed: cra.yaml",
    )


@pytest.mark.usefixtures("project")
def test_a_trace_is_found_as_given_and_then_in_the_newest_run():
    File("runs/traffic/0001/trace.npz").write("")
    Path("runs/latest").symlink_to("traffic/0001")
    assert File("trace.npz").trace() == Path("runs/latest/trace.npz")
    File("trace.npz").write("")
    assert File("trace.npz").trace() == Path("trace.npz")
    with pytest.raises(UsageError) as caught:
        File("trase.npz").trace()
    assert finding(caught).help == ("did you mean `trace.npz`?",)
    assert finding(caught).note == ("looked at: trase.npz, runs/latest/trase.npz",)


def test_a_name_that_no_file_can_have():
    with pytest.raises(UsageError) as caught:
        File("a\0b.stl").read()
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
    assert File("**/*.csv").matches() == [*deep, "z.csv"]
    assert File(f"{tmp_path}/a/**/*.csv").matches() == [f"{tmp_path}/{name}" for name in deep]
    assert File("a/**").matches() == [*deep, "a/t.txt"]
    assert File("*").matches() == ["bag", "z.csv"]
    assert File("**/*.db3").matches() == ["bag/x.db3"]
    assert File("a/b/*/[[]4].csv").matches() == ["a/b/c/[4].csv"]
    assert File(".h/*.csv").matches() == [".h/x.csv"]
    assert File("a**/?.csv").matches() == ["a/1.csv"]
    assert File("a/*.csv").is_pattern
    assert not File("a/b/c/[4].csv").is_pattern
    for pattern in ("none/*.csv", "a/**/*.npz"):
        with pytest.raises(UsageError, match="U102: no file matches"):
            File(pattern).matches()


@pytest.mark.parametrize("codec", ["utf-16", "utf-16-be", "utf-16-le"])
def test_a_text_in_utf_16_is_told_by_name(tmp_path, codec):
    path = tmp_path / "wide.stl"
    mark = "" if codec == "utf-16" else "\ufeff"
    path.write_bytes((mark + "signal x\n").encode(codec))
    with pytest.raises(SpecError) as caught:
        File(path).read()
    assert "is UTF-16" in finding(caught).message
    assert "UTF-8" in finding(caught).help[0]


@pytest.mark.parametrize("name", ["tank.yaml", "my tank.yml", "-x.yaml"])
def test_a_system_file_is_no_specification(name):
    with pytest.raises(UsageError) as caught:
        File(name).spec()
    assert "is a system file" in finding(caught).message
    option, word = shlex.split(finding(caught).help[0].partition(", and ")[2])
    assert (option, word) == ("--system", name if not name.startswith("-") else f"./{name}")


# ------------------------------------------------------------------ regular files, within a folder


def test_what_could_wait_or_never_end_is_not_read(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.stl")
    for name, noun in (("pipe.stl", "a pipe"), ("/dev/zero", "a device"), (".", "a folder")):
        with pytest.raises(UsageError, match=f"cannot read .*it is {noun}"):
            File(tmp_path / name).read()
    (tmp_path / "main.stl").write_text('import "pipe.stl" as p\nsignal x\nrequire r: x > 0\n')

    with pytest.raises(SpecError, match="it is a pipe"):
        Spec.parse(File(tmp_path / "main.stl").read()).imported_texts()


def test_a_pipe_of_the_shell_is_read() -> None:
    reader, writer = os.pipe()
    with os.fdopen(writer, "w") as end:
        end.write("spec piped\n")
    try:
        assert File(f"/dev/fd/{reader}").read().text == "spec piped\n"
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
        File(place(root, name)).write("content")
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
