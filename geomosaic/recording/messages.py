"""The project's own protobuf messages, built at import without a compiler.

Package `geomosaic`, proto3. Repeated numbers are packed. Parallel lists stand for tables, since a
list of structs costs a tag and a length per row. What Foxglove has a schema for is not repeated here.
"""

from __future__ import annotations

from typing import Any

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

_Field = descriptor_pb2.FieldDescriptorProto
_PACKAGE = "geomosaic"
_WIRE = {
    "string": _Field.TYPE_STRING,
    "bytes": _Field.TYPE_BYTES,
    "bool": _Field.TYPE_BOOL,
    "uint32": _Field.TYPE_UINT32,
    "uint64": _Field.TYPE_UINT64,
    "float": _Field.TYPE_FLOAT,
    "double": _Field.TYPE_DOUBLE,
}

_MESSAGES: dict[str, tuple[str, ...]] = {
    "Fingerprint": ("string name", "string fingerprint"),
    # One at a stage's start and one at its end. `seconds` is absent at the start and in a recording
    # with fixed times. `params_json` and `inputs` stand at the start, `outputs` and `notes_json` at the end.
    # An output's fingerprint is of its bytes, of files that the stage wrote (`written`, name and hash) and
    # of all files that it goes back to (`lineage`, sorted), both at the end (`recording/fingerprints.py`).
    # `reads_run`: the stage reports the run itself, durations included, so its outputs differ every time.
    "StageEvent": (
        "string stage_id",
        "uint32 stage_index",
        "uint32 version",
        "bool finished",
        "bool cached",
        "optional double seconds",
        "string params_json",
        "repeated Fingerprint inputs",
        "repeated Fingerprint outputs",
        "string notes_json",
        "bool reads_run",
        "repeated Fingerprint written",
        "repeated string lineage",
    ),
    # One round of an adjustment: (left, right, east_m, north_m) are the misalignments of the pairs
    # before the moves, right minus left, NaN where unknown; (frame, move_east_m, move_north_m) the moves.
    # `stage_index` is that of the latest StageEvent, as in every message here.
    "PairOffsets": (
        "string stage",
        "uint32 round",
        "repeated string left",
        "repeated string right",
        "repeated double east_m",
        "repeated double north_m",
        "repeated string frame",
        "repeated double move_east_m",
        "repeated double move_north_m",
        "double largest_misalignment_m",
        "double rms_misalignment_m",
        "double largest_move_m",
        "uint32 stage_index",
    ),
    # Tie points of one pair: col and row in the full frames, corner origin. Residuals, where given,
    # are on the ground: right minus left.
    "TiePoints": (
        "string left",
        "string right",
        "repeated float left_col_px",
        "repeated float left_row_px",
        "repeated float right_col_px",
        "repeated float right_row_px",
        "repeated float residual_east_m",
        "repeated float residual_north_m",
        "uint32 stage_index",
    ),
    # Offsets of one pair of CCD strips, right against left, at some of the left strip's lines; `sd` is one
    # standard deviation, label 0 measured, 1 bridged, 2 unreliable. `pair` counts from 0.
    "StripOffsets": (
        "uint32 pair",
        "string left",
        "string right",
        "repeated uint32 line",
        "repeated float dcol_px",
        "repeated float dline_px",
        "repeated float sd_col_px",
        "repeated float sd_line_px",
        "repeated uint32 label",
        "double share_measured",
        "double share_bridged",
        "double share_unreliable",
        "uint32 stage_index",
    ),
    # What is left between the strips of a pair where the offsets lay them, block of lines by block: offset +
    # residual would be right. `line` is the left strip's in the middle of a block; NaN where nothing could be
    # measured. `sd` is one standard deviation, of either axis.
    "StripResiduals": (
        "uint32 pair",
        "string left",
        "string right",
        "repeated uint32 line",
        "repeated float dcol_px",
        "repeated float dline_px",
        "repeated float sd_px",
        "uint32 stage_index",
    ),
    # Amplitudes of what moves line by line, dcol across and dline along; of `what` the topic names.
    "JitterSpectrum": (
        "repeated float frequency_hz",
        "repeated float across_px",
        "repeated float along_px",
        "uint32 stage_index",
    ),
    # One part of an encoded artefact; the parts' data joined in order has `total_bytes` bytes.
    "Artefact": (
        "string stage_id",
        "uint32 stage_index",
        "string name",
        "string type_name",
        "string fingerprint",
        "uint32 part",
        "uint32 parts",
        "uint64 total_bytes",
        "bytes data",
    ),
}


def _add_field(message: descriptor_pb2.DescriptorProto, number: int, declaration: str) -> None:
    *rule, kind, name = declaration.split()
    field = message.field.add(name=name, number=number, label=_Field.LABEL_OPTIONAL)
    if rule == ["repeated"]:
        field.label = _Field.LABEL_REPEATED
    if rule == ["optional"]:  # presence in proto3 is a oneof of one member
        field.proto3_optional = True
        field.oneof_index = len(message.oneof_decl)
        message.oneof_decl.add(name=f"_{name}")
    if kind in _WIRE:
        field.type = _WIRE[kind]
    else:
        field.type = _Field.TYPE_MESSAGE
        field.type_name = f".{_PACKAGE}.{kind}"


def _build() -> dict[str, Any]:
    file = descriptor_pb2.FileDescriptorProto(
        name="geomosaic/recording.proto", package=_PACKAGE, syntax="proto3"
    )
    for name, fields in _MESSAGES.items():
        message = file.message_type.add(name=name)
        for number, declaration in enumerate(fields, start=1):
            _add_field(message, number, declaration)
    pool = descriptor_pool.Default()
    pool.AddSerializedFile(file.SerializeToString())
    return {
        name: message_factory.GetMessageClass(pool.FindMessageTypeByName(f"{_PACKAGE}.{name}"))
        for name in _MESSAGES
    }


_classes = _build()
StageEvent = _classes["StageEvent"]
PairOffsets = _classes["PairOffsets"]
TiePoints = _classes["TiePoints"]
StripOffsets = _classes["StripOffsets"]
StripResiduals = _classes["StripResiduals"]
JitterSpectrum = _classes["JitterSpectrum"]
Artefact = _classes["Artefact"]
