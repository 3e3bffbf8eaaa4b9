"""Random systems and specifications as text, with every feature of both that a plan can meet.

Thresholds are odd numbers, so that no timer on the grid of dt stands exactly on one.
"""

from __future__ import annotations

from hypothesis import strategies as st

HEAD = """\
stlc: 1
name: drawn
time: {{dt: 0.1 s, horizon: 8 steps, integrator: {integrator}, substeps: {substeps}{discrete}}}
const: {{top: 2 m, low: [-2 rad, -1 rad], high: "[2 rad, 1 rad]"}}
functions: {{ee: {{kind: urdf, file: panda.urdf, tip: panda_link3}}}}
state:
  x: {{unit: m, range: [-3, 3]{clamp}}}
  y: {{unit: m}}
  v: {{unit: m/s}}
  q: {{size: 2, unit: rad, range: [low, high], clamp: true}}
  heat: {{}}
  mode: {{enum: {{eco: 0, sport: 1, rest: 4}}}}
  armed: {{bool: true, role: env}}
  count: {{role: env}}
  held: {{unit: s, timer: {timer}, run: {cond}, reset_when: {other}, to: {to} s}}
  limit: {{unit: m/s, role: env}}
param:
  gain: {{range: [0.5, 1.5]}}
  load: {{unit: kg, draw: "truncnorm(1, 0.2, 0.5, 2)"}}
control:
  a: {{unit: m/s^2, range: [-4, 4], squash: {squash}}}
  w: {{size: 2, unit: rad/s, range: [-3, 3]}}
def:
  fast: v > limit
  tip: "ee([q[0], q[1], 0.3])"
"""

FLOWS = {
    "x": ("v * cos(heat)", "v * clip(heat, -0.31, 1.7)", "if fast then v else -v / 2"),
    "y": ("v * sin(q[0])", "tip[0] * 1 m/s / 1 m", "min(v, 2 m/s, abs(limit) * gain)"),
    "v": (
        "a - 0.3 * v * abs(v) / 1 m",
        "a * gain - relu(v) / load * 1 kg/s",
        "max(a, -1.3) * ind(armed) - v / 1 s",
    ),
    "heat": (
        "(ind(fast) - heat * exp(-heat^2)) / 1 s",
        "sqrt(abs(heat) + 0.3) / 2 s - heat / 1 s",
        "atan2(q[0], q[1] + 3) / 3 s",
    ),
    "q": ("w", "[w[0], w[1] * load / 1 kg]", "-q / 1 s + w"),
}
MAPS = {name: [f"{name} + (0.1 s) * ({text})" for text in texts] for name, texts in FLOWS.items()}

CONDITIONS = (
    "v > limit",
    "x > 0.537 m",
    "mode == sport",
    "armed",
    "not armed or y < 0.31 m",
    "heat in [0.11, 0.73]",
    "tip[1] > 0.083 m",
)

JUMPS = (
    "{name: bounce, guard: x > 1.53 m and v > 0, reset: {v: -0.5 * v}, sharpness: 50}",
    "{name: hot, guard: heat > 0.37, reset: {mode: sport, heat: heat / 2}}",
    "{name: calm, guard: mode == sport and heat < 0.23, reset: {mode: rest, x: x / 2}, sharpness: 30}",
    "{name: first, guard: y > 0.213 m, reset: {y: -y}, once: true}",
    '{name: turn, guard: held > 0.537 s, reset: {q: "-q", "q[1]": 0}, once: true}',
)

DRAW = (
    'x: "uniform(-2, 2)", y: "normal(0, 1)", v: "uniform(-2, 2)", q: "uniform(low, high)",'
    ' heat: "uniform(0, 0.5)",'
    ' mode: "choice(eco, sport, rest)", armed: bernoulli(0.5), count: "randint(0, 5)", held: "uniform(0, 1)",'
    ' limit: "uniform(0, 1)"'
)
INITS = (
    f"{{mixture: [{{draw: {{{DRAW}}}}}]}}",
    f'{{mixture: [{{weight: 2, let: {{s: "uniform(0, 1)"}}, draw: {{{DRAW}}}}}, {{draw: {{{DRAW}}}}}],'
    " where: [v > -1.5 m/s]}",
    "{grid: {x: {from: -1, to: 1, count: 7}, mode: [eco, rest]}, draw: {"
    + DRAW.replace('x: "uniform(-2, 2)", ', "", 1).replace('mode: "choice(eco, sport, rest)", ', "")
    + "}}",
)


@st.composite
def systems(draw: st.DrawFn) -> str:
    """The text of a system file."""
    discrete = draw(st.integers(0, 4)) == 0
    pick = lambda options: draw(st.sampled_from(options))  # noqa: E731
    text = HEAD.format(
        integrator="euler" if discrete else pick(("euler", "heun", "rk4")),
        substeps=1 if discrete else pick((1, 3)),
        discrete=", discrete: true" if discrete else "",
        clamp=pick((", clamp: true", "")),
        timer=pick(("up", "down")),
        cond=f'"{pick(CONDITIONS)}"',
        other=f'"{pick(CONDITIONS)}"',
        to=pick(("0", "0.71")),
        squash=pick(("tanh", "clip")),
    )
    flows = MAPS if discrete else FLOWS
    text += "flow:\n" + "".join(f'  {name}: "{pick(texts)}"\n' for name, texts in flows.items())
    jumps = draw(st.lists(st.sampled_from(JUMPS), unique=True, max_size=4))
    if jumps:
        text += "jump:\n" + "".join(f"  - {jump}\n" for jump in jumps)
    return text + f"init: {pick(INITS)}\n"


# ------------------------------------------------------------------ specifications

SPEC = """\
spec drawn
state signal x [m]
state signal y [m]
state signal v [m/s]
state signal q : real[2] [rad]
state signal heat
enum Mode {{ eco = 0, sport = 1, rest = 4 }}
state signal mode : Mode
env signal armed : bool
env signal count : int
state signal held [s]
env signal limit [m/s]
const walls = [-1.7, 1.9]
def near(d) = abs(x) < d
{lines}
"""

POINTS = ("[x, y]", "[x, 0.3 m]", "[y, x]")
REGIONS = (
    "circle([0.5 m, 0.2 m], 0.7 m)",
    "box([-1 m, -0.5 m], [1.3 m, 0.9 m])",
    "halfspace([3, 4], 1 m)",
    "polygon([0 m, 0 m], [2 m, -1 m], [3 m, 1 m], [1.5 m, 3 m], [-0.5 m, 1.5 m])",
    "polygon([0 m, 0 m], [4 m, 0 m], [4 m, 1 m], [1 m, 1 m], [1 m, 3 m], [0 m, 3 m])",
    "union(circle([-1 m, 0 m], 0.6 m), box([0 m, 0 m], [1 m, 2 m]))",
    "intersect(circle([0 m, 0 m], 1.3 m), complement(box([0.1 m, 0.1 m], [1 m, 1 m])))",
    "dilate(box([-1 m, -0.5 m], [0.3 m, 0.9 m]), 0.31 m)",
    "circle([y, x], 0.9 m)",
)
SMOOTH = (
    "x > 0.31 m", "y <= -0.13 m", "v < limit + 0.2 m/s", "near(0.7 m)",
    "heat in [0.11, 0.63]", "0.1 < heat <= 0.77", "norm(q) > 0.9 rad",
    "dist([x, y], [0.4 m, -0.2 m]) > 0.6 m", "(if armed then x else y) > 0.17 m", "next(x) > x - 0.07 m",
    "shift(y, 2) < 0.57 m",
    "min(x, y, 1 m) > -0.83 m", "exists k in {0, 1}: q[k] > 0.43 rad", "forall k in {0, 1}: cos(q[k]) < 0.93",
    "ind(v > limit) * heat < 0.29", "sdist([x, y], circle([0 m, 1 m], 0.5 m)) > 0.1 m",
    "sign(x) * heat < 0.41",
    "exists w in {-1.7, 0.3, 1.9}: abs(heat - w) < 0.23",
)  # fmt: skip
STEPWISE = (
    "mode == sport", "mode in {eco, rest}", "armed", "count >= 3", "count % 2 == 0", "held < 0.537 s",
    "mode != eco", "true", "round(heat * 3) >= 1", "floor(x / 1 m) < 1",
)  # fmt: skip
"""Columns that stay constant for some steps: at ties a gradient has more than one right value."""
INTERVALS = (
    "[0, T]",
    "[0.1 s, 0.4 s]",
    "[0.2 s, 0.5 s)",
    "(0 s, 0.3 s]",
    "[0, 3 steps]",
    "[2 steps, 4 steps]",
    "[1 steps, end]",
    "",
)
PAST = ("[0, 0.3 s]", "[0, 2 steps]", "")


@st.composite
def predicates(draw: st.DrawFn, *, smooth: bool) -> str:
    """Formulas of one sample, or nearly; `smooth` ones have no ties."""
    kind = draw(st.integers(0, 4))
    if kind == 0:
        point, region = draw(st.sampled_from(POINTS)), draw(st.sampled_from(REGIONS))
        point = f"sweep({point})" if draw(st.booleans()) else point
        return f"({point} {draw(st.sampled_from(['in', 'not in']))} {region})"
    return f"({draw(st.sampled_from(SMOOTH if smooth else (*SMOOTH, *STEPWISE)))})"


@st.composite
def formulas(draw: st.DrawFn, depth: int = 2, *, ahead: bool = True, smooth: bool = False) -> str:
    """Formulas with every operator; without `ahead` of the present and the past."""
    if depth == 0:
        return draw(predicates(smooth=smooth))
    part = lambda: draw(formulas(draw(st.integers(0, depth - 1)), ahead=ahead, smooth=smooth))  # noqa: E731
    now = lambda: draw(formulas(draw(st.integers(0, depth - 1)), ahead=False, smooth=smooth))  # noqa: E731
    kinds = ["bool", "not", "past", "since", "edge"]
    kinds += ["unary", "unary", "binary", "freeze", "clock", "next"] if ahead else []
    interval = draw(st.sampled_from(INTERVALS))
    match draw(st.sampled_from(kinds)):
        case "bool":
            op = draw(st.sampled_from(["and", "or", "->", "<->", "xor"]))
            return f"({part()} {op} {part()})"
        case "not":
            return f"(not {part()})"
        case "past":
            return f"({draw(st.sampled_from(['once', 'historically']))}{draw(st.sampled_from(PAST))} {now()})"
        case "since":
            return f"({now()} since{draw(st.sampled_from(PAST))} {now()})"
        case "edge":
            return f"{draw(st.sampled_from(['rise', 'fall']))}({now()})"
        case "unary":
            return f"({draw(st.sampled_from(['always', 'eventually']))}{interval} {part()})"
        case "binary":
            return f"({part()} {draw(st.sampled_from(['until', 'release', 'unless']))}{interval} {part()})"
        case "freeze":
            level = draw(st.sampled_from(["x", "y", "next(x)", "min(x, y)"]))
            return f"(freeze x0 = {level} in ({part()} or always[0, 0.3 s] abs(x - x0) < 0.47 m))"
        case "clock":
            window = draw(st.sampled_from(["[0.2 s, 0.6 s]", "[0 s, 2 s]", "[0.3 s, 1 s)"]))
            return f"({draw(st.sampled_from(['always', 'eventually']))}@{window} {now()})"
        case _:
            return f"next({part()})"


def spec_of(lines: list[str]) -> str:
    """A specification of these requirements."""
    return SPEC.format(lines="\n".join(f"require r{i}: {line}" for i, line in enumerate(lines)))
