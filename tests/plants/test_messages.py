"""Messages survive the way, and other bytes are refused."""

from __future__ import annotations

import io
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from stlc.plants.messages import MAX_ARRAY, MAX_HEADER, MessageError, encoded, received


def reader(data: bytes):
    stream = io.BytesIO(data)

    def read(count: int) -> bytes:
        found = stream.read(count)
        if len(found) < count:
            raise EOFError
        return found

    return read


@given(
    st.dictionaries(
        st.text("aä\0", max_size=3),
        st.integers() | st.text("bß\n", max_size=3) | st.booleans() | st.none(),
        max_size=4,
    ),
    arrays.arrays(np.float64, arrays.array_shapes(min_dims=2, max_dims=2, min_side=0, max_side=5)),
)
def test_what_is_sent_is_received(header, array):
    found = received(reader(encoded(header, array)))
    assert {**found.header, "shape": None} == {**header, "shape": None}
    assert found.array.dtype == np.float64
    assert found.array.tobytes() == array.tobytes()
    assert found.array.shape == array.shape


def framed(header: bytes, body: bytes = b"") -> bytes:
    return struct.pack("<II", len(header), len(body)) + header + body


@pytest.mark.parametrize(
    "data",
    [
        struct.pack("<II", MAX_HEADER + 1, 0),
        struct.pack("<II", 2, MAX_ARRAY + 1),
        framed(b"not json"),
        framed(b"[1]"),
        framed(b"{}"),
        framed(b'{"shape": [1, 1]}'),
        framed(b'{"shape": [2, 1]}', bytes(8)),
        framed(b'{"shape": [1, 1]}', bytes(7)),
        framed(b'{"shape": ["x", 1]}', bytes(8)),
        framed(b"\xff\xfe"),
        framed(b"[" * 100_000),
    ],
)
def test_other_bytes_are_refused(data):
    with pytest.raises(MessageError):
        received(reader(data))


@given(st.binary(max_size=64))
def test_any_bytes_are_a_message_or_refused(data):
    try:
        received(reader(data))
    except (EOFError, MessageError):
        return
    assert data[:8] != b""


def test_a_cut_message_ends():
    whole = encoded({"a": 1}, np.ones((2, 2)))
    for length in (0, 7, 8, len(whole) - 1):
        with pytest.raises(EOFError):
            received(reader(whole[:length]))
