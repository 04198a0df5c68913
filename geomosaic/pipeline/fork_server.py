"""Imported first by the process that workers are forked from.

All that process does is import: nothing of it is rubbish. Nor need workers look through what they have from
it, which would take time and copy the memory that they share.
"""

from __future__ import annotations

import gc
import os

gc.disable()
os.register_at_fork(before=gc.freeze, after_in_child=gc.enable)
