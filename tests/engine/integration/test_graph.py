"""Components are the sets of linked pixels, numbered in reading order."""

from __future__ import annotations

import numpy as np
import pytest

from mirrorskin.engine.integration.graph import find_components
from mirrorskin.kernels.integration.links import DOWN, KNOWN, LOST, RIGHT, SLOPE


def walk(flags):
    """Number the components by walking from pixel to pixel."""
    labels, count = np.full(flags.shape, -1), 0
    for first in np.ndindex(flags.shape):
        if labels[first] >= 0 or not flags[first] & (SLOPE | KNOWN):
            continue
        labels[first], members = count, [first]
        while members:
            y, x = members.pop()
            near = []
            near += [(y, x + 1)] * bool(flags[y, x] & RIGHT) + [(y + 1, x)] * bool(flags[y, x] & DOWN)
            near += [(y, x - 1)] * bool(x and flags[y, x - 1] & RIGHT)
            near += [(y - 1, x)] * bool(y and flags[y - 1, x] & DOWN)
            for place in near:
                if labels[place] < 0:
                    labels[place] = count
                    members.append(place)
        count += 1
    return labels, count


def picture(shape, seed, with_cuts):
    """Flags of random pixels; all neighbours are linked, or most."""
    random = np.random.default_rng(seed)
    answered = random.random(shape) < 0.7
    flags = np.where(answered, SLOPE, LOST * (random.random(shape) < 0.5))
    flags |= KNOWN * (answered & (random.random(shape) < 0.02))
    linked = [random.random(shape) < 0.8 if with_cuts else np.ones(shape, bool) for _ in range(2)]
    flags[:, :-1] |= RIGHT * (answered[:, :-1] & answered[:, 1:] & linked[0][:, :-1])
    flags[:-1] |= DOWN * (answered[:-1] & answered[1:] & linked[1][:-1])
    return flags.astype(np.uint8)


@pytest.mark.parametrize("shape", [(1, 1), (17, 1), (40, 61)])
@pytest.mark.parametrize("with_cuts", [False, True], ids=["whole", "cut"])
def test_components_are_what_links_hold_together(shape, with_cuts):
    for seed in range(3):
        flags = picture(shape, seed, with_cuts)
        labels, count = walk(flags)
        components = find_components(flags, with_cuts)
        np.testing.assert_array_equal(components.labels, labels)
        assert components.labels.dtype == np.int32
        anchored = {
            labels[place] for place in np.argwhere(flags & KNOWN).tolist() for place in [tuple(place)]
        }
        assert [n in anchored for n in range(count)] == (~components.offset_unknown).tolist()
        assert min(shape) == 1 or 10 < count < 400
