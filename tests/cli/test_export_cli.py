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


def test_an_export_goes_with_the_run_that_it_is_of(plugged: Desk) -> None:  # noqa: F811
    """It stays where the same run is made again, also without its cache."""
    export, mine = plugged.folder / "run" / "export.txt", plugged.folder / "run" / "mine.txt"
    run = ("run", "toy.yaml", "-o", "run", "--workers", "1")
    assert plugged.ask(*run)[0] == 0
    mine.write_text("not geomosaic's")
    assert plugged.ask("export", "toy", "run")[0] == 0 and export.read_text() == "30.00 3"
    assert plugged.ask(*run)[0] == 0 and export.read_text() == "30.00 3"
    shutil.rmtree(plugged.folder / "run" / "work")
    assert plugged.ask(*run)[0] == 0 and export.read_text() == "30.00 3"
    assert plugged.ask(*run, "--set", "toy.power.power=3")[0] == 0
    assert not export.exists() and mine.read_text() == "not geomosaic's"
    assert plugged.ask("export", "toy", "run")[0] == 0 and export.read_text() == "100.00 3"
    (plugged.folder / "numbers.txt").write_text("1\n2\n")
    assert plugged.ask(*run, "--set", "toy.power.power=3")[0] == 0
    assert not export.exists() and mine.exists()


def test_an_export_goes_where_the_run_between_has_failed(plugged: Desk) -> None:  # noqa: F811
    run = ("run", "toy.yaml", "-o", "run", "--workers", "1")
    assert plugged.ask(*run)[0] == 0
    assert plugged.ask("export", "toy", "run")[0] == 0
    numbers = (plugged.folder / "numbers.txt").read_text()
    (plugged.folder / "numbers.txt").write_text("13\n")
    assert plugged.ask(*run)[0] != 0
    (plugged.folder / "numbers.txt").write_text(numbers)
    assert plugged.ask(*run)[0] == 0
    assert not (plugged.folder / "run" / "export.txt").exists()
