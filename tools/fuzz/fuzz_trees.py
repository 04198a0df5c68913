"""Spoiling what is a tree: JSON, YAML and XML, and the tricks that only they know."""

from __future__ import annotations

import json
from collections.abc import Sequence
from random import Random
from typing import Any

import yaml

from tools.fuzz.fuzz_mutations import Nasty, some_text

_LARGE_BYTES = 200_000


def a_json(data: bytes, rng: Random, nasty: Nasty) -> tuple[bytes, str]:
    """A leaf, a key or a branch of a tree in JSON."""
    try:
        tree = json.loads(data)
    except (ValueError, RecursionError):
        return some_text(data, rng, nasty)
    if rng.random() < 0.35:
        return some_text(data, rng, nasty)
    what, tree = _spoiled(tree, rng, nasty)
    return json.dumps(tree, ensure_ascii=rng.random() < 0.5).encode(errors="replace"), what


def a_yaml(data: bytes, rng: Random, nasty: Nasty) -> tuple[bytes, str]:
    """The same in YAML, and what only YAML has: aliases, merge keys, tags."""
    kind = rng.random()
    if kind < 0.3 or b": &a" in data or len(data) > _LARGE_BYTES:  # a bomb already: not for us to open
        return some_text(data, rng, nasty)
    if kind < 0.5:
        bomb = rng.choice(
            (
                "a: &a [x,x,x,x,x,x,x,x,x]\n" + "".join(
                    f"{n}: &{n} [{','.join([f'*{p}'] * 9)}]\n"
                    for p, n in zip("abcdefgh", "bcdefghi", strict=True)
                ),
                "a: &a [*a]\n", "? [[[[1]]]]\n: 2\n", "<<: [{a: 1}, {a: 2}]\n",
                "!!python/object/new:os.system [true]\n",
                "".join(f"k{i}: {i}\n" for i in range(70_000)), "b: !!bool foo\n", 'i: !!int ""\n',
                "t: 2001-99-99\n", "- " * 4000 + "\n", "m: &m {<<: *m}\n", "f: !!float 9" + "9" * 5000 + "\n",
                "s: !!set {a, b}\n", "o: !!omap [a: 1]\n", "b: !!binary ////\n", "x: 0b1" + "0" * 2000 + "\n",
            )
        )  # fmt: skip
        out = data + bomb.encode() if rng.random() < 0.7 else bomb.encode() + data
        return out, f"YAML {bomb[:40]!r} added"
    try:
        tree = yaml.safe_load(data)
    except Exception:  # whatever an earlier spoiling makes of the loader
        return some_text(data, rng, nasty)
    what, tree = _spoiled(tree, rng, nasty)
    return yaml.safe_dump(tree, allow_unicode=True, sort_keys=False).encode(errors="replace"), what


def _spoiled(tree: Any, rng: Random, nasty: Nasty) -> tuple[str, Any]:
    """A tree with one node spoiled, and what was done."""
    places: list[tuple[Any, Any]] = []

    def walk(node: Any) -> None:
        keys = node.keys() if isinstance(node, dict) else range(len(node)) if isinstance(node, list) else ()
        for key in keys:
            places.append((node, key))
            walk(node[key])

    walk(tree)
    if not places:
        return "as text", nasty.word(rng).decode(errors="replace")
    node, key = rng.choice(places)
    old, where = node[key], f"{key!r}"
    new: Any = rng.choice(
        (
            None, True, [], {}, "", [old], {"a": old}, -1, 0, 10**401, 1e308, -1e308, 2**63, 5e-324,
            float("nan"), float("inf"), nasty.word(rng).decode(errors="replace"),
            nasty.number(rng).decode(), [old] * (300 if len(str(old)) < 10_000 else 1),
            rng.choice(nasty.paths),
            old * rng.choice((-1, 10, 0.1, 1000)) if isinstance(old, float) else old,
        )
    )  # fmt: skip
    match rng.randrange(5):
        case 0 if isinstance(node, dict):
            node[nasty.word(rng).decode(errors="replace")] = node.pop(key)
            return f"{where} under another name", tree
        case 1:
            del node[key]
            return f"{where} taken out", tree
        case 2 if isinstance(node, list):
            node.insert(key, old)
            return f"{where} twice", tree
        case _:
            node[key] = new
            return f"{where} = {str(new)[:40]!r}", tree


def an_xml(data: bytes, rng: Random, nasty: Nasty) -> tuple[bytes, str]:
    """Entities, depth, repeats; else as text."""
    start = data.find(b"<")
    if start < 0 or rng.random() < 0.6:
        return some_text(data, rng, nasty)
    url = nasty.paths[8]
    doctypes: Sequence[bytes] = (
        b'<!DOCTYPE a [<!ENTITY x SYSTEM "file:///etc/passwd">]>',
        f'<!DOCTYPE a SYSTEM "{url}">'.encode(errors="replace"),
        b'<!DOCTYPE a [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "' + b"&a;" * 99 + b'">'
        b'<!ENTITY c "' + b"&b;" * 99 + b'">]>',
        b"<x:xmpmeta " * 1000, b"<a>" * 20_000, b"<![CDATA[" + b"]" * 9000, b"<!--" + b"-" * 9000,
        b'<?xml version="1.0" encoding="utf-7"?>', b"\xef\xbb\xbf", b"<a " + b'b="c" ' * 9000 + b"/>",
    )  # fmt: skip
    new = rng.choice(doctypes)
    at = start if rng.random() < 0.6 else rng.randrange(start, len(data))
    return data[:at] + new + data[at:], f"XML {new[:40]!r} at {at}"
