"""Arrays take memory again that others gave back, in a process and in those that it starts."""

import os
import subprocess
import sys

import pytest

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="another C library than glibc")

FAULTS = """
import resource
import numpy as np
def some():
    return [np.ones(3 << 17) for _ in range(24)]  # 3 MB each
some(), some()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
some()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""
PARENT = "from geomosaic.cli.memory import keep_freed_memory; keep_freed_memory()\n"
CHILD = "import subprocess, sys; subprocess.run([sys.executable, '-c', sys.argv[1]], check=True)"


def faults(code: str, *words: str, **said: str) -> int:
    """Pages that the system gave while arrays were made for the third time."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith("MALLOC_")} | said
    command = [sys.executable, "-c", code, *words]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    return int(done.stdout)


def test_arrays_take_memory_again() -> None:
    assert faults(FAULTS) > 10_000
    assert faults(PARENT + FAULTS) < 1_000
    assert faults(PARENT + CHILD, FAULTS) < 1_000


def test_what_the_environment_says_stays() -> None:
    said = {"MALLOC_TRIM_THRESHOLD_": "131072", "MALLOC_MMAP_THRESHOLD_": "131072"}
    assert faults(PARENT + FAULTS, **said) > 10_000
