"""Suites of other monitors: small ones in their form, with a wrong expectation each."""

from __future__ import annotations

import json
from pathlib import Path

from helpers.tools import load_tool

suites = load_tool("suites")

FORMULAS = """\
INPUT a, b: bool;
FTSPEC
    G[1] a && !b;
    a U[1,2] b;
"""
TRACE = "# a,b\n1,0\n1,1\n0,1\n1,0\n"
ORACLE = "0:0,T\n0:2,F\n1:0,T\n1:1,F\n"
"""The last verdict is wrong: from sample 1 on, `b` holds at sample 2."""

TESTS = """
class Suite:
    def __init__(self):
        self.one = 1
        self.two = -2

    def test_window(self):
        spec.spec = 'out = always[0,1](req)'
        out1 = spec.update(0, [('req', self.one)])
        out2 = spec.update(1, [('req', self.two)])
        self.assertEqual(out1, 7, "not known yet")
        self.assertEqual(out2, -2, "the first start")

    def test_since(self):
        spec.spec = 'out = req since[0,1] gnt'
        out1 = spec.update(0, [('req', self.two), ('gnt', self.one)])
        out2 = spec.update(1, [('req', self.two), ('gnt', self.two)])
        self.assertEqual(out1, 1)
        self.assertEqual(out2, 1, "wrong")

    def test_error(self):
        spec.spec = 'out = next(req)'
        self.assertRaises(Exception, spec.update, 0, [('req', self.one)])
"""


def test_verdicts_of_r2u2_are_compared(tmp_path: Path):
    texts = {"c2po/a.c2po": FORMULAS, "trace/a.csv": TRACE, "oracle/a.log": ORACLE}
    tests = [{"mltl": "a.c2po", "trace": "a.csv", "oracle": "a.log"}]
    for name, text in {**texts, "suites/all.json": json.dumps({"tests": tests})}.items():
        path = tmp_path / "test" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    found = suites.r2u2(tmp_path)
    assert (found.tests, found.untranslated, found.equal, found.different.total()) == (1, 0, 4, 1)


def test_values_of_rtamt_are_compared(tmp_path: Path):
    path = tmp_path / "tests/python/api/test_stl_discrete_time_online_specification.py"
    path.parent.mkdir(parents=True)
    path.write_text(TESTS)
    found = suites.rtamt(tmp_path)
    assert (found.tests, found.untranslated, found.equal) == (3, 1, 2)
    assert dict(found.different) == {"req since[0,1] gnt: -2, there 1": 1}
