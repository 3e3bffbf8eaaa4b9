"""Sessions over the standard input and output, as an editor has them."""

from __future__ import annotations

import shutil
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from lsp_client import Client, LspError

from stlc.cli.framework.app import main
from stlc.extras import installation

pytestmark = pytest.mark.apart

ROOT = Path(__file__).resolve().parent.parent.parent


@pytest.fixture(scope="module")
def project(tmp_path_factory) -> Path:
    """A copy of the traffic benchmark, to be broken at will."""
    folder = tmp_path_factory.mktemp("project")
    for name in ("specs", "examples"):
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    return folder


@pytest.fixture(scope="module")
def session(project) -> Iterator[Client]:
    client = Client(project)
    client.start()
    yield client
    assert client.stop() == 0


@pytest.fixture
def spec(project) -> str:
    return (project / "specs/traffic.stl").read_text(encoding="utf-8")


def uri(project: Path) -> str:
    return (project / "specs/traffic.stl").as_uri()


def place(text: str, needle: str, inside: int = 0) -> tuple[int, int]:
    offset = text.index(needle) + inside
    return text.count("\n", 0, offset), offset - text.rfind("\n", 0, offset) - 1


def test_a_good_text_has_no_findings(session, project, spec):
    assert session.open(uri(project), spec) == []


def test_findings_follow_the_text(session, project, spec):
    session.open(uri(project), spec)
    wrong = spec.replace("dx > gap", "dx - gap > 1 s")
    (finding,) = session.change(uri(project), wrong)
    assert finding["code"] == "E203"
    assert finding["severity"] == 1
    assert finding["source"] == "stlc"
    line, column = place(wrong, "> 1 s")
    assert finding["range"]["start"] == {"line": line, "character": column}
    assert [info["message"] for info in finding["relatedInformation"]] == ["[m]", "[s]"]
    assert session.change(uri(project), spec) == []


def test_a_finding_of_the_syntax(session, project, spec):
    session.open(uri(project), spec)
    (finding,) = session.change(uri(project), spec.replace("require stop_sign:", "require stop_sign"))
    assert finding["code"] == "E010"


@pytest.mark.bench
def test_a_change_takes_no_time(session, project, spec):
    session.open(uri(project), spec)
    start = time.perf_counter()
    for version in range(5):
        session.change(uri(project), f"{spec}\n# {version}\n", version)
    milliseconds = (time.perf_counter() - start) / 5 * 1e3
    sys.stdout.write(f"a change of {len(spec)} letters: {milliseconds:.0f} ms\n")


def test_hover(session, project, spec):
    session.open(uri(project), spec)
    found = session.at("hover", uri(project), *place(spec, "v_lead"))
    assert "env real [m/s], 0 to 10 m/s (enforced)" in found["contents"]["value"]
    found = session.at("hover", uri(project), *place(spec, "always[0, T] before", 3))
    assert "[0 s, 2.5 s] = samples 0..25" in found["contents"]["value"]
    assert session.at("hover", uri(project), 2, 0) is None


def test_completion(session, project, spec):
    text = spec + "\nrequire more: al"
    session.open(uri(project), text)
    line = text.count("\n")
    found = session.at("completion", uri(project), line, len("require more: al"))
    by_label = {item["label"]: item for item in found["items"]}
    assert {"always", "x", "T", "abs"} <= by_label.keys()
    assert by_label["always"]["textEdit"]["range"]["start"]["character"] == len("require more: ")


def test_definition_in_the_text_and_in_the_system(session, project, spec):
    session.open(uri(project), spec)
    (use,) = session.at("definition", uri(project), *place(spec, "tau >= 1 s"))
    assert use["uri"] == uri(project)
    assert (use["range"]["start"]["line"], use["range"]["start"]["character"]) == place(spec, "tau [s]")
    system = (project / "examples/car.yaml").read_text(encoding="utf-8")
    (there,) = session.at("definition", uri(project), *place(spec, "tau [s]"))
    assert there["uri"] == (project / "examples/car.yaml").as_uri()
    assert there["range"]["start"]["line"] == place(system, "  tau: ")[0]
    (same,) = session.at("implementation", uri(project), *place(spec, "tau >= 1 s"))
    assert same == there
    (file,) = session.at("definition", uri(project), *place(spec, "../examples"))
    assert file["uri"] == there["uri"]


def test_references(session, project, spec):
    session.open(uri(project), spec)
    found = session.at(
        "references", uri(project), *place(spec, "T_total"), context={"includeDeclaration": True}
    )
    assert len(found) == spec.count("T_total")


def test_rename(session, project, spec):
    session.open(uri(project), spec)
    where = place(spec, "red             =")
    assert session.at("prepareRename", uri(project), *where)["start"]["line"] == where[0]
    edits = session.at("rename", uri(project), *where, newName="at_red")["changes"][uri(project)]
    assert {edit["newText"] for edit in edits} == {"at_red"}
    assert len(edits) == 2
    with pytest.raises(LspError, match="has a meaning already"):
        session.at("rename", uri(project), *where, newName="outside_box")


def test_formatting(session, project, spec):
    untidy = spec.replace("always[0, T] (dx > -0.5 m -> dx > gap)", "G [0,T]   (dx > -0.5 m -> dx>gap)")
    session.open(uri(project), untidy)
    options = {"tabSize": 4, "insertSpaces": True}
    document = {"textDocument": {"uri": uri(project)}, "options": options}
    (edit,) = session.request("textDocument/formatting", document)
    assert "always[0, T] (dx > -0.5 m -> dx > gap)" in edit["newText"]
    session.change(uri(project), edit["newText"])
    assert not session.request("textDocument/formatting", document)
    session.change(uri(project), spec + "require")
    assert not session.request("textDocument/formatting", document)


def test_a_quick_fix(session, project):
    text = "signal x [m]\nrequire r: always[0, 5] x > 0 m\n"
    other = (project / "specs/other.stl").as_uri()
    (finding,) = session.open(other, text)
    assert finding["code"] == "W101"
    assert finding["severity"] == 2
    asked = {"textDocument": {"uri": other}, "range": finding["range"], "context": {"diagnostics": []}}
    (action,) = session.request("textDocument/codeAction", asked)
    assert action["title"] == "write `5 s`"
    assert action["edit"]["changes"][other][0]["newText"] == "5 s"


def test_the_outline(session, project, spec):
    session.open(uri(project), spec)
    found = session.request("textDocument/documentSymbol", {"textDocument": {"uri": uri(project)}})
    assert [symbol["name"] for symbol in found][-4:] == ["no_collision", "stop_sign", "give_way", "red_light"]
    assert found[-1]["detail"] == "requirement @safety"


def test_a_system_that_is_not_there(session, project, spec):
    session.open(uri(project), spec)
    (finding,) = session.change(uri(project), spec.replace("car.yaml", "cart.yaml"))
    assert finding["code"] == "U102"
    assert finding["range"]["start"]["line"] == 1


def test_a_system_that_is_wrong_and_then_mended(session, project, spec):
    session.open(uri(project), spec)
    path = project / "examples/car.yaml"
    good = path.read_text(encoding="utf-8")
    changed = {"changes": [{"uri": path.as_uri(), "type": 2}]}
    path.write_text(good.replace("integrator:", "integrater:"), encoding="utf-8")
    session.notify("workspace/didChangeWatchedFiles", changed)
    found = wait_for(session, uri(project), empty=False)
    assert [finding["code"] for finding in found] == ["S101"]
    assert found[0]["relatedInformation"][0]["location"]["uri"] == path.as_uri()
    path.write_text(good, encoding="utf-8")
    session.notify("workspace/didChangeWatchedFiles", changed)
    assert wait_for(session, uri(project), empty=True) == []


def wait_for(session: Client, address: str, *, empty: bool) -> list[dict[str, object]]:
    """Diagnostics of a text, once there are (not) any: other texts may be open."""
    while bool(found := session.findings(address)) is empty:
        pass
    return found


def test_a_closed_text_takes_its_findings_along(session, project):
    other = (project / "specs/wrong.stl").as_uri()
    assert session.open(other, "require r: x > 0")
    session.notify("textDocument/didClose", {"textDocument": {"uri": other}})
    assert session.findings(other) == []


def test_columns_are_counted_as_agreed(tmp_path):
    client = Client(tmp_path)
    assert client.start(["utf-8", "utf-16"])["capabilities"]["positionEncoding"] == "utf-8"
    (finding,) = client.open((tmp_path / "a.stl").as_uri(), 'signal x from "😀" [y]')
    assert finding["range"]["start"]["character"] == len('signal x from "😀" '.encode())
    assert client.stop() == 0


def test_without_the_package_the_command_says_what_to_install(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "pygls", None)
    for name in [name for name in sys.modules if name.startswith(("pygls.", "stlc.editor"))]:
        monkeypatch.delitem(sys.modules, name)
    assert main(["lsp"]) == 5
    assert installation("lsp") in capsys.readouterr().err
