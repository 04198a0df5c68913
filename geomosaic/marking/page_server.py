"""The page of a marking session on loopback: only requests that know its address are answered."""

from __future__ import annotations

import hmac
import json
import secrets
from collections.abc import Mapping
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, Final

from geomosaic.errors import GeomosaicError
from geomosaic.marking.session import MarkingSession

_PAGE: Final = Path(__file__).with_name("page")
_FILES: Final[Mapping[str, str]] = {
    "index.html": "text/html; charset=utf-8",
    "marking.css": "text/css; charset=utf-8",
    "marking.js": "text/javascript; charset=utf-8",
    "pan_zoom.js": "text/javascript; charset=utf-8",
    "frame_view.js": "text/javascript; charset=utf-8",
    "map_view.js": "text/javascript; charset=utf-8",
}
"""All files that are served, by name: no request is made a path of."""
_HEADERS: Final = (
    (
        "Content-Security-Policy",
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src 'self'; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    ),
    ("X-Content-Type-Options", "nosniff"),
    ("Referrer-Policy", "no-referrer"),
    ("Cross-Origin-Resource-Policy", "same-origin"),
    ("Cross-Origin-Opener-Policy", "same-origin"),
)
_LOOPBACK: Final = "127.0.0.1"
_MOST_BODY_BYTES: Final = 4096
_STALLED_S: Final = 60.0


class PageServer(ThreadingHTTPServer):
    """Serves one session at `url` until it is shut down.

    A request is answered if its path begins with the token of this start and its Host is this server's. The
    Host keeps out pages of other names that point to this machine (DNS rebinding).
    """

    daemon_threads = True

    def __init__(self, session: MarkingSession, port: int = 0) -> None:
        super().__init__((_LOOPBACK, port), _PageHandler)
        self.session, self.token = session, secrets.token_urlsafe(24)

    @property
    def hosts(self) -> tuple[str, ...]:
        """What a request's Host may be."""
        return f"{_LOOPBACK}:{self.server_port}", f"localhost:{self.server_port}"

    @property
    def url(self) -> str:
        """The page's address, with the token."""
        return f"http://{self.hosts[0]}/{self.token}/"

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Nothing: who asked has gone away."""


class _PageHandler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    server_version, sys_version = "geomosaic", ""
    timeout = _STALLED_S
    server: PageServer

    def log_message(self, format: str, *args: Any) -> None:
        """Nothing on the screen: addresses hold the token."""

    def do_GET(self) -> None:
        """Files of the page, the survey, the state, tiles of frames."""
        match self._admitted():
            case None:
                self._refuse()
            case [""]:
                self._file("index.html")
            case [name] if name in _FILES:
                self._file(name)
            case ["survey"]:
                self._json(self.server.session.survey())
            case ["state"]:
                self._json(self.server.session.state())
            case ["tile", *numbers] if len(numbers) == 4 and all(_is_number(n) for n in numbers):
                self._tile([int(n) for n in numbers])
            case _:
                self._send(HTTPStatus.NOT_FOUND, "text/plain", b"not found")

    def do_POST(self) -> None:
        """A change: a mark, or a point's kind. Answers the new state."""
        self.close_connection = True  # what is left unread of a refused body is no next request
        path = self._admitted()
        origin = self.headers.get("Origin")
        if path is None or (origin is not None and origin not in [f"http://{h}" for h in self.server.hosts]):
            self._refuse()
            return
        asked = self._body()
        try:
            said = _changed(self.server.session, path, asked)
        except (LookupError, TypeError, ValueError) as error:
            text = str(error) if isinstance(error, GeomosaicError) else "the request is not understood"
            self._json({"error": text}, HTTPStatus.BAD_REQUEST)
        except GeomosaicError as error:
            self._json({"error": str(error)}, HTTPStatus.INTERNAL_SERVER_ERROR)
        else:
            self._json({**self.server.session.state(), "said": said})

    def _admitted(self) -> list[str] | None:
        """The path behind the token; None of a request that is refused."""
        if self.headers.get_all("Host") not in [[host] for host in self.server.hosts]:
            return None
        _, _, asked = self.path.partition("?")[0].partition("/")
        token, *path = asked.split("/")
        right = hmac.compare_digest(token.encode(), self.server.token.encode())
        return path if right and path else None

    def _refuse(self) -> None:
        self.close_connection = True
        self._send(HTTPStatus.FORBIDDEN, "text/plain", b"open the address that geomosaic control printed")

    def _body(self) -> Any:
        """The JSON of a request; None where it is none."""
        length = self.headers.get("Content-Length", "")
        wanted = self.headers.get_content_type() == "application/json"
        if not wanted or not _is_number(length) or int(length) > _MOST_BODY_BYTES:
            return None
        try:
            return json.loads(self.rfile.read(int(length)))
        except ValueError:
            return None

    def _file(self, name: str) -> None:
        self._send(HTTPStatus.OK, _FILES[name], (_PAGE / name).read_bytes())

    def _tile(self, numbers: list[int]) -> None:
        try:
            jpeg = self.server.session.tiles.tile(*numbers)
        except GeomosaicError as error:
            self._json({"error": str(error)}, HTTPStatus.INTERNAL_SERVER_ERROR)
            return
        if jpeg is None:
            self._send(HTTPStatus.NOT_FOUND, "text/plain", b"not found")
        else:
            self._send(HTTPStatus.OK, "image/jpeg", jpeg, "private, max-age=3600")

    def _json(self, value: Any, status: HTTPStatus = HTTPStatus.OK) -> None:
        self._send(status, "application/json", json.dumps(value).encode())

    def _send(self, status: HTTPStatus, kind: str, body: bytes, cache: str = "no-store") -> None:
        self.send_response(status)
        for name, value in (*_HEADERS, ("Content-Type", kind), ("Cache-Control", cache)):
            self.send_header(name, value)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)


def _changed(session: MarkingSession, path: list[str], asked: Any) -> str:
    """Makes a change. Raises: `LookupError`, `TypeError`, `ValueError` for what is none."""
    match path:
        case ["mark"]:
            at = asked["at"]
            place = None if at is None else (float(at[0]), float(at[1]))
            return session.mark(int(asked["point"]), int(asked["frame"]), place, bool(asked["refine"]))
        case ["kind"]:
            session.set_kind(int(asked["point"]), bool(asked["check"]))
            return ""
        case _:
            raise ValueError(path)


def _is_number(text: str) -> bool:
    return text.isascii() and text.isdigit() and len(text) < 8
