"""A page on loopback: only requests that know its address are answered."""

from __future__ import annotations

import hmac
import json
import secrets
from collections.abc import Mapping
from dataclasses import dataclass
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, Final, Protocol, Self

from geomosaic.errors import GeomosaicError, InputError

_PAGE: Final = Path(__file__).with_name("page")
COMMON_FILES: Final[Mapping[str, Path]] = {name: _PAGE / name for name in ("page.css", "pan_zoom.js")}
"""How pages look, and a canvas that is moved and zoomed."""
_KINDS: Final[Mapping[str, str]] = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
}
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
_MOST_BODY_BYTES: Final = 1 << 16
_STALLED_S: Final = 60.0


@dataclass(frozen=True)
class Answer:
    """What a page is sent; a browser may keep it for an hour where `kept` says so."""

    kind: str
    body: bytes
    kept: bool = False

    @classmethod
    def json(cls, value: Any) -> Self:
        """A value as JSON."""
        return cls("application/json", json.dumps(value).encode())


class Pages(Protocol):
    """What a server serves."""

    @property
    def command(self) -> str:
        """The command that prints the address."""

    @property
    def files(self) -> Mapping[str, Path]:
        """All files that are served, by name: no request is made a path of."""

    def get(self, path: list[str]) -> Answer | None:
        """The answer to what is no file; None where there is none. Raises: `GeomosaicError`."""

    def post(self, path: list[str], asked: Any) -> Answer:
        """The answer to a request with JSON. Raises: `LookupError`, `TypeError`, `ValueError` for one that
        is not understood; `GeomosaicError`."""


def is_number(text: str) -> bool:
    """Whether a part of a path is a whole number that is not absurdly long."""
    return text.isascii() and text.isdigit() and len(text) < 8


def numbers(parts: list[str], count: int) -> list[int] | None:
    """So many whole numbers from parts of a path; None where they are none."""
    return [int(n) for n in parts] if len(parts) == count and all(map(is_number, parts)) else None


class LoopbackServer(ThreadingHTTPServer):
    """Serves pages at `url` until it is shut down.

    A request is answered if its path begins with the token of this start and its Host is this server's. The
    Host keeps out pages of other names that point to this machine (DNS rebinding).

    Raises: `InputError` where the port cannot be used.
    """

    daemon_threads = True

    def __init__(self, pages: Pages, port: int = 0) -> None:
        try:
            super().__init__((_LOOPBACK, port), _PageHandler)
        except OSError as error:
            fix = "leave out --port, or give another number"
            raise InputError(f"port {port} cannot be used ({error.strerror})", fix=fix) from error
        self.pages, self.token = pages, secrets.token_urlsafe(24)

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
    server: LoopbackServer

    def log_message(self, format: str, *args: Any) -> None:
        """Nothing on the screen: addresses hold the token."""

    def do_GET(self) -> None:
        """Files of the page, and what its pages answer."""
        path = self._admitted()
        if path is None:
            self._refuse()
            return
        name = "/".join(path) or "index.html"
        if name in self.server.pages.files:
            file = self.server.pages.files[name]
            self._send(HTTPStatus.OK, Answer(_KINDS[file.suffix], file.read_bytes()))
            return
        try:
            answer = self.server.pages.get(path)
        except Exception as error:  # the connection would be closed without a word
            self._fail(error)
            return
        if answer is None:
            self._send(HTTPStatus.NOT_FOUND, Answer("text/plain", b"not found"))
        else:
            self._send(HTTPStatus.OK, answer)

    def do_POST(self) -> None:
        """A request with JSON."""
        self.close_connection = True  # what is left unread of a refused body is no next request
        path = self._admitted()
        origin = self.headers.get("Origin")
        if path is None or (origin is not None and origin not in [f"http://{h}" for h in self.server.hosts]):
            self._refuse()
            return
        asked = self._body()
        try:
            answer = self.server.pages.post(path, asked)
        except Exception as error:  # as above
            self._fail(error)
        else:
            self._send(HTTPStatus.OK, answer)

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
        text = f"open the address that {self.server.pages.command} printed"
        self._send(HTTPStatus.FORBIDDEN, Answer("text/plain", text.encode()))

    def _fail(self, error: Exception) -> None:
        """Says what went wrong: 400 where the request was at fault, else 500."""
        at_fault = self.command == "POST" and isinstance(error, (LookupError, TypeError, ValueError))
        status = HTTPStatus.BAD_REQUEST if at_fault else HTTPStatus.INTERNAL_SERVER_ERROR
        text = str(error) if isinstance(error, GeomosaicError) else ""
        if not text:
            text = "the request is not understood" if at_fault else f"failed: {type(error).__name__}: {error}"
        self._send(status, Answer.json({"error": text}))

    def _body(self) -> Any:
        """The JSON of a request; None where it is none."""
        length = self.headers.get("Content-Length", "")
        wanted = self.headers.get_content_type() == "application/json"
        if not wanted or not is_number(length) or int(length) > _MOST_BODY_BYTES:
            return None
        try:
            return json.loads(self.rfile.read(int(length)))
        except ValueError:
            return None

    def _send(self, status: HTTPStatus, answer: Answer) -> None:
        cache = "private, max-age=3600" if answer.kept else "no-store"
        self.send_response(status)
        for name, value in (*_HEADERS, ("Content-Type", answer.kind), ("Cache-Control", cache)):
            self.send_header(name, value)
        self.send_header("Content-Length", str(len(answer.body)))
        if self.close_connection:
            self.send_header("Connection", "close")
        self.end_headers()
        self.wfile.write(answer.body)
