"""Verdicts in the XML that test runners and their dashboards read: a suite a file, a case a requirement."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from stlc.cli.check.outcome import Outcome, Row
from stlc.escape import xml


def junit(outcomes: Sequence[Outcome]) -> str:
    """The document."""
    lines = ['<?xml version="1.0" encoding="UTF-8"?>', f"<testsuites{_counts(outcomes)}>"]
    for outcome in outcomes:
        lines += _suite(outcome)
    return "\n".join([*lines, "</testsuites>", ""])


def _counts(outcomes: Sequence[Outcome]) -> str:
    rows = [row for outcome in outcomes for row in outcome.rows]
    errors = sum(bool(outcome.errors) for outcome in outcomes)
    failures = sum(row.status == "violated" for row in rows)
    skipped = sum(row.status in ("inconclusive", "out of scope") for row in rows)
    seconds = sum(outcome.seconds for outcome in outcomes)
    return (
        f' tests="{len(rows) + errors}" failures="{failures}" errors="{errors}" skipped="{skipped}"'
        f' time="{seconds:.3f}"'
    )


def _suite(outcome: Outcome) -> Iterator[str]:
    yield f"  <testsuite name={_attribute(outcome.name)}{_counts([outcome])}>"
    for error in outcome.errors[:1]:
        yield f'    <testcase classname={_attribute(outcome.name)} name="trace">'
        detail = xml("\n".join(f"{e.code}: {e.message}" for e in outcome.errors))
        told = f"type={_attribute(error.code)} message={_attribute(error.message)}"
        yield f"      <error {told}>{detail}</error>"
        yield "    </testcase>"
    for row in outcome.rows:
        yield from _case(outcome, row)
    yield "  </testsuite>"


def _case(outcome: Outcome, row: Row) -> Iterator[str]:
    head = f"    <testcase classname={_attribute(outcome.name)} name={_attribute(row.name)}"
    if row.status == "satisfied":
        yield f"{head}/>"
        return
    yield f"{head}>"
    if row.status == "violated":
        message = f"robustness {row.robustness}{', ' + row.where if row.where else ''}"
        yield f'      <failure type="violated" message={_attribute(message)}>{xml(row.why)}</failure>'
    else:
        yield f"      <skipped message={_attribute(row.why or row.status)}/>"
    yield "    </testcase>"


def _attribute(text: str) -> str:
    return f'"{xml(text)}"'
