"""The QGIS Processing algorithm that `geomosaic qgis-script` writes: QGIS' own Python runs it, not ours.

It knows stages by what `geomosaic stages --json` said when it was written, and runs the command line.
"""

# mypy: ignore-errors
# ruff: noqa: N802, S603

import json
import os
import re
import signal
import subprocess
import threading
from pathlib import Path

from qgis.core import (
    QgsProcessingAlgorithm,
    QgsProcessingException,
    QgsProcessingOutputFile,
    QgsProcessingOutputRasterLayer,
    QgsProcessingParameterBoolean,
    QgsProcessingParameterDefinition,
    QgsProcessingParameterEnum,
    QgsProcessingParameterFile,
    QgsProcessingParameterFolderDestination,
    QgsProcessingParameterNumber,
    QgsProcessingParameterString,
)

DECLARED = json.loads(r"""DECLARATION""")
_PROGRESS = re.compile(r"\[(\d+)/(\d+)\] [^:]+: .*?(\d+) of (\d+)$")
_STAGE_DONE = re.compile(r"\[(\d+)/(\d+)\] [^:]+: [\d.,]+ (?:s|min)")
_QGIS_OWN = ("PYTHONHOME", "PYTHONPATH", "GDAL_DATA", "GDAL_DRIVER_PATH", "PROJ_LIB", "PROJ_DATA")
_SECONDS_TO_END = 10.0


class Geomosaic(QgsProcessingAlgorithm):
    """One command, with every parameter of its stages."""

    OUTPUT = "OUTPUT"

    def createInstance(self):
        return Geomosaic()

    def name(self):
        return DECLARED["name"]

    def displayName(self):
        return DECLARED["display_name"]

    def group(self):
        return "geomosaic"

    def groupId(self):
        return "geomosaic"

    def shortHelpString(self):
        return DECLARED["help"]

    def initAlgorithm(self, config=None):
        for declared in DECLARED["params"]:
            parameter = definition(declared)
            if declared["advanced"]:
                parameter.setFlags(parameter.flags() | QgsProcessingParameterDefinition.FlagAdvanced)
            self.addParameter(parameter)
        self.addParameter(QgsProcessingParameterFolderDestination(self.OUTPUT, "Run folder to write"))
        self.addOutput(QgsProcessingOutputRasterLayer("MOSAIC", "Mosaic"))
        self.addOutput(QgsProcessingOutputFile("PROJECT", "QGIS project of the run"))

    def processAlgorithm(self, parameters, context, feedback):
        folder = Path(self.parameterAsString(parameters, self.OUTPUT, context))
        command = [*DECLARED["command"], "-o", str(folder)]
        for declared in DECLARED["params"]:
            command += self.words(declared, parameters, context)
        feedback.pushCommandInfo(" ".join(command))
        last = run(command, feedback)
        if feedback.isCanceled():
            return {self.OUTPUT: str(folder)}
        if last is not None:
            raise QgsProcessingException(last)
        return {
            self.OUTPUT: str(folder),
            "MOSAIC": str(folder / "mosaic.tif"),
            "PROJECT": str(folder / "project.qgz"),
        }

    def words(self, declared, parameters, context):
        """Of a parameter on the command line; none where it is left as it is declared."""
        name = declared["key"]
        if name not in parameters or parameters[name] is None:
            return []
        if declared["kind"] == "bool":
            value = str(self.parameterAsBoolean(parameters, name, context)).lower()
        else:
            value = self.parameterAsString(parameters, name, context)
        default = declared["default"]
        if value in ("", "NULL") or value == str(default).lower() or value == str(default):
            return []
        option = declared["option"]
        if option == "":
            return [value]
        return [option, value] if option != "--set" else ["--set", f"{declared['name']}={value}"]


def definition(declared):
    """A parameter as QGIS has it."""
    name, text, kind = declared["key"], declared["text"], declared["kind"]
    optional, default = not declared["required"], declared["default"]
    if kind in ("file", "folder"):
        behavior = QgsProcessingParameterFile.Folder if kind == "folder" else QgsProcessingParameterFile.File
        return QgsProcessingParameterFile(name, text, behavior=behavior, optional=optional)
    if kind == "bool":
        return QgsProcessingParameterBoolean(name, text, defaultValue=default, optional=optional)
    if kind == "choice":
        return QgsProcessingParameterEnum(
            name, text, options=declared["choices"], defaultValue=default, optional=optional,
            usesStaticStrings=True,
        )  # fmt: skip
    if kind in ("int", "float"):
        of = QgsProcessingParameterNumber.Integer if kind == "int" else QgsProcessingParameterNumber.Double
        limits = {
            side: declared[key]
            for side, key in (("minValue", "min"), ("maxValue", "max"))
            if declared[key] is not None
        }
        return QgsProcessingParameterNumber(
            name, text, type=of, defaultValue=default, optional=optional, **limits
        )
    return QgsProcessingParameterString(name, text, defaultValue=default, optional=optional)


def run(command, feedback):
    """Runs it, tells how far it is, ends it if QGIS says so: the last line of a failure, None of success."""
    environment = {name: value for name, value in os.environ.items() if name not in _QGIS_OWN}
    ended, last = threading.Event(), ""
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, env=environment, encoding="utf-8"
    ) as process:
        threading.Thread(target=end_if_cancelled, args=(process, feedback, ended), daemon=True).start()
        for line in process.stdout:
            last = line.strip()
            if last.startswith("warning:"):
                feedback.pushWarning(last)
            elif not _PROGRESS.match(last):
                feedback.pushInfo(last)
            feedback.setProgress(share(last, feedback.progress()))
    ended.set()
    return None if process.returncode == 0 else last or f"geomosaic ended with {process.returncode}"


def end_if_cancelled(process, feedback, ended):
    """Asks the command to stop; what it has done is kept and taken up by the next run."""
    while not ended.wait(0.2):
        if feedback.isCanceled():
            process.send_signal(signal.SIGINT if os.name != "nt" else signal.SIGTERM)
            if not ended.wait(_SECONDS_TO_END):
                process.kill()
            return


def share(line, before):
    """How much is done, in percent, by a line of the command."""
    if found := _PROGRESS.match(line):
        stage, stages, done, total = map(int, found.groups())
        return 100.0 * (stage - 1 + done / max(total, 1)) / stages
    if found := _STAGE_DONE.match(line):
        stage, stages = map(int, found.groups())
        return 100.0 * stage / stages
    return before
