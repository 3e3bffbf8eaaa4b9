"""FMUs that are built from tests/data/fmus/models.c: a zip of a model description and a shared library."""

from __future__ import annotations

import inspect
import re
import subprocess
import zipfile
from pathlib import Path

from stlc.toolchain import compiler

SOURCE = Path(__file__).parents[1] / "data" / "fmus" / "models.c"
MODELS = {"ball": 1, "decay": 2, "oscillator": 3}
_PLATFORM = {2: "linux64", 3: "x86_64-linux"}


def build(folder: Path, model: str, fmi: int) -> Path:
    """Build `folder/model.fmu` for FMI 2 or 3, with both interfaces; return its path."""
    (folder / "stubs.h").write_text(_stubs(fmi))
    library = folder / f"{model}.so"
    command = [compiler() or "cc", "-shared", "-fPIC", "-O0", f"-DFMI={fmi}", f"-DMODEL={MODELS[model]}"]
    subprocess.run([*command, f"-I{folder}", "-o", str(library), str(SOURCE), "-lm"], check=True)
    path = folder / f"{model}.fmu"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("modelDescription.xml", description(model, fmi))
        archive.write(library, f"binaries/{_PLATFORM[fmi]}/{model}.so")
        archive.writestr("resources/readme.txt", "none")
    return path


def _stubs(fmi: int) -> str:
    """Functions of the standard that the models do not have, so that the library can be loaded."""
    from fmpy import fmi2, fmi3

    kinds = (fmi2.FMU2Slave, fmi2.FMU2Model) if fmi == 2 else (fmi3.FMU3Slave, fmi3.FMU3Model)
    names = {name for kind in kinds for name, _ in inspect.getmembers(kind) if name.startswith(f"fmi{fmi}")}
    own = set(re.findall(rf"\bfmi{fmi}\w+", SOURCE.read_text()))
    return "\n".join(f"int {name}(void) {{ return 3; }}" for name in sorted(names - own)) + "\n"


def _variables(model: str) -> list[tuple[str, str, int, str, str, str, str]]:
    """Rows of (type, name, reference, causality, variability, start, further attributes)."""
    rows = [("Real", "time", 0, "independent", "continuous", "", "")]
    units = {"ball": ('unit="m" ', 'unit="m/s" ')}.get(model, ("", ""))
    states = {"ball": ("h", "v"), "decay": ("x",), "oscillator": ("x0", "x1")}[model]
    for i, name in enumerate(states):
        start = {"h": "1", "x": "1", "x0": "2"}.get(name, "0")
        rows.append(("Real", name, 1 + i, "output", "continuous", start, f'{units[i]}initial="exact"'))
    for i, name in enumerate(states):
        rows.append(("Real", f"der({name})", 3 + i, "local", "continuous", "", f'derivative="{name}"'))
    params = {"ball": ("g", "e"), "decay": ("k",), "oscillator": ("mu",)}[model]
    for i, name in enumerate(params):
        start = {"g": "9.81", "e": "0.7"}.get(name, "1")
        rows.append(("Real", name, 5 + i, "parameter", "fixed", start, ""))
    rows.append(("Real", "force", 7, "input", "continuous", "0", ""))
    rows.append(("Real", "lifetime", 8, "parameter", "fixed", "1e300", ""))
    if model == "ball":
        rows.append(("Integer", "bounces", 9, "output", "discrete", "", ""))
        rows.append(("Boolean", "frozen", 10, "parameter", "fixed", "false", ""))
    return rows


def description(model: str, fmi: int) -> str:
    """The text of modelDescription.xml."""
    return _two(model) if fmi == 2 else _three(model)


def _units() -> str:
    units = """<Unit name="m"><BaseUnit m="1"/></Unit><Unit name="m/s"><BaseUnit m="1" s="-1"/></Unit>"""
    return f"<UnitDefinitions>{units}</UnitDefinitions>"


def _two(model: str) -> str:
    rows = _variables(model)
    order = {name: index + 1 for index, (_, name, *_) in enumerate(rows)}
    lines = []
    for kind, name, reference, causality, variability, start, rest in rows:
        derivative = re.search(r'derivative="(.*)"', rest)
        initial = re.search(r'initial="\w+"', rest)
        inner = f'derivative="{order[derivative[1]]}"' if derivative else ""
        inner += (re.search(r'unit="[^"]+"', rest) or [""])[0]
        inner += f' start="{start}"' if start else ""
        lines.append(
            f'<ScalarVariable name="{name}" valueReference="{reference}" causality="{causality}" '
            f'variability="{variability}" {initial[0] if initial else ""}><{kind} {inner}/></ScalarVariable>'
        )
    outputs = "".join(
        f'<Unknown index="{order[name]}"/>' for _, name, _, cause, *_ in rows if cause == "output"
    )
    slopes = "".join(f'<Unknown index="{order[name]}"/>' for name in order if name.startswith("der("))
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        f'<fmiModelDescription fmiVersion="2.0" modelName="{model}" guid="stlc" '
        f'numberOfEventIndicators="{int(model == "ball")}">'
        f'<ModelExchange modelIdentifier="{model}"/><CoSimulation modelIdentifier="{model}"/>'
        f"{_units()}<ModelVariables>{''.join(lines)}</ModelVariables><ModelStructure>"
        f"<Outputs>{outputs}</Outputs><Derivatives>{slopes}</Derivatives>"
        f"<InitialUnknowns>{slopes}</InitialUnknowns></ModelStructure></fmiModelDescription>"
    )


def _three(model: str) -> str:
    rows = _variables(model)
    references = {name: reference for _, name, reference, *_ in rows}
    types = {"Real": "Float64", "Integer": "Int32", "Boolean": "Boolean"}
    lines = []
    for kind, name, reference, causality, variability, start, rest in rows:
        rest = re.sub(r'derivative="(.*)"', lambda m: f'derivative="{references[m[1]]}"', rest)
        given = f'start="{start}"' if start else ""
        lines.append(
            f'<{types[kind]} name="{name}" valueReference="{reference}" causality="{causality}" '
            f'variability="{variability}" {given} {rest}/>'
        )
    if model == "ball":
        lines.append('<Float64 name="z" valueReference="11" causality="local" variability="continuous"/>')
    outputs = "".join(
        f'<Output valueReference="{ref}"/>' for _, _, ref, cause, *_ in rows if cause == "output"
    )
    slopes = [ref for name, ref in references.items() if name.startswith("der(")]
    derivatives = "".join(f'<ContinuousStateDerivative valueReference="{ref}"/>' for ref in slopes)
    unknowns = "".join(f'<InitialUnknown valueReference="{ref}"/>' for ref in slopes)
    events = '<EventIndicator valueReference="11"/>' if model == "ball" else ""
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        f'<fmiModelDescription fmiVersion="3.0" modelName="{model}" instantiationToken="stlc">'
        f'<ModelExchange modelIdentifier="{model}" needsCompletedIntegratorStep="true"/>'
        f'<CoSimulation modelIdentifier="{model}"/>'
        f"{_units()}<ModelVariables>{''.join(lines)}</ModelVariables>"
        f"<ModelStructure>{outputs}{derivatives}{unknowns}{events}</ModelStructure></fmiModelDescription>"
    )
