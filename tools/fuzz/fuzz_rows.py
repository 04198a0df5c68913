"""The rows of results that the fuzzer writes."""

from __future__ import annotations

from tools.bench.result_rows import ResultRow, RowKind
from tools.docs.results_page import SAFE

ROWS = {
    "all": RowKind(
        SAFE,
        "damaged files of every kind: failures",
        "none",
        "{failed:,} of {cases:,}",
    ),
    "recording": RowKind(
        SAFE,
        "damaged recordings through `inspect`, `diff`, `view`, `replay`: failures",
        "none",
        "{failed:,} of {cases:,}",
    ),
}


def result_row(only: str | None, failed: int, cases: int) -> ResultRow | None:
    """The row of all kinds, or of recordings alone; None for another kind alone."""
    kind = ROWS.get(only or "all")
    return kind.row(not failed, failed=failed, cases=cases) if kind else None
