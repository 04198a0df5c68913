"""What every test stands on, before numpy is imported."""

import os
import signal

# threads of the linear algebra would wait for each other on the cores that the tests share
for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(name, "1")

# a script's background job ignores Ctrl-C, and so would all its children
signal.signal(signal.SIGINT, signal.default_int_handler)
