"""What a kind of message is, and the project's own protobuf messages, built at import without a compiler."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

if TYPE_CHECKING:
    from geomosaic.recording.file.model import Recording

_Field = descriptor_pb2.FieldDescriptorProto
_PACKAGE = "geomosaic"
_LAST_S = 2.0**33
_WIRE = {
    "string": _Field.TYPE_STRING,
    "bytes": _Field.TYPE_BYTES,
    "bool": _Field.TYPE_BOOL,
    "uint32": _Field.TYPE_UINT32,
    "uint64": _Field.TYPE_UINT64,
    "float": _Field.TYPE_FLOAT,
    "double": _Field.TYPE_DOUBLE,
}
_DECLARATION = re.compile(r"(?:(repeated|optional) )?(\w+) (.+)")
Topics = Iterable[tuple[str, Any]]
"""Messages of a call of the recorder, each with its topic."""


class At(NamedTuple):
    """Where a message stands. number: of the file's messages; offset: of its chunk, in bytes."""

    topic: str
    time_ns: int
    number: int
    offset: int

    @property
    def name(self) -> str:
        """The last part of its topic."""
        return self.topic.rpartition("/")[2]


@dataclass(frozen=True)
class Kind:
    """All that is known of a kind of message.

    message: its protobuf class. topics: as docs/recording.md names them. shown: where Rerun's view shows it;
    empty: nowhere. level: from which it is recorded. calls: what stages call to record it, each a generator
    of messages from plain values and arrays; the recorder sets `stage_id`, `stage_index` and `iteration`.
    take: adds a decoded message to what is known of a recording; ValueError for one that no run writes.
    parse: the message of its bytes.
    """

    message: Any
    topics: str
    shown: str = ""
    level: str = "summary"
    calls: tuple[Callable[..., Topics], ...] = ()
    take: Callable[[Recording, Any, At], None] | None = None
    parse: Callable[[bytes], Any] | None = None

    @property
    def schema(self) -> str:
        """The full name."""
        return str(self.message.DESCRIPTOR.full_name)

    def of(self, data: bytes) -> Any:
        """The message of its bytes. Raises one of `mcapfile.BROKEN`."""
        return (self.parse or self.message.FromString)(data)


def own(name: str, *fields: str, **parts: tuple[str, ...]) -> Any:
    """The class of a message of package `geomosaic`, proto3.

    A field's rule and type stand before its name; fields of one type may stand together, with blanks between
    their names. Fields are numbered in their order; repeated numbers are packed. Parallel lists stand for
    tables: a list of structs costs a tag and a length a row. parts: messages within it, by name.
    """
    file = descriptor_pb2.FileDescriptorProto(
        name=f"{_PACKAGE}/{name}.proto", package=_PACKAGE, syntax="proto3"
    )
    for part, declared in {**parts, name: fields}.items():
        message = file.message_type.add(name=part)
        for declaration in declared:
            rule, kind, names = _DECLARATION.fullmatch(declaration).groups()  # type: ignore[union-attr]
            for field in names.split():
                _add_field(message, rule or "", kind, field)
    pool = descriptor_pool.Default()
    pool.AddSerializedFile(file.SerializeToString())
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(f"{_PACKAGE}.{name}"))


def _add_field(message: descriptor_pb2.DescriptorProto, rule: str, kind: str, name: str) -> None:
    label = _Field.LABEL_REPEATED if rule == "repeated" else _Field.LABEL_OPTIONAL
    field = message.field.add(name=name, number=len(message.field) + 1, label=label)
    if rule == "optional":  # presence in proto3 is a oneof of one member
        field.proto3_optional = True
        field.oneof_index = len(message.oneof_decl)
        message.oneof_decl.add(name=f"_{name}")
    if kind in _WIRE:
        field.type = _WIRE[kind]
    else:
        field.type = _Field.TYPE_MESSAGE
        field.type_name = f".{_PACKAGE}.{kind}"


def stamped(message: Any, captured_s: float | None) -> Any:
    """A message with the time of an exposure, seconds since 1970; as it is where that isn't known."""
    if captured_s is not None and math.isfinite(captured_s) and 0.0 < captured_s < _LAST_S:
        whole_s = math.floor(captured_s)
        message.timestamp.FromNanoseconds(whole_s * 10**9 + round((captured_s - whole_s) * 1e9))
    return message
