"""Freed memory is used again, instead of new memory from the system."""

import platform
import subprocess
import sys

import pytest

COUNT = """
import resource, sys
import numpy as np
from mirrorskin.engine.batch.work import keep_memory
if sys.argv[1] == "kept":
    keep_memory()
np.ones(1 << 22, np.uint8)
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(20):
    np.ones(1 << 22, np.uint8)
print((resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before) // 20)
"""


def pages(how):
    run = subprocess.run([sys.executable, "-c", COUNT, how], capture_output=True, text=True, check=True)
    return int(run.stdout)


@pytest.mark.slow
@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only the GNU C library is told so")
def test_memory_is_kept_for_the_next_file():
    assert pages("kept") < 10
    assert pages("as it is") >= 2  # huge pages are as large as two of them
