"""Clones the repository into an empty folder, and times `make setup` and `make demo` there.

    python -m tools.check.fresh_clone [--out DIR]

The clone has the last commit, so changes that are not committed are not in it. It is deleted at the end.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

from tools.bench.result_rows import RowKind, add_options, write_rows
from tools.docs.results_page import GIS

ROOT = Path(__file__).parents[2]
ROWS = {
    "times": RowKind(
        GIS,
        "a fresh clone: `make setup`, `make demo`",
        "",
        "{setup_s:.0f} s, {demo_s:.0f} s",
    ),
    "size": RowKind(
        GIS,
        "a fresh clone: size of `.venv` after `make setup`",
        "",
        "{size_mb:.0f} MB",
    ),
}


def made(clone: Path, target: str) -> float:
    """Seconds that a target of the clone takes; ends the check if it fails."""
    names = ("VIRTUAL_ENV", "PYTHONPATH", "PYTHONHOME", "MAKEFLAGS", "MAKELEVEL", "MFLAGS")
    own = {name: value for name, value in os.environ.items() if name not in names}
    begun = time.monotonic()
    if code := subprocess.run(["make", target], cwd=clone, env=own, check=False).returncode:
        sys.exit(f"fresh-clone: make {target} ends with {code}")
    return time.monotonic() - begun


def size_mb(folder: Path) -> float:
    """Of all files below a folder, symbolic links not followed."""
    return sum(path.lstat().st_size for path in folder.rglob("*")) / 1e6


def main() -> None:
    """Clones, times, writes the rows."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("out/fresh-clone"))
    add_options(parser)
    args = parser.parse_args()
    shutil.rmtree(args.out, ignore_errors=True)
    try:
        subprocess.run(["git", "clone", "-q", ROOT, args.out], check=True)
        setup_s = made(args.out, "setup")
        size, demo_s = size_mb(args.out / ".venv"), made(args.out, "demo")
    finally:
        shutil.rmtree(args.out, ignore_errors=True)
    print(f"setup {setup_s:.0f} s, demo {demo_s:.0f} s, .venv {size:.0f} MB")
    times = ROWS["times"].row(None, setup_s=setup_s, demo_s=demo_s)
    write_rows(args, [times, ROWS["size"].row(None, size_mb=size)])


if __name__ == "__main__":
    main()
