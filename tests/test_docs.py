"""Documents are true because they are held against the program: commands, codes, files, links, code."""

from __future__ import annotations

import ast
import contextlib
import re
import shlex
import shutil
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer
from helpers.sources import tree

from benchmarks.__main__ import PROGRAM as MEASURE
from stlc.cli.framework.app import PROGRAM as STLC
from stlc.cli.framework.app import main
from stlc.diagnostics import CODES
from stlc.dynamics.declaration.schema.record import reference
from stlc.dynamics.declaration.sections import SystemKeys
from stlc.grammar.manual import Page
from stlc.plants.declaration import PlantKeys

ROOT = Path(__file__).resolve().parent.parent
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])
PROGRAM: Any = STLC.parser()
FENCE = re.compile(r"^```(\w*)\n(.*?)^```", re.MULTILINE | re.DOTALL)
PLACEHOLDERS = re.compile(r"…|\.\.\.")


def name_of(path: Path) -> str:
    return str(path.relative_to(ROOT))


@pytest.fixture
def regenerate(request) -> bool:
    return bool(request.config.getoption("--regenerate"))


def section(page: Path, marker: str) -> tuple[str, str, str]:
    """The text before, between and after `<!-- marker -->` and `<!-- /marker -->`."""
    text = page.read_text(encoding="utf-8")
    start, end = f"<!-- {marker} -->\n", f"<!-- /{marker} -->"
    head, found, rest = text.partition(start)
    body, closed, tail = rest.partition(end)
    assert found, f"{page} has no section {marker}"
    assert closed, f"{page} does not close section {marker}"
    return head + start, body, end + tail


def hold(page: Path, marker: str, wanted: str, *, regenerate: bool) -> None:
    head, body, tail = section(page, marker)
    if regenerate:
        page.write_text(head + wanted + tail, encoding="utf-8")
    else:
        assert body == wanted, "the code has changed; run: make docs"


# ---------------------------------------------------------------------- commands


def test_the_reference_is_what_help_says(regenerate):
    everywhere = [row(param) for param in PROGRAM.params if param.name in ("color", "_quiet", "version")]
    head = "\n".join(["| | default | |", "|---|---|---|", *everywhere, "", ""])
    text = head + "\n".join(command_section(name, command) for name, command in every_command())
    hold(ROOT / "docs/cli.md", "commands", text, regenerate=regenerate)


def every_command() -> Iterator[tuple[str, Any]]:
    """All commands; those of a group under the name of the group."""
    for name, command in PROGRAM.commands.items():
        inner = getattr(command, "commands", None)
        if inner is None:
            yield name, command
        else:
            yield from ((f"{name} {word}", part) for word, part in inner.items())


def command_section(name: str, command: Any) -> str:
    sentence, examples, *notes = command.help.split("\n\n")
    typed = [line.strip() for line in examples.splitlines() if line.startswith("  ")]
    usage = " ".join(
        [f"stlc {name}", *(argument_usage(param) for param in command.params if is_argument(param))]
    )
    rows = [row(param) for param in command.params if param.name != "help"]
    lines = [
        f"### {usage}",
        "",
        sentence,
        "",
        "```console",
        *(f"$ {line}" for line in typed),
        "```",
        "",
        *(line for note in notes for line in (*textwrap.wrap(note, 118), "")),
        "| | default | |",
        "|---|---|---|",
        *rows,
        "",
    ]
    return "\n".join(lines)


def is_argument(param: Any) -> bool:
    return bool(param.param_type_name == "argument")


def argument_usage(param: Any) -> str:
    name = (param.metavar or param.name).upper()
    dots = "…" if param.nargs == -1 and not name.endswith("…") else ""
    return f"{name}{dots}" if param.required else f"[{name}{dots}]"


def row(param: Any) -> str:
    if is_argument(param):
        shown = f"`{escaped((param.metavar or param.name).upper())}`"
    else:
        shown = ", ".join(f"`{option}`" for option in (*param.opts, *param.secondary_opts))
        kind = param.metavar or choices(param)
        shown += f" `{escaped(kind)}`" if kind else ""
    given = param.show_default if isinstance(getattr(param, "show_default", None), str) else param.default
    default = given if isinstance(given, str | int | float) else ""
    default = "" if isinstance(default, bool) else default
    return f"| {shown} | {default} | {escaped(param.help or '')} |"


# ---------------------------------------------------------------------- codes


def choices(param: Any) -> str:
    """The words that an option takes, if they are few; typer keeps them in different places."""
    kind = getattr(param, "type_descriptor", None) or param.type
    return "|".join(map(str, getattr(kind, "choices", None) or ()))


GROUPS = {
    "E": "Specifications and traces",
    "S": "System files",
    "R": "Runs",
    "U": "Usage",
    "B": "stlc itself",
}


def escaped(text: str) -> str:
    return text.replace("|", "\\|")


def test_every_code_is_listed(regenerate):
    parts = []
    for letter, title in GROUPS.items():
        codes = sorted(code for code in CODES if code[0] in (letter, "W" if letter == "E" else letter))
        ordered = sorted(codes, key=lambda code: code[1:])
        rows = [f"| [{code}](#{code.lower()}) | {escaped(CODES[code])} |" for code in ordered]
        parts += [f"## {title}", "", "| code | what is wrong |", "|---|---|", *rows, ""]
        parts += [line for code in ordered for line in code_section(code)]
    hold(ROOT / "docs/errors.md", "codes", "\n".join(parts), regenerate=regenerate)
    assert {code[0] for code in CODES} <= {*GROUPS, "W"}


def code_section(code: str) -> list[str]:
    """The page of a code (`stlc explain CODE`); its examples are held against the program elsewhere."""
    page = Page.read(code)
    assert page is not None, code
    lines = [f'### <a id="{code.lower()}"></a>{page.title}', ""]
    for line in page.text.splitlines():
        notes = line.removeprefix("```").split() if line.startswith("```") else []
        if {"wrong", "right"} & set(notes):
            lines += [f"{'Wrong' if 'wrong' in notes else 'Right'}:", ""]
        lines.append("```" if notes else line)
    return [*lines, ""]


def test_every_code_that_is_raised_exists():
    source = "\n".join(path.read_text(encoding="utf-8") for path in (ROOT / "stlc").rglob("*.py"))
    used = set(re.findall(r"[\"']([ESRUWB]\d{3})[\"']", source))
    assert used <= set(CODES)


# ---------------------------------------------------------------------- command lines in documents


def command_lines() -> Iterator[Any]:
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        for language, block in FENCE.findall(text):
            if language in ("console", "sh", "bash", "text"):
                for line in block.splitlines():
                    yield from as_command(page, line.strip())
        for inline in inline_commands(text):
            if " " in inline:
                yield from as_command(page, f"$ stlc {inline}")


def inline_commands(text: str) -> list[str]:
    """Words after `stlc` in running text; a single word only names a command."""
    return re.findall(r"`(?:\$ )?stlc ([^`\n]+)`", FENCE.sub("", text))


def as_command(page: Path, line: str) -> Iterator[Any]:
    match = re.match(r"\$ (?:\.venv/bin/)?stlc\b(.*)", line)
    if match and not PLACEHOLDERS.search(line) and "--install-completion" not in line:  # that writes to ~
        words = shlex.split(match[1].partition(" | ")[0], comments=True)
        yield pytest.param(words, id=f"{name_of(page)}: stlc {' '.join(words)}")


LINES = list({line.id: line for line in command_lines()}.values())


def test_command_lines_in_the_documents_can_be_parsed():
    assert {line.id: wrong for line in LINES if (wrong := misread(line.values[0]))} == {}
    assert misread(["check", "a.npz", "--no-such-option"])


def misread(words: list[str]) -> str:
    """Fault of a command line; "" if there is none."""
    try:
        with PROGRAM.make_context("stlc", list(words)) as context:
            rest = [*context._protected_args, *context.args]
            name, command, arguments = PROGRAM.resolve_command(context, rest)
            with command.make_context(name, list(arguments), parent=context):
                pass
    except typer.Exit as stopped:  # --help and --version
        return f"exit code {stopped.exit_code}" if stopped.exit_code else ""
    except Exception as error:
        return str(error) or type(error).__name__
    return ""


def test_running_text_names_commands_that_exist():
    for page in PAGES:
        words = {inline.split()[0] for inline in inline_commands(page.read_text(encoding="utf-8"))}
        assert {word for word in words if word.isidentifier()} <= set(PROGRAM.commands), page


BENCHMARKS: Any = MEASURE.parser()


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_a_command_line_of_the_benchmarks_can_be_parsed(page):
    text = page.read_text(encoding="utf-8")
    for line in re.findall(r"(?:`|^\$ )python -m benchmarks ([^`\n]+)", text, re.MULTILINE):
        if not PLACEHOLDERS.search(line):
            name, command, words = BENCHMARKS.resolve_command(None, shlex.split(line, comments=True))
            with contextlib.suppress(typer.Exit):  # --help
                command.make_context(name, list(words))


def test_command_lines_were_found():
    assert len(LINES) > 12


QUICK = {"compile"}
WALKED = ("docs/tutorial.md:", "docs/own-system.md:")
HERE = [line for line in LINES if set(line.values[0]) & QUICK and not line.id.startswith(WALKED)]


@pytest.mark.parametrize("words", HERE)  # test_tutorial.py runs those of the tutorials, in order
def test_a_quick_command_line_runs(words, monkeypatch, tmp_path, capsys):
    place = tmp_path if "cart.stl" in words else ROOT
    write_examples(tmp_path)
    monkeypatch.chdir(place)
    assert main(words) == 0, capsys.readouterr().err
    assert capsys.readouterr().out


# ---------------------------------------------------------------------- examples in documents


def write_examples(folder: Path) -> list[Path]:
    """Write the files that the quickstart shows."""
    text = (ROOT / "docs/quickstart.md").read_text(encoding="utf-8")
    written = []
    for name, body in re.findall(
        r"<!-- example: ([\w.]+) -->\n```\w*\n(.*?)^```", text, re.MULTILINE | re.DOTALL
    ):
        (folder / name).write_text(body, encoding="utf-8")
        written.append(folder / name)
    return written


def test_the_examples_of_the_quickstart_were_found(tmp_path):
    assert [path.name for path in write_examples(tmp_path)] == ["cart.stl", "cart.yaml"]


def python_blocks() -> Iterator[Any]:
    for page in PAGES:
        for language, block in FENCE.findall(page.read_text(encoding="utf-8")):
            if language == "python":
                yield pytest.param(block, id=name_of(page))


@pytest.mark.parametrize("block", list(python_blocks()))
def test_python_in_the_documents_names_what_exists(block):
    import stlc

    for node in ast.walk(ast.parse(block)):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "stlc":
            assert hasattr(stlc, node.attr), node.attr


def test_the_python_of_the_quickstart_runs(monkeypatch, capsys):
    text = (ROOT / "docs/quickstart.md").read_text(encoding="utf-8")
    (block,) = [body for language, body in FENCE.findall(text) if language == "python"]
    monkeypatch.chdir(ROOT)
    exec(compile(block, "quickstart.md", "exec"), {})
    assert "2.5 s of signal decide a verdict" in capsys.readouterr().out


def test_the_readme_shows_the_specification_as_it_is():
    shown = next(
        body
        for language, body in FENCE.findall((ROOT / "README.md").read_text())
        if body.startswith("@safety")
    )
    written = (ROOT / "specs/traffic.stl").read_text(encoding="utf-8").splitlines()
    for line in filter(None, shown.splitlines()):
        assert line in written


def test_the_readme_shows_a_real_check(monkeypatch, capsys):
    (shown,) = [
        body for _, body in FENCE.findall((ROOT / "README.md").read_text()) if body.startswith("$ stlc check")
    ]
    command, _, rest = shown.partition("\n")
    monkeypatch.chdir(ROOT)
    assert main(shlex.split(command)[2:]) == 1
    assert rest.partition("\n$ ")[0] == capsys.readouterr().out.rstrip()


def test_the_readme_shows_a_real_diagnostic(monkeypatch, tmp_path, capsys):
    (shown,) = [
        body for _, body in FENCE.findall((ROOT / "README.md").read_text()) if body.startswith("error")
    ]
    text = (ROOT / "specs/traffic.stl").read_text(encoding="utf-8")
    for folder in ("specs", "examples"):
        shutil.copytree(ROOT / folder, tmp_path / folder)
    (tmp_path / "specs/traffic.stl").write_text(text.replace("dx > gap", "dx > 1 s"), encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    assert main(["compile", "specs/traffic.stl"]) == 3
    assert capsys.readouterr().err == shown


# ---------------------------------------------------------------------- links and files


def test_links_lead_somewhere():
    for page in PAGES:
        text = re.sub(r"`[^`\n]+`", "", FENCE.sub("", page.read_text(encoding="utf-8")))
        for target in re.findall(r"\]\(([^)#\s]+)[^)]*\)", text):
            if "://" not in target:
                assert (page.parent / target).exists(), f"{page}: {target}"


ROOMS = {
    "": "stlc: modules that all packages may import",
    "trace": "trace: recordings and their file formats",
    "grammar": "grammar: parser, syntax tree, printer, formatter",
    "compile": "compile: from syntax to evaluated formulas",
    "lint": "lint: warnings and repairs",
    "dynamics": "dynamics: system files and models",
    "runtime": "runtime: exported controllers in Python",
    "monitor": "monitor: verdicts, streams, explanations",
    "plants": "plants: black boxes from elsewhere",
    "controller": "controller: policies, training, guard, deployment, evaluation",
    "assurance": "assurance: statistical bounds and certificates",
    "export": "export: torch programs, ONNX graphs, C headers",
    "view": "view: plots, animations, reports",
    "editor": "editor: the language server",
    "gym": "gym: tasks as gymnasium environments",
    "cli": "cli: the command line",
    "../benchmarks": "benchmarks: the tables of the documentation, beside the package",
}


def test_every_file_is_listed_with_its_first_line(regenerate):
    parts, listed = [], 0
    for room, title in ROOMS.items():
        parts += [f"## {title}", ""]
        folders = [ROOT / "stlc" / room]
        if room:
            folders += sorted(path.parent for path in folders[0].glob("*/**/__init__.py"))
        for folder in folders:
            files = [path for path in sorted(folder.glob("*.py")) if not path.stem.startswith("__")]
            if folder != folders[0]:
                name = folder.relative_to(ROOT / "stlc" / room).as_posix()
                name = name if room.startswith("..") else f"{room}/{name}"
                parts += [f"### `{name}`", "", first_line(folder / "__init__.py"), ""]
            if files:
                rows = [f"| `{path.name}` | {first_line(path)} |" for path in files]
                parts += ["| file | purpose |", "|---|---|", *rows, ""]
            listed += len(files)
    hold(ROOT / "docs/files.md", "files", "\n".join(parts), regenerate=regenerate)
    code = [path for room in ("stlc", "benchmarks") for path in (ROOT / room).rglob("*.py")]
    judges = sorted((ROOT / "benchmarks/tasks").glob("*/judge.py"))
    assert listed == sum(not path.stem.startswith("__") for path in code) - len(judges)


def first_line(path: Path) -> str:
    text = ast.get_docstring(tree(path)) or ""
    return escaped(text.partition("\n")[0])


def test_every_key_of_a_system_file_is_listed(regenerate):
    text = "\n".join(reference(SystemKeys, "The file"))
    hold(ROOT / "docs/systems.md", "keys", text, regenerate=regenerate)


def test_every_key_of_a_plant_file_is_listed(regenerate):
    text = "\n".join(reference(PlantKeys, "The file"))
    hold(ROOT / "docs/plants.md", "keys", text, regenerate=regenerate)


def test_the_architecture_names_files_that_exist():
    text = (ROOT / "docs/architecture.md").read_text(encoding="utf-8")
    rows = [line for line in text.splitlines() if re.match(r"\| `[\w/*]+\.(py|lark)`", line)]
    assert len(rows) > 30
    for line in rows:
        folder, text = "", ""
        _, files, _, holds, _ = line.split("|")
        for name in re.findall(r"`([\w/*]+\.(?:py|lark))`", files):
            folder = name.rpartition("/")[0] or folder
            full = name if "/" in name or not folder else f"{folder}/{name}"
            found = [*(ROOT / "stlc").glob(full), *ROOT.glob(full)]
            assert found, full
            text += "\n".join(path.read_text(encoding="utf-8") for path in found)
        for name in re.findall(r"`(?:\w+\.)*(\w+)`", holds):
            assert re.search(rf"\b{name}\b", text), f"{files.strip()} has no {name}"


def test_the_architecture_names_the_packages_of_each_room():
    text = (ROOT / "docs/architecture.md").read_text(encoding="utf-8")
    for room in sorted((ROOT / "stlc").iterdir()):
        packages = [path.parent.name for path in room.glob("*/__init__.py")]
        if packages:
            (line,) = re.findall(rf"^\| `{room.name}` \| (.*) \|$", text, re.MULTILINE)
            assert set(packages) <= set(re.findall(r"`(\w+)`", line)), room.name


def test_the_architecture_lists_the_decisions():
    text = (ROOT / "docs/architecture.md").read_text(encoding="utf-8")
    for path in (ROOT / "docs/decisions").glob("*.md"):
        title = path.read_text(encoding="utf-8").partition("\n")[0].removeprefix("# ")
        assert f"- [{title}](decisions/{path.name})\n" in text


def test_pages_are_readable_in_a_terminal():
    for page in PAGES:
        for number, line in enumerate(page.read_text(encoding="utf-8").splitlines(), start=1):
            assert len(line) <= 160 or line.startswith("|"), f"{page.name}:{number}"
