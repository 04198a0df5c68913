"""Plain YAML and JSON of strangers: numbers, words, lists and mappings, within budgets of depth and count."""

from __future__ import annotations

import json
import reprlib
from collections import Counter
from pathlib import Path
from typing import Any, Final

import yaml

from geomosaic.constants import tuned
from geomosaic.doors.files import printable, read_bytes
from geomosaic.errors import FileError

YAML_BYTES = tuned(256 << 10, "bytes", "of a file for people: YAML takes half a minute a megabyte")
MOST_DEPTH: Final = 32
"""Of lists and mappings within each other: a recipe has 6, a reconstruction.json 7."""
MOST_YAML_NODES: Final = 10_000
"""Keys and values: a rig of 100 cameras, the longest that people write, has 3,000; 10,000 take a second."""
_MOST_JSON: Final = {b"{": 2_000_000, b"[": 2_000_000, b",": 5_000_000}
"""A reconstruction.json of 600,000 points has 1.8 million lists and mappings; these limits hold 1 GB."""
_MOST_DIGITS: Final = 30
"""Of a whole number: the largest that a float64 distinguishes has 16."""
_SHORT: Final = reprlib.Repr()
_SHORT.maxstring = 60


def shown(value: object) -> str:
    """A value out of a file as a message shows it: short, whatever it is."""
    try:
        return _SHORT.repr(value)[:80]
    except ValueError:  # an integer of more digits than Python prints
        return "too large a number"


def read_yaml(path: Path, most_bytes: int, kind: str, fix: str) -> Any:
    """What a YAML file holds; raises as `files.read_bytes` and `plain_yaml` do."""
    return plain_yaml(read_bytes(path, most_bytes, kind, fix), path, fix)


def read_json(path: Path, most_bytes: int, kind: str, fix: str) -> Any:
    """What a JSON file holds; raises as `files.read_bytes` and `plain_json` do."""
    return plain_json(read_bytes(path, most_bytes, kind, fix), path, fix)


def plain_yaml(content: bytes | str, file: str | Path | None, fix: str) -> Any:
    """YAML without tags, anchors, merges and keys given twice.

    Raises: `FileError`, one line that says where and why.
    """
    try:
        text = content if isinstance(content, str) else content.decode("utf-8-sig")
        return yaml.load(text, _PlainLoader)  # noqa: S506  a SafeLoader
    except UnicodeDecodeError as error:
        raise FileError("is no valid YAML: it is no text in UTF-8", file=file, fix=fix) from error
    except (yaml.YAMLError, ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        mark = getattr(error, "problem_mark", None)
        where = f" in line {mark.line + 1}" if mark is not None else ""
        why = getattr(error, "problem", None) or getattr(error, "reason", None) or "a value can't be read"
        problem = f"is no valid YAML{where}: {printable(str(why))[:120]}"
        raise FileError(problem, file=file, fix=fix) from error


class _PlainLoader(yaml.SafeLoader):
    """Counts nodes and depth while they come, so that nothing large is built first."""

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self._nodes = 0
        self._depth = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        event = self.peek_event()  # type: ignore[no-untyped-call]
        if getattr(event, "anchor", None) is not None:  # an alias's too
            raise _refused("anchors and aliases (& and *) aren't read; put such words in quotes", event)
        if getattr(event, "tag", None) is not None:
            raise _refused("tags (!) aren't read; put such words in quotes", event)
        self._nodes += 1
        if self._nodes > MOST_YAML_NODES:
            raise _refused(f"more than {MOST_YAML_NODES} keys and values", event)
        if self._depth > MOST_DEPTH:
            raise _refused(f"more than {MOST_DEPTH} levels", event)
        self._depth += 1
        try:
            return super().compose_node(parent, index)
        finally:
            self._depth -= 1

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        found = set()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode):
                raise _refused("a key is a list or a mapping", key)
            if key.tag == "tag:yaml.org,2002:merge":
                raise _refused("merge keys (<<) aren't read", key)
            name = self.construct_object(key)
            if name in found:
                raise _refused(f"'{shown(key.value)[1:-1]}' is given twice", key)
            found.add(name)
        return super().construct_mapping(node, deep)

    def construct_object(self, node: yaml.Node, deep: bool = False) -> Any:
        try:
            if node.tag == "tag:yaml.org,2002:int" and len(node.value) > _MOST_DIGITS:
                raise _refused("too large a number", node)
            return super().construct_object(node, deep)
        except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
            raise _refused(f"{shown(node.value)} can't be read", node) from error


def _refused(problem: str, at: Any) -> yaml.MarkedYAMLError:
    return yaml.MarkedYAMLError(problem=problem, problem_mark=at.start_mark)


def plain_json(content: bytes, file: str | Path | None, fix: str) -> Any:
    """JSON as the standard has it: no NaN, no key given twice.

    Raises: `FileError`, one line that says why.
    """
    try:
        if any(content.count(mark) > most for mark, most in _MOST_JSON.items()):
            raise ValueError("too many values")
        return json.loads(
            content.decode("utf-8-sig"),
            parse_int=_whole,
            parse_constant=_no_number,
            object_pairs_hook=_mapping,
        )
    except UnicodeDecodeError as error:
        raise FileError("is no valid JSON: it is no text in UTF-8", file=file, fix=fix) from error
    except (ValueError, RecursionError) as error:
        why = "too many levels" if isinstance(error, RecursionError) else printable(str(error))[:120]
        raise FileError(f"is no valid JSON: {why}", file=file, fix=fix) from error


def _whole(text: str) -> int:
    if len(text) > _MOST_DIGITS:
        raise ValueError("too large a number")
    return int(text)


def _no_number(text: str) -> float:
    raise ValueError(f"{text} is no number of JSON")


def _mapping(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    mapping = dict(pairs)
    if len(mapping) < len(pairs):
        twice = Counter(key for key, _ in pairs).most_common(1)[0][0]
        raise ValueError(f"{shown(twice)} is given twice")
    return mapping
