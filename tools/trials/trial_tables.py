"""The tables of the standing trials: one JSON for programs, one Markdown for people."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any


def write_tables(
    path: Path,
    title: str,
    facts: Mapping[str, Any],
    rows: Sequence[Mapping[str, Any]],
    listed: Sequence[str],
    details: Sequence[Any],
) -> None:
    """PATH.json and PATH.md: facts, a table, and the failures in a list."""
    whole = {"title": title, **facts, "table": list(rows), "failures": list(listed), "details": list(details)}
    path.with_suffix(".json").write_text(json.dumps(whole, indent=1, ensure_ascii=True, default=str) + "\n")
    lines = [f"# {title}", "", ", ".join(f"{name} {value}" for name, value in facts.items()), ""]
    if rows:
        names = [n for n in rows[0] if isinstance(rows[0][n], str) or any(row[n] for row in rows)]
        lines += ["| " + " | ".join(names) + " |", "|" + "---|" * len(names)]
        lines += ["| " + " | ".join(str(row[n]) for n in names) + " |" for row in rows]
        unseen = [n for n in rows[0] if n not in names]
        lines += ["", f"None: {', '.join(unseen)}."] if unseen else []
    lines += ["", "## Failures", ""] if listed else []
    lines += [f"- {line}" for line in listed]
    text = "\n".join(lines) + "\n"
    path.with_suffix(".md").write_text(text, errors="backslashreplace")
    print(text.encode(errors="backslashreplace").decode())
