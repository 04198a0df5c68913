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
        "optional uint64 peak_memory_bytes",
    ),
    # How far a stage is: `done` of `total` of what `text` names, `seconds` after its start, and the memory
    # that all processes hold now (0: unknown). At most one a second; none in a recording with fixed times.
    "Progress": (
        "string stage_id",
        "uint32 stage_index",
        "string text",
        "uint64 done",
        "uint64 total",
        "double seconds",
        "uint64 memory_bytes",
    ),
    # One figure of a stage, or a whole entry of run.json, as it comes: `json` is its value, `number` too if
    # it is one. The same stand in the stage's `notes_json`.
    "Metric": (
        "string stage_id",
        "uint32 stage_index",
        "string name",
        "optional double number",
        "string json",
    ),
    # One step of a solve; `iteration` counts through all solves of a stage. `cost` is what is minimised,
    # in cost_unit ("" for a sum of weighted squares), `sigma_px` the deviation of image coordinates,
    # `step_m` the largest move of a frame. NaN where a method has no such thing.
    "Iteration": (
        "string stage",
        "uint32 stage_index",
        "uint32 iteration",
        "string solve",
        "double cost",
        "string cost_unit",
        "double sigma_px",
        "double damping",
        "double step_m",
        "double share_down_weighted",
    ),
    # Any table: rows are frames, or pairs of `row` and `other`. Values stand column by column, NaN where
    # unknown; the columns' names end in units. `note` has a text for each row, or is empty.
    "Table": (
        "string stage_id",
        "uint32 stage_index",
        "repeated string row",
        "repeated string other",
        "repeated string column",
        "repeated double value",
        "repeated string note",
    ),
    # Rings or lines in the work frame, one behind the other: `vertices` says how many points each has.
    "Outlines": (
        "string stage_id",
        "uint32 stage_index",
        "repeated string name",
        "repeated uint32 vertices",
        "repeated float east_m",
        "repeated float north_m",
    ),
    # Where in both frames the halves of the image before it on /chips are from, and the tie points in them.
    # Each half is a square of side_px; the corner of the left one is at (left_col_px, left_row_px) of its
    # frame; the right one's likewise, then turned by right_quarters times 90 degrees anticlockwise. Places
    # (x, y) are the image's. weight: of the solve, 1 for a good tie point, NaN if it took no part.
    "ChipTies": (
        "uint32 rank",
        "string left",
        "string right",
        "uint32 side_px",
        "double left_col_px",
        "double left_row_px",
        "double right_col_px",
        "double right_row_px",
        "uint32 right_quarters",
        "repeated float left_x_px",
        "repeated float left_y_px",
        "repeated float right_x_px",
        "repeated float right_y_px",
        "repeated float residual_east_m",
        "repeated float residual_north_m",
        "repeated float weight",
        "uint32 stage_index",
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
    # are on the ground: right minus left; weight: of the solve, NaN for those that took no part.
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
        "repeated float weight",
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
Progress = _classes["Progress"]
Metric = _classes["Metric"]
Iteration = _classes["Iteration"]
Table = _classes["Table"]
Outlines = _classes["Outlines"]
ChipTies = _classes["ChipTies"]
