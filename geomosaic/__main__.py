"""`python -m geomosaic`: the command of the same name."""

from __future__ import annotations

import sys

from geomosaic.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
