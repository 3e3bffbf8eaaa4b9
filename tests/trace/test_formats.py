"""Parquet, MATLAB and ROS 2 bags: what is read, what is refused, and files that somebody has damaged."""

from __future__ import annotations

import os
import random
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from stlc.diagnostics import StlcError, TraceError
from stlc.trace import Reading, Trace
from stlc.trace.chunks import pieces
from stlc.trace.formats.mat import read

pa = pytest.importorskip("pyarrow")
parquet = pytest.importorskip("pyarrow.parquet")
scipy_io = pytest.importorskip("scipy.io")
h5py = pytest.importorskip("h5py")
mcap_writer = pytest.importorskip("mcap_ros2.writer")

from helpers import robot_logs  # noqa: E402

N = 21
T = np.arange(N) * 0.1
X = np.sin(T)
ON = T > 1.0

MUTATIONS = int(os.environ.get("STLC_FUZZ", "40"))
"""Number of damaged files of each format."""

POSE = """geometry_msgs/Point position
bool ok
float64[3] cov
string frame
std_msgs/Header header
================
MSG: geometry_msgs/Point
float64 x
float64 y
================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""


def code_of(path: Path, reading: Reading | None = None) -> str:
    with pytest.raises(StlcError) as caught:
        Trace.load(path, *([reading] if reading else []))
    return caught.value.diagnostics[0].code


def message_of(path: Path) -> str:
    with pytest.raises(StlcError) as caught:
        Trace.load(path)
    return str(caught.value)


# --------------------------------------------------------------------------- parquet


def a_parquet(path: Path) -> Path:
    q = pa.array(np.stack([X, -X], axis=1).tolist(), pa.list_(pa.float64(), 2))
    fields = [
        pa.field("t", pa.float64()),
        pa.field("x [km/h]", pa.float32()),
        pa.field("v", pa.float64(), metadata={"unit": "m/s"}),
        pa.field("on", pa.bool_()),
        pa.field("q", pa.list_(pa.float64(), 2)),
        pa.field("word", pa.string()),
    ]
    columns = [T, X.astype(np.float32), X, ON, q, ["a"] * N]
    parquet.write_table(pa.table(columns, schema=pa.schema(fields)), path)
    return path


def test_parquet(tmp_path: Path) -> None:
    trace = Trace.load(a_parquet(tmp_path / "a.parquet"))
    assert list(trace.data) == ["x", "v", "on", "q[0]", "q[1]"]
    assert (trace.dt, trace.samples, trace.traces) == (0.1, N, 1)
    np.testing.assert_array_equal(trace.data["v"][0], X)
    np.testing.assert_array_equal(trace.data["q[1]"][0], -X)
    np.testing.assert_array_equal(trace.data["on"][0], ON)
    assert [trace.signature[name].unit.text for name in ("x", "v")] == ["km/h", "m/s"]


@pytest.mark.parametrize("encoded", [False, True])
def test_words_of_parquet(tmp_path: Path, encoded: bool) -> None:
    words = pa.chunked_array([["go", None], ["Stop", "x" * 100]])
    column = words.dictionary_encode() if encoded else words
    table = pa.table({"t": [0.0, 0.1, 0.2, 0.3], "x": [1.0, 2.0, 3.0, 4.0], "sign": column, "why": column})
    parquet.write_table(table, tmp_path / "a.parquet", row_group_size=3)
    assert Trace.load(tmp_path / "a.parquet").extras["sign"].tolist() == ["go", "", "Stop", "x" * 64]
    members = {"go": 0.0, "stop": 2.0, "": 1.0, "x" * 64: 3.0}
    trace = Trace.load(tmp_path / "a.parquet", Reading(words={"sign": members, "x": {}}))
    assert trace.data["sign"].tolist() == [[0.0, 1.0, 2.0, 3.0]]
    assert list(trace.extras) == ["why"]
    with pytest.raises(TraceError, match="cannot be `x"):
        Trace.load(tmp_path / "a.parquet", Reading(words={"sign": {"go": 0.0, "stop": 2.0, "": 1.0}}))


def test_parquet_times_and_traces(tmp_path: Path) -> None:
    stamps = pa.array((np.arange(4) * 10_000_000 + 1_700_000_000_000_000_000).tolist(), pa.timestamp("ns"))
    both = pa.chunked_array([stamps, stamps])
    table = pa.table({"t": both, "trace": [0] * 4 + [1] * 4, "x": list(range(8)), "hole": [None, *range(7)]})
    parquet.write_table(table, tmp_path / "a.parquet")
    trace = Trace.load(tmp_path / "a.parquet")
    assert (trace.dt, trace.t0, trace.traces, trace.samples) == (0.01, 0.0, 2, 4)
    assert trace.data["x"].tolist() == [[0, 1, 2, 3], [4, 5, 6, 7]]
    assert np.isnan(trace.data["hole"][0, 0])


def test_parquet_that_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    parquet.write_table(pa.table({"t": pa.array([], pa.float64())}), tmp_path / "b.parquet")
    assert code_of(tmp_path / "b.parquet") == "E603"
    assert code_of(tmp_path / "none.parquet") == "U102"
    monkeypatch.setattr("stlc.trace.formats.registry.MAX_BYTES", 100)
    assert "unpacks to" in message_of(a_parquet(tmp_path / "c.parquet"))


@pytest.mark.parametrize(
    "column",
    [
        pa.array(["w"] * 1000).dictionary_encode(),
        pa.array(["w" * 1_000_000] + ["w"] * 999),
        pa.array([[0.0] * 100_000] + [[0.0]] * 999),
    ],
)
def test_words_and_lists_that_unpack_to_much(
    tmp_path: Path, column: pa.Array, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.parquet"
    table = pa.table({"t": np.arange(1000.0), "x": np.zeros(1000), "a.b": column})
    parquet.write_table(table, path, compression="zstd")
    assert load_refused(path) in (None, "E605")
    monkeypatch.setattr("stlc.trace.formats.registry._ROOM", 200_000)
    monkeypatch.setattr("stlc.trace.formats.registry._RATIO", 1)
    assert "unpacks to" in message_of(path)
    with pytest.raises(TraceError, match="a chunk unpacks to"):
        list(pieces(path, 900, Reading()))


def load_refused(path: Path) -> str | None:
    try:
        Trace.load(path)
    except StlcError as error:
        return error.diagnostics[0].code
    return None


def test_a_word_is_unpacked_once(tmp_path: Path) -> None:
    words = pa.DictionaryArray.from_arrays(np.zeros(10_000, np.int32), pa.array(["w" * 10_000]))
    table = pa.table({"t": np.arange(10_000.0), "x": np.zeros(10_000), "word": words})
    parquet.write_table(table, tmp_path / "a.parquet", store_schema=False)
    assert parquet.read_schema(tmp_path / "a.parquet").field("word").type == pa.string()
    usual, watched = pa.default_memory_pool(), pa.system_memory_pool()  # which nothing else uses
    pa.set_memory_pool(watched)
    try:
        assert Trace.load(tmp_path / "a.parquet").extras["word"].tolist() == ["w" * 64] * 10_000
    finally:
        pa.set_memory_pool(usual)
    assert watched.max_memory() < 10_000_000


# ---------------------------------------------------------------------------- MATLAB


def a_mat5(path: Path, *, compressed: bool = True) -> Path:
    data = {"t": T, "x": X, "on": ON, "q": np.stack([X, -X], axis=1), "many": np.stack([X, 2 * X])}
    extra = {
        "s": {"y": X, "inner": {"z": X.astype(np.float32)}},
        "word": "hello",
        "n": np.arange(N, dtype=np.int16),
    }
    scipy_io.savemat(path, data | extra, do_compression=compressed)
    return path


@pytest.mark.parametrize("compressed", [True, False])
def test_mat5(tmp_path: Path, compressed: bool) -> None:
    path = a_mat5(tmp_path / "a.mat", compressed=compressed)
    trace = Trace.load(path)
    assert set(trace.data) == {"x", "on", "q[0]", "q[1]", "many", "s.y", "s.inner.z", "n"}
    assert (trace.dt, trace.samples, trace.traces) == (0.1, N, 2)
    np.testing.assert_array_equal(trace.data["x"], [X, X])
    np.testing.assert_array_equal(trace.data["many"], [X, 2 * X])
    np.testing.assert_array_equal(trace.data["q[1]"][0], -X)


def test_mat5_of_the_other_byte_order(tmp_path: Path) -> None:
    def element(kind: int, data: bytes) -> bytes:
        return struct.pack(">II", kind, len(data)) + data + b"\0" * (-len(data) % 8)

    def matrix(name: str, values: np.ndarray) -> bytes:
        head = element(6, struct.pack(">II", 6, 0)) + element(5, struct.pack(">ii", 1, len(values)))
        return element(14, head + element(1, name.encode()) + element(9, values.astype(">f8").tobytes()))

    body = matrix("t", T) + matrix("x", X)
    path = tmp_path / "a.mat"
    path.write_bytes(b"MATLAB 5.0".ljust(124) + b"\x01\x00MI" + body)
    np.testing.assert_array_equal(Trace.load(path).data["x"][0], X)


def test_mat5_that_declares_more_than_it_holds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    raw = bytearray(a_mat5(tmp_path / "a.mat", compressed=False).read_bytes())
    at = raw.index(struct.pack("<ii", 1, N))
    raw[at + 4 : at + 8] = struct.pack("<i", 2**31 - 1)
    (tmp_path / "a.mat").write_bytes(raw)
    assert "declares 1 x 2147483647 values" in message_of(tmp_path / "a.mat")
    head = struct.pack(
        "<IIIIIIIIIIHH4sII", 14, 10_000_000, 6, 8, 6, 0, 5, 8, 1, 10**6, 1, 1, b"x", 9, 8 * 10**6
    )
    bomb = zlib.compress(head + b"\0" * 10_000_000)
    monkeypatch.setattr("stlc.trace.formats.registry.MAX_BYTES", 1_000_000)
    head = b"MATLAB 5.0".ljust(124) + b"\x00\x01IM"
    (tmp_path / "b.mat").write_bytes(head + struct.pack("<II", 15, len(bomb)) + bomb)
    assert "unpacks to" in message_of(tmp_path / "b.mat")


def a_mat73(path: Path) -> Path:
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, values in {
            "t": T[None].T,
            "x": X[None].T,
            "q": np.stack([X, -X]),
            "s/y": X[None].T,
        }.items():
            file.create_dataset(name, data=values, compression="gzip").attrs["MATLAB_class"] = np.bytes_(
                "double"
            )
        file["word"] = np.frombuffer(b"h\0i\0", dtype=np.uint16)
        file["word"].attrs["MATLAB_class"] = np.bytes_("char")
        file["elsewhere"] = h5py.ExternalLink("/etc/hostname", "x")
        file["soft"] = h5py.SoftLink("/x")
    return path


def test_mat73(tmp_path: Path) -> None:
    trace = Trace.load(a_mat73(tmp_path / "a.mat"))
    assert set(trace.data) == {"x", "q[0]", "q[1]", "s.y"}
    np.testing.assert_array_equal(trace.data["q[1]"][0], -X)


def test_mat73_that_declares_more_than_it_holds(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.mat", "w") as file:
        file.create_dataset("t", shape=(10**9,), dtype="f8", chunks=(1000,))
    assert "does not hold" in message_of(tmp_path / "a.mat")


def test_mat_of_no_version(tmp_path: Path) -> None:
    (tmp_path / "a.mat").write_bytes(b"hello")
    with pytest.raises(StlcError) as caught:
        Trace.load(tmp_path / "a.mat")
    assert "save FILE -v7" in caught.value.diagnostics[0].help[0]
    (tmp_path / "b.mat").write_bytes(b"")
    assert "empty" in message_of(tmp_path / "b.mat")
    assert code_of(tmp_path / "none.mat") == "U102"


@pytest.mark.parametrize("version", ["5", "7.3"])
def test_complex_numbers_are_refused_where_a_signal_needs_them(tmp_path: Path, version: str) -> None:
    path, columns = tmp_path / "a.mat", {"t": T, "x": X, "flat": X + 0j, "z": X + 1j * T}
    if version == "5":
        scipy_io.savemat(path, columns)
    else:
        pair = np.dtype([("real", "f8"), ("imag", "f8")])
        with h5py.File(path, "w") as file:
            for name, values in columns.items():
                made = np.array(list(zip(values.real, values.imag, strict=True)), dtype=pair)
                file[name] = made if values.dtype.kind == "c" else values
                file[name].attrs["MATLAB_class"] = np.bytes_("double")
    arrays = read(path).groups[0].arrays
    assert arrays.keys() == {"t", "x", "flat"}
    np.testing.assert_array_equal(arrays["flat"], X)
    assert "imag" in read(path).refused["z"]
    with pytest.raises(TraceError):
        Trace.load(path, Reading({"y": "z"}, words={"y": {}}))


# ------------------------------------------------------------------------------- bags


def a_bag(path: Path) -> Path:
    with path.open("wb") as file:
        writer = mcap_writer.Writer(file)
        pose = writer.register_msgdef("demo/Pose", POSE)
        flag = writer.register_msgdef("std_msgs/Bool", "bool data")
        for k in range(N):
            stamp = 1_700_000_000_000_000_000 + k * 100_000_000
            content = {
                "position": {"x": float(X[k]), "y": 2.0},
                "ok": True,
                "cov": [1.0, 2.0, 3.0],
                "frame": "map",
                "header": {"stamp": {"sec": 1, "nanosec": 2}, "frame_id": ""},
            }
            writer.write_message("/robot/pose", pose, content, log_time=stamp, publish_time=stamp)
            if k in (0, 7):
                writer.write_message("/on", flag, {"data": k == 7}, log_time=stamp, publish_time=stamp)
        writer.finish()
    return path


def test_a_bag_is_resampled(tmp_path: Path) -> None:
    path = a_bag(tmp_path / "a.mcap")
    assert code_of(path) == "E602"
    trace = Trace.load(path, Reading(names={"x": "robot.pose.position.x"}, resample=0.1))
    assert set(trace.data) >= {"x", "robot.pose.position.y", "robot.pose.ok", "robot.pose.cov[2]", "on"}
    assert not any("header" in name for name in trace.data)
    assert (trace.samples, trace.t0) == (N, 0.0)
    np.testing.assert_allclose(trace.data["x"][0], X, atol=1e-12)
    assert trace.data["on"][0].tolist() == [0.0] * 7 + [1.0] * 14


def test_a_bag_without_numbers(tmp_path: Path) -> None:
    with (tmp_path / "a.mcap").open("wb") as file:
        mcap_writer.Writer(file).finish()
    assert "no message with numbers" in message_of(tmp_path / "a.mcap")


# ------------------------------------------------------------------------- resampling


def test_what_is_discrete_is_held_and_real_numbers_run_straight(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    t = np.array([0.0, 0.1, 0.25, 0.4, 0.5])
    x = np.array([0.0, 1.0, 2.5, 4.0, 5.0])
    np.savez(path, t=t, x=x, on=np.array([0, 0, 1, 1, 0], dtype=bool), mode=np.array([3.0, 1, 2, 2, 0]))
    assert code_of(path) == "E602"
    trace = Trace.load(path, Reading(resample=0.1, kinds={"mode": "enum"}))
    np.testing.assert_allclose(trace.data["x"][0], np.arange(6.0), atol=1e-12)
    assert trace.data["on"][0].tolist() == [0, 0, 0, 1, 1, 0]
    assert trace.data["mode"][0].tolist() == [3, 1, 1, 2, 2, 0]
    assert Trace.load(path, Reading(resample=0.05)).samples == 11


def test_resampling_on_the_own_grid_changes_nothing(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    np.savez(tmp_path / "a.npz", t=0.3 + T, x=rng.normal(size=(3, N)))
    plain, again = Trace.load(tmp_path / "a.npz"), Trace.load(tmp_path / "a.npz", Reading(resample=0.1))
    np.testing.assert_allclose(again.data["x"], plain.data["x"], atol=1e-12)
    assert again.samples == plain.samples


@pytest.mark.parametrize(
    ("t", "code"),
    [([0.0, 0.2, 0.1], "E602"), ([0.0, np.nan, 1.0], "E604"), ([0.0, 1e12, 2e12], "E605"), ([], "E605")],
)
def test_clocks_that_cannot_be_resampled(tmp_path: Path, t: list[float], code: str) -> None:
    np.savez(tmp_path / "a.npz", t=np.array(t), x=np.zeros(len(t)))
    assert code_of(tmp_path / "a.npz", Reading(resample=0.1)) == code


def test_the_clock_may_have_another_name(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", time=T, x=X)
    assert list(Trace.load(tmp_path / "a.npz").data) == ["x"]
    np.savez(tmp_path / "a.npz", now=T, x=X)
    assert code_of(tmp_path / "a.npz") == "E601"
    trace = Trace.load(tmp_path / "a.npz", Reading(names={"t": "now", "y": "x"}))
    assert list(trace.data) == ["y"]
    assert code_of(tmp_path / "a.npz", Reading(names={"t": "clock"})) == "E601"


# ---------------------------------------------------------------------- damaged files


def a_npz(path: Path) -> Path:
    np.savez_compressed(path, t=T, x=X, on=ON)
    return path


def a_csv(path: Path) -> Path:
    rows = "\n".join(f"{t!r},{x!r},{int(on)}" for t, x, on in zip(T.tolist(), X.tolist(), ON, strict=True))
    path.write_text(f"t,x [m],on\n{rows}\n")
    return path


def made(path: Path, maker: Callable[[list[float]], bytes]) -> Path:
    path.write_bytes(maker(X.tolist()))
    return path


MAKERS: dict[str, Callable[[Path], Path]] = {
    "npz": a_npz,
    "csv": a_csv,
    "parquet": a_parquet,
    "mat": a_mat5,
    "v73.mat": a_mat73,
    "mcap": a_bag,
    "json.mcap": lambda path: made(path, robot_logs.json_mcap),
    "bag": lambda path: made(path, robot_logs.bag),
    "db3": lambda path: made(path, robot_logs.bag2),
}


def damaged(raw: bytes, rng: random.Random) -> bytes:
    """A few bytes changed, cut out, doubled, or the tail lost."""
    data = bytearray(raw)
    for _ in range(rng.choice([1, 1, 2, 8, 64])):
        at = rng.randrange(max(len(data), 1))
        match rng.randrange(6):
            case 0:
                data[at : at + 1] = bytes([rng.randrange(256)])
            case 1:
                data[at : at + 4] = rng.choice(
                    [b"\xff\xff\xff\x7f", b"\0\0\0\0", b"\xff\xff\xff\xff", b"1e30"]
                )
            case 2:
                del data[at : at + rng.randrange(1, 40)]
            case 3:
                data[at:at] = data[at : at + rng.randrange(1, 40)]
            case 4:
                data[at:at] = rng.randbytes(rng.randrange(1, 20))
            case _:
                del data[at + len(data) // 2 :]
    return bytes(data)


@pytest.mark.parametrize("form", MAKERS)
def test_damaged_files_give_traces_or_diagnostics(form: str, tmp_path: Path) -> None:
    raw = MAKERS[form](tmp_path / f"whole.{form}").read_bytes()
    rng = random.Random(form)
    path = tmp_path / f"a.{form}"
    refused = 0
    for _ in range(MUTATIONS):
        path.write_bytes(damaged(raw, rng))
        for reading in (Reading(), Reading(resample=0.1)):
            try:
                Trace.load(path, reading)
            except StlcError as error:
                assert error.diagnostics  # noqa: PT017
                refused += 1
    assert refused


@pytest.mark.parametrize("form", MAKERS)
def test_a_missing_package_is_named(form: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = MAKERS[form](tmp_path / f"a.{form}")
    package = {"parquet": "pyarrow.parquet", "v73.mat": "h5py"}.get(form)
    if package is None and not form.endswith(("mcap", "bag", "db3")):
        assert Trace.load(path).samples == N
        return
    if package is None:
        return
    monkeypatch.setitem(__import__("sys").modules, package, None)
    with pytest.raises(StlcError) as caught:
        Trace.load(path)
    (finding,) = caught.value.diagnostics
    assert finding.code == "R301"
    assert finding.help[0].startswith("pip install ")


def test_writing_stays_with_npz_and_csv(tmp_path: Path) -> None:
    trace = Trace.load(a_csv(tmp_path / "a.csv"))
    trace.save(tmp_path / "b.npz")
    np.testing.assert_array_equal(Trace.load(tmp_path / "b.npz").data["x"], trace.data["x"])
