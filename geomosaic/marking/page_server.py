"""The page of a marking session on loopback."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

from geomosaic.marking.session import MarkingSession
from geomosaic.pages.loopback_server import COMMON_FILES, Answer, LoopbackServer, numbers

_PAGE: Final = Path(__file__).with_name("page")
_FILES: Final = ("index.html", "marking.css", "marking.js", "frame_view.js", "map_view.js")


class MarkingPages:
    """The survey, the state and tiles of frames of a session, and its changes."""

    command = "geomosaic control"
    files: Final = {**COMMON_FILES, **{name: _PAGE / name for name in _FILES}}

    def __init__(self, session: MarkingSession) -> None:
        self.session = session

    def get(self, path: list[str]) -> Answer | None:
        """The survey, the state, or a tile of a frame."""
        match path:
            case ["survey"]:
                return Answer.json(self.session.survey())
            case ["state"]:
                return Answer.json(self.session.state())
            case ["tile", *parts] if (at := numbers(parts, 4)) is not None:
                jpeg = self.session.tiles.tile(*at)
                return None if jpeg is None else Answer("image/jpeg", jpeg, kept=True)
            case _:
                return None

    def post(self, path: list[str], asked: Any) -> Answer:
        """A change: a mark, or a point's kind. Answers the new state."""
        said = self._changed(path, asked)
        return Answer.json({**self.session.state(), "said": said})

    def _changed(self, path: list[str], asked: Any) -> str:
        match path:
            case ["mark"]:
                at = asked["at"]
                place = None if at is None else (float(at[0]), float(at[1]))
                point, frame = int(asked["point"]), int(asked["frame"])
                return self.session.mark(point, frame, place, bool(asked["refine"]))
            case ["kind"]:
                self.session.set_kind(int(asked["point"]), bool(asked["check"]))
                return ""
            case _:
                raise ValueError(path)


class PageServer(LoopbackServer):
    """Serves one session at `url` until it is shut down."""

    def __init__(self, session: MarkingSession, port: int = 0) -> None:
        super().__init__(MarkingPages(session), port)
        self.session = session
