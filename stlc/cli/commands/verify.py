"""`stlc verify`: proofs that a trained policy satisfies its specification, on boxes of initial states."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated

import typer

from stlc.assurance.options import VerifyOptions
from stlc.cli.framework.completion import run_names
from stlc.cli.framework.options import FailUnderOption
from stlc.cli.framework.output import Answer, emit, show_diagnostics, table
from stlc.cli.framework.program import command
from stlc.diagnostics import Diagnostic
from stlc.escape import visible

if TYPE_CHECKING:
    from stlc.assurance.verification.verified import Verified

OPTIONS = VerifyOptions()
_MOST = 3
"""Counterexamples that the text shows."""


@command(
    "stlc verify latest",
    "stlc verify traffic --budget 10min --jobs 2 --fail-under 0.5",
    "stlc verify latest --states 1000",
    "stlc verify loop.stl --controller network.onnx --period 0.1s",
)
def verify(
    run: Annotated[
        str,
        typer.Argument(
            metavar="RUN|SPEC", help="A run, or with --controller a specification.", autocompletion=run_names
        ),
    ] = "latest",
    options: VerifyOptions = OPTIONS,
    fail_under: FailUnderOption = None,
) -> Answer[Verified]:
    """Prove plans or closed loops on boxes of states.

    Each way to draw an initial state is divided into boxes. A box is proved if bounds on network, motion
    and robustness show that one proposal of the network satisfies the specification from every state in it.
    It is refuted if the policy violates the specification from a sampled state. More time proves more, and
    so do more processes (--jobs); each has the whole budget if --budget-clock is processor. With --states,
    boxes are also searched around random initial states; the number of states with a proof bounds the share
    of all states that have one, with 95 % confidence. Exit code: 0 all proved, 1 a counterexample was
    found, 4 open;
    with --fail-under, 0 if at least that share is proved.

    With --controller, a network acts on the system of SPEC once per period, and the whole horizon is proved,
    at the samples of the model or, with --continuous, of the exact solutions.
    """
    from stlc.assurance.verification.verified import verify as prove

    found = prove(run, **options.given())
    lost: tuple[Diagnostic, ...] = ()
    if found.lost:
        count = f"{len(found.lost):,} batch{'es' if len(found.lost) > 1 else ''} of boxes"
        message = f"{count} stayed open: lost with the processes that examined them"
        lost = (Diagnostic("R406", message, note=tuple(dict.fromkeys(found.lost))),)
    verification = found.found
    if fail_under is not None:
        code = 0 if verification.proved >= fail_under else 1 if 1.0 - verification.refuted < fail_under else 4
    elif any(each.witness is not None for each in verification.modes):
        code = 1
    else:
        code = 4 if verification.open > 0.0 else 0

    def show() -> None:
        show_diagnostics(lost)
        emit("\n".join(_lines(found)))

    return Answer(found, show, code, lost)


def _lines(told: Verified) -> Iterator[str]:
    """Lines of text that show the result of `stlc verify`."""
    from stlc.assurance.bounds import floored

    found, modes = told.found, told.modes
    rows = [
        (
            visible(mode.result.mode.name or "initial set"),
            *map(_percent, (mode.probability, mode.result.proved, mode.result.refuted, mode.result.open)),
        )
        for mode in modes
    ]
    rows.append(("all", *map(_percent, (1.0, found.proved, found.refuted, found.open))))
    yield f"{visible(told.run)}    {found.seconds:.0f} s"
    yield ""
    yield table(rows, header=("initial states", "probability", "proved", "refuted", "open"))
    if told.states:
        yield ""
        yield (
            f"{told.states_proved} of {told.states} random initial states are in a proved box, "
            f"{told.states_violated} are violated; so at least {floored(told.states_share)} of all initial "
            "states have such a box (95 % confidence)"
        )
    known = [(mode.result.mode.name, each) for mode in modes if (each := mode.result.witness) is not None]
    for name, witness in sorted(known, key=lambda pair: pair[1].robustness)[:_MOST]:
        state = ", ".join(f"{each}={value:.6g}" for each, value in witness.state.items())
        yield ""
        yield (
            f"{visible(name or 'initial set')}: violated from {visible(state)}, "
            f"robustness {witness.robustness:+.3g}"
        )


def _percent(share: float) -> str:
    value = 100.0 * share
    return f"{value:.1f} %" if value >= 0.05 or value == 0.0 else f"{value:.1g} %"
