"""Statistical bounds as text."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

from stlc.assurance.bounds import floored, raised
from stlc.diagnostics import usage
from stlc.escape import visible
from stlc.jsontext import plain
from stlc.options import Options

if TYPE_CHECKING:
    from stlc.assurance.certificate import Assessment


def require_claim(share: float | None, fail_under: float | None) -> None:
    """Check the options `--certify` and `--fail-under`.

    Raises:
        UsageError: U101, `share` is not between 0 and 1, or both options are given: each sets the exit code.
    """
    if share is not None and Options.checked_share("--certify", share) and fail_under is not None:
        raise usage("`--certify` does not go with `--fail-under`", "each of them says what the exit code is")


def bounds_lines(found: Assessment | Mapping[str, Any]) -> Iterator[str]:
    """Lines of text that show bounds: the answer, a table of the requirements, and the assumptions."""
    from stlc.cli.framework.output import table

    record: Any = plain(found)
    noun, overall = record["unit"], record["overall"]
    target = record["share"] or record["confidence"]
    each = [overall, *(record["requirements"] if len(record["requirements"]) > 1 else ())]
    header = (
        "",
        "satisfied",
        "share",
        "at least",
        "interval",
        f"next {noun}",
        f"{percent(target)} of {noun}s",
    )
    yield f"  {answer(record)}"
    yield table([_row(one) for one in each], header=header)
    yield from _more(record)
    yield "  assumed:"
    yield from (f"    - {text}" for text in record["assumptions"])


def answer(record: Mapping[str, Any]) -> str:
    """Sentence that answers the claim, such as `certified: at least 99 % of drives satisfy everything …`."""
    noun = _observed(record)
    overall, sure = record["overall"], f"with {percent(record['confidence'])} confidence"
    if record["answer"] == "measured":
        low, high = overall["interval"]
        return f"{floored(low)} to {raised(high)} of {noun} satisfy everything, {sure}"
    least = f"at least {percent(record['share'])} of {noun} satisfy everything"
    match record["answer"]:
        case "certified":
            return f"certified: {least}, {sure}"
        case "refuted":
            return (
                f"refuted: at most {raised(overall['upper_deployed'])} of {noun} satisfy everything, {sure}"
            )
    return f"undecided, {sure}, whether {least}"


def _observed(record: Mapping[str, Any]) -> str:
    """Plural of what is judged: drives, of which a unit may have several, traces or simulations."""
    return {"trace": "traces", "simulation": "simulations"}.get(record["unit"], "drives")


def _row(one: Mapping[str, Any]) -> tuple[str, ...]:
    low, high = one["interval"]
    unit = one["robustness_unit"]
    return (
        one["name"],
        f"{one['satisfied']:,} of {one['drives']:,}",
        percent(one["share"]),
        floored(one["lower_deployed"]),
        f"{floored(low)} to {raised(high)}",
        robustness(one["next_robustness"], unit),
        robustness(one["reached_robustness"], unit),
    )


def _more(record: Mapping[str, Any]) -> Iterator[str]:
    overall, noun = record["overall"], record["unit"]
    if overall["drives"] > overall["units"]:
        whole = f"{overall['whole_units']:,} of {overall['units']:,} {noun}s satisfy everything as a whole"
        yield f"  {whole}: at least {floored(overall['whole_units_lower'])} of {noun}s"
    if overall["undecided"]:
        some = f"{overall['undecided']:,} of {overall['drives']:,} {_observed(record)}"
        yield f"  {some} have no verdict, as after too few steps, and count as not satisfied in lower bounds"
    needed = record["needed"]
    if record["answer"] == "undecided" and overall["units"] < needed["units"]:
        yield f"  {percent(record['share'])} needs {needed['units']:,} {noun}s without a failure"
    if needed["robustness"] is not None and record["calibration"] < needed["robustness"]:
        yield f"  a bound on the next robustness needs {needed['robustness']:,} {noun}s"
    if record["sequential"] and overall["lower_fixed"] is not None:
        fixed = f"at least {floored(overall['lower_fixed'])}"
        yield f"  Clopper-Pearson: {fixed}, which holds only for a number of {noun}s fixed in advance"
    if record["shift"] is not None:
        yield f"  after a shift of {record['shift']}; without it at least {floored(overall['lower'])}"
    if record["online"] is not None:
        margins = [margin for margin in record["online"]["margins"] if isinstance(margin, float)]
        if margins:
            sure = percent(record["online"]["confidence"])
            parts = f"less {margins[0]:.3g} at the start, at most {max(margins):.3g} later ({sure})"
            yield f"  while driving, robustness is at least that of the plan followed {parts}"


def percent(share: float) -> str:
    """Format a share, such as `99.5 %`, with up to two decimals; it is never rounded to 0 or 100 %."""
    text = f"{100 * share:.2f}".rstrip("0").rstrip(".")
    if 0.0 < share < 1.0 and text in ("0", "100"):
        text = "< 0.01" if share < 0.5 else "> 99.99"
    return f"{text} %"


def robustness(value: float | str, unit: str) -> str:
    """Format a lower bound on robustness; `unknown` if there are too few drives for one."""
    if isinstance(value, str):
        return "unknown" if value.startswith("-") else value
    return f"{value:.3g} {visible(unit)}".rstrip()
