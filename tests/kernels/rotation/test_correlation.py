"""Correlation: the reference, compared with exact numbers."""

from fractions import Fraction

import numpy as np

from mirrorskin.kernels.rotation import correlation


def test_the_reference_is_least_squares_in_fractions() -> None:
    phases = [(1, 0), (0, 1), (-1, 0), (0, -1)]
    counts = [[10, 200], [17, 3], [12, 250], [200, 0]]
    rows = np.array([[1, c, s] for c, s in phases], np.int32)
    sums = np.zeros((4, 2), np.int64)
    correlation.correlation_add(np.array(counts, np.uint8), np.arange(4, dtype=np.int32), rows, 0, *sums)
    upper = np.diag([2, np.sqrt(2), np.sqrt(2)])
    project = np.linalg.inv(upper).ravel()
    high = project.astype(np.float32)
    fit = np.concatenate([high, project - high, np.linalg.inv(upper).ravel(), [1]]).astype(np.float32)
    answers = correlation.correlation_solve_counts(4, 0, 0, *sums, fit)
    for pixel in range(2):
        column = [Fraction(row[pixel]) for row in counts]
        mean = sum(column) / 4
        cosine, sine = (column[0] - column[2]) / 2, (column[1] - column[3]) / 2
        cost = sum((e - mean - c * cosine - s * sine) ** 2 for e, (c, s) in zip(column, phases, strict=True))
        expected = [float(mean), float(cosine), float(sine), float(cost) ** 0.5]
        np.testing.assert_allclose([answer[pixel] for answer in answers], expected, rtol=1e-6)
