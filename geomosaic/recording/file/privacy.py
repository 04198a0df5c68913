"""Recordings for strangers: without folders, and where asked without places."""

from __future__ import annotations

import json
import re
import secrets
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from foxglove_schemas_protobuf.GeoJSON_pb2 import GeoJSON
from foxglove_schemas_protobuf.LocationFix_pb2 import LocationFix

from geomosaic.geodesy.local import LocalFrame
from geomosaic.recording.file.plain import json_text

_NAME = r"[^\s/\\:'\",;()\[\]{}<>]+"
_FOLDERS = re.compile(
    rf"(?:(?<![\w.:/])(?:file:/?/?)?(?:[A-Za-z]:)?[/\\]?(?:[/\\]{_NAME}(?: {_NAME})*)*"
    rf"|(?<![\w./])(?:\.\.[/\\])*\.\.(?:[/\\]{_NAME}(?: {_NAME})*)*)[/\\](?=[^\s/\\])"
)
"""The folders of a path that is absolute, of a network or above the current one, in a text."""
_CRS = re.compile(
    r"(?:urn:ogc:def:crs:)?\b(?:EPSG|ESRI|IGNF|OGC):+\w+(?:\+\w+)?|(?:WGS 84 / )?\bUTM zone \w+"
    r"|\+proj=[^\s,;()]+(?: \+[^\s;()]*[^\s,;()])*",
    re.IGNORECASE,
)
_NUMBER = r"-?\d+(?:\.\d+)?"
_PLACE = re.compile(
    rf"\({_NUMBER}(?: to {_NUMBER})?, {_NUMBER}(?: to {_NUMBER})? deg\)|{_NUMBER}, {_NUMBER}, {_NUMBER} m\b"
)
"""A place, or a reach of places, as messages state it."""
_JSON_FIELDS = frozenset({"json", "params_json", "notes_json", "geojson"})
"""Of messages: texts that are JSON themselves."""
_PLACES = frozenset({"easting_m", "northing_m", "centre_east_m", "centre_north_m", "middle_m"})
"""Entries of metrics that hold places of the map."""


def _without_places(text: str) -> str:
    """A text of JSON whose entries of `_PLACES` are null."""

    def cleared(value: Any) -> Any:
        match value:
            case dict():
                return {k: None if k in _PLACES else cleared(v) for k, v in value.items()}
            case list():
                return [cleared(v) for v in value]
        return value

    return json_text(cleared(json.loads(text))) if text else text


class Privacy:
    """Takes out of texts the folders of absolute paths, so that names of files stay. With `places` it also
    moves all places to a secret one, and takes out the names of map systems.

    folders, systems: those that are known to be named, whatever is in their names.
    """

    def __init__(
        self, folders: Iterable[Path] = (), systems: Iterable[str] = (), *, places: bool = False
    ) -> None:
        known = {str(f.absolute()) for f in folders} - {"/"}
        self.places = places
        self._known = [f"{name}/" for name in sorted(known, key=len, reverse=True)]
        self._systems = sorted(set(systems), key=len, reverse=True) if places else []
        self._here: LocalFrame | None = None
        self._there = LocalFrame(
            secrets.SystemRandom().uniform(-180.0, 180.0), secrets.SystemRandom().uniform(-60.0, 60.0), 0.0
        )

    def text(self, text: str) -> str:
        """A text without folders."""
        if "/" in text or "\\" in text:
            for folder in self._known:
                text = text.replace(folder, "")
            text = _FOLDERS.sub("", text)
        for system in self._systems:
            text = text.replace(system, "its map system")
        return _PLACE.sub("(its place)", _CRS.sub("its map system", text)) if self.places else text

    def json(self, text: str) -> str:
        """A text of JSON whose own texts are without folders; escapes would hide these."""
        return json_text(self.value(json.loads(text))) if text else text

    def yaml(self, text: str) -> str:
        """A text in YAML, which may break a folder's name over lines, without folders."""
        return yaml.safe_dump(self.value(yaml.safe_load(text)), sort_keys=False, allow_unicode=True)

    def value(self, value: Any) -> Any:
        """A value that JSON knows, with all its texts, names of entries too."""
        match value:
            case str() | Path():
                return self.text(str(value))
            case dict():
                return {self.text(str(k)): self.value(v) for k, v in value.items()}
            case list() | tuple():
                return [self.value(v) for v in value]
        return value

    def message(self, message: Any) -> None:
        """A protobuf message, changed where it is."""
        if self.places:
            self._move(message)
        for field, value in message.ListFields():
            repeated = not isinstance(value, str | bytes | int | float | bool) and hasattr(value, "__len__")
            if field.type == field.TYPE_STRING:
                if repeated:
                    value[:] = [self.text(v) for v in value]
                else:
                    of = self.json if field.name in _JSON_FIELDS else self.text
                    setattr(message, field.name, of(value))
            elif field.type == field.TYPE_MESSAGE:
                for one in value if repeated else (value,):
                    self.message(one)

    def _move(self, message: Any) -> None:
        if isinstance(message, LocationFix):
            at = (message.longitude, message.latitude, message.altitude)
            message.longitude, message.latitude, message.altitude = self._moved(at)
        elif "json" in message.DESCRIPTOR.fields_by_name:
            message.json = _without_places(message.json)
        elif "notes_json" in message.DESCRIPTOR.fields_by_name:
            message.notes_json = _without_places(message.notes_json)
        elif isinstance(message, GeoJSON):
            tree = json.loads(message.geojson)
            for feature in tree["features"]:
                self._move_all(feature["geometry"])
            message.geojson = json_text(tree)

    def _move_all(self, geometry: Any) -> None:
        def moved(coordinates: Any) -> Any:
            if coordinates and not isinstance(coordinates[0], list):
                return self._moved((*coordinates[:2], 0.0))[:2]
            return [moved(c) for c in coordinates]

        geometry["coordinates"] = moved(geometry["coordinates"])

    def _moved(self, place: tuple[float, float, float]) -> list[float]:
        """Longitude, latitude and height, as far from the secret place as from the first that was moved."""
        self._here = self._here or LocalFrame(*place)
        enu = self._here.enu_from_geodetic(*place)
        return [float(v) for v in np.asarray(self._there.geodetic_from_enu(enu))]
