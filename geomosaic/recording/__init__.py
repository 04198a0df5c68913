"""The recording of a run: its file, what it says and how two differ, the view in Rerun, the replay."""

from geomosaic.recording.file.model import ArtefactEntry, Recording, StageRecord
from geomosaic.recording.file.reader import artefact_data, messages, printable, read_recording, stage_messages
from geomosaic.recording.file.thumbnail import thumbnail
from geomosaic.recording.file.writer import STAGE_CALLS, Recorder

__all__ = [
    "STAGE_CALLS",
    "ArtefactEntry",
    "Recorder",
    "Recording",
    "StageRecord",
    "artefact_data",
    "messages",
    "printable",
    "read_recording",
    "stage_messages",
    "thumbnail",
]
