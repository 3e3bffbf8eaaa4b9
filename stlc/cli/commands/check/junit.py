"""Results of `stlc check` as JUnit XML."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from stlc.cli.commands.check.many import Outcome
from stlc.cli.commands.check.text import inconclusive, remarks_of, robustness_of, words_of
from stlc.escape import xml


def junit(outcomes: Sequence[Outcome], *, strict: bool = False) -> str:
    """The results as a JUnit XML document; with `strict`, what was not fully judged is skipped."""
    lines = ['<?xml version="1.0" encoding="UTF-8"?>', f"<testsuites{_counts(outcomes, strict=strict)}>"]
    for outcome in outcomes:
        lines += _suite(outcome, strict=strict)
    return "\n".join([*lines, "</testsuites>", ""])


def _counts(outcomes: Sequence[Outcome], *, strict: bool) -> str:
    rows = [row for outcome in outcomes for row in outcome.rows]
    errors = sum(bool(outcome.errors) for outcome in outcomes)
    failures = sum(row.overall == "violated" for row in rows)
    skipped = sum(
        row.overall in ("inconclusive", "out of scope") or (strict and row.unjudged) for row in rows
    )
    seconds = sum(outcome.seconds for outcome in outcomes)
    return (
        f' tests="{len(rows) + errors}" failures="{failures}" errors="{errors}" skipped="{skipped}"'
        f' time="{seconds:.3f}"'
    )


def _suite(outcome: Outcome, *, strict: bool) -> Iterator[str]:
    yield f"  <testsuite name={_attribute(outcome.name)}{_counts([outcome], strict=strict)}>"
    for error in outcome.errors[:1]:
        yield f'    <testcase classname={_attribute(outcome.name)} name="trace">'
        detail = xml("\n".join(f"{e.code}: {e.message}" for e in outcome.errors))
        kind, message = _attribute(error.code), _attribute(error.message)
        yield f"      <error type={kind} message={message}>{detail}</error>"
        yield "    </testcase>"
    for row in outcome.rows:
        head = f"    <testcase classname={_attribute(outcome.name)} name={_attribute(row.name)}"
        told = "\n".join([words_of(row), *remarks_of(row)]) if row.facts else ""
        if row.overall == "satisfied" and not told:
            yield f"{head}/>"
            continue
        yield f"{head}>"
        if row.overall == "violated":
            message = ", ".join(
                filter(None, (f"robustness {robustness_of(row, outcome.verdict)}", row.where))
            )
            why = "" if row.cause is None else row.cause.because
            yield f'      <failure type="violated" message={_attribute(message)}>{xml(why)}</failure>'
        elif row.overall != "satisfied":
            why = inconclusive(row, outcome.verdict) if row.overall == "inconclusive" else row.overall
            yield f"      <skipped message={_attribute(why)}/>"
        elif strict and row.unjudged:
            yield f"      <skipped message={_attribute(told)}/>"
        if told:
            yield f"      <system-out>{xml(told)}</system-out>"
        yield "    </testcase>"
    if outcome.verdict is not None and outcome.verdict.remarks:
        told = "\n".join(fact.text for fact in outcome.verdict.remarks)
        yield f"    <system-out>{xml(told)}</system-out>"
    yield "  </testsuite>"


def _attribute(text: str) -> str:
    return f'"{xml(text)}"'
