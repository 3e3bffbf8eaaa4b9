"""The base installation: tests that need an optional package are skipped where torch is not installed.

A test needs a package if it fails and asked for the package on its way.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from importlib.abc import MetaPathFinder
from typing import Any

import pytest

from stlc.extras import EXTRAS, package_of

TOOLS = ("jsonschema", "scipy", "hatchling", "packaging", "pandas", "polars", "rtamt", "ruff", "sphinx")
"""Packages that only tests use."""
OPTIONAL = frozenset({*TOOLS, *(package for brought in EXTRAS.values() for package in brought)})


class Absent(MetaPathFinder):
    """The last finder of modules: it finds none, and notes the optional packages that were asked for."""

    def __init__(self) -> None:
        self.asked: set[str] = set()

    def find_spec(self, name: str, path: Sequence[str] | None = None, target: object = None) -> None:  # noqa: ARG002
        if path is None and package_of(name) in OPTIONAL:
            self.asked.add(package_of(name))


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(collector: pytest.Collector) -> Iterator[Any]:
    ABSENT.asked.clear()
    report = yield
    if report.failed and ABSENT.asked:
        report.outcome = "skipped"
        report.longrepr = (str(collector.path), 0, f"needs {', '.join(sorted(ABSENT.asked))}")
    return report


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol() -> Iterator[Any]:
    ABSENT.asked.clear()
    return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]) -> Iterator[Any]:
    report = yield
    if report.failed and call.excinfo is not None:
        error: Any = call.excinfo.value
        needs = ABSENT.asked or getattr(error, "needs", set())  # that of a fixture, which fails again
        if needs:
            error.needs = set(needs)
            report.outcome = "skipped"
            report.longrepr = (str(item.path), 0, f"needs {', '.join(sorted(needs))}")
    return report


ABSENT = Absent()
sys.meta_path.append(ABSENT)
