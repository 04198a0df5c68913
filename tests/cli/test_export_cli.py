"""`geomosaic export`: what its help lists of a run, and what it prints the first and the second time."""

from __future__ import annotations

import shutil

from test_cli_commands import Desk, desk, plugged  # noqa: F401


def commands(text: str) -> list[str]:
    """Commands come before options in the help."""
    listed = text.partition("Commands:")[2].partition("Options:")[0]
    return [line.split()[0] for line in listed.splitlines() if line.strip()]


def test_a_runs_own_exports_are_listed(plugged: Desk) -> None:  # noqa: F811
    code, out, _ = plugged.run("export", "--help")
    assert code == 0
    assert {"toy", "colmap", "tiles", "offsets"} <= set(commands(out))
    assert "Write the strips' offsets (of strips)" in out
    assert "Write the block for COLMAP (of frames)" in out
    assert plugged.run("run", "toy.yaml", "-o", "run")[0] == 0
    for asked in (["run"], ["run", "--help"]):
        code, out, _ = plugged.run("export", *asked)
        assert (code, commands(out)) == (0, ["toy"])
    (plugged.folder / "other").mkdir()
    code, _, err = plugged.run("export", "other")
    assert code == 2 and "other: is no finished run" in err


def test_the_first_and_the_repeated_call_print_the_same(plugged: Desk) -> None:  # noqa: F811
    assert plugged.run("run", "toy.yaml", "-o", "run")[0] == 0
    first = plugged.run("export", "toy", "run")[1]
    assert first == plugged.run("export", "toy", "run")[1] == "run/export.txt\n"
    shutil.rmtree(plugged.folder / "run" / "work")
    assert plugged.run("export", "toy", "run")[1] == first
