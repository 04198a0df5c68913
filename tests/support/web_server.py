"""A web server of this machine, which is an object store too, and fails as it is asked to."""

from __future__ import annotations

import re
import threading
import time
from dataclasses import dataclass, field
from email.utils import formatdate
from hashlib import blake2b
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from types import TracebackType
from urllib.parse import parse_qs, unquote, urlsplit
from xml.sax.saxutils import escape


@dataclass
class Server:
    """Gives the files below a folder: at /NAME as a web server, at /BUCKET/... as a store that speaks S3.

    wrong: by path, what is amiss there. asked: each request's method and path.
    """

    root: Path
    wrong: dict[str, str] = field(default_factory=dict)
    asked: list[tuple[str, str]] = field(default_factory=list)
    tags: bool = True

    def __enter__(self) -> Server:
        handler = type("Handler", (_Handler,), {"world": self})
        self._server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.05,), daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: type[BaseException] | BaseException | TracebackType | None) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._thread.join(5.0)

    @property
    def host(self) -> str:
        """Host and port."""
        return f"127.0.0.1:{self._server.server_port}"

    def url(self, path: str) -> str:
        """The address of a file."""
        return f"http://{self.host}/{path}"

    def store(self) -> dict[str, str]:
        """The environment in which GDAL takes this server for S3."""
        plain = {"AWS_HTTPS": "NO", "AWS_VIRTUAL_HOSTING": "FALSE", "AWS_NO_SIGN_REQUEST": "YES"}
        return {"AWS_S3_ENDPOINT": self.host, **plain}

    def bodies(self) -> list[str]:
        """Paths whose content was asked for, sorted."""
        return sorted(unquote(path) for method, path in self.asked if method == "GET")


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    world: Server

    def log_message(self, *_: object) -> None:
        """Nothing on the screen."""

    def do_HEAD(self) -> None:
        self._answer()

    def do_GET(self) -> None:
        self._answer()

    def do_PUT(self) -> None:
        """Keeps a file, as a store does; wrong: `refuses` says no, `loses` keeps the half of it."""
        path = unquote(urlsplit(self.path).path)
        self.world.asked.append((self.command, path))
        data = self.rfile.read(int(self.headers["Content-Length"]))
        wrong = self.world.wrong.get(path, "")
        if wrong == "refuses":
            self._send(403, b"<Error><Code>AccessDenied</Code></Error>")
            return
        place = self.world.root / path.lstrip("/")
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_bytes(data[: len(data) // 2] if wrong == "loses" else data)
        self._send(200, b"")

    def do_DELETE(self) -> None:
        """Deletes a file, as a store does; wrong: `refuses` says no."""
        path = unquote(urlsplit(self.path).path)
        self.world.asked.append((self.command, path))
        if self.world.wrong.get(path, "") == "refuses":
            self._send(403, b"<Error><Code>AccessDenied</Code></Error>")
            return
        (self.world.root / path.lstrip("/")).unlink(missing_ok=True)
        self._send(204, b"")

    def _answer(self) -> None:
        url = urlsplit(self.path)
        self.world.asked.append((self.command, url.path))
        query = parse_qs(url.query)
        if "delimiter" in query:
            self._list(query.get("prefix", [""])[0], unquote(url.path).strip("/"))
            return
        wrong = self.world.wrong.get(unquote(url.path), "")
        if wrong.isdigit():
            self._send(int(wrong), b"no")
        elif wrong.startswith("busy once"):
            self.world.wrong.pop(unquote(url.path))
            self._send(503, b"busy")
        elif wrong.startswith("http"):
            self._send(302, b"", Location=wrong.replace("PORT", str(self.server.server_address[1])))
        elif wrong.startswith("size"):
            self._send(200, b"", length=int(wrong.split()[1]))
        else:
            self._file(self.world.root / unquote(url.path).lstrip("/"), wrong)

    def _file(self, path: Path, wrong: str) -> None:
        if not path.is_file():
            self._send(404, b"<html>none</html>")
            return
        data, reported = path.read_bytes(), {"Last-Modified": formatdate(path.stat().st_mtime, usegmt=True)}
        if self.world.tags:
            reported["ETag"] = f'"{blake2b(data, digest_size=8).hexdigest()}"'
        if wrong == "slow":
            time.sleep(0.5)
        asked = re.fullmatch(r"bytes=(\d+)-(\d+)", self.headers.get("Range", ""))
        if asked is None or wrong == "no ranges":
            self._send(200, data, **reported)
            return
        first, last = int(asked[1]), min(int(asked[2]), len(data) - 1)
        reported["Content-Range"] = f"bytes {first}-{last}/{len(data)}"
        if wrong == "changes":
            path.write_bytes(data[:-3] + b"new")
        if wrong == "hangs":
            self._send(206, data[first : first + 1000], length=last + 1 - first, **reported)
            time.sleep(20.0)
        elif wrong.startswith("breaks off"):
            if wrong == "breaks off once":
                self.world.wrong.clear()
            self._send(206, data[first : first + 1000], length=last + 1 - first, **reported)
            self.close_connection = True
        else:
            self._send(206, data[first : last + 1], **reported)

    def _list(self, prefix: str, bucket: str) -> None:
        if not (self.world.root / bucket).is_dir():
            self._send(404, b"<Error><Code>NoSuchBucket</Code></Error>")
            return
        inside = sorted((self.world.root / bucket / prefix).iterdir())
        files = "".join(
            f"<Contents><Key>{escape(prefix + p.name)}</Key><Size>{p.stat().st_size}</Size>"
            f"<LastModified>{time.strftime('%Y-%m-%dT%H:%M:%S.000Z', time.gmtime(p.stat().st_mtime))}</LastModified>"
            f"<ETag>&quot;{blake2b(p.read_bytes(), digest_size=8).hexdigest()}&quot;</ETag></Contents>"
            for p in inside
            if p.is_file()
        )
        folders = "".join(
            f"<CommonPrefixes><Prefix>{escape(prefix + p.name)}/</Prefix></CommonPrefixes>"
            for p in inside
            if p.is_dir()
        )
        self._send(
            200,
            '<?xml version="1.0" encoding="UTF-8"?>'
            '<ListBucketResult xmlns="http://s3.amazonaws.com/doc/2006-03-01/">'
            f"<Name>{bucket}</Name><Prefix>{escape(prefix)}</Prefix><IsTruncated>false</IsTruncated>"
            f"{files}{folders}</ListBucketResult>".encode(),
        )

    def _send(self, code: int, body: bytes, length: int | None = None, **headers: str) -> None:
        self.send_response(code)
        for name, value in headers.items():
            self.send_header(name, value)
        self.send_header("Content-Length", str(len(body) if length is None else length))
        self.end_headers()
        try:
            if self.command != "HEAD":
                self.wfile.write(body)
        except OSError:  # who asked has had enough
            self.close_connection = True
