"""Every code has a page, its wrong example gives that code, its right one does not."""

from __future__ import annotations

import functools
import json
import os
import re
import shlex
import shutil
from contextlib import ExitStack
from datetime import timedelta
from pathlib import Path

import pytest
from helpers.exported import exported
from helpers.several import ENVIRONMENT, free_port

from stlc.cli.framework.app import main
from stlc.controller.training.config import TrainConfig
from stlc.diagnostics import CODES, StlcError
from stlc.grammar.manual import FOLDER, Example, Page
from stlc.grammar.tables import load_parser
from stlc.rundir import RunDir

ROOT = Path(__file__).resolve().parents[3]
PAGES = {code: Page.read(code) for code in CODES}


def having(page: Page, note: str) -> tuple[Example, ...]:
    """The examples of a page whose notes include `note`."""
    return tuple(example for example in page.examples if note in example.notes)


OPTIONAL = {"W302"}
SOURCES = "".join(path.read_text() for path in (ROOT / "stlc").rglob("*.py") if path.name != "diagnostics.py")
GIVEN = [code for code in CODES if re.search(rf'"{code}"', SOURCES)]


def examples(*languages: str) -> list[pytest.param]:
    return [
        pytest.param(code, example, id=f"{code}-{'-'.join(example.notes)}-{number}")
        for code, page in PAGES.items()
        if page and code in GIVEN
        for number, example in enumerate(page.examples)
        if example.language in languages and {"wrong", "right"} & set(example.notes)
    ]


def test_every_code_has_a_page_with_both_examples():
    for code, page in PAGES.items():
        assert page is not None, f"write stlc/pages/{code}.md"
        assert page.title == f"{code}: {CODES[code]}"
        assert having(page, "wrong"), code
        assert having(page, "right"), code
        assert max(map(len, page.text.splitlines())) <= 150, code


def test_no_page_is_about_nothing():
    assert {path.stem for path in FOLDER.glob("*.md")} == {*CODES, "precedence"}


def codes_of(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, set[str]]:
    code = main([*words, "--json"])
    found = json.loads(capsys.readouterr().out)
    return code, {finding["code"] for finding in found["diagnostics"]}


def judge(example: Example, code: str, found: set[str]) -> None:
    if "wrong" in example.notes:
        assert code in found
    else:
        assert not found


# ---------------------------------------------------------------------- specifications


@pytest.mark.parametrize(("code", "example"), examples("stl"))
def test_a_specification(code, example, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(ROOT)
    path = tmp_path / "example.stl"
    path.write_text(example.body)
    options = ["--system", "car.yaml"] if "car.yaml" in example.notes else []
    _, found = codes_of(capsys, "lint", str(path), *options)
    if code in OPTIONAL:
        assert not found
        _, found = codes_of(capsys, "lint", str(path), "--select", code)
    judge(example, code, found)
    if "wrong" in example.notes:
        assert found == {code}


# ---------------------------------------------------------------------- systems, traces


@pytest.mark.parametrize(("code", "example"), examples("yaml"))
def test_a_system(code, example, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("cart.yaml").write_text(example.body)
    _, found = codes_of(capsys, "system", "check", "cart.yaml")
    judge(example, code, found)


@pytest.mark.parametrize(("code", "example"), examples("plant"))
def test_a_plant(code, example, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (program,) = having(PAGES[code], "file")
    Path("ball.py").write_text(program.body)
    Path("ball.yaml").write_text(example.body)
    Path("above.stl").write_text("signal height: real [m]\nrequire above: always[0 s, 1 s] height >= 0 m\n")
    _, found = codes_of(capsys, "simulate", "above.stl", "--plant", "ball.yaml", "--seeds", "0")
    judge(example, code, found)


@pytest.mark.parametrize(("code", "example"), examples("csv"))
def test_a_trace(code, example, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (spec,) = having(PAGES[code], "spec")
    Path("near.stl").write_text(spec.body)
    Path("drive.csv").write_text(example.body)
    if code.startswith("W"):  # a fact or a warning about the recording; others may be true too
        _, found = codes_of(capsys, "lint", "near.stl", "--trace", "drive.csv", "--select", code)
    else:
        exit_code, found = codes_of(capsys, "check", "near.stl", "drive.csv")
        assert exit_code == (3 if "wrong" in example.notes else 0)
    judge(example, code, found)


# ---------------------------------------------------------------------- programs


@pytest.mark.apart
@pytest.mark.parametrize(("code", "example"), examples("py"))
def test_a_program(code, example, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    if "controller" in example.body or "torn" in example.body:
        for name in ("controller", "torn"):
            shutil.copytree(exported("traffic", "car")[1], name)
        Path("torn/judge.onnx").unlink()
    program = compile(example.body, f"{code}.md", "exec")
    if "right" in example.notes:
        exec(program, {})
        return
    with pytest.raises(StlcError) as caught:
        exec(program, {})
    assert [finding.code for finding in caught.value.diagnostics] == [code]


# ---------------------------------------------------------------------- runs, commands, bugs

WORLD = "from stlc.controller.world import ModelWorld\n\n\nclass Yard(ModelWorld):\n    pass\n"


def quicken(patch: pytest.MonkeyPatch) -> None:
    """Judge fewer states and decisions than a run is worth: only what is said matters here."""
    patch.setattr("stlc.controller.training.config.TrainConfig", functools.partial(TrainConfig, held_out=64))
    patch.setattr("stlc.controller.training.learner.MARGIN_STATES", 16)


@pytest.fixture(scope="module")
def project(tmp_path_factory):
    """A project with a run that has been trained for a moment and driven once."""
    folder = tmp_path_factory.mktemp("project")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        quicken(patch)
        assert main(["init"]) == 0
        system = Path("systems/cart.yaml")
        world = 'test: {world: "yard.py:Yard", agents: 2, steps: 5}\ntrain: {steps: 20, batch: 32}\n'
        system.write_text(system.read_text() + world)
        Path("systems/yard.py").write_text(WORLD)
        assert main(["train", "specs/cart.stl", "--name", "first", "--no-pictures"]) == 0
        assert main(["simulate", "first", "--seeds", "0..1", "--no-pictures", "--record", "trace.npz"]) == 0
        assert main(["certify", "first", "--seeds", "0..19", "--share", ".01"]) in (0, 1, 4)
        for name in ("changed", "broken"):
            shutil.copytree("runs/cart/0001-first", f"runs/cart/0002-{name}")
        edited = Path("runs/cart/0002-changed/spec.stl")
        edited.write_text(edited.read_text().replace("1.5 m/s", "1.4 m/s"))
        Path("near.stl").write_text(having(PAGES["E311"], "spec")[0].body)
        Path("drive.csv").write_text(next(e.body for e in PAGES["E311"].examples if e.language == "csv"))
        shutil.copy("systems/cart.yaml", "cart.yaml")
        shutil.copy("systems/yard.py", "yard.py")
    return folder


@pytest.fixture
def there(project, tmp_path, monkeypatch, capsys):
    """A copy of the project, as the current folder."""
    home = tmp_path / "project"
    shutil.copytree(project, home, symlinks=True)
    monkeypatch.chdir(home)
    quicken(monkeypatch)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    capsys.readouterr()
    return home


def no_memory(*_):
    raise MemoryError


def bug(*_):
    raise ZeroDivisionError("this should not happen")


def ends_its_process(_):
    os._exit(3)


def no_package(_):
    return None


def no_number(policy, x0):
    plans = policy.network(x0)
    return plans.to(x0.dtype) * float("nan")


@pytest.fixture
def machine(monkeypatch, tmp_path):
    """Machine that a wrong example needs."""
    others = ExitStack()

    def arrange(code: str) -> None:
        if code == "W701":
            monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
            load_parser.cache_clear()
            (tmp_path / "cache/stlc").mkdir(parents=True)
            (tmp_path / "cache/stlc").chmod(0o770)
        elif code == "R109":
            others.enter_context(RunDir.open("first").claimed())
        elif code == "R406":
            monkeypatch.setattr("stlc.cli.commands.check.many.outcomes_of", ends_its_process)
        elif code == "W702":
            (tmp_path / "cc").write_text("#!/bin/sh\necho error: no licence\nexit 1\n")
            (tmp_path / "cc").chmod(0o755)
            monkeypatch.setenv("CC", str(tmp_path / "cc"))
            monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))

    with others:
        yield arrange


@pytest.fixture
def arranged(monkeypatch, machine):
    """Surroundings that a wrong example of a code needs."""

    def arrange(code: str) -> None:
        machine(code)
        match code:
            case "R202":
                shutil.copy("trace.npz", "huge.npz")
                monkeypatch.setattr("stlc.trace.read_recording", no_memory)
            case "B001":
                shutil.copy("trace.npz", "crash.npz")
                monkeypatch.setattr("stlc.trace.read_recording", bug)
            case "R301":
                monkeypatch.setattr("stlc.view.find_spec", no_package)
            case "R402":
                monkeypatch.setattr("stlc.controller.policies.policy.BestOfKPolicy.candidates", no_number)
            case "R105":
                monkeypatch.setattr("stlc.export.verify._distance", lambda *_: float("inf"))  # nothing agrees
            case "R110":
                path = Path("runs/cart/0001-first/spec.stl")
                path.unlink()
                path.symlink_to("/etc/passwd")
            case "R111":
                with Path("runs/cart/0001-first/system.yaml").open("a") as lines:
                    lines.write("functions: {f: {kind: python, target: 'f.py:f'}}\n")
            case "R404":
                path = Path("specs/cart.stl")
                path.write_text(path.read_text().replace("abs(x) < 0.1 m", "x > 100 m"))
            case "R403":
                monkeypatch.setattr("stlc.controller.parallel.ddp.PATIENCE", timedelta(seconds=0.1))
                for name, value in {**ENVIRONMENT, "RANK": 0, "MASTER_PORT": free_port()}.items():
                    monkeypatch.setenv(name, str(value))

    return arrange


@pytest.mark.apart
@pytest.mark.usefixtures("there")
@pytest.mark.parametrize(("code", "example"), examples("console"))
def test_a_command(code, example, arranged, capsys):
    if "wrong" in example.notes:
        arranged(code)
    for line in example.body.splitlines():
        words = shlex.split(line.removeprefix("$ "), comments=True)
        if "stlc" not in words:
            continue
        words = words[words.index("stlc") :]
        extra = ["--no-pictures"] if words[1] in ("train", "simulate") else []
        main([*words[1:], *extra])
    said = capsys.readouterr().err
    if "wrong" in example.notes:
        assert f"{'warning' if code[0] == 'W' else 'error'}[{code}]" in said
    else:
        assert "error[" not in said
        assert f"[{code}]" not in said


@pytest.mark.apart
@pytest.mark.parametrize(("code", "example"), examples("python"))
def test_a_world(code, example, there, capsys):
    for path in there.rglob("yard.py"):
        path.write_text(example.body)
    main(["simulate", "first", "--no-pictures", "--seeds", "0..1"])
    said = capsys.readouterr().err
    assert (f"error[{code}]" in said) == ("wrong" in example.notes), said


# ---------------------------------------------------------------------- the command


@pytest.mark.parametrize("code", ["E203", "e203", "S204", "precedence"])
def test_a_page_in_the_terminal(code, capsys):
    assert main(["explain", code]) == 0
    out = capsys.readouterr().out
    assert "```" not in out
    if code != "precedence":
        assert code.upper() in out
        assert out.index("wrong:") < out.index("right:")


def test_a_page_as_json(capsys):
    assert main(["explain", "E203", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)["result"]
    assert result["title"].startswith("E203")
    assert [example["notes"] for example in result["examples"]] == [["wrong"], ["right"]]


def test_all_codes_are_listed(capsys):
    assert main(["explain"]) == 0
    assert len(capsys.readouterr().out.splitlines()) == len(CODES)


def test_an_unknown_code(capsys):
    assert main(["explain", "E999"]) == 2
    assert "there is no code `E999`" in capsys.readouterr().err


def test_precedence_is_that_of_the_grammar():
    from stlc.grammar.parser import parse_expr
    from stlc.grammar.printer import show
    from stlc.source import Source

    for written, meant in [
        ("always[0, T] a and b", "(always[0, T] a) and b"),
        ("a -> b -> c", "a -> (b -> c)"),
        ("-x^2", "-(x^2)"),
        ("a or b and c", "a or (b and c)"),
        ("a and b until c", "a and (b until c)"),
        ("not a < b", "not (a < b)"),
    ]:
        one, other = (parse_expr(Source("text", text)) for text in (written, meant))
        assert one == other, show(one)
