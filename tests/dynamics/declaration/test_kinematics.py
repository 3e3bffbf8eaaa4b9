"""Forward kinematics: chains read from URDF, unrolled, against products of transforms and two libraries."""

from __future__ import annotations

import contextlib
import io
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stlc.compile.backends.array.arith import ArrayProgram
from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.ir import nodes as ir
from stlc.diagnostics import SystemFileError
from stlc.dynamics.declaration.kinematics import Joint, chain, position
from stlc.dynamics.load import parse_system
from stlc.source import Source

EXAMPLES = Path(__file__).parents[3] / "examples"
PANDA = (EXAMPLES / "panda.urdf").read_text()


def computed(body: ir.Body, q: np.ndarray) -> np.ndarray:
    """The body as a program, (n, joints) -> (n, 3)."""
    args = tuple(ir.Signal(f"a{i}") for i in range(len(body.formals)))
    program = ArrayProgram({str(i): ir.Extern("f", args, i, body) for i in range(3)})
    found = program({"": q[:, 0], **{arg.name: q[:, i] for i, arg in enumerate(args)}}, NUMPY)
    return np.stack([np.broadcast_to(found[str(i)], len(q)) for i in range(3)], 1)


def rotation(axis: np.ndarray, angle: float) -> np.ndarray:
    """About a unit axis, by the exponential of its cross-product matrix."""
    cross = np.cross(np.eye(3), axis)
    value, term = np.eye(3), np.eye(3)
    for k in range(1, 40):
        term = term @ (cross * angle) / k
        value = value + term
    return value


def transforms(joints: tuple[Joint, ...], q: np.ndarray) -> np.ndarray:
    """Product of homogeneous transforms, one configuration."""
    pose, values = np.eye(4), iter(q)
    for joint in joints:
        rest, move = np.eye(4), np.eye(4)
        rest[:3, :3], rest[:3, 3] = joint.rotation, joint.offset
        if joint.kind == "revolute":
            move[:3, :3] = rotation(joint.axis, next(values))
        elif joint.kind == "prismatic":
            move[:3, 3] = joint.axis * next(values)
        pose = pose @ rest @ move
    return pose[:3, 3]


def urdf(joints: list[tuple[str, tuple[float, ...], tuple[float, ...], tuple[float, ...]]]) -> str:
    def words(numbers: tuple[float, ...]) -> str:
        return " ".join(repr(number) for number in numbers)

    lines = [
        f'<joint name="j{i}" type="{kind}"><parent link="l{i}"/><child link="l{i + 1}"/>'
        f'<origin xyz="{words(xyz)}" rpy="{words(rpy)}"/><axis xyz="{words(axis)}"/></joint>'
        for i, (kind, xyz, rpy, axis) in enumerate(joints)
    ]
    return f'<robot name="r">{"".join(lines)}</robot>'


NUMBERS = st.sampled_from([0.0, 1.0, -1.0, 0.5, -0.3]) | st.floats(-2, 2)
TRIPLES = st.tuples(NUMBERS, NUMBERS, NUMBERS)
ANGLES = st.sampled_from([0.0, math.pi / 2, -math.pi / 2, math.pi, 1.57079632679, 0.4])
AXES = st.sampled_from(
    [(0.0, 0.0, 1.0), (0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (1.0, 2.0, -2.0), (0.0, 3.0, 4.0)]
)
KINDS = st.sampled_from(["revolute", "continuous", "prismatic", "fixed"])
CHAINS = st.lists(st.tuples(KINDS, TRIPLES, st.tuples(ANGLES, ANGLES, ANGLES), AXES), min_size=1, max_size=6)


@settings(deadline=None, max_examples=18)
@given(CHAINS, st.integers(0, 1000))
def test_an_unrolled_chain_is_the_product_of_its_transforms(joints: list, seed: int) -> None:
    found = chain(urdf(joints), f"l{len(joints)}")
    body = position(found)
    assert len(body.formals) == sum(kind != "fixed" for kind, *_ in joints)
    q = np.random.default_rng(seed).uniform(-3, 3, (4, max(len(body.formals), 1)))
    wanted = [transforms(found, row) for row in q]
    np.testing.assert_allclose(computed(body, q), wanted, atol=1e-9, rtol=0)


def test_seven_joints_become_few_operations() -> None:
    body = position(chain(PANDA, "panda_link8"))
    names = [num.name for _, num in body.lets if isinstance(num, ir.Op)]
    assert names.count("sin") == names.count("cos") == 6, "the last joint turns about the flange"
    assert len(body.lets) <= 40


def configurations(n: int) -> np.ndarray:
    low, high = (
        (-2.89, -1.76, -2.89, -3.07, -2.89, -0.017, -2.89),
        (2.89, 1.76, 2.89, -0.07, 2.89, 3.75, 2.89),
    )
    return np.random.default_rng(3).uniform(low, high, (n, 7))


def installed_urdf() -> str:
    with contextlib.redirect_stdout(io.StringIO()):
        data = pytest.importorskip("pybullet_data")
    return str(Path(data.getDataPath()) / "franka_panda" / "panda.urdf")


@pytest.mark.filterwarnings("ignore")
def test_the_panda_is_that_of_pytorch_kinematics(capfd: pytest.CaptureFixture[str]) -> None:
    library = pytest.importorskip("pytorch_kinematics")
    torch = pytest.importorskip("torch")
    text = Path(installed_urdf()).read_bytes()
    serial = library.build_serial_chain_from_urdf(text, "panda_link8").to(dtype=torch.float64)
    q = configurations(1000)
    wanted = serial.forward_kinematics(torch.tensor(q)).get_matrix()[:, :3, 3].numpy()
    for source in (PANDA, text.decode()):
        got = computed(position(chain(source, "panda_link8")), q)
        np.testing.assert_allclose(got, wanted, atol=1e-7, rtol=0)  # it keeps offsets in float32
    capfd.readouterr()


@pytest.mark.filterwarnings("ignore")
def test_the_panda_is_that_of_pybullet(capfd: pytest.CaptureFixture[str]) -> None:
    bullet = pytest.importorskip("pybullet")
    client = bullet.connect(bullet.DIRECT)
    try:
        arm = bullet.loadURDF(installed_urdf(), useFixedBase=True, physicsClientId=client)
        count = bullet.getNumJoints(arm, physicsClientId=client)
        infos = [bullet.getJointInfo(arm, i, physicsClientId=client) for i in range(count)]
        tip = next(info[0] for info in infos if info[12] == b"panda_link8")
        q, wanted = configurations(300), []
        for row in q:
            for joint, angle in enumerate(row):
                bullet.resetJointState(arm, joint, angle, physicsClientId=client)
            state = bullet.getLinkState(arm, tip, computeForwardKinematics=True, physicsClientId=client)
            wanted.append(state[4])
    finally:
        bullet.disconnect(client)
    got = computed(position(chain(PANDA, "panda_link8")), q)
    np.testing.assert_allclose(got, wanted, atol=2e-6, rtol=0)  # it computes in float32
    capfd.readouterr()


# ------------------------------------------------------------------------------ bad input

HEAD = """stlc: 1
name: arm
time: {dt: 0.1 s, horizon: 5 steps}
state: {q: {size: 7, unit: rad}}
control: {dq: {size: 7, unit: rad/s, range: [-4, 4]}}
flow: {q: dq}
init: {mixture: [{draw: {q: "uniform(-1, 1)"}}]}
"""


def refused(text: str) -> str:
    path = EXAMPLES / "arm.yaml"
    with pytest.raises(SystemFileError) as caught:
        parse_system(Source(str(path), HEAD + text), path)
    return "\n".join(f"{finding.code} {finding.message}" for finding in caught.value.diagnostics)


@pytest.mark.parametrize(
    ("fields", "wanted"),
    [("file: nowhere.urdf, tip: hand", "S208 `nowhere.urdf` gives no kinematics: No such file"),
     ("file: panda.urdf, tip: hand", "there is no link `hand`; links: panda_link0, panda_link1"),
     ("file: panda.urdf, tip: panda_link0", "no joint moves `panda_link0`"),
     ("file: panda.urdf, tip: panda_link2, base: panda_link5", "`panda_link5` is not above `panda_link2`"),
     ("file: car.yaml, tip: hand", "it is not XML"), ("tip: hand", "`file`"),
     ("file: panda.urdf, tip: panda_link8, target: x", "target")],
)  # fmt: skip
def test_what_gives_no_kinematics_is_said(fields: str, wanted: str) -> None:
    assert wanted in refused(f"functions: {{ee: {{kind: urdf, {fields}}}}}")


@pytest.mark.parametrize(
    ("text", "wanted"),
    [("<model/>", "its root is <model>"),
     ('<!DOCTYPE x [<!ENTITY a "b">]><robot/>', "no document type"),
     (urdf([("floating", (0, 0, 0), (0, 0, 0), (1, 0, 0))]), "the joint `j0` is floating"),
     (urdf([("revolute", (0, 0, 0), (0, 0, 0), (0, 0, 0))]), "the axis of the joint `j0` is zero"),
     (urdf([("revolute", (0, 0), (0, 0, 0), (1, 0, 0))]), "`xyz` of the joint `j0` is not three numbers"),
     (urdf([("revolute", (0, 0, 0), (0, math.nan, 0), (1, 0, 0))]), "`rpy` of the joint `j0`"),
     (urdf([("fixed", (0, 0, 0), (0, 0, 0), (0, 0, 1))]).replace('"l0"', '"l1"'), "form a ring")],
)  # fmt: skip
def test_what_is_no_robot_is_said(text: str, wanted: str) -> None:
    with pytest.raises(ValueError, match=wanted):
        chain(text, "l1")


def test_a_chain_may_begin_at_any_link() -> None:
    whole, upper = chain(PANDA, "panda_link8"), chain(PANDA, "panda_link8", "panda_link3")
    assert [joint.name for joint in whole[3:]] == [joint.name for joint in upper]


def test_system_files_call_it_in_all_their_expressions() -> None:
    path = EXAMPLES / "arm.yaml"
    text = HEAD.replace("flow:", "def: {hand: ee(q)}\nflow:") + (
        "functions: {ee: {kind: urdf, file: panda.urdf, tip: panda_link8}}\n"
        "objective: {terms: [{name: low, weight: 1, expr: 'ee(q)[2]'}]}\n"
        "policy: {observe: ['hand[2]', 'q[0]']}\n"
    )
    decl = parse_system(Source(str(path), text), path)
    assert len(decl.policy.observe) == 2
