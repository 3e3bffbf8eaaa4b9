"""The rooms of docs/architecture.md: imports go down only, and heavy libraries stay where they belong."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest
from helpers.sources import tree

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = (ROOT / "stlc", ROOT / "benchmarks")

# From the bottom up; what stands in one line is one room.
ROOMS = (
    {"source", "version", "stopping", "similar"},
    {"diagnostics"},
    {"escape"},
    {"activity", "options", "plugins", "registry", "units", "jsontext", "records", "extras", "tabular"},
    {"signature"},
    {"rundir", "files", "foreign", "provenance", "cache", "toolchain", "native", "trace"},
    {"grammar"},
    {"compile"},
    {"runtime"},
    {"lint"},
    {"dynamics"},
    {"monitor"},
    {"plants"},
    {"controller"},
    {"assurance"},
    {"export"},
    {"view"},
    {"editor"},
    {"gym"},
    {"cli", "__main__"},
    {"__init__"},
    {"benchmarks"},
)

# Where a library may be imported, as prefixes of module names. What is not listed may be used anywhere.
HOMES = {
    "torch": (
        "stlc.compile.backends.torch",
        "stlc.dynamics",
        "stlc.controller",
        "stlc.assurance",
        "stlc.export",
        "stlc.view",
        "stlc.gym",
        "stlc.cli",
        "benchmarks",
    ),
    "safetensors": ("stlc.controller",),
    "lark": ("stlc.grammar.tables", "stlc.grammar.parser", "stlc.grammar.fold", "stlc.grammar.tokens"),
    "rich": ("stlc.cli", "stlc.view"),
    "typer": ("stlc.cli", "benchmarks"),
    "click": (),
    "yaml": ("stlc.dynamics.declaration.schema.yaml_nodes", "benchmarks.tables.ainncs"),
    "pydantic": (),
    "matplotlib": ("stlc.view", "stlc.controller.sketch"),  # what worlds draw with, while they draw
    "pygls": ("stlc.editor",),
    "gymnasium": ("stlc.gym", "benchmarks.methods", "stlc.plants.kinds.gym"),
    "stable_baselines3": ("stlc.gym", "benchmarks.methods"),
    "lsprotocol": ("stlc.editor",),
    "PIL": ("stlc.view",),
    "numpy": (
        "stlc.trace",
        "stlc.native",
        "stlc.compile",
        "stlc.dynamics",
        "stlc.monitor",
        "stlc.plants",
        "stlc.runtime",
        "stlc.controller",
        "stlc.assurance",
        "stlc.export",
        "stlc.view",
        "stlc.gym",
        "stlc.cli",
        "benchmarks",
    ),
    "onnx": ("stlc.export", "stlc.assurance.verification.onnx_layers"),
    "onnxruntime": ("stlc.runtime", "stlc.plants.controller"),
    "fmpy": ("stlc.plants.kinds.fmu",),
    "pyarrow": ("stlc.trace.formats.parquet", "stlc.trace.formats.cells"),
    "h5py": ("stlc.trace.formats.mat",),
    "mcap": ("stlc.trace.formats.mcap",),
    "tensorboardX": ("stlc.controller.training.tensorboard",),
    "ray": ("stlc.controller.parallel.ray_cluster",),
    "rosbags": ("stlc.trace.formats.bag",),
    "pytorch_kinematics": ("stlc.dynamics.crosscheck",),
    "pickle": (),
    "marshal": (),
    "shelve": (),
    "dill": (),
}


@dataclass(frozen=True)
class Import:
    """One imported module: from where, and whether only type checkers see it."""

    module: str
    target: str
    line: int
    typing_only: bool


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" and len(parts) > 2 else parts)


MODULES = {module_name(path): path for package in PACKAGES for path in sorted(package.rglob("*.py"))}


@cache
def nodes_of(name: str) -> list[ast.AST]:
    """The nodes of a module that may import something, guard an import or call a function."""
    found: list[ast.AST] = []
    queue: list[object] = [tree(MODULES[name])]
    while queue:  # ast.walk takes twice as long
        each = queue.pop()
        if isinstance(each, list):
            queue += each
        elif isinstance(each, ast.AST):
            queue += each.__dict__.values()
            if isinstance(each, ast.Import | ast.ImportFrom | ast.If | ast.Call):
                found.append(each)
    return found


def imports_of(name: str) -> Iterator[Import]:
    guarded = {
        id(node)
        for block in nodes_of(name)
        if isinstance(block, ast.If) and last_name(block.test) == "TYPE_CHECKING"
        for statement in block.body
        for node in ast.walk(statement)
    }
    for node in nodes_of(name):
        for target in targets_of(node):
            yield Import(name, target, node.lineno, id(node) in guarded)


def targets_of(node: ast.AST) -> Iterator[str]:
    """Modules that a statement imports; `from package import module` names the module."""
    if isinstance(node, ast.Import):
        yield from (alias.name for alias in node.names)
    elif isinstance(node, ast.ImportFrom):
        assert node.level == 0, "imports are absolute"
        for alias in node.names:
            full = f"{node.module}.{alias.name}"
            yield full if full in MODULES else str(node.module)
    elif isinstance(node, ast.Call) and last_name(node.func) == "import_module":
        argument = node.args[0]
        if isinstance(argument, ast.Constant):
            yield str(argument.value)


def last_name(function: ast.expr) -> str:
    """The `c` of `a.b.c`."""
    return str(getattr(function, "attr", getattr(function, "id", "")))


def room_of(module: str) -> int:
    package, _, rest = module.partition(".")
    top = "benchmarks" if package == "benchmarks" else rest.partition(".")[0] or "__init__"
    (room,) = [index for index, names in enumerate(ROOMS) if top in names]
    return room


@cache
def every_import() -> list[Import]:
    return [entry for name in MODULES for entry in imports_of(name)]


def test_every_module_has_one_room():
    assert len(MODULES) > 20
    for name in MODULES:
        room_of(name)


def test_imports_go_down_only():
    upward = [
        f"{entry.module}:{entry.line} imports {entry.target}"
        for entry in every_import()
        if entry.target.partition(".")[0] in ("stlc", "benchmarks")
        and room_of(entry.target) > room_of(entry.module)
    ]
    assert not upward, "\n".join(upward)


def order_of_packages() -> dict[str, list[str]]:
    """Packages and modules of each room, from below, as the table of docs/architecture.md names them."""
    text = (ROOT / "docs/architecture.md").read_text(encoding="utf-8")
    table = text.partition("| room | packages and modules, from below |\n|---|---|\n")[2].partition("\n\n")[0]
    rows = [row.split("|")[1:3] for row in table.splitlines()]
    return {re.findall("`(.+?)`", room)[0]: re.findall("`(.+?)`", names) for room, names in rows}


def test_packages_of_a_room_import_those_before_them():
    order = order_of_packages()
    assert {"grammar", "compile", "dynamics", "controller", "cli"} < order.keys()
    backward, seen = [], 0
    for entry in every_import():
        places = [name.removeprefix("stlc.").split(".")[:2] for name in (entry.module, entry.target)]
        rooms, (taker, giver) = {place[0] for place in places}, (place[-1] for place in places)
        names = order.get(places[0][0], [])
        if len(rooms) == 1 and {taker, giver} <= {*names}:
            seen += 1
            if names.index(giver) > names.index(taker):
                backward.append(f"{entry.module}:{entry.line} imports {entry.target}")
    assert not backward, "\n".join(backward)
    assert seen > 100


def test_no_cycles():
    graph: dict[str, set[str]] = {name: set() for name in MODULES}
    for entry in every_import():
        if entry.target in MODULES and entry.target != entry.module and not entry.typing_only:
            graph[entry.module].add(entry.target)
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(" -> ".join(error.args[1]))


def test_a_library_is_imported_only_where_it_belongs():
    strays = [
        f"{library} is imported in {entry.module}:{entry.line}"
        for entry in every_import()
        if (library := entry.target.partition(".")[0]) in HOMES
        and not entry.typing_only
        and not entry.module.startswith(HOMES[library])
    ]
    assert not strays, "\n".join(strays)


def test_schemas_do_not_import_torch():
    light = ("stlc.dynamics.declaration", "stlc.dynamics.load")
    strays = [
        entry
        for entry in every_import()
        if entry.module.startswith(light) and entry.target.partition(".")[0] == "torch"
    ]
    assert not strays


DANGEROUS = {
    "eval": "evaluates text",
    "exec": "runs text",
    "compile": "compiles text",
    "yaml.load": "builds objects",
    "yaml.unsafe_load": "builds objects",
    "yaml.full_load": "builds objects",
    "os.system": "runs a shell",
}


LOOKED_AT = {"shell", "weights_only", "allow_pickle"}
SUSPECT = {*(name.rpartition(".")[2] for name in DANGEROUS), "load"}


def calls(nodes: Iterable[ast.AST]) -> Iterator[tuple[str, ast.Call]]:
    for node in nodes:
        if isinstance(node, ast.Call) and (last_name(node.func) in SUSPECT or node.keywords):
            yield ast.unparse(node.func), node


def test_nothing_that_a_user_gives_is_run():
    found = [
        f"{name}:{call.lineno}: {function} {why}"
        for name in MODULES
        for function, call in calls(nodes_of(name))
        if (why := danger(function, call))
    ]
    assert not found, "\n".join(found)


def danger(function: str, call: ast.Call) -> str:
    """Fault of a call; "" if there is none."""
    options = {word.arg: ast.unparse(word.value) for word in call.keywords if word.arg in LOOKED_AT}
    if function in DANGEROUS:
        return DANGEROUS[function]
    if options.get("shell", "False") != "False":
        return "starts a shell"
    if function.endswith("torch.load") and options.get("weights_only") != "True":
        return "unpickles"
    if function in ("np.load", "numpy.load") and options.get("allow_pickle") != "False":
        return "may unpickle"
    return ""


@pytest.mark.parametrize(
    "text", ["eval(x)", "run(x, shell=True)", "torch.load(f)", "np.load(f)", "np.load(f, allow_pickle=True)"]
)
def test_a_dangerous_call_is_noticed(text):
    ((function, call),) = calls(ast.walk(ast.parse(text)))
    assert danger(function, call)
