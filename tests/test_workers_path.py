"""What workers import: nothing that lies in the current folder."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from geomosaic.pipeline import executor

SCRIPT = """
from geomosaic.pipeline.executor import Workers, prepare_workers
prepare_workers(["geomosaic.matching.sift"])
with Workers(2) as workers:
    print(workers.result(workers.submit(abs, -7)))
"""


def test_workers_take_no_module_from_the_current_folder(tmp_path: Path) -> None:
    """Neither one of a library's name nor a folder named as the package, as a clone beside the frames is."""
    folder, script = tmp_path / "frames", tmp_path / "elsewhere" / "run.py"
    (folder / "geomosaic").mkdir(parents=True)
    for name in ("cv2", "signal", "numpy"):
        (folder / f"{name}.py").write_text("open('taken', 'w').close()\n")
    script.parent.mkdir()
    script.write_text(SCRIPT)
    package = str(Path(executor.__file__).parents[2])
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONSAFEPATH"} | {"PYTHONPATH": package}
    done = subprocess.run(
        [sys.executable, script], cwd=folder, env=environment, capture_output=True, text=True, timeout=120
    )
    assert (done.stdout.strip(), done.returncode) == ("7", 0), done.stderr
    assert not (folder / "taken").exists()
