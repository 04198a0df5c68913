"""How files are spoiled: bytes, tokens, tables, and the file itself; by the generator handed in."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from pathlib import Path
from random import Random

Mutate = Callable[[bytes, Random, "Nasty"], tuple[bytes, str]]
"""Bytes in, bytes and what was done to them out."""

_NUMBER = re.compile(rb"[-+]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
_WORD = re.compile(rb"[A-Za-z_][\w.\-/]*")
LARGEST_BYTES = 8 << 20
"""No spoiled file grows beyond this by repeats: a million POS rows and 70,000 keys are in it."""
NUMBERS = (
    *("0", "-0", "-1", "1e999", "-1e308", "1e-320", "NaN", "nan", "inf", "-Infinity", "4294967295"),
    *(
        "9223372036854775808",
        "2147483648",
        "616333.1",
        "1e7",
        "0x10",
        "1_000",
        "1,5",
        "\u0663\u0664",
        "1e400",
    ),
    *("9" * 401, "-9999", "89.9", "180.0", "360", "90", "-180.0000001", "+.5", "1/4294967295", "1/0"),
)
LENGTHS = (0, 1, 2, 3, 0x7F, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0xFFFFFFFF, 0x80000000, 65500, 32767)


class Nasty:
    """Tokens with the places of one box in them: its listening port, people's files, the folder's name."""

    def __init__(self, box: Path, port: int) -> None:
        self.box = box
        url = f"http://127.0.0.1:{port}/a.tif"
        self.paths = (
            *("../../../../../../etc/passwd", "/etc/passwd", "/dev/zero", "/proc/self/mem", "/dev/stdin"),
            "/",
            *(f"/vsicurl/{url}", "/vsis3/bucket/a.tif", url, f"ftp://127.0.0.1:{port}/a"),
            f"WMS:{url}",
            *(str(box / "outside" / "secret.tif"), "../outside/secret.tif", "../outside/secret.txt"),
            "/vsimem/a",
            *("/vsizip/a.zip/b.tif", f"<GDAL_WMS><Service name='TMS'><ServerUrl>{url}</ServerUrl>"
              "</Service><DataWindow><SizeX>64</SizeX><SizeY>64</SizeY></DataWindow></GDAL_WMS>"),
            *(f"PG:host=127.0.0.1 port={port} dbname=a", "a" * 300, "", ".", "..", "~/x", "$HOME", "con:\\x"),
            f"<VRTDataset rasterXSize='9' rasterYSize='9'><VRTRasterBand dataType='Byte' band='1'>"
            f"<SimpleSource><SourceFilename>/vsicurl/{url}</SourceFilename></SimpleSource>"
            f"</VRTRasterBand></VRTDataset>",
        )  # fmt: skip
        self.words = (
            *self.paths, "\x1b[31mred", "\0", "%s%n%x", "{{7*7}}", "A" * 70_000, "\u202etxt",
            "\ud7ff", "é\u0301",
            "EPSG:4326", "EPSG:999999", "EPSG:32760", "null", "true", "-", "#", "'", '"', ";", "\r", "\t",
            "=1+1",
            "!!python/object/apply:os.system ['touch owned']", "!!bool foo", '!!int ""', "&a [*a]", "<<: *a",
            "<!ENTITY a 'b'>", "&lol;", "]]>", "<x:xmpmeta ", "\\u0000", "[" * 5000, "{" * 5000, "0o777",
        )  # fmt: skip

    def number(self, rng: Random) -> bytes:
        return rng.choice(NUMBERS).encode()

    def word(self, rng: Random) -> bytes:
        return rng.choice(self.words).encode(errors="replace")


def repeated(part: bytes, count: int) -> bytes:
    """So many times, or as often as the largest file allows."""
    return part * min(count, LARGEST_BYTES // max(1, len(part)))


def some_bytes(data: bytes, rng: Random, nasty: Nasty) -> tuple[bytes, str]:
    """Flips, cuts, duplicates, splices, overwrites, grows."""
    n = len(data)
    at = rng.randrange(n + 1)
    size = min(rng.choice((1, 2, 4, 16, 256, max(1, n // 4), max(1, n // 2))), n)
    match rng.randrange(9):
        case 0:
            out = bytearray(data)
            for _ in range(rng.choice((1, 1, 2, 8, 64))):
                if out:
                    out[rng.randrange(n)] ^= 1 << rng.randrange(8)
            return bytes(out), "bits flipped"
        case 1:
            return data[:at], f"cut at {at}"
        case 2:
            return data[:at] + data[at + size :], f"{size} bytes taken out at {at}"
        case 3:
            return data[:at] + repeated(data[at : at + size], rng.choice((2, 3, 50))) + data[
                at + size :
            ], f"repeated at {at}"
        case 4:
            other = rng.randrange(n + 1)
            return data[:at] + data[other : other + size] + data[at:], f"spliced {other} into {at}"
        case 5:
            return data[:at] + bytes(size) + data[at + size :], f"{size} zeros at {at}"
        case 6:
            return data[:at] + rng.randbytes(size) + data[at + size :], f"{size} random bytes at {at}"
        case 7:
            token = nasty.word(rng)
            return data[:at] + token + data[at:], f"token {token[:40]!r} at {at}"
        case _:
            value = rng.choice(LENGTHS).to_bytes(4, rng.choice(("little", "big")))
            return data[:at] + value + data[at + 4 :], f"length {value.hex()} at {at}"


def some_text(data: bytes, rng: Random, nasty: Nasty) -> tuple[bytes, str]:
    """A number, a word or a line is spoiled; encodings and line ends too."""
    kind = rng.randrange(12)
    if kind <= 3 and (found := list(_NUMBER.finditer(data))):
        one = rng.choice(found)
        new = _other_number(one[0], rng, nasty)
        return data[: one.start()] + new + data[
            one.end() :
        ], f"{one[0][:30]!r} -> {new[:40]!r} at {one.start()}"
    if kind <= 5 and (found := list(_WORD.finditer(data))):
        one = rng.choice(found)
        new = nasty.word(rng) if rng.random() < 0.7 else rng.choice(found)[0]
        return data[: one.start()] + new + data[
            one.end() :
        ], f"{one[0][:30]!r} -> {new[:40]!r} at {one.start()}"
    lines = data.splitlines(keepends=True) or [b""]
    at = rng.randrange(len(lines))
    match kind:
        case 6:
            return b"".join(lines[:at] + lines[at + 1 :]), f"line {at + 1} taken out"
        case 7:
            count = rng.choice((1, 1, 5, 100_000))
            return b"".join(
                [*lines[:at], repeated(lines[at], count), *lines[at:]]
            ), f"line {at + 1} {count} times more"
        case 8:
            rng.shuffle(lines)
            return b"".join(lines), "lines shuffled"
        case 9:
            code = rng.choice(("utf-16", "utf-8-sig", "utf-32", "latin-1"))
            text = data.decode(errors="replace") + ("é" if code == "latin-1" else "")
            return text.encode(code, errors="replace"), f"as {code}"
        case 10:
            new = rng.choice((b"\r", b"\r\n", b";", b"\n\n", b"\0\n"))
            return data.replace(b"\n", new), f"line ends {new!r}"
    return some_bytes(data, rng, nasty)


def _other_number(old: bytes, rng: Random, nasty: Nasty) -> bytes:
    """A token, a digit changed, the point moved, the sign turned."""
    match rng.randrange(4):
        case 0:
            return nasty.number(rng)
        case 1:
            digits = [i for i, c in enumerate(old) if 48 <= c <= 57]
            at = rng.choice(digits)
            return old[:at] + bytes([48 + rng.randrange(10)]) + old[at + 1 :]
        case 2:
            flat = old.replace(b".", b"")
            at = rng.randrange(len(flat) + 1)
            return flat[:at] + b"." + flat[at:]
        case _:
            return old[1:] if old[:1] in b"+-" else b"-" + old


def a_table(data: bytes, rng: Random, nasty: Nasty) -> tuple[bytes, str]:
    """Cells and columns of a table."""
    comma = b"," if b"," in data else b" "
    rows = [line.split(comma) for line in data.splitlines()]
    if not rows or rng.random() < 0.4:
        return some_text(data, rng, nasty)
    r = rng.randrange(len(rows))
    c = rng.randrange(max(1, len(rows[r])))
    match rng.randrange(7):
        case 0:
            new = nasty.number(rng) if rng.random() < 0.6 else nasty.word(rng)
            what = f"cell {r},{c} = {new[:40]!r}"
            rows[r][c] = new
        case 1:
            what = f"cell {r},{c} taken out"
            del rows[r][c]
        case 2:
            what = f"column {c} taken out"
            rows = [row[:c] + row[c + 1 :] for row in rows]
        case 3:
            d = rng.randrange(max(1, len(rows[r])))
            what = f"columns {c} and {d} exchanged in all lines but the first"
            for row in rows[1:]:
                if max(c, d) < len(row):
                    row[c], row[d] = row[d], row[c]
        case 4:
            what = f"cell {r},{c} twice"
            rows[r].insert(c, rows[r][c])
        case 5:
            new = rows[rng.randrange(len(rows))]
            what = f"line {r} as another"
            rows[r] = list(new)
        case _:
            count = rng.choice((2, 100, 3000))
            what = f"line {r} with {count} cells"
            rows[r] = (rows[r] * count)[: count + 1] if sum(map(len, rows[r])) < 10_000 else rows[r]
    return comma.join([]) + b"\n".join(comma.join(row) for row in rows) + b"\n", what


def spoil_the_file(path: Path, rng: Random, nasty: Nasty) -> str:
    """Something else stands where the file stood."""
    people = nasty.box / "outside" / "secret.tif"
    kinds: dict[str, Callable[[], object]] = {
        "a link to people's file": lambda: path.symlink_to(people),
        "a link to itself": lambda: path.symlink_to(path.name),
        "a dangling link": lambda: path.symlink_to(nasty.box / "outside" / "new.txt"),
        "a pipe": lambda: os.mkfifo(path),
        "a folder": path.mkdir,
        "an empty file": lambda: path.write_bytes(b""),
        "a link to /dev/zero": lambda: path.symlink_to("/dev/zero"),
        "a link to /proc/self/mem": lambda: path.symlink_to("/proc/self/mem"),
        "a link to /proc/self/environ": lambda: path.symlink_to("/proc/self/environ"),
        "gone": lambda: None,
        "a sparse file of 3 GB": lambda: os.truncate(os.open(path, os.O_CREAT | os.O_WRONLY), 3 << 30),
        "another file's bytes": lambda: path.write_bytes(people.read_bytes()),
    }
    what = rng.choice(list(kinds))
    path.unlink()
    kinds[what]()
    return what
