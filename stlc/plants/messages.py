"""Messages between stlc and the process of a plant: a JSON header and one array of numbers, never a pickle.

A message is two lengths (header, array; unsigned 32-bit, little-endian), the header as UTF-8 JSON, and the
array as float64, little-endian, row by row. The header gives the shape of the array under the key `shape`.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from stlc.jsontext import dumps, loads

Floats: TypeAlias = NDArray[np.float64]
MAX_HEADER = 1 << 20
MAX_ARRAY = 1 << 28
"""Most bytes of the two parts of a message. What is longer is not read."""
SAID = b"\0said\0"
"""Bytes on the standard error of a plant's process after all that was printed before a fault."""
_LENGTHS = struct.Struct("<II")
_NUMBER = np.dtype("<f8")


class MessageError(ValueError):
    """Error: the bytes received are not a message."""


@dataclass(frozen=True, slots=True)
class Message:
    """A message.

    Attributes:
        header: JSON object.
        array: numbers, (rows, columns).
    """

    header: Mapping[str, Any]
    array: Floats


def encoded(header: Mapping[str, Any], array: Floats | None = None) -> bytes:
    """Return the bytes of a message; `array` is (rows, columns), None for an empty one."""
    body = np.ascontiguousarray(np.zeros((0, 0)) if array is None else array, dtype=_NUMBER)
    text = dumps({**header, "shape": list(body.shape)}).encode()
    return _LENGTHS.pack(len(text), body.nbytes) + text + body.tobytes()


def received(read: Callable[[int], bytes]) -> Message:
    """Read one message.

    Args:
        read: function that returns the given number of bytes; it raises EOFError if there are fewer.

    Raises:
        EOFError: the sender has closed the stream.
        MessageError: the bytes are not a message, or the message is too long.
    """
    head, size = _LENGTHS.unpack(read(_LENGTHS.size))
    if head > MAX_HEADER or size > MAX_ARRAY:
        raise MessageError(f"a message of {head + size:,} bytes")
    text, body = read(head), read(size)
    try:
        header = loads(text.decode())
        rows, columns = header["shape"]
        array = np.frombuffer(body, dtype=_NUMBER).reshape(int(rows), int(columns))
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        raise MessageError("bytes that are no message") from error
    return Message(header, array.astype(np.float64))
