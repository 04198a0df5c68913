"""MCAP writer and reader, replay, diff, the Rerun view: beside the staircase, not on it."""

from geomosaic.recording.thumbnail import thumbnail
from geomosaic.recording.writer import Recorder

__all__ = ["Recorder", "thumbnail"]
