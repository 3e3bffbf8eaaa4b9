"""Documents that commands print with `--json`, as typed records from which their JSON Schemas are derived.

Times are in seconds, positions count from 1. A number (`Num`) that is not finite is a text. Within one major
version of a schema, keys are added and never removed.
"""

from types import NoneType
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    Literal,
    NotRequired,
    TypeAlias,
    TypedDict,
    TypeVar,
    get_args,
    get_origin,
    get_type_hints,
    is_typeddict,
)

from stlc.cli.framework.assured import (
    Assurance,
    CertifyResult,
    ClosedLoopRecord,
    FalsificationRounds,
    FalsifyResult,
    UncertainSignal,
    Verified,
)
from stlc.cli.framework.plan_documents import Plans
from stlc.cli.framework.plant_documents import PlantSimulation

if TYPE_CHECKING:
    from stlc.view.learning import Learning

R = TypeVar("R")

Num: TypeAlias = float | str
Count = Annotated[int, 0]
Positive = Annotated[float, 0]
"""Numbers that are not negative."""


def record(kind: type[R], source: object, **given: object) -> R:
    """Return a record of the type `kind`.

    The value of a key is taken from `given`, else from the attribute of `source` with the same name. Optional
    keys that neither has are left out.
    """
    optional: frozenset[str] = getattr(kind, "__optional_keys__", frozenset())
    missing = (name for name in kind.__annotations__ if name not in given)
    names = [name for name in missing if name not in optional or hasattr(source, name)]
    made: Any = {name: getattr(source, name) for name in names} | given
    found: R = made
    return found


class Horizon(TypedDict):
    seconds: Num
    steps: int


class UnknownSamples(TypedDict):
    samples: int
    first: float
    last: float


class WorstStart(TypedDict):
    trace: int
    start: Num
    time: Num


class Robustness(TypedDict):
    min: Num | None
    mean: Num | None
    low: Num | None
    high: Num | None
    argmin: WorstStart
    unit: str


class ReadingRecord(TypedDict):
    signal: str
    value: Num
    text: str
    unit: str


class PlaceRecord(TypedDict):
    line: int
    column: int


class CauseRecord(TypedDict):
    signal: str | None
    value: Num | None
    predicate: str
    readings: list[ReadingRecord]
    trace: int
    start: int
    sample: int
    time: Num
    span: PlaceRecord
    requirement: PlaceRecord
    because: str


class JudgedPart(TypedDict):
    first: Num
    last: Num
    of: Num


class FactRecord(TypedDict):
    code: str
    text: str
    advice: list[str]
    signal: str
    time: Num | None
    count: int | None
    of: int | None
    unjudged: bool


class ClockRecord(TypedDict):
    name: str
    unit: str
    why: str
    others: list[str]


class FileRecord(TypedDict):
    path: str
    sha256: str
    bytes: int


class EvidenceRecord(TypedDict):
    stlc: str
    trace: FileRecord
    inputs: list[FileRecord]
    options: dict[str, list[str]]


class CheckedRequirement(TypedDict):
    name: str
    id: NotRequired[str]
    doc: str
    tags: list[str]
    verdict: Literal["satisfied", "violated", "inconclusive"]
    robustness: Robustness
    starts: int
    satisfied_share: Num
    violated_traces: int
    judged: NotRequired[JudgedPart | None]
    facts: NotRequired[list[FactRecord]]
    cause: CauseRecord | None


class CheckedTrace(TypedDict):
    assurance: NotRequired[Assurance]
    trace: str
    spec: str
    spec_sha256: str
    dt: Num
    horizon: Horizon | None
    end: Literal["open", "strict", "truncate"]
    traces: int
    samples: int
    clocks: NotRequired[list[ClockRecord]]
    facts: NotRequired[list[FactRecord]]
    lint: NotRequired[list[str]]
    unknown: dict[str, UnknownSamples]
    uncertain: NotRequired[dict[str, UncertainSignal]]
    in_scope: int
    verdict: Literal["satisfied", "violated", "inconclusive", "out of scope"]
    robustness: Num | None
    satisfied_traces: int
    satisfied_share: Num
    evidence: NotRequired[EvidenceRecord]
    requirements: list[CheckedRequirement]


class InvalidTrace(TypedDict):
    trace: str
    verdict: Literal["invalid", "not judged"]


class CheckedTraces(TypedDict):
    assurance: NotRequired[Assurance]
    verdict: Literal["satisfied", "violated", "inconclusive", "out of scope"]
    files: list[CheckedTrace | InvalidTrace]


class AddedState(TypedDict):
    name: str
    kind: str
    initial: Num | None
    range: list[Num | None]
    about: str


class WrittenInterval(TypedDict):
    operator: str
    steps: list[int | None]
    seconds: list[Num | None]
    written: str
    line: int | None


class RequirementInSteps(TypedDict):
    name: str
    doc: str
    tags: list[str]
    weight: Num
    scale: Num
    reach: Horizon
    intervals: list[WrittenInterval]


class CompiledSpec(TypedDict):
    spec: str
    spec_sha256: str
    system: str
    dt: Num
    horizon: Horizon
    states: list[str]
    added: list[AddedState]
    safety: list[str]
    requirements: list[RequirementInSteps]


class SyntaxTree(TypedDict):
    node: str
    line: int
    column: int


class ParsedFile(TypedDict):
    file: str
    tree: SyntaxTree


class ParsedFiles(TypedDict):
    files: list[ParsedFile]


class InstallationFinding(TypedDict):
    name: str
    state: Literal["ok", "missing", "off"]
    detail: str


class InstallationReport(TypedDict):
    findings: list[InstallationFinding]


class CodeList(TypedDict):
    codes: dict[str, str]


class PageExample(TypedDict):
    language: str
    notes: list[str]
    text: str


class ManualPage(TypedDict):
    name: str
    title: str
    text: str
    examples: list[PageExample]


class RequirementInWords(TypedDict):
    name: str
    kind: Literal["require", "assume"]
    tags: list[str]
    doc: str
    sentence: str
    where: dict[str, str]


class SpecInWords(TypedDict):
    spec: str
    requirements: list[RequirementInWords]


class CauseNodeRecord(TypedDict):
    depth: int
    text: str
    line: int
    column: int
    holds: bool
    time: Num
    robustness: Num
    readings: list[str]
    unit: str


class ViolationCause(TypedDict):
    requirement: str
    trace: int
    start: Num
    violated: Num
    because: str
    tree: list[CauseNodeRecord]


class Explanation(TypedDict):
    trace: str
    verdict: Literal["satisfied", "violated", "inconclusive", "out of scope"]
    causes: list[ViolationCause]


class TriedControl(TypedDict):
    name: str
    low: float
    high: float
    values: list[float]


class ChanceOfPrefix(TypedDict):
    radius: float
    length: int
    candidates: int
    theorem: float
    bound: float
    exact: float
    sampled: bool


class Guarantee(TypedDict):
    run: str
    assumptions: list[str]
    controls: list[TriedControl]
    chances: list[ChanceOfPrefix]


class ExportCheck(TypedDict):
    states: int
    guarded: int
    plan: float
    rho: float


class ExportLatency(TypedDict):
    median_ms: float
    p99_ms: float


class ExportedRun(TypedDict):
    run: str
    target: Literal["torch", "c", "onnx"]
    folder: str
    files: list[str]
    kept: list[str]
    checked: ExportCheck | None
    latency: ExportLatency | None


class FormattedFiles(TypedDict):
    files: list[str]
    changed: list[str]
    written: bool
    diff: NotRequired[str]


class Range(TypedDict):
    start: PlaceRecord
    end: PlaceRecord


class LabelRecord(TypedDict):
    file: str | None
    range: Range | None
    text: str


class Edit(TypedDict):
    file: str | None
    range: Range | None
    replacement: str


class FixRecord(TypedDict):
    text: str
    edits: list[Edit]


class DiagnosticRecord(TypedDict):
    code: str
    severity: Literal["error", "warning"]
    message: str
    file: str | None
    range: Range | None
    label: str
    labels: list[LabelRecord]
    help: list[str]
    note: list[str]
    fix: FixRecord | None


class DocumentRecord(TypedDict):
    stlc: str
    schema: str
    ok: bool
    exit_code: int
    diagnostics: list[DiagnosticRecord]
    result: Any


class CreatedFiles(TypedDict):
    files: list[str]


class LintedFiles(TypedDict):
    files: list[str]
    findings: int
    fixed: int


class PlottedTrace(TypedDict):
    trace: str
    picture: str
    shown: list[int]


class TrainingVerdict(TypedDict):
    level: Literal["infeasible", "no plan known", "not driven", "undertrained", "partly trained", "trained"]
    share_of_feasible: float | None
    sentence: str
    advice: list[str]
    next: str
    worst: NotRequired[str]


def verdict_record(learning: "Learning") -> TrainingVerdict:
    """JSON record of the assessment of a training run: level (such as "undertrained"), advice and command."""
    share, following = learning.share, learning.command
    return record(TrainingVerdict, learning, share_of_feasible=share, next=following)


class WrittenReport(TypedDict):
    run: str
    report: str
    verdict: NotRequired[TrainingVerdict]


class ListedRun(TypedDict):
    run: str
    path: str
    status: str
    accuracy: float | None
    spec: Any
    system_path: Any
    steps: Any
    seed: Any
    started: Any


class RunList(TypedDict):
    runs: list[ListedRun]


class DifferentFact(TypedDict):
    key: str
    values: list[str]


class RunComparison(TypedDict):
    runs: list[str]
    facts: list[DifferentFact]
    files: list[str]


class RunContent(TypedDict):
    run: str
    record: dict[str, Any]
    files: list[str]


class RemovedRuns(TypedDict):
    removed: list[str]


class MetricValues(TypedDict):
    mean: Num
    low: Num | None
    high: Num | None
    values: list[Num]


class UnsafeStart(TypedDict):
    seed: int
    agent: int
    savable: bool


class DecisionLatencyRecord(TypedDict):
    median: Num
    p99: Num
    samples: int


class RuleCounts(TypedDict):
    obeyed: Count
    broken: Count
    undecided: Count


class LossCause(TypedDict):
    why: Literal["start", "told", "later", "missed", "near", "rules"]
    time: Positive


class BrokenRun(TypedDict):
    seed: int
    agent: Count
    lost: bool
    rules: dict[str, float | None]
    cause: LossCause | None


class JudgedRuns(TypedDict):
    count: Count
    obeyed: Count
    safe: Count | None
    undecided: Count
    lost: Count
    told: Count
    rules: dict[str, RuleCounts]
    broken: list[BrokenRun]


class GuardedRuns(TypedDict):
    metrics: dict[str, MetricValues]
    units: dict[str, str]
    decisions: dict[str, Num]
    unsafe: NotRequired[list[UnsafeStart]]
    latency: DecisionLatencyRecord
    search: NotRequired[dict[str, Num]]
    drives: NotRequired[JudgedRuns]
    assurance: NotRequired[Assurance]


class ModelErrors(TypedDict):
    actuator_gain: NotRequired[float]
    parameters: NotRequired[float]
    actuator_noise: NotRequired[float]
    sensor_noise: NotRequired[float]
    numbers: NotRequired[list[str]]
    exact: NotRequired[list[str]]


class JudgeSpec(TypedDict):
    spec: str
    path: str
    rules: dict[str, str]


class ScenarioResult(TypedDict):
    doc: str
    expect: Literal["nominal", "ood"]
    guards: dict[str, GuardedRuns]
    judge: NotRequired[JudgeSpec | None]


class LiveMargin(TypedDict):
    status: Literal["satisfied", "violated", "inconclusive"]
    low: Num
    high: Num
    violated: Count


class RobustnessLine(TypedDict):
    step: Count
    t: float
    seed: int
    agent: Count
    decided: str | None
    plan_rho: Num | None
    policy_rho: Num | None
    plan_safe: bool | None
    margins: dict[str, LiveMargin]


class Simulation(TypedDict):
    scenarios: NotRequired[dict[str, ScenarioResult]]
    spec: str
    system: str
    run: str
    world: str | None
    scenario: str | None
    trace: str
    seeds: list[int]
    agents: int
    steps: int
    replan: int
    starts: NotRequired[Literal["any", "savable", "feasible"]]
    redrawn: NotRequired[Count]
    time_limit: NotRequired[float | None]
    paper_time_limit: NotRequired[float | None]
    ceiling: NotRequired[int]
    overrides: NotRequired[dict[str, str]]
    interval: str
    guards: dict[str, GuardedRuns]
    planners: NotRequired[dict[str, GuardedRuns]]
    animation: NotRequired[str]
    report: NotRequired[str]
    errors: NotRequired[ModelErrors]
    margin: NotRequired[dict[str, Positive]]
    safety: NotRequired[list[str]]
    judge: NotRequired[JudgeSpec | None]


SimulateResult: TypeAlias = Simulation | PlantSimulation


class ListedSystem(TypedDict):
    name: str
    path: str
    doc: str


class SystemList(TypedDict):
    systems: list[ListedSystem]


class StateFacts(TypedDict):
    name: str
    kind: str
    unit: str
    role: str
    low: Num | None
    high: Num | None
    labels: dict[str, Num]
    flow: str | None


class ControlRange(TypedDict):
    name: str
    unit: str
    low: Num
    high: Num


class InputSignal(ControlRange):
    pieces: int
    interpolate: Literal["hold", "linear", "pchip"]
    seconds: Num
    free_times: bool
    columns: list[str]


class KinematicsCheck(TypedDict):
    name: str
    distance_m: float | None
    why_not: str | None


class DrivenSteps(TypedDict):
    steps: int
    seed: int


class SystemFacts(TypedDict):
    name: str
    doc: str
    path: str
    dt: Num
    horizon: Horizon
    states: list[StateFacts]
    controls: list[ControlRange]
    inputs: list[InputSignal]
    constants: dict[str, Num]
    jumps: list[str]
    situations: list[str]
    kinematics: NotRequired[list[KinematicsCheck]]
    driven: NotRequired[DrivenSteps]


class Training(TypedDict):
    accuracy: NotRequired[float]
    interval: NotRequired[list[float]]
    held_out: NotRequired[int]
    requirements: NotRequired[dict[str, float]]
    feasible: NotRequired[float]
    searched: NotRequired[int]
    judged_seconds: NotRequired[float]
    closed_loop: NotRequired[ClosedLoopRecord]
    falsification: NotRequired[FalsificationRounds]
    verdict: NotRequired[TrainingVerdict]
    steps: NotRequired[int | None]
    schedule: NotRequired[str | None]


class TrainedRun(Training):
    run: str
    seconds: float


class TrainedJob(Training):
    spec: str
    seed: NotRequired[int]
    exit_code: int
    why: NotRequired[str]
    run: NotRequired[str]
    seconds: NotRequired[float]


class TrainedRuns(TypedDict):
    runs: list[TrainedJob]


CheckResult: TypeAlias = CheckedTrace | CheckedTraces
CompileResult: TypeAlias = CompiledSpec | ParsedFile | ParsedFiles
ExplainResult: TypeAlias = CodeList | ManualPage | SpecInWords | Explanation | Guarantee

RESULTS: dict[str, Any] = {
    "certify": CertifyResult,
    "check": CheckResult,
    "compile": CompileResult,
    "doctor": InstallationReport,
    "explain": ExplainResult,
    "export": ExportedRun,
    "falsify": FalsifyResult,
    "fmt": FormattedFiles,
    "init": CreatedFiles,
    "lint": LintedFiles,
    "plan": Plans,
    "plot": PlottedTrace,
    "report": WrittenReport,
    "runs": RunList | RunComparison | RunContent | RemovedRuns,
    "simulate": SimulateResult,
    "stlc": NoneType,
    "system": SystemList | SystemFacts,
    "train": TrainedRun | TrainedRuns,
    "verify": Verified,
}
"""The result of each command's document, by the name of its schema."""
LINES: dict[str, Any] = {"robustness-line": RobustnessLine}
"""Documents that are single lines without a frame: those of `simulate --robustness`."""


_OPEN = (SyntaxTree,)
"""Records that may have further keys."""
_NAMES: dict[Any, str] = {str: "string", int: "integer", float: "number", bool: "boolean", NoneType: "null"}


def schema_of(kind: Any) -> dict[str, Any]:
    """JSON Schema (draft 2020-12) of the values of a type."""
    origin, args = get_origin(kind), get_args(kind)
    if kind is Any:
        return {}
    if kind in _NAMES:
        return {"type": _NAMES[kind]}
    if is_typeddict(kind):
        return _object(kind)
    if origin is Annotated:
        what = args[1]() if callable(args[1]) else args[1]
        return {**schema_of(args[0]), "minimum": what} if isinstance(what, int) else {"enum": list(what)}
    if origin is Literal:
        return {"enum": list(args)}
    if origin is dict:
        return {"type": "object"} | ({} if args[1] is Any else {"additionalProperties": schema_of(args[1])})
    if origin is list:
        return {"type": "array", "items": schema_of(args[0])}
    if origin is tuple:
        return {"type": "array", "items": schema_of(args[0]), "minItems": len(args), "maxItems": len(args)}
    return _union([schema_of(each) for each in args])


def _object(kind: Any) -> dict[str, Any]:
    properties, required = {}, []
    for name, hint in get_type_hints(kind, include_extras=True).items():
        optional = get_origin(hint) is NotRequired
        properties[name] = schema_of(get_args(hint)[0] if optional else hint)
        required += [] if optional else [name]
    found: dict[str, Any] = {"type": "object", "properties": properties}
    found |= {"required": required} if required else {}
    return found | ({"additionalProperties": True} if kind in _OPEN else {})


def _union(parts: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the JSON Schema of a value that matches one of the schemas `parts`.

    Schemas that consist of a type only are joined into one: `{"type": ["string", "null"]}`.
    """
    plain = [part["type"] for part in parts if part.keys() == {"type"}]
    rest = [part for part in parts if part.keys() != {"type"}]
    if not rest:
        return {"type": plain}
    if len(rest) == 1 and plain == ["null"] and "type" in rest[0]:
        return {**rest[0], "type": [rest[0]["type"], "null"]}
    return {"anyOf": parts}
