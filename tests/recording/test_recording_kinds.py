"""The table of message kinds: one entry each, and the docs list them all."""

from __future__ import annotations

from pathlib import Path

from geomosaic.recording.file.kinds import CALLS, KINDS, kind_of
from geomosaic.recording.file.levels import LEVELS

_DOCS = (Path(__file__).parents[2] / "docs" / "recording.md").read_text()


def test_every_kind_is_in_the_docs_under_its_schema_and_topics() -> None:
    for schema, kind in KINDS.items():
        assert f"`{schema}`" in _DOCS, schema
        assert kind.level in LEVELS[1:], schema
        for topic in kind.topics.split(", "):
            assert f"`{topic.partition('NAME')[0].partition('WHAT')[0]}" in _DOCS, topic


def test_a_call_is_of_one_kind() -> None:
    calls = [call.__name__ for kind in KINDS.values() for call in kind.calls]
    assert len(calls) == len(set(calls)) == len(CALLS)
    assert kind_of("chip") is KINDS["geomosaic.ChipTies"] is kind_of("geomosaic.ChipTies")
    assert kind_of("nothing") is None
