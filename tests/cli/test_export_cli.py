"""`geomosaic export`: what its help lists of a run, and what it prints the first and the second time."""

from __future__ import annotations

import shutil

from test_cli_commands import Desk, desk, plugged  # noqa: F401


def commands(text: str) -> list[str]:
    """Commands come before options in the help."""
    listed = text.partition("Commands:")[2].partition("Options:")[0]
    return [line.split()[0] for line in listed.splitlines() if line.strip()]


def test_a_runs_own_exports_are_listed(plugged: Desk) -> None:  # noqa: F811
    code, out, _ = plugged.ask("export", "--help")
    assert code == 0
    assert {"toy", "colmap", "tiles", "offsets"} <= set(commands(out))
    assert "Write the strips' offsets (of strips)" in out
    assert "Write the block for COLMAP (of frames)" in out
    assert plugged.ask("run", "toy.yaml", "-o", "run", "--workers", "1")[0] == 0
    for asked in (["run"], ["run", "--help"]):
        code, out, _ = plugged.ask("export", *asked)
        assert (code, commands(out)) == (0, ["toy"])
    (plugged.folder / "other").mkdir()
    code, _, err = plugged.ask("export", "other")
    assert code == 2 and "other: is no finished run" in err


def test_the_first_and_the_repeated_call_print_the_same(plugged: Desk) -> None:  # noqa: F811
    assert plugged.ask("run", "toy.yaml", "-o", "run", "--workers", "1")[0] == 0
    first = plugged.ask("export", "toy", "run")[1]
    assert first == plugged.ask("export", "toy", "run")[1] == "run/export.txt\n"
    shutil.rmtree(plugged.folder / "run" / "work")
    assert plugged.ask("export", "toy", "run")[1] == first
