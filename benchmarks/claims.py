"""The paper's claims about its comparison of methods, each with a verdict based on the measured results.

The paper is Meng & Fan (2023). A claim of the form "better than every baseline" is refuted by one measured
baseline. If it is not refuted, it is confirmed only for those baselines that are measured.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

OURS = "guided"
RL = ("sac:task", "sac:robustness", "sac:accuracy", "mbpo", "pets")
CLASSICAL = ("plan:milp", "plan:mpc", "plan:gradient:paper")
CEM = "plan:cem:paper"
BASELINES = (*RL, *CLASSICAL)
"""Baselines of the paper, without CEM, to which the paper's claims do not apply."""
LEADS = {"ship_track": 0.20, "navigation": 0.45, "manipulation": 0.08}
"""Benchmark -> lead of the paper's policy over the best baseline."""
SIMPLE = ("traffic", "reach_n_avoid", "ship_safe")
BEHIND = 0.03
"""Largest gap of the paper's policy to the best baseline on the simple benchmarks."""
SLOWER = (10.0, 100.0)
"""Least and largest factor by which MPC and MILP are slower, according to the paper."""
STL_M, NEAR = 0.83, 0.02
CEM_SLOWER = 3.0
HOLDS, FAILS, OPEN = "holds", "does not hold", "not measured"


@dataclass(frozen=True, slots=True)
class Standing:
    """Measured results of one method on one benchmark.

    Attributes:
        benchmark: name of the specification.
        method: name of the method, such as `guided` or `plan:milp`.
        accuracy: plan accuracy with the longest training, or with the largest time budget per plan.
        decision_ms: median processor time of a plan from one initial state; None if not measured.
        guarded_ms: median processor time of a closed-loop decision with the paper's backup policy; None if
            not measured.
    """

    benchmark: str
    method: str
    accuracy: float
    decision_ms: float | None = None
    guarded_ms: float | None = None


@dataclass(frozen=True, slots=True)
class Claim:
    """A claim of the paper, with a verdict.

    Attributes:
        claim: the claim as a sentence.
        here: the measured results, as text.
        verdict: `holds`, `does not hold` or `not measured`.
        why: reason for the verdict `does not hold`, if one is known, else "".
    """

    claim: str
    here: str
    verdict: str
    why: str = ""


def claims(standings: Iterable[Standing]) -> list[Claim]:
    """Return all claims of the paper, each with a verdict based on the measured results `standings`."""
    known = {(each.benchmark, each.method): each for each in standings}
    return [
        *(_lead(known, name, lead) for name, lead in LEADS.items()),
        *(_behind(known, name) for name in SIMPLE),
        *(_faster(known, method, title) for method, title in (("plan:mpc", "MPC"), ("plan:milp", "MILP"))),
        _milp_on_traffic(known),
        _cem(known),
    ]


Known = dict[tuple[str, str], Standing]


def _compared(known: Known, benchmark: str) -> tuple[Standing, Standing, str] | None:
    """Return the result of our method on a benchmark, that of the best baseline, and a text with both.

    None is returned if either of the two is not measured.
    """
    ours = known.get((benchmark, OURS))
    rivals = [each for name in BASELINES if (each := known.get((benchmark, name))) is not None]
    if ours is None or not rivals:
        return None
    best = max(rivals, key=lambda each: each.accuracy)
    text = f"{OURS} {ours.accuracy:.3f}, best baseline {best.method} {best.accuracy:.3f}"
    if missing := len(BASELINES) - len(rivals):
        text += f"; {missing} of {len(BASELINES)} baselines not measured or refused"
    return ours, best, text


def _lead(known: Known, benchmark: str, lead: float) -> Claim:
    claim = f"{benchmark}: about {100 * lead:.0f} % above the best baseline but CEM"
    found = _compared(known, benchmark)
    if found is None:
        return Claim(claim, "", OPEN)
    ours, best, text = found
    if ours.accuracy - best.accuracy >= lead:
        return Claim(claim, text, HOLDS)
    room = 1.0 - best.accuracy
    why = (
        f"{best.method} leaves {100 * room:.1f} % to gain here"
        if room < lead
        else f"the lead is {100 * (ours.accuracy - best.accuracy):.1f} % of all starts, feasible or not"
    )
    return Claim(claim, text, FAILS, why)


def _behind(known: Known, benchmark: str) -> Claim:
    claim = f"{benchmark}: at most {100 * BEHIND:.0f} % below the best baseline but CEM"
    found = _compared(known, benchmark)
    if found is None:
        return Claim(claim, "", OPEN)
    ours, best, text = found
    behind = best.accuracy - ours.accuracy
    why = "" if behind <= BEHIND else f"{100 * behind:.1f} % below {best.method}"
    return Claim(claim, text, FAILS if why else HOLDS, why)


def _faster(known: Known, method: str, title: str) -> Claim:
    claim = f"10 to 100 times faster than {title} per decision"
    ratios = {
        benchmark: each.decision_ms / ours.decision_ms
        for (benchmark, name), each in known.items()
        if name == method
        and each.decision_ms is not None
        and (ours := known.get((benchmark, OURS))) is not None
        and ours.decision_ms
    }
    if not ratios:
        return Claim(claim, "", OPEN)
    text = ", ".join(f"{name} {factor:.3g} times" for name, factor in ratios.items())
    short = [name for name, factor in ratios.items() if factor < SLOWER[0]]
    beyond = [name for name, factor in ratios.items() if factor > SLOWER[1]]
    why = [f"less than {SLOWER[0]:g} times on {', '.join(short)}"] if short else []
    why += [f"more than {SLOWER[1]:g} times on {', '.join(beyond)}"] if beyond and short else []
    return Claim(claim, text, FAILS if short else HOLDS, "; ".join(why))


def _milp_on_traffic(known: Known) -> Claim:
    claim = f"traffic: STL_M, a MILP over piecewise linear paths, reaches {STL_M:.2f}"
    found = known.get(("traffic", "plan:milp"))
    if found is None:
        return Claim(claim, "", OPEN)
    text = f"plan:milp {found.accuracy:.3f}"
    if abs(found.accuracy - STL_M) <= NEAR:
        return Claim(claim, text, HOLDS)
    why = "here the model and the specification are encoded themselves, not paths that are tracked afterwards"
    return Claim(claim, text, FAILS, why if found.accuracy > STL_M else "")


def _cem(known: Known) -> Claim:
    claim = "the policy with its backup is 3 times faster than CEM"
    ratios = {
        benchmark: each.decision_ms / ours.guarded_ms
        for (benchmark, name), each in known.items()
        if name == CEM
        and each.decision_ms is not None
        and (ours := known.get((benchmark, OURS))) is not None
        and ours.guarded_ms
    }
    if not ratios:
        return Claim(claim, "", OPEN)
    text = ", ".join(f"{name} {factor:.3g} times" for name, factor in ratios.items())
    short = [name for name, factor in ratios.items() if factor < CEM_SLOWER]
    why = f"less than {CEM_SLOWER:g} times on {', '.join(short)}" if short else ""
    return Claim(claim, text, FAILS if short else HOLDS, why)


@dataclass(frozen=True, slots=True)
class Upset:
    """A benchmark on which a planner reaches a higher accuracy than the best trained policy.

    Attributes:
        benchmark: name of the specification.
        planner: name of the planner.
        budget: time budget of the planner per plan, such as `10 ms`.
        accuracy: plan accuracy of the planner.
        policy: label of the best trained policy, such as `guided-60s-seed0`.
        policy_accuracy: plan accuracy of that policy.
        decision_ms: median processor time of a decision of the planner.
        policy_ms: median processor time of a decision of the policy.
        overlap: whether the 95 % intervals of the two accuracies overlap.
    """

    benchmark: str
    planner: str
    budget: str
    accuracy: float
    policy: str
    policy_accuracy: float
    decision_ms: float | None
    policy_ms: float | None
    overlap: bool = False

    @property
    def text(self) -> str:
        """The two results in one line of text."""
        first = f"{self.benchmark}: {self.planner} at {self.budget} a plan {self.accuracy:.3f}"
        second = f"{self.policy} {self.policy_accuracy:.3f}"
        if self.decision_ms is None or self.policy_ms is None:
            text = f"{first}, {second}"
        else:
            text = f"{first} ({self.decision_ms:.2g} ms a decision), {second} ({self.policy_ms:.2g} ms)"
        return f"{text}; the intervals overlap" if self.overlap else text
