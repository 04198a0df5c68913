"""Names of what was made, by content: what a recording says of its artefacts, and whether that is so."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from hashlib import blake2b
from typing import Any

from geomosaic.errors import FileError
from geomosaic.recording.file.model import Recording
from geomosaic.recording.file.reader import artefact_data


def fingerprint_of_bytes(*pieces: bytes | memoryview) -> str:
    """BLAKE2b with 160 bits, in hexadecimal: the one hash of a run. Of pieces, of all one after the other."""
    made = blake2b(digest_size=20)
    for piece in pieces:
        made.update(piece)
    return made.hexdigest()


def fingerprint_of_json(value: Any) -> str:
    """The fingerprint of plain values, by their canonical JSON."""
    return fingerprint_of_bytes(json.dumps(value, sort_keys=True, separators=(",", ":")).encode())


def artefact_fingerprint(content: str, written: Mapping[str, str], lineage: Iterable[str]) -> str:
    """Of an artefact whose bytes have the fingerprint `content`, of the files that its stage wrote with it
    (name and hash), and of all files that it goes back to."""
    return fingerprint_of_json([content, dict(written), sorted(lineage)])


def altered_artefacts(recording: Recording) -> list[tuple[str, str]]:
    """Stage and name of each whole artefact whose bytes aren't those that its fingerprint names.

    Recordings from before stages recorded their lineage (`StageRecord.lineage`) can't be asked.
    """
    stages = {stage.index: stage for stage in recording.stages}
    out = []
    for entry in recording.artefacts:
        stage = stages.get(entry.stage_index)
        if stage is None or not stage.lineage or not entry.complete:
            continue
        try:
            content = fingerprint_of_bytes(artefact_data(recording, entry))
        except FileError:
            content = ""
        if artefact_fingerprint(content, stage.written, stage.lineage) != entry.fingerprint:
            out.append((stage.stage_id, entry.name))
    return out
