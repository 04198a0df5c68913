"""MCAP writer and reader, replay, diff, the Rerun view: beside the staircase, not on it."""

from geomosaic.recording.compare import compare
from geomosaic.recording.model import ArtefactEntry, Recording, StageRecord
from geomosaic.recording.reader import artefact_data, messages, printable, read_recording, stage_messages
from geomosaic.recording.summary import summary
from geomosaic.recording.thumbnail import thumbnail
from geomosaic.recording.writer import STAGE_CALLS, Recorder

__all__ = [
    "STAGE_CALLS",
    "ArtefactEntry",
    "Recorder",
    "Recording",
    "StageRecord",
    "artefact_data",
    "compare",
    "messages",
    "printable",
    "read_recording",
    "stage_messages",
    "summary",
    "thumbnail",
]
