"""Starts a script of `geomosaic qgis-script` in a real QGIS and cancels it: it has to end soon, all of it.

Run by the Python that QGIS has.
"""

from __future__ import annotations

import importlib.util
import subprocess
import sys
import time

from qgis.core import QgsApplication, QgsProcessingContext, QgsProcessingFeedback

MOST_S = 15.0


class CancelledEarly(QgsProcessingFeedback):
    """As a user who presses Cancel in the second stage."""

    cancelled_s = 0.0

    def pushInfo(self, text: str) -> None:  # noqa: N802
        if text.startswith("[2/") and not self.isCanceled():
            self.cancelled_s = time.monotonic()
            self.cancel()


script, frames, out = sys.argv[1:4]
application = QgsApplication([], False)
application.initQgis()
spec = importlib.util.spec_from_file_location("script", script)
assert spec is not None and spec.loader is not None
module = importlib.util.module_from_spec(spec)
spec.loader.exec_module(module)
algorithm, feedback = module.Geomosaic(), CancelledEarly()
algorithm.initAlgorithm()
parameters = {"SURVEY_READ_FRAMES": frames, "OUTPUT": out}
algorithm.run(parameters, QgsProcessingContext(), feedback)
took = time.monotonic() - feedback.cancelled_s
running = subprocess.run(["pgrep", "-f", f"-o {out} "], capture_output=True, text=True, check=False).stdout
if not feedback.isCanceled() or took > MOST_S or running:
    sys.exit(f"check-qgis: cancelled {feedback.isCanceled()}, ended after {took:.1f} s, left: {running!r}")
print(f"  cancelled: ended after {took:.1f} s, nothing left running")
application.exitQgis()
