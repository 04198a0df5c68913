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


def figure(code: str, *words: str, **said: str) -> int:
    """What a program prints: of `FAULTS`, pages that the system gave while arrays were made for the third time."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith("MALLOC_")} | said
    command = [sys.executable, "-c", code, *words]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    return int(done.stdout)


def test_arrays_take_memory_again() -> None:
    assert figure(FAULTS) > 10_000
    assert figure(PARENT + FAULTS) < 1_000
    assert figure(PARENT + CHILD, FAULTS) < 1_000


def test_what_the_environment_says_stays() -> None:
    said = {"MALLOC_TRIM_THRESHOLD_": "131072", "MALLOC_MMAP_THRESHOLD_": "131072"}
    assert figure(PARENT + FAULTS, **said) > 10_000


def test_memory_of_a_process_is_without_that_of_its_parent() -> None:
    asks = "from geomosaic.pipeline.executor import peak_memory_bytes; print(peak_memory_bytes())"
    starts = (
        "import subprocess, sys; import numpy as np; kept = np.ones(1 << 26)\n"
        f"print(subprocess.run([sys.executable, '-c', {asks!r}], preexec_fn=int, capture_output=True).stdout.decode())"
    )
    assert 10e6 < figure(starts) < 250e6
