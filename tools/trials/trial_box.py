"""A box for one command of geomosaic: its memory and time limited, its files and connections watched."""

from __future__ import annotations

import ctypes
import fcntl
import os
import re
import resource
import select
import shutil
import signal
import socket
import stat
import struct
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from hashlib import blake2b
from pathlib import Path

MEMORY_BYTES = 2 << 30
"""What a case may use beyond what the imported program takes: the issue's 2 GB."""
FILE_BYTES = 1 << 30
"""No file of a case is larger: the disk is not to be filled by a trial."""
_HASHED_BYTES = 64 << 20
"""Larger files of a trial are sparse: size and time of change speak for them."""
_NEW_NETWORK = 0x40000000  # CLONE_NEWNET
_WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
_PROGRAMS = {"subprocess.Popen", "os.system", "os.exec", "os.posix_spawn", "pickle.find_class"}
_NETWORK = {"socket.connect", "socket.getaddrinfo", "socket.sendto", "urllib.Request"}
_CHANGES = {
    "os.remove": ((0, 1),), "os.rmdir": ((0, 1),), "os.mkdir": ((0, 2),), "os.symlink": ((1, 2),),
    "os.rename": ((0, 2), (1, 3)), "os.link": ((1, 3),), "os.chmod": ((0, 2),), "os.truncate": ((0, None),),
}  # fmt: skip
"""Python's audit events by which files change: where the path and its folder's descriptor stand."""

_HARMLESS = {"uname", "geomosaic.errors"}
"""What `platform` asks; the program's own errors, which the executor pickles to see whether they can be."""

Snapshot = dict[str, tuple[object, ...]]
_digests: dict[tuple[int, int], tuple[tuple[int, int], str]] = {}
"""Content by device and inode, and of what size and time of change (nobody can set it) it was."""


@dataclass(frozen=True)
class EndedCommand:
    """How a command ended: exit code (a signal negative), its words, and its other doings.

    seconds: without those in which others had the processor, so that a busy machine makes nothing slow.
    cpu_s: processor time.
    doings: programs started, files opened for writing outside the output, as Python reported.
    """

    argv: tuple[str, ...]
    code: int
    out: str
    err: str
    seconds: float
    cpu_s: float
    peak_mb: float
    hung: bool
    connections: int
    doings: tuple[str, ...]


def snapshot(folder: Path, without: Sequence[str] = ()) -> Snapshot:
    """Kind, size, time of change and content of all below a folder but for the named things on its top."""
    found: Snapshot = {}

    def walk(at: Path, under: str) -> None:
        for entry in sorted(os.scandir(at), key=lambda e: e.name):
            name = f"{under}{entry.name}"
            if name in without:
                continue
            said = entry.stat(follow_symlinks=False)
            kind = stat.S_IFMT(said.st_mode)
            if stat.S_ISDIR(kind):
                found[name] = ("folder", stat.S_IMODE(said.st_mode))
                walk(Path(entry.path), f"{name}/")
            elif stat.S_ISLNK(kind):
                found[name] = ("link", str(Path(entry.path).readlink()))
            elif stat.S_ISREG(kind):
                mode = stat.S_IMODE(said.st_mode)
                found[name] = ("file", said.st_size, said.st_mtime_ns, mode, _digest(entry.path, said))
            else:
                found[name] = ("device", kind)

    walk(folder, "")
    return found


def _digest(path: str, said: os.stat_result) -> str:
    """The content's hash, read again only where the system says that the file was touched."""
    if said.st_size > _HASHED_BYTES:
        return ""
    inode, state = (said.st_dev, said.st_ino), (said.st_size, said.st_ctime_ns)
    known = _digests.get(inode)
    if known is None or known[0] != state:
        known = state, blake2b(Path(path).read_bytes(), digest_size=16).hexdigest()
        _digests[inode] = known
    return known[1]


def changes(before: Snapshot, after: Snapshot) -> list[str]:
    """What came, went or became other, one short line each."""
    lines = [f"{n}: gone" for n in before.keys() - after.keys()]
    lines += [f"{n}: new" for n in after.keys() - before.keys()]
    lines += [f"{n}: changed" for n in before.keys() & after.keys() if before[n] != after[n]]
    return sorted(lines)


class Box:
    """A folder with in/ (what is given), out/ (the run folder), outside/ (people's), home/, cwd/ and tmp/."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.closed = _leave_the_network()
        self.listener = socket.socket()
        self.listener.bind(("127.0.0.1", 48619 if self.closed else 0))
        self.listener.listen(64)
        self.listener.setblocking(False)
        self.port: int = self.listener.getsockname()[1]

    def empty(self) -> None:
        """A new box: nothing in it but people's files outside."""
        shutil.rmtree(self.folder, ignore_errors=True)
        for name in ("in", "outside", "home", "cwd", "tmp"):
            (self.folder / name).mkdir(parents=True)

    def path(self, name: str) -> Path:
        return self.folder / name

    def run(self, argv: Sequence[str], seconds: float, details: bool = False) -> EndedCommand:
        """`geomosaic ARGV` in a forked child. details: errors are reported with where they were raised."""
        logs = [self.folder.with_name(f"{self.folder.name}.{name}") for name in ("out", "err", "doings")]
        before, accepted = _attempts(), 0
        started = time.monotonic()
        pid = os.fork()
        if pid == 0:
            _become(self, argv, logs, seconds, details)
        handle = os.pidfd_open(pid)
        hung = False
        while not hung:
            left = seconds - (time.monotonic() - started - waited_s(pid))
            ready, _, _ = select.select([handle, self.listener], [], [], max(left, 0.0))
            if self.listener in ready:
                self.listener.accept()[0].close()
                accepted += 1
            if handle in ready:
                break
            hung = left <= 0
        own_s = time.monotonic() - started - waited_s(pid)
        with suppress(ProcessLookupError):
            os.killpg(pid, signal.SIGKILL)  # it, if it hangs, and whatever it may have started
        _, status, usage = os.wait4(pid, 0)
        os.close(handle)
        texts = [log.read_bytes()[:200_000].decode(errors="replace") for log in logs]
        return EndedCommand(
            tuple(argv),
            os.waitstatus_to_exitcode(status),
            texts[0],
            texts[1],
            own_s,
            usage.ru_utime + usage.ru_stime,
            usage.ru_maxrss / 1024,
            hung,
            max(_attempts() - before, accepted),
            tuple(dict.fromkeys(texts[2].splitlines())),
        )


def waited_s(pid: int) -> float:
    """How long a process was ready to go on and others had the processor (Linux's schedstat)."""
    return int(Path(f"/proc/{pid}/schedstat").read_text().split()[1]) / 1e9


def _become(box: Box, argv: Sequence[str], logs: Sequence[Path], seconds: float, details: bool) -> None:
    """The child: never returns."""
    code = 70
    try:
        os.setpgid(0, 0)
        box.listener.close()
        os.chdir(box.path("cwd"))
        os.environ["HOME"] = str(box.path("home"))
        os.environ["TMPDIR"] = str(box.path("tmp"))
        tempfile.tempdir = None
        os.environ["GEOMOSAIC_TRACEBACK"] = "1" if details else "0"
        nowhere = os.open(os.devnull, os.O_RDONLY)
        streams = [os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_APPEND, 0o600) for log in logs]
        for fd, target in zip((nowhere, *streams[:2]), (0, 1, 2), strict=True):
            os.dup2(fd, target)
        here = int(re.search(r"VmSize:\s+(\d+)", Path("/proc/self/status").read_text())[1]) * 1024  # type: ignore[index]
        resource.setrlimit(resource.RLIMIT_AS, (here + MEMORY_BYTES,) * 2)
        resource.setrlimit(resource.RLIMIT_CPU, (int(seconds) + 5,) * 2)
        resource.setrlimit(resource.RLIMIT_FSIZE, (FILE_BYTES,) * 2)
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        from geomosaic.cli.main import main

        sys.addaudithook(_watcher(streams[2], (box.path("out"), box.path("tmp"), Path("/dev"))))
        code = main(list(argv))
        sys.stdout.flush()
        sys.stderr.flush()
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else 1
    except BaseException:
        import traceback

        traceback.print_exc()
        sys.stderr.flush()
    finally:
        os._exit(code)


def _watcher(fd: int, allowed: Sequence[Path]) -> Callable[[str, tuple[object, ...]], None]:
    """Tells programs that are started, connections, and changes outside the allowed folders."""
    roots = tuple(os.path.realpath(path) for path in allowed)
    busy = False

    def inside(real: str) -> bool:
        return any(real == root or real.startswith(root + os.sep) for root in roots)

    def name_in(path: object, folder: object) -> str:
        """Where a name lies, its own link not followed."""
        base = Path(f"/proc/self/fd/{folder}" if isinstance(folder, int) and folder >= 0 else "")
        whole = base.resolve() / os.fsdecode(path)  # type: ignore[arg-type]
        return str(whole.parent.resolve() / whole.name)

    def line_of(event: str, args: tuple[object, ...]) -> str:
        if event in _PROGRAMS or event in _NETWORK:
            return "" if args[0] in _HARMLESS else f"{event} {args!r}"
        if event == "open":
            path, mode, flags = args
            written = isinstance(flags, int) and flags & _WRITES and isinstance(path, str | bytes)
            if not written or (
                mode is None and not Path(os.fsdecode(path)).is_absolute()
            ):  # next to a folder's descriptor
                return ""
            return "" if inside(os.path.realpath(os.fsdecode(path))) else f"open for writing {path!r}"
        for at, folder in _CHANGES.get(event, ()):
            if isinstance(args[at], str | bytes):
                name = name_in(args[at], None if folder is None else args[folder])
                if not inside(name):
                    return f"{event} {name}"
        return ""

    def hook(event: str, args: tuple[object, ...]) -> None:
        nonlocal busy
        if busy or not (event in _CHANGES or event in _PROGRAMS or event in _NETWORK or event == "open"):
            return
        busy = True
        try:
            if line := line_of(event, args):
                os.write(fd, (line[:500].replace("\n", " ") + "\n").encode(errors="replace"))
        except (OSError, TypeError, ValueError):
            pass
        finally:
            busy = False

    return hook


def _leave_the_network() -> bool:
    """Into a network of this process's own, with nothing but its loopback, where the system allows it."""
    if ctypes.CDLL(None, use_errno=True).unshare(_NEW_NETWORK) != 0:
        return False
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as lo:
        flags = struct.pack("16sh14x", b"lo", 0x1 | 0x40)  # up, running
        fcntl.ioctl(lo, 0x8914, flags)  # SIOCSIFFLAGS
    return True


def _attempts() -> int:
    """Connections and datagrams begun so far in this network, also those without a way."""
    rows: dict[str, dict[str, int]] = {}
    lines = Path("/proc/self/net/snmp").read_text().splitlines()
    for names, values in zip(lines[::2], lines[1::2], strict=True):
        room, *words = names.split()
        rows[room] = dict(zip(words, map(int, values.split()[1:]), strict=True))
    count = rows["Tcp:"]["ActiveOpens"] + rows["Udp:"]["OutDatagrams"] + rows["Ip:"]["OutNoRoutes"]
    six = Path("/proc/self/net/snmp6")
    if six.exists():
        reported = dict(line.split() for line in six.read_text().splitlines())
        count += int(reported.get("Ip6OutNoRoutes", 0)) + int(reported.get("Udp6OutDatagrams", 0))
    return count
