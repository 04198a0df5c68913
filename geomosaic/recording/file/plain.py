"""Values as protobuf and JSON take them."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

_PACKED: Final = 2
"""The wire type of what says its length."""


def set_singles(message: Any, **values: ArrayLike) -> None:
    """Sets lists of numbers in single precision, by field, from arrays. They are put in as they lie on the
    wire (Protocol Buffers encoding, packed): number by number takes forty times as long."""
    fields = message.DESCRIPTOR.fields_by_name
    for name, value in values.items():
        packed = np.asarray(value, dtype="<f4").tobytes()
        message.MergeFromString(_varint(8 * fields[name].number + _PACKED) + _varint(len(packed)) + packed)


def _varint(number: int) -> bytes:
    """Seven bits a byte, the last first."""
    out = bytearray()
    while number > 0x7F:
        out.append(number & 0x7F | 0x80)
        number >>= 7
    return bytes([*out, number])


def picked(thing: Any, *names: str) -> dict[str, Any]:
    """Some of its attributes, by name."""
    return {name: getattr(thing, name) for name in names}


def json_text(value: Any) -> str:
    """JSON in the order given, numpy numbers and arrays as plain ones, paths as text; NaN refused."""
    return json.dumps(value, allow_nan=False, default=_plain, separators=(",", ":"))


def json_object(text: str | bytes) -> dict[str, Any]:
    """The object of a JSON text; None for what isn't finite. Raises ValueError for anything else."""
    value = json.loads(text, parse_constant=lambda _: None)
    if not isinstance(value, dict):
        raise ValueError("no JSON object")
    return value


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return dict(value)
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    return str(value)


def as_text(name: str | int) -> str:
    """A name or a message as protobuf takes it: a file name that isn't Unicode gets question marks."""
    return str(name).encode("utf-8", "replace").decode()


def topic_part(name: str) -> str:
    """A name as one level of a topic: no slash, no blank."""
    return re.sub(r"[^\w.+-]+", "_", as_text(name)) or "_"
