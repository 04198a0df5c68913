"""Values as protobuf and JSON take them."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from geomosaic.arrays import Floats32


def single(**values: ArrayLike) -> dict[str, Floats32]:
    """Arrays in single precision."""
    return {name: np.asarray(value, dtype=np.float32) for name, value in values.items()}


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
