"""``older_processor.py`` limits the instructions of all libraries."""

import subprocess
import sys

import pytest

from mirrorskin.evaluation.portability import older_processor
from mirrorskin.kernels import embedded

# Prints the processor for which PoCL compiles, and which of its instructions NumPy uses.
LIMITED = """
from numpy._core._multiarray_umath import __cpu_dispatch__, __cpu_features__
from mirrorskin.kernels import embedded
embedded.prepare()
print(embedded.compiler()[0], *(name for name in __cpu_dispatch__ if __cpu_features__[name]))
"""


@pytest.mark.parametrize("processor", older_processor.PROCESSORS)
def test_only_instructions_of_the_older_processor_are_used(processor):
    if embedded.find_library() is None:
        pytest.skip("there is no wheel of PoCL")
    command = [sys.executable, older_processor.__file__, processor, "-W", "error", "-c", LIMITED]
    limited, *features = subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()
    assert limited == processor
    assert set(features) <= older_processor.NUMPY[processor]
