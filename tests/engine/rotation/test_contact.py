"""Lost contact on the twin: a ball that touches in only part of the turn, detected by brightness alone."""

from functools import cache
from typing import NamedTuple

import numpy as np
import poses
import pytest
from geometry import pixel_centres
from numpy.typing import NDArray
from stacks import read_all

from mirrorskin import engine
from mirrorskin.evaluation.scenes.rotations import EIGHTHS, TILT, UNEVEN
from mirrorskin.twin import Axial, Body, Camera, Twin

SHAPE = (111, 110)
# So high that the wall's rim is seen at zenith 0, and a mirror without flakes: light is linear from there on.
BODY = Body(height=1e5, scatter=0.0)


class Turn(NamedTuple):
    """A ball under the rotating sensor, and where it touches."""

    frames: NDArray[np.generic]
    phase: tuple[float, ...]
    header: object
    always: NDArray[np.bool_]  # in contact in every frame
    never: NDArray[np.bool_]


class Case(NamedTuple):
    press: float
    pixel: float
    pivot: tuple[float, float, float] = (0.0, 0.0, 0.0)
    phase: tuple[float, ...] = EIGHTHS
    noise: float = 1.5
    dtype: str = "uint8"


CASES = {
    "deep": Case(1.0, 0.06),
    "barely": Case(0.03, 0.013),
    "about a point aside and below": Case(0.4, 0.04, pivot=(0.6, -0.3, -0.5)),
    "uneven phases": Case(0.5, 0.045, phase=UNEVEN),
    "sixteen frames": Case(0.5, 0.045, phase=tuple(np.arange(16) * np.pi / 8)),
    "a finer camera": Case(0.5, 0.045, noise=10.0, dtype="uint16"),
}


@cache
def turn(name):
    case = CASES[name]
    twin = Twin(
        object="sphere",
        shape=SHAPE,
        pixel_size=case.pixel,
        movement=Axial(case.phase, TILT, press=case.press, pivot=case.pivot),
        pattern="linear",
        body=BODY,
        camera=Camera(dtype=case.dtype, noise=case.noise, seed=5),
    )
    x, y = pixel_centres(SHAPE, case.pixel)
    touches = np.stack(
        [
            poses.see(poses.Ball(), poses.leaning(phase, TILT, case.press, case.pivot), x, y).contact
            for phase in case.phase
        ]
    )
    frames = read_all(twin, len(case.phase)).frames
    always = touches.all(axis=0)
    np.testing.assert_array_equal(twin.truth.contact.astype(bool), always)
    return Turn(frames, case.phase, twin.header, always, ~touches.any(axis=0))


@pytest.fixture(scope="module", params=CASES)
def classified(request, device):
    """What the contact flag says: the scene, and where it is down."""
    scene = turn(request.param)
    header, case = scene.header, CASES[request.param]
    spread = float(np.hypot(case.noise, 1 / np.sqrt(12)))
    normals = engine.estimate_normals(
        scene.frames,
        scene.phase,
        tilt=TILT,
        zenith_gain=header.zenith_gain,
        zenith_offset=header.zenith_offset,
        noise=spread,
        device=device,
    )
    return scene, normals


def test_lost_contact_is_flagged_and_little_else(classified):
    scene, normals = classified
    lost = ~scene.always & ~scene.never
    assert lost.sum() > 200
    assert scene.always.sum() > 2000
    flagged = normals.contact == 0
    assert np.mean(flagged[lost]) >= 0.95
    assert np.mean(flagged[scene.always]) <= 0.01
    assert scene.never.sum() > 1000
    assert np.mean(normals.contact[scene.never] != 0) <= 0.02
