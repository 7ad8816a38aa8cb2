"""Accuracy: devices meet their bounds, and answers that are spoilt do not."""

from types import SimpleNamespace

import numpy as np
import pytest

from mirrorskin.bench import accuracy
from mirrorskin.bench.accuracy import CASES, aims, press, rotation, surfaces, twin
from mirrorskin.kernels.device import open_device


@pytest.mark.parametrize("name", CASES)
def test_a_device_meets_every_bound(name):
    case = CASES[name](open_device(), True)
    assert case.name == name
    assert not case.rows
    assert len(case.targets) >= 3
    assert [target for target in case.targets if not target.met] == []


def missed(name):
    return [target.what for target in CASES[name](open_device(), True).targets if not target.met]


def spoil(monkeypatch, module, name, change):
    """Have a function's answer changed in place before it is looked at."""
    right = getattr(module, name)

    def wrong(*given, **options):
        found = right(*given, **options)
        change(found)
        return found

    monkeypatch.setattr(module, name, wrong)


def test_onsets_a_frame_late_are_noticed(monkeypatch):
    spoil(monkeypatch, press, "find_onset", lambda found: np.add(found.frame, 1, out=found.frame))
    assert {f"{kind}, sudden: onsets in another frame" for kind in ("uint8", "float32")} <= set(
        missed("accuracy-press")
    )


def test_a_sigma_that_promises_too_much_is_noticed(monkeypatch):
    spoil(
        monkeypatch,
        rotation,
        "estimate_normals",
        lambda found: np.multiply(found.sigma, 0.9, out=found.sigma),
    )
    told = missed("accuracy-normals")
    assert len(told) == 27
    assert all(what.endswith("chi-square") for what in told)


def test_normals_that_lean_are_noticed(monkeypatch):
    def lean(found):
        found.vectors[..., 0] += 0.005

    spoil(monkeypatch, rotation, "estimate_normals", lean)
    assert any("RMS error of the bound's" in what for what in missed("accuracy-normals"))


def test_waves_that_lose_a_digit_are_noticed(monkeypatch):
    spoil(monkeypatch, rotation, "correlate", lambda found: np.multiply(found.mean, 1 + 1e-6, out=found.mean))
    assert any("a stack: mean" in what for what in missed("accuracy-correlation"))


def test_edges_beside_the_ridge_are_noticed(monkeypatch):
    def scatter(drawn):
        drawn[20:40, 10] = 1

    spoil(monkeypatch, rotation, "find_edges", scatter)
    assert missed("accuracy-edges") == ["pixels elsewhere with an edge"]


def test_heights_that_are_too_steep_are_noticed(monkeypatch):
    spoil(
        monkeypatch, surfaces, "integrate", lambda found: np.multiply(found.height, 1.001, out=found.height)
    )
    assert any(what.startswith("plane, whole picture") for what in missed("accuracy-surfaces"))


def test_a_fused_surface_with_an_offset_is_noticed(monkeypatch):
    x = 0.05 * 201 / 101 * (np.arange(101) - 50)
    ball = np.sqrt(np.maximum(25 - x**2 - x[:, np.newaxis] ** 2, 0)) - 5
    for offset, expected in ((0.0, 0), (0.004, 2)):
        surface = SimpleNamespace(height=ball + offset)
        monkeypatch.setattr(surfaces, "fuse", lambda *given, told=surface, **options: told)
        assert len(missed("accuracy-fusion")) == expected


def test_a_camera_with_more_noise_is_noticed(monkeypatch):
    monkeypatch.setattr(twin, "_NOISE", 2.0)
    right = twin._moments
    monkeypatch.setattr(
        twin, "_moments", lambda where, clean, noisy: right(where, clean, clean + 1.1 * (noisy - clean))
    )
    assert any(what.endswith("variance of the expected one") for what in missed("accuracy-twin"))


def test_a_number_that_is_none_reaches_nothing():
    assert not aims.at_most("any", np.nan, 1.0).met
    assert not aims.within("any", np.nan, 0.0, 1.0).met
    assert aims.at_most("any", 1.0, 1.0).met
    assert aims.within("any", 0.5, 0.5, 1.0).met
    assert not aims.within("any", 1.1, 0.5, 1.0).met
    assert accuracy.InaccurateError.exit_code == 1
