"""The boundary of the program: whatever happens becomes a message and the right exit code."""

from __future__ import annotations

import errno
import functools
import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Annotated

import pytest
import typer
from helpers.documents import misfits

from stlc.cli.commands.schema import load_schema
from stlc.cli.framework.app import PROGRAM, main
from stlc.cli.framework.program import Program
from stlc.diagnostics import (
    Diagnostic,
    MissingError,
    RunError,
    SpecError,
    StlcError,
    SystemFileError,
    TraceError,
    usage,
)
from stlc.version import __version__

COMMANDS = (
    *("train", "simulate", "plan", "check", "explain", "plot", "report", "runs"),
    *("init", "lint", "fmt", "compile", "system", "lsp", "schema", "doctor", "help"),
    *("export", "certify", "falsify", "verify"),
)
HEAVY = {"torch", "numpy", "matplotlib", "lark", "yaml", "rich"}


@pytest.fixture
def boundary(monkeypatch, tmp_path):
    """Run `main` on a program whose only command does what it is told; crash reports land in `tmp_path`."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))

    def run(action, *options):
        fake = typer.Typer(rich_markup_mode=None, pretty_exceptions_enable=False)

        @fake.callback()
        def _program() -> None: ...

        @fake.command()
        def act(as_json: Annotated[bool, typer.Option("--json")] = False) -> None:
            action()
            assert not as_json

        monkeypatch.setattr(Program, "parser", lambda _self, _name: typer.main.get_command(fake))
        return main(["act", *options])

    return run


def fail(error):
    def action():
        raise error

    return action


def os_error(number, path=None):
    return OSError(number, os.strerror(number), path)


FAILURES = {
    "spec": (SpecError(Diagnostic("E203", "units")), 3, "E203"),
    "system": (SystemFileError(Diagnostic("S101", "key")), 3, "S101"),
    "trace": (TraceError(Diagnostic("E601", "lacks")), 3, "E601"),
    "run": (RunError(Diagnostic("R102", "other")), 3, "R102"),
    "usage": (usage("gone", code="U102"), 2, "U102"),
    "missing": (MissingError(Diagnostic("R301", "no")), 5, "R301"),
    "bad parameter": (typer.BadParameter("too large"), 2, "U101"),
    "disk full": (os_error(errno.ENOSPC, "a.npz"), 5, "R201"),
    "read-only": (os_error(errno.EROFS, "a.npz"), 5, "R201"),
    "not allowed": (os_error(errno.EACCES, "a.npz"), 5, "R201"),
    "no file": (os_error(errno.ENOENT, "a.npz"), 2, "U102"),
    "a folder": (os_error(errno.EISDIR, "a.npz"), 2, "U102"),
    "memory": (MemoryError(), 5, "R202"),
    "an extra": (ModuleNotFoundError("No module named 'matplotlib'", name="matplotlib.pyplot"), 5, "R301"),
    "our own module": (ModuleNotFoundError("No module named 'stlc.x'", name="stlc.x"), 70, "B001"),
    "division": (ZeroDivisionError("division by zero"), 70, "B001"),
    "assertion": (AssertionError(), 70, "B001"),
    "end of file": (EOFError(), 70, "B001"),
    "recursion": (RecursionError("too deep"), 70, "B001"),
    "socket": (os_error(errno.ECONNREFUSED), 70, "B001"),
}


@pytest.mark.parametrize(("error", "exit_code", "code"), FAILURES.values(), ids=FAILURES)
def test_failures_are_told_on_stderr(boundary, capsys, error, exit_code, code):
    assert boundary(fail(error)) == exit_code
    out, err = capsys.readouterr()
    assert out == ""
    assert f"error[{code}]" in err
    assert "Traceback" not in err


@pytest.mark.parametrize(("error", "exit_code", "code"), FAILURES.values(), ids=FAILURES)
def test_failures_are_one_json_document(boundary, capsys, error, exit_code, code):
    assert boundary(fail(error), "--json") == exit_code
    out, err = capsys.readouterr()
    document = json.loads(out)
    assert err.strip() == ""
    assert document["schema"] == "stlc/1"
    assert document["stlc"] == __version__
    assert (document["ok"], document["exit_code"], document["result"]) == (False, exit_code, None)
    assert [finding["code"] for finding in document["diagnostics"]] == [code]


def test_all_findings_are_shown(boundary, capsys):
    error = StlcError(Diagnostic("E101", "first"), Diagnostic("W304", "second"))
    assert boundary(fail(error)) == 3
    err = capsys.readouterr().err
    assert "error[E101]: first" in err
    assert "warning[W304]: second" in err


def test_a_crash_leaves_a_report(boundary, capsys, tmp_path):
    assert boundary(fail(ZeroDivisionError("division by zero")), "--json") == 70
    (report,) = tmp_path.glob("stlc-crash-*.txt")
    assert str(report) in capsys.readouterr().out
    text = report.read_text()
    assert "command   stlc act --json" in text
    assert "Traceback (most recent call last)" in text
    assert "ZeroDivisionError: division by zero" in text


def test_a_crash_without_room_for_a_report_still_exits_70(boundary, capsys, monkeypatch, tmp_path):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "gone"))
    assert boundary(fail(ZeroDivisionError())) == 70
    assert "no crash report could be written" in capsys.readouterr().err


@pytest.mark.parametrize("code", [0, 1, 4])
def test_exit_codes_of_commands_come_out(boundary, capsys, code):
    assert boundary(fail(typer.Exit(code))) == code
    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("error", "code"),
    [(KeyboardInterrupt(), 130), (typer.Abort(), 130), (SystemExit(143), 143), (SystemExit(None), 0)],
)
def test_interruptions(boundary, capsys, error, code):
    assert boundary(fail(error)) == code
    assert "Traceback" not in capsys.readouterr().err


def test_sigterm_unwinds_and_exits_143(boundary):
    unwound = []

    def action():
        try:
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(5)
        finally:
            unwound.append(True)

    before = signal.getsignal(signal.SIGTERM)
    assert boundary(action) == 143
    assert unwound == [True]
    assert signal.getsignal(signal.SIGTERM) is before


def test_ctrl_c_that_surfaces_as_another_error_is_one(boundary, capsys):
    def action():
        try:
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(5)
        except KeyboardInterrupt:
            raise ImportError("numpy.core.multiarray failed to import") from None

    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        assert boundary(action, "--json") == 130
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)
    out, err = capsys.readouterr()
    assert (json.loads(out)["exit_code"], json.loads(out)["schema"], err) == (130, "stlc/1", "")


# ---------------------------------------------------------------------- the real program


@pytest.fixture(scope="module")
def a_whole_run(tmp_path_factory):
    """Seconds that a command takes that imports much and then finds nothing to do."""
    begun = time.monotonic()
    with _started(*_importing(tmp_path_factory.mktemp("whole"))) as whole:
        assert whole.wait(timeout=60) == 2
    return time.monotonic() - begun


@pytest.mark.apart
@pytest.mark.parametrize("share", [pytest.param(0.3, marks=pytest.mark.slow), 0.8])
def test_ctrl_c_at_any_time_of_the_imports(share, tmp_path, a_whole_run):
    with _started(*_importing(tmp_path)) as process:
        time.sleep(share * a_whole_run * 0.5)
        process.send_signal(signal.SIGINT)
        code = process.wait(timeout=60)
        said = process.stderr.read()
    assert "Traceback" not in said
    assert "B001" not in said
    assert code in (130, 2)
    assert list(tmp_path.iterdir()) == []


def _importing(folder):
    words = [sys.executable, "-c", "print(flush=True)\nfrom stlc.__main__ import main\nexit(main())"]
    return [*words, "simulate", "none", "--runs", str(folder)], {**os.environ, "TMPDIR": str(folder)}


def _started(words, environment):
    """A process that has begun to run its first line."""
    pipe = subprocess.PIPE
    heard = functools.partial(
        signal.signal, signal.SIGINT, signal.SIG_DFL
    )  # a shell's `&` lets it be ignored
    process = subprocess.Popen(words, stdout=pipe, stderr=pipe, text=True, env=environment, preexec_fn=heard)
    process.stdout.readline()
    return process


def stlc(*arguments, **options):
    environment = {**os.environ, "COLUMNS": "100"}
    return subprocess.run(
        [sys.executable, "-m", "stlc", *arguments],
        text=True,
        env=environment,
        timeout=60,
        check=False,
        **options,
    )


def test_version(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"stlc {__version__}\n"


@pytest.mark.parametrize("flag", ["-h", "--help"])
def test_help_opens_with_a_sentence_and_examples(capsys, flag):
    assert main([flag]) == 0
    out = capsys.readouterr().out
    assert out.splitlines()[2].strip().startswith("Train, check and guard controllers")
    assert "\n    stlc check trace.npz\n" in out
    for name in COMMANDS:
        assert f"\n  {name} " in out


@pytest.mark.parametrize("group", [[], ["runs"], ["system"]])
def test_sentences_of_a_list_of_commands_are_whole(capsys, group):
    assert main([*group, "--help"]) == 0
    listed = capsys.readouterr().out.partition("\nCommands:\n")[2].splitlines()
    assert [line for line in listed if not line.endswith(".") or line.endswith("...")] == []


@pytest.mark.parametrize("group", [[], ["system"]])
def test_nothing_asked_shows_the_help(capsys, group):
    assert main(group) == 2
    out, err = capsys.readouterr()
    assert out.startswith(f"Usage: {' '.join(['stlc', *group])} ")
    assert ("\nCommands:\n" if group else "\nControllers:\n") in out
    assert err == ""


@pytest.mark.parametrize("arguments", [["chek", "t.npz"], ["schema", "none"], ["--none"]])
def test_a_document_of_no_schema_of_its_own(capsys, arguments):
    assert main([*arguments, "--json"]) == 2
    document = json.loads(capsys.readouterr().out)
    assert document["schema"] == "stlc/1"
    assert misfits(document, load_schema("stlc/1")) == []


@pytest.mark.parametrize(
    ("arguments", "command", "message"),
    [
        (["chek"], "stlc", "no such command 'chek'"),
        (["check", "--nonsense", "--json"], "stlc check", "no such option: --nonsense"),
        (["compile", "--json"], "stlc compile", "missing argument 'SPEC'"),
        (["--color", "sometimes", "check"], "stlc", "'sometimes'"),
        (
            ["check", "t.npz", "--end", "soon"],
            "stlc check",
            "invalid value for '--end': 'soon' is not one of",
        ),
    ],
)
def test_usage_errors(capsys, arguments, command, message):
    assert main(arguments) == 2
    out, err = capsys.readouterr()
    if "--json" in arguments:
        (finding,) = json.loads(out)["diagnostics"]
        assert finding["code"] == "U101"
        assert message in finding["message"]
        assert finding["help"] == [f"{command} --help"]
        assert json.loads(out)["schema"] == f"{arguments[0]}/1"
    else:
        assert message in err
        assert f"{command} --help" in err


def test_color_may_stand_anywhere(capsys):
    assert main(["check", "no-such.npz", "--color", "always"]) == 2
    assert "\x1b[" in capsys.readouterr().err
    assert main(["--color=never", "check", "no-such.npz"]) == 2
    assert "\x1b[" not in capsys.readouterr().err


@pytest.mark.parametrize("command", COMMANDS)
def test_commands_open_their_help_with_a_sentence_and_an_example(capsys, command):
    assert main([command, "--help"]) == 0
    lines = [line.strip() for line in capsys.readouterr().out.splitlines()]
    assert lines[0].startswith(f"Usage: stlc {command}")
    assert lines[2][0].isupper()
    heading = next(i for i, line in enumerate(lines) if line in ("Example:", "Examples:"))
    assert lines[heading + 1].startswith(f"stlc {command}")
    assert heading < lines.index("Options:")


def test_a_reader_that_goes_away_is_no_error():
    read, write = os.pipe()
    os.close(read)
    done = stlc("--help", stdout=write, stderr=subprocess.PIPE)
    os.close(write)
    assert done.returncode == 0
    assert done.stderr == ""


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_standard_output_is_the_environments_fault():
    with open("/dev/full", "w") as full:  # noqa: PTH123
        done = stlc("--version", stdout=full, stderr=subprocess.PIPE)
    assert done.returncode == 5
    assert "error[R201]" in done.stderr
    assert "Exception ignored" not in done.stderr


def test_a_closed_standard_output_is_no_error():
    done = subprocess.run(
        f"'{sys.executable}' -m stlc --version >&-", shell=True, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")


# ---------------------------------------------------------------------- what help costs


def imported_by(*commands):
    """Modules that a process imports for these commands, one after the other."""
    program = (
        "import json, sys; from stlc.cli.framework.app import main\n"
        "for words in json.loads(sys.argv[1]): main(words)\n"
        "print(*sys.modules, file=sys.stderr)"
    )
    words = [sys.executable, "-c", program, json.dumps(commands)]
    done = subprocess.run(words, capture_output=True, text=True, check=True)
    return {*done.stderr.split()}


def test_help_imports_nothing_heavy():
    assert not {"stlc.grammar", "stlc.units", "stlc.compile.ir"} & imported_by(("--help",))
    assert not imported_by(*((name, "--help") for name in COMMANDS)) & HEAVY


@pytest.mark.bench
def test_help_is_fast():
    seconds = []
    for _ in range(5):
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        stlc("--help", stdout=subprocess.DEVNULL)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        seconds.append(after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime)
    assert min(seconds) < 0.25, f"{min(seconds):.3f} s of CPU time"


def test_every_command_is_there():
    assert set(PROGRAM.names()) == set(COMMANDS)
    assert set(typer.main.get_command(PROGRAM.made()).commands) == set(COMMANDS)


@pytest.mark.parametrize(("name", "instead"), [("bench", "python -m benchmarks"), ("parse", "--show ast")])
def test_a_command_that_moved_says_where(name, instead, capsys):
    assert main([name, "--any"]) == 2
    err = capsys.readouterr().err
    assert f"there is no command `{name}`" in err
    assert instead in err


def test_quiet_leaves_results_and_errors(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a.stl").write_text("signal x [m]\nrequire low: x < 3 m\n")
    assert main(["fmt", "a.stl", "-q"]) == 0
    assert capsys.readouterr() == ("", "")
    assert main(["--quiet", "lint", "b.stl"]) == 2
    assert "b.stl" in capsys.readouterr().err
    assert main(["lint", "a.stl", "--json", "-q"]) == 0
    assert json.loads(capsys.readouterr().out)["ok"]
    assert main(["fmt", "a.stl"]) == 0
    assert capsys.readouterr().err


def test_help_is_a_command(capsys):
    for words in ([], ["lint"], ["runs", "list"]):
        assert main(["help", *words]) == main([*words, "--help"]) == 0
        first, second = capsys.readouterr().out.split("Usage: ")[1:]
        assert first.rstrip() == second.rstrip()


def test_ctrl_c_prints_one_json_document(boundary, capsys):
    """The parser turns Ctrl-C into an exit code of its own."""

    def action():
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(5)

    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        assert boundary(action, "--json") == 130
    finally:
        signal.signal(signal.SIGINT, before)
    out, err = capsys.readouterr()
    assert (json.loads(out)["exit_code"], err) == (130, "")


@pytest.mark.apart
@pytest.mark.parametrize("closed", ["stdin", "stdout", "stderr"])
def test_closed_streams_are_no_bug(closed, tmp_path):
    (tmp_path / "s.stl").write_text("signal a\nrequire low: always a < 2\n")
    (tmp_path / "a.csv").write_text("t,a\n0,1\n0.1,1\n")
    number = {"stdin": "0<&-", "stdout": ">&-", "stderr": "2>&-"}[closed]
    words = f'"{sys.executable}" -m stlc check s.stl a.csv'
    for more in ("", " --json"):
        line = ["sh", "-c", f"{words}{more} {number}"]
        assert subprocess.run(line, cwd=tmp_path, check=False, capture_output=True).returncode == 0
