"""What a run that goes on from a finished one finds unchanged."""

from __future__ import annotations

from pathlib import Path

from geomosaic.pipeline.earlier_run import EarlierRun
from geomosaic.pipeline.hashes import FileHashes
from geomosaic.pipeline.run_folder import RunFolder


def test_frames_in_folders_of_a_camera_card(tmp_path: Path):
    """Two folders have files of one name: each counts by itself, by the frame's own name."""
    inputs, frames = {}, {}
    for folder in ("100MEDIA", "101MEDIA"):
        card = tmp_path / "DCIM" / folder
        card.mkdir(parents=True)
        for name in ("DJI_0001.JPG", "DJI_0002.JPG"):
            (card / name).write_bytes(f"{folder} {name}".encode())
            frames[f"{folder}_{name}"] = card / name
        hashes = FileHashes()
        marks = {path.name: hashes.of_file(path) for path in card.iterdir()}
        inputs[f"survey.read.frames/DCIM/{folder}"] = {"path": str(card), "files": marks}
    frames["101MEDIA_DJI_0001.JPG"].write_bytes(b"another picture")
    before = EarlierRun(RunFolder(tmp_path / "run"), {"inputs": inputs})
    assert before.unchanged(frames) == frames.keys() - {"101MEDIA_DJI_0001.JPG"}
    assert before.unchanged({}) == frozenset()
