"""The one table of message kinds. A new kind is an entry of a module `*_kinds`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Final

from geomosaic.recording.file.frame_kinds import FRAME_KINDS
from geomosaic.recording.file.messages import Kind, Topics
from geomosaic.recording.file.pair_kinds import PAIR_KINDS
from geomosaic.recording.file.run_kinds import RUN_KINDS
from geomosaic.recording.file.strip_kinds import STRIP_KINDS

KINDS: Final[Mapping[str, Kind]] = {
    kind.schema: kind for kind in (*RUN_KINDS, *FRAME_KINDS, *PAIR_KINDS, *STRIP_KINDS)
}
"""By schema."""
CALLS: Final[Mapping[str, Callable[..., Topics]]] = {
    call.__name__: call for kind in KINDS.values() for call in kind.calls
}
"""What stages may record, by the name of the recorder's method."""
_OF_CALLS: Final = {call.__name__: kind for kind in KINDS.values() for call in kind.calls}


def kind_of(name: str) -> Kind | None:
    """The kind of a schema, or that of a call."""
    return KINDS.get(name) or _OF_CALLS.get(name)
