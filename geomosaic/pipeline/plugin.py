"""Stages of third parties: who brought one, what its code is, and whose fault it is when it fails."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from importlib.metadata import entry_points
from importlib.util import find_spec
from pathlib import Path

from geomosaic.errors import CancelledError, GeomosaicError, OutputError, StageFaultError
from geomosaic.pipeline import files
from geomosaic.pipeline.artefacts import fingerprint_of_file
from geomosaic.pipeline.entry_points import GROUP
from geomosaic.pipeline.stage import Stage
from geomosaic.recording.file.fingerprints import fingerprint_of_json

_OWN = ("geomosaic", "geomosaic_simulate")
_CODE = (".py", ".so", ".pyd")


def distribution_of(stage: type[Stage]) -> str:
    """Name and version of the distribution that announces a stage; '' for geomosaic's own stages and for
    those registered in this process."""
    if _package(stage) in _OWN:
        return ""
    value = f"{stage.__module__}:{stage.__qualname__}"
    found = [e.dist for e in entry_points(group=GROUP, name=stage.id) if e.value.replace(" ", "") == value]
    return next((f"{dist.name} {dist.version}" for dist in found if dist is not None), "")


def code_of(stage: type[Stage], plugged: Iterable[tuple[str, str]] = ()) -> str:
    """The fingerprint of all plug-ins' code that a stage's work depends on: their distributions, and every
    module of the packages they stand in.

    '' where there are none: geomosaic's own stages say by their `version` what they compute. The version
    alone would not do for others: an editable install changes without it. plugged: see `Stage.plugged`.
    """
    own = [] if _package(stage) in _OWN else [(distribution_of(stage), _package(stage))]
    named = [entry for group, name in plugged for entry in entry_points(group=group, name=name)]
    brought = [
        (f"{e.dist.name} {e.dist.version}" if e.dist else "", e.module.partition(".")[0]) for e in named
    ]
    packages = [*own, *brought]
    return fingerprint_of_json([[who, _modules(package)] for who, package in packages]) if packages else ""


def _modules(package: str) -> list[tuple[str, str]]:
    """Each module of a package or the one it is, with the fingerprint of its contents."""
    spec = None
    with suppress(ValueError, ImportError):  # of a script that is run there is none
        spec = find_spec(package)
    folders = [] if spec is None else [Path(folder) for folder in spec.submodule_search_locations or ()]
    found = [(p, p.relative_to(folder)) for folder in folders for p in folder.rglob("*") if p.suffix in _CODE]
    if not folders and spec is not None and spec.origin is not None:
        found = [(Path(spec.origin), Path(Path(spec.origin).name))]
    return sorted((str(name), _mark(path)) for path, name in found)


def _package(stage: type[Stage]) -> str:
    return stage.__module__.partition(".")[0]


def _mark(path: Path) -> str:
    with path.open("rb") as file:
        return fingerprint_of_file(file)


@contextmanager
def blamed(stage: type[Stage]) -> Iterator[None]:
    """Names the stage and its distribution in whatever a plug-in raises.

    What it raises on purpose keeps its type; anything else becomes a `StageFaultError`. A full disk is
    nobody's fault, and geomosaic's own stages are named by nobody.
    """
    try:
        yield
    except (CancelledError, OutputError):
        raise
    except Exception as error:
        distribution = distribution_of(stage)
        if not distribution or (isinstance(error, OSError) and files.is_output_error(error)):
            raise
        who = f"stage {stage.id} of {distribution}"
        if isinstance(error, GeomosaicError):
            error.args = (f"{who}: {error}",)
            raise
        raise StageFaultError(f"{who} failed: {type(error).__name__}: {error}") from error
