"""A declared mirror is believed only where it is a symmetry; the policy then treats both sides alike."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from stlc.controller.policies.policy import PlanNetwork
from stlc.controller.problem.task import Task
from stlc.controller.training.diagnose import check_mirror
from stlc.diagnostics import SystemFileError
from stlc.dynamics.load import parse_system
from stlc.dynamics.system import System
from stlc.grammar.spec import Spec
from stlc.source import Source

ROOT = Path(__file__).parent.parent.parent
PAIRS = {
    "ship_safe": "ship_safe",
    "ship_track": "ship_track",
    "reach_n_avoid": "maze",
    "navigation": "rover",
}


def _task(spec: str, old: str = "", new: str = "") -> Task:
    path = ROOT / "examples" / f"{PAIRS[spec]}.yaml"
    text = path.read_text()
    assert old in text
    decl = parse_system(Source(path.name, text.replace(old, new) if old else text), path)
    source = Source(f"{spec}.stl", (ROOT / "specs" / f"{spec}.stl").read_text())
    return Task.of(Spec.parse(source), System(decl))


@pytest.mark.parametrize("spec", PAIRS)
def test_the_mirrors_of_the_examples_are_symmetries(spec: str) -> None:
    check_mirror(_task(spec))


@pytest.mark.parametrize("spec", ["ship_track", "navigation"])
def test_plans_of_images_are_images_of_plans(spec: str) -> None:
    task = _task(spec)
    torch.manual_seed(0)
    network = PlanNetwork(task, hidden=(16,), plans=3)
    x0 = task.sample(200, seed=1)
    network.normalise(x0)
    mirror = task.system.mirror
    assert mirror is not None
    image = mirror.states(x0)
    assert not torch.equal(image, x0)
    torch.testing.assert_close(network(image), mirror.plans(network(x0)), atol=1e-4, rtol=1e-4)
    plain = PlanNetwork(task, hidden=(16,), plans=3, mirrored=False)
    assert not torch.allclose(plain(image), mirror.plans(plain(x0)), atol=1e-2)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("psi: -psi, ", "", "where the image of a state gets to differs in x"),
        ("y1: -y1, ", "r1: 1.8 m - r1, ", "whether an image satisfies a requirement differs in `avoid`"),
        ("v: -v, ", "v: 0 m/s, ", "the image of the image of a state differs in v"),
        ("rudder: -rudder", "rudder: 0.5 * rudder", "the image of the image of a control differs in rudder"),
    ],
)
def test_what_is_no_symmetry_is_refused(old: str, new: str, message: str) -> None:
    with pytest.raises(SystemFileError) as caught:
        check_mirror(_task("ship_track", old, new))
    (finding,) = caught.value.diagnostics
    assert finding.code == "S304"
    assert message in finding.message
    assert finding.span is not None
    assert finding.span.text.startswith("{y: -y")


@pytest.mark.parametrize(
    ("new", "code"),
    [
        ("{rudder: -rudder, y: -y}", "S103"),
        ("{yy: -y}", "S202"),
        ("{y: -psi}", "E203"),
        ("{y: -y, rudder: -nothing}", "E101"),
    ],
)
def test_a_mirror_that_cannot_be_read(new: str, code: str) -> None:
    with pytest.raises(SystemFileError) as caught:
        _task("ship_track", "{y: -y, psi: -psi, v: -v, r: -r, y1: -y1, rudder: -rudder}", new)
    assert code in [finding.code for finding in caught.value.diagnostics]
