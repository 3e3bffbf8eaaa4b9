"""The grammar of the extension is what the words of the language make of it, and colours what it should."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from helpers.tools import load_tool

from stlc.grammar.words import DECLARATIONS, OPERATORS, RESERVED
from stlc.units import Unit

ROOT = Path(__file__).resolve().parent.parent.parent
EXTENSION = ROOT / "editors/vscode"
FILE = EXTENSION / "syntaxes/stlc.tmLanguage.json"
GRAMMAR = load_tool("textmate").textmate()


def test_the_file_is_made_from_the_words_of_the_language(request):
    text = json.dumps(GRAMMAR, indent=2, ensure_ascii=False) + "\n"
    if request.config.getoption("--regenerate"):
        FILE.write_text(text, encoding="utf-8")
    assert FILE.read_text(encoding="utf-8") == text, "the words have changed; run: make docs"


def rules(node: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """The rules with a pattern, in the order in which they are tried."""
    if "match" in node:
        yield node
    for part in node.get("patterns", ()):
        if "include" in part:
            yield from rules(GRAMMAR["repository"][part["include"].removeprefix("#")])
        else:
            yield from rules(part)


RULES = [(re.compile(rule["match"]), rule) for rule in rules(GRAMMAR)]


def colours(line: str) -> dict[str, str]:
    """The scope of every piece of a line, found as editors do: the first match wins, then the first rule."""
    found: dict[str, str] = {}
    position = 0
    while position < len(line):
        hits = [
            (match.start(), order, match, rule)
            for order, (pattern, rule) in enumerate(RULES)
            if (match := pattern.search(line, position)) is not None and match.group()
        ]
        if not hits:
            break
        _, _, match, rule = min(hits, key=lambda hit: hit[:2])
        if "name" in rule:
            found[match.group()] = rule["name"]
        for group, scope in rule.get("captures", {}).items():
            if match[int(group)] is not None:
                found[match[int(group)]] = scope["name"]
        position = match.end()
    return {piece: scope.removesuffix(".stlc") for piece, scope in found.items()}


def test_a_requirement():
    found = colours("@safety require stop: sign == light -> always[0, T - 2.5 s] (dx > gap)  # why")
    assert found["@safety"] == "storage.modifier.tag"
    assert found["require"] == "keyword.declaration"
    assert found["stop"] == "entity.name.section"
    assert found["always"] == "keyword.operator.temporal"
    assert found["T"] == "variable.language"
    assert found["2.5"] == "constant.numeric"
    assert found["s"] == "keyword.other.unit"
    assert found["->"] == "keyword.operator"
    assert found["# why"] == "comment.line"
    assert "dx" not in found


def test_declarations():
    found = colours("env signal v_lead : real [m/s] in [0, 10]")
    assert found == {
        "env": "storage.modifier.role",
        "signal": "keyword.declaration",
        "v_lead": "variable.other.declaration",
        "real": "support.type",
        "m/s": "keyword.other.unit",
        "in": "keyword.operator.word",
        "0": "constant.numeric",
        "10": "constant.numeric",
    }
    assert colours("region pond = circle([0, 0], 2 m)")["circle"] == "support.class.region"
    assert colours("extern fn ee(q: real[7]) -> real[3]")["ee"] == "entity.name.function"


def test_words_within_names_are_names():
    assert colours("always_on steps_taken T_red inform") == {}
    assert colours("`always` x") == {"`always`": "variable.other"}
    assert "spec" not in colours("x > spec")


def test_percent_is_a_unit_unless_an_operand_follows():
    assert colours("x > 5 % and y")["%"] == "keyword.other.unit"
    assert colours("signal s [%]")["%"] == "keyword.other.unit"
    assert colours("x > 5 % 3")["%"] == "keyword.operator"


def test_the_mission_clock():
    found = colours("always@(5 s, 10 steps] home")
    assert found["always"] == "keyword.operator.temporal"
    assert found["steps"] == "keyword.other.unit"


def test_documentation_is_a_comment_of_its_own():
    assert colours("## what holds") == {"## what holds": "comment.line.documentation"}
    assert colours("// always") == {"// always": "comment.line"}


def test_every_reserved_word_is_coloured():
    wanted = {
        **dict.fromkeys(RESERVED, "keyword.operator.word"),
        **dict.fromkeys(("true", "false", "inf"), "constant.language"),
        **dict.fromkeys(OPERATORS, "keyword.operator.temporal"),
        **dict.fromkeys(DECLARATIONS, "keyword.declaration"),
    }
    assert {word: colours(f"x {word} (y)")[word] for word in RESERVED} == {
        word: wanted[word] for word in RESERVED
    }


def test_every_unit_is_coloured():
    units = Unit.SYMBOLS.keys() - {"1"}
    assert {colours(f"x > 2 {unit} ")[unit] for unit in units} == {"keyword.other.unit"}


def test_the_extension_claims_what_it_has():
    package = json.loads((EXTENSION / "package.json").read_text(encoding="utf-8"))
    contributed = package["contributes"]
    assert [language["extensions"] for language in contributed["languages"]] == [[".stl", ".stlc"]]
    assert contributed["grammars"][0]["scopeName"] == GRAMMAR["scopeName"]
    for entry in (*contributed["grammars"], {"path": contributed["languages"][0]["configuration"]}):
        assert (EXTENSION / entry["path"]).is_file()
    assert (EXTENSION / package["main"]).is_file()
    json.loads((EXTENSION / "language-configuration.json").read_text(encoding="utf-8"))
