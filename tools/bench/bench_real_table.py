"""The table that bench_real prints."""

from __future__ import annotations

from collections.abc import Iterable

Row = tuple[str, str, str, bool]
"""What was measured, what came out, what is wanted (may be empty), and whether it is met."""


def print_table(rows: Iterable[Row]) -> None:
    """A Markdown table for docs/results.md."""
    print("| what | found | wanted | |\n|---|---|---|---|")
    for what, found, wanted, good in rows:
        print(f"| {what} | {found} | {wanted} | {('ok' if good else 'MISSED') if wanted else ''} |")
