"""Positions as JSON, the only messages that aren't protobuf.

Foxglove's map shows `foxglove.LocationFix` in both encodings. Rerun makes a map of protobuf's wherever it
finds one, and asks a tile server on the internet for it, which then knows where the survey is; JSON it leaves
alone.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, Final

from foxglove_schemas_protobuf.LocationFix_pb2 import LocationFix

from geomosaic.recording.plain import json_text

_NUMBERS: Final = ("latitude", "longitude", "altitude")
_SHADES: Final = ("r", "g", "b", "a")


def _object(title: str, **properties: Any) -> dict[str, Any]:
    return {"title": title, "type": "object", "properties": properties}


_NUMBER, _WHOLE = {"type": "number"}, {"type": "integer"}
_FIX = _object(
    "foxglove.LocationFix",
    timestamp=_object("time", sec=_WHOLE, nsec=_WHOLE),
    frame_id={"type": "string"},
    **dict.fromkeys(_NUMBERS, _NUMBER),
    position_covariance={"type": "array", "items": _NUMBER},
    position_covariance_type=_WHOLE,
    color=_object("foxglove.Color", **dict.fromkeys(_SHADES, _NUMBER)),
)
AS_JSON: Final[Mapping[str, bytes]] = {LocationFix.DESCRIPTOR.full_name: json_text(_FIX).encode()}
"""The JSON schema of each schema that is written as JSON."""


def fix_json(fix: Any) -> bytes:
    """A LocationFix as Foxglove has it in JSON."""
    values = {
        "timestamp": {"sec": fix.timestamp.seconds, "nsec": fix.timestamp.nanos},
        "frame_id": fix.frame_id,
        **{name: getattr(fix, name) for name in _NUMBERS},
        "position_covariance": list(fix.position_covariance),
        "position_covariance_type": fix.position_covariance_type,
        "color": {name: getattr(fix.color, name) for name in _SHADES},
    }
    return json_text(values).encode()


def fix_of(data: bytes) -> Any:
    """The LocationFix of such JSON, its time left out; of protobuf too, as in recordings of earlier versions.

    Raises one of `BROKEN`, TypeError, KeyError or AttributeError for anything else, and where a number isn't
    finite.
    """
    if not data.startswith(b"{"):
        fix = LocationFix.FromString(data)
    else:
        values = json.loads(data)
        fix = LocationFix(
            frame_id=values["frame_id"],
            **{name: values[name] for name in _NUMBERS},
            position_covariance=values["position_covariance"],
            position_covariance_type=values["position_covariance_type"],
        )
        for name in _SHADES:
            setattr(fix.color, name, values["color"][name])
    fix_json(fix)
    return fix
