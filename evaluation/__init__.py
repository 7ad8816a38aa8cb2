"""How far answers are from a known truth, and where they hold.

What goes where: a test passes or fails, and is in ``tests/`` with the helpers of tests. A measured time is in
``bench/``. An error, a standard deviation compared with errors, and a run on another OpenCL implementation or
GPU are here, with the scenes and sources that tests, evaluation and benchmarks share. The product imports
neither package; ``bench`` and ``tests`` import this one; only ``tests/bench`` imports ``bench``.
``make accuracy`` writes the numbers into docs/accuracy.md.
"""
