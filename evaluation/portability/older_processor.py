"""Run Python as on an older processor: ``older_processor.py sandybridge|haswell ARGUMENTS...``.

``older_processor.py haswell -m pytest tests/golden`` runs the golden results. PoCL, NumPy, OpenBLAS, OpenCV
and the C library then use only instructions of that processor: haswell has AVX2 and FMA but not AVX-512,
sandybridge has AVX only. The last bits of floats are therefore as on such a processor.
"""

from __future__ import annotations

import os
import sys

from numpy._core._multiarray_umath import (  # type: ignore[import-not-found]
    __cpu_dispatch__,
    __cpu_features__,
)

# OpenCV and the C library are given what the processor lacks.
PROCESSORS = {
    "sandybridge": {
        "MIRRORSKIN_PROCESSOR": "sandybridge",
        "OPENBLAS_CORETYPE": "Sandybridge",
        "OPENCV_CPU_DISABLE": "FP16,AVX2,AVX512-SKX",
        "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2,-FMA",
    },
    "haswell": {
        "MIRRORSKIN_PROCESSOR": "haswell",
        "OPENBLAS_CORETYPE": "Haswell",
        "OPENCV_CPU_DISABLE": "AVX512-SKX",
    },
}
NUMPY = {"sandybridge": {"SSSE3", "SSE41", "POPCNT", "SSE42", "AVX"}}
NUMPY["haswell"] = NUMPY["sandybridge"] | {"F16C", "FMA3", "AVX2", "X86_V3"}


def environment_of(processor: str) -> dict[str, str]:
    """Return the environment variables that limit all libraries to the instructions of a processor."""
    lacking = [name for name in __cpu_dispatch__ if __cpu_features__[name] and name not in NUMPY[processor]]
    disabled = os.environ.get("NPY_DISABLE_CPU_FEATURES", "")
    return {**PROCESSORS[processor], "NPY_DISABLE_CPU_FEATURES": " ".join([disabled, *lacking])}


if __name__ == "__main__":
    os.environ.update(environment_of(sys.argv[1]))
    os.execv(sys.executable, [sys.executable, *sys.argv[2:]])
