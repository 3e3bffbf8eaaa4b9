"""Hostile names through all that a run writes: its folder, tables, page, pictures, logs and exports."""

from __future__ import annotations

import json
import re
import subprocess
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
from helpers.hostile import CANARY, NAMES, OF_FILES, sample
from test_hostile_names import seen_in_markup, steering

from stlc import escape, native
from stlc.cli.framework.app import main
from stlc.controller.problem.task import Task
from stlc.diagnostics import SystemFileError
from stlc.dynamics.load import load_system_decl
from stlc.dynamics.system import System
from stlc.export.c_header import header, main_of
from stlc.files import File
from stlc.grammar.spec import Spec
from stlc.jsontext import dumps
from stlc.rundir import RunDir

SYSTEM = """stlc: 1
name: {name}
doc: {name}
time: {{dt: 0.1 s, horizon: 6 steps}}
state:
  x: {{unit: m, range: [-2, 2]}}
  v: {{unit: m/s, range: [-2, 2]}}
  gear: {{enum: [{name}, other], role: env}}
control:
  u: {{unit: m/s^2, range: [-8, 8]}}
flow: {{x: v, v: u}}
jump:
  - {{name: {name}, guard: x > 1.9 m, reset: {{v: 0}}}}
objective: {{terms: [{{name: {name}, expr: abs(u)}}]}}
backup: {{bins: 3, T0: [1, 2]}}
init:
  mixture:
    - {{name: {name}, draw: {{x: "uniform(-0.5, 0.5)", v: 0, gear: 0}}}}
test:
  agents: 2
  steps: 8
  events:
    - {{name: {name}, at: 0.3 s, set: {{v: 0}}}}
scenario:
  {name}: {{doc: {name}}}
"""
SIGNALS = "state signal x [m]\nstate signal v [m/s]\n"
VISIBLE = [name for name in NAMES if not escape.unseen(name) and len(name) <= 200]
compiled = pytest.mark.skipif(native.compiler() is None, reason="needs a C compiler")


def spec_of(names: list[str], spec: str = "plain") -> str:
    """A requirement for each name; every other one is violated now and then."""
    lines = [f"spec `{spec}`", SIGNALS]
    for number, name in enumerate(names):
        tag = "@safety\n" if number == 0 else ""
        lines.append(f"## {name}\n{tag}require `{name}`: always[0, T] x <= {2 if number % 2 else 0.2} m")
    return "\n".join(lines) + "\n"


def system_of(name: str) -> str:
    return SYSTEM.format(name=json.dumps(name))


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    monkeypatch.chdir(tmp_path)
    yield tmp_path
    assert not [path for path in tmp_path.rglob("*") if path.name == CANARY]


def task_of(spec: str, system: str) -> Task:
    Path("h.stl").write_text(spec, encoding="utf-8", newline="")
    Path("h.yaml").write_text(system, encoding="utf-8")
    return Task.of(Spec.parse(File("h.stl").read()), System.load("h.yaml"))


# --------------------------------------------------------------------------- systems


def test_names_of_a_system_can_be_seen_or_are_refused(folder: Path) -> None:
    for name in OF_FILES[::4]:
        path = folder / "s.yaml"
        path.write_text(system_of(name), encoding="utf-8")
        if name in VISIBLE:
            assert load_system_decl(path).name == name
            continue
        with pytest.raises(SystemFileError) as caught:
            load_system_decl(path)
        assert {finding.code for finding in caught.value.diagnostics} <= {"S100", "S103"}


def test_half_a_character_is_refused(folder: Path) -> None:
    path = folder / "s.yaml"
    path.write_text(system_of("x").replace('doc: "x"', 'doc: "\\ud800"'), encoding="utf-8")
    with pytest.raises(SystemFileError, match="half of a character"):
        load_system_decl(path)


@pytest.mark.parametrize("name", [sample(10)[2], "<b>[red]$x$|"])
def test_a_system_is_shown_in_lines(name: str, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "s.yaml").write_text(system_of(name), encoding="utf-8")
    assert main(["system", "show", "s.yaml"]) == 0
    shown = capsys.readouterr().out
    (folder / "s.yaml").write_text(system_of("plain"), encoding="utf-8")
    assert main(["system", "show", "s.yaml"]) == 0
    assert shown.count("\n") == capsys.readouterr().out.count("\n")
    assert not steering(shown)


def test_a_specification_from_a_system_means_its_words(folder: Path) -> None:
    for name in ("a b", "always", "x # y", "</b>", "T", "dt"):
        (folder / "s.yaml").write_text(system_of(name), encoding="utf-8")
        assert main(["init", "--spec", "made", "--from", "s.yaml", "--force"]) == 0
        (enum,) = Spec.parse(File("made.stl").read()).enums
        assert [member for member, _ in enum.members] == [name, "other"]


# -------------------------------------------------------------------------------- C


def without_comments(text: str) -> str:
    """Text after a preprocessor, without the files that it includes."""
    using = native.compiler()
    assert using is not None
    own = re.sub(r"^#include.*$", "", text, flags=re.M)
    command = [using, "-fpreprocessed", "-dD", "-E", "-P", "-x", "c", "-"]
    done = subprocess.run(command, input=own, check=True, capture_output=True, text=True, encoding="utf-8")
    return done.stdout


def network_of(task: Task) -> Any:
    from stlc.controller.policies.policy import PlanNetwork

    network = PlanNetwork(task, hidden=(4,), plans=1).eval()
    network.normalise(task.sample(8, seed=1))
    return network


@compiled
@pytest.mark.parametrize(
    "names", [sample(10), pytest.param(NAMES, marks=pytest.mark.slow)], ids=["sample", "all"]
)
def test_names_of_specification_and_system_stay_in_their_comments(names: list[str]) -> None:
    plain_task = task_of(spec_of(["a"]), system_of("plain"))
    plain = without_comments(header(plain_task, network_of(plain_task)))
    for name in names:
        system = name if name in VISIBLE else "plain"
        task = task_of(spec_of(["a"], name), system_of(system))
        text, program = header(task, network_of(task)), main_of(task)
        assert without_comments(text).split() == plain.split()
        assert without_comments(program).split() == without_comments(main_of(plain_task)).split()
        first = text[: text.index("*/")]
        assert escape.c_comment(name) in first
        assert escape.c_comment(system) in first


PRINT = """
#include <stdio.h>
#include "stlc_controller.h"
int main(void) {
  for (int i = 0; i < STLC_RULES; ++i) { fputs(stlc_rule_names[i], stdout); putchar('\\n'); }
  return (int)(sizeof stlc_rule_names / sizeof stlc_rule_names[0]) - STLC_RULES;
}
"""


@compiled
@pytest.mark.parametrize(
    "names", [sample(15), pytest.param(NAMES, marks=pytest.mark.slow)], ids=["sample", "all"]
)
def test_a_header_compiles_without_a_warning_and_gives_names_back(names: list[str], folder: Path) -> None:
    from helpers.exported import untrained

    from stlc.export.write import export

    (folder / "h.stl").write_text(spec_of(names, "*/ #error"), encoding="utf-8", newline="")
    (folder / "h.yaml").write_text(system_of("*/ #error"), encoding="utf-8")
    done = export(untrained(folder / "h.stl", folder / "h.yaml", folder / "runs"), "c", folder / "out")
    (folder / "out" / "names.c").write_text(PRINT, encoding="utf-8")
    using = native.compiler()
    assert using is not None
    strict = ("-std=c99", "-Wall", "-Wextra", "-Wtrigraphs", "-trigraphs", "-Werror", "-Wno-unused-function")
    for source in ("main.c", "names.c"):
        command = [using, *strict, "-O0", "-o", str(folder / source[:-2]), str(done.folder / source), "-lm"]
        subprocess.run(command, check=True)
    said = subprocess.run([folder / "names"], check=True, capture_output=True, cwd=folder).stdout
    assert said.decode().split("\n")[:-1] == names
    subprocess.run([folder / "main"], input=b"0 0 0\n", check=True, capture_output=True, cwd=folder)


# ------------------------------------------------------------------------- whole runs


class Page(HTMLParser):
    """Contents of a page: its elements, their attributes, the words of each."""

    def __init__(self, text: str) -> None:
        super().__init__(convert_charrefs=True)
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.words = ""
        self.other: list[str] = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))

    def handle_data(self, data: str) -> None:
        self.words += data

    def handle_comment(self, data: str) -> None:
        self.other.append(data)

    def outline(self) -> list[tuple[str, tuple[str, ...]]]:
        return [(tag, tuple(sorted(attrs))) for tag, attrs in self.elements]


def lived(names: list[str], spec: str, system: str, capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    """The life of a run, from training to its report, and what its commands say."""
    Path("h.stl").write_text(spec_of(names, spec), encoding="utf-8", newline="")
    Path("h.yaml").write_text(system_of(system), encoding="utf-8")
    found: dict[str, Any] = {}
    training = ["--steps", "52", "--batch", "8", "--held-out", "20", "--method", "gradient", "--no-pictures"]
    commands = {
        "train": ["train", "h.stl", "--system", "h.yaml", "--log", "tensorboard", "--json", *training],
        "simulate": ["simulate", "latest", "--backup", "--seeds", "0", "--json", "--scenario", system],
        "told": ["simulate", "latest", "--seeds", "0", "--robustness", "m.jsonl", "--no-pictures"],
        "report": ["report", "latest"],
        "plot": ["plot", "latest", "-o", "p.svg"],
        "check": ["check", "runs/latest/trace.npz"],
        "explain": ["explain", "runs/latest/trace.npz"],
        "list": ["runs", "list"],
        "list.json": ["runs", "list", "--json"],
        "show": ["runs", "show", "latest"],
    }
    for key, words in commands.items():
        found[f"{key} code"] = main(words)
        out, err = capsys.readouterr()
        assert not steering(out), key
        assert not steering(err), key
        assert found[f"{key} code"] in (0, 1, 4), (key, out, err)
        found[key] = out
    return found


def look_over(names: list[str], spec: str, system: str, capsys: pytest.CaptureFixture[str]) -> Page:
    """Everything that a run leaves, read by a reader of each; gives its page."""
    pytest.importorskip("tensorboardX")
    from stlc.controller.training import tensorboard

    found = lived(names, spec, system, capsys)
    run = RunDir.newest()
    assert list(json.loads(found["train"])["result"]["requirements"]) == names
    assert json.loads(found["list.json"])["result"]["runs"][0]["spec"] == spec
    rows = [json.loads(line) for line in (run.path / "train.jsonl").read_text(encoding="utf-8").splitlines()]
    told = [row["requirements"] for row in rows if row.get("requirements")]
    assert all(list(each) == names for each in told)
    json.loads(found["simulate"])
    margins = [json.loads(line) for line in Path("m.jsonl").read_text(encoding="utf-8").split("\n")[:-1]]
    assert margins
    parts = run.path.relative_to(Path("runs").resolve()).parts
    assert len(parts) == 2
    (events,) = (run.path / "tensorboard").iterdir()
    tags = {tag.decode() for tag in re.findall(rb"requirements/[\w.-]+", events.read_bytes())}
    assert {tensorboard.tag(name).lstrip("/") for name in names if name.isascii()} <= {
        tag.removeprefix("requirements/") for tag in tags
    }
    svg = ElementTree.parse("p.svg").getroot()
    assert svg.tag.endswith("svg")
    assert not [node for node in svg.iter() if str(node.tag).endswith("script")]
    page = Page((run.path / "report.html").read_text(encoding="utf-8"))
    for name in names:
        assert seen_in_markup(name) in page.words
    assert not page.other
    assert not [key for _, attrs in page.elements for key in attrs if key.startswith("on")]
    return page


def groups(size: int) -> list[list[str]]:
    return [NAMES[start : start + size] for start in range(0, len(NAMES), size)]


@pytest.mark.slow
@pytest.mark.parametrize("names", groups(46), ids=lambda names: str(NAMES.index(names[0])))
def test_all_that_a_run_leaves_is_what_it_would_be(
    names: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    system = next((name for name in names if name in VISIBLE), "plain")
    hostile = look_over(names, names[0], system, capsys)
    assert hostile.outline()[0][0] == "html"


@pytest.mark.slow
def test_a_page_has_the_elements_of_a_plain_one(capsys: pytest.CaptureFixture[str], folder: Path) -> None:
    names = ["</title><script>alert(1)</script>", '" onmouseover="alert(1)', "<!--", "$x$", "_hidden"]
    hostile = look_over(names, names[0], names[0], capsys)
    for path in ("h.stl", "h.yaml", "p.svg", "m.jsonl"):
        (folder / path).unlink()
    (folder / "runs").rename(folder / "before")
    plain = look_over(["a", "b", "c", "d", "e"], "s", "t", capsys)
    kinds = [[each for each in page.outline() if each[0] != "span"] for page in (hostile, plain)]
    assert kinds[0] == kinds[1]


@pytest.mark.slow
@pytest.mark.parametrize("target", ["onnx", "torch"])
def test_an_export_says_every_name(target: str, folder: Path) -> None:
    from helpers.exported import untrained

    from stlc.export.write import export

    if target == "onnx":
        pytest.importorskip("onnxruntime")
    names = sample(30)
    (folder / "h.stl").write_text(spec_of(names, names[0]), encoding="utf-8", newline="")
    (folder / "h.yaml").write_text(system_of(names[0]), encoding="utf-8")
    done = export(untrained(folder / "h.stl", folder / "h.yaml", folder / "runs"), target, folder / "out")  # type: ignore[arg-type]
    facts = json.loads((done.folder / "controller.json").read_text(encoding="utf-8"))
    assert facts["requirements"] == names
    assert dumps(facts)
