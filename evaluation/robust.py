"""Errors of robust integration on surfaces that hide parts of themselves, and of a published method.

Bounds on every scene: an error no larger than with the published method, and half of it on average; at most
10 % more than with plain least squares. For held-out heaps, the median and the maximum are tested. Figures,
which include pinhole cameras and errors of normals, are compared with plain least squares only, and their
errors with the standard deviations.
"""

from __future__ import annotations

import numpy as np

from mirrorskin import engine
from mirrorskin.cli.commands.bench.records import Case
from mirrorskin.evaluation.base.tables import at_most
from mirrorskin.evaluation.bilateral import integrate_bilaterally
from mirrorskin.evaluation.scenes import depth, figures, occlusions
from mirrorskin.kernels.device import Device

PLAIN, PEER = "plain", "Cao et al."

_SHAPE, _QUICK = (256, 256), (24, 24)
_WORSE, _MEAN = 1.1, 0.5  # bounds of errors over those of plain least squares, and of the published method


def run_robust(device: Device, quick: bool) -> Case:
    """Compare the heights of scenes, held-out heaps and figures with the truth."""
    shape = _QUICK if quick else _SHAPE
    notes, targets, ratios = [], [], []
    for name, make in list(depth.SCENES.items())[:: 4 if quick else 1]:
        ours, plain, peer = _errors(make(shape), device)
        ratios.append(ours / peer)
        notes.append(f"{name}: mean absolute error {ours:.3f} mm, {PLAIN} {plain:.3f}, {PEER} {peer:.3f}")
        targets.append(at_most(f"{name}: error, mm, of {PEER}", ours, peer))
        targets.append(at_most(f"{name}: error, mm, {PLAIN} and a tenth", ours, _WORSE * plain))
    targets.append(at_most(f"mean of errors, of those of {PEER}", float(np.mean(ratios)), _MEAN))
    heaps = list(depth.HELD_OUT.values())[: 1 if quick else None]
    errors = np.array([_errors(make(shape), device) for make in heaps])  # ours, plain, the peer's
    to_plain, to_peer = errors[:, 0] / errors[:, 1], errors[:, 0] / errors[:, 2]
    for method, ratio in ((PLAIN, to_plain), (PEER, to_peer)):
        middle, worst = np.median(ratio), ratio.max()
        notes.append(f"held-out heaps, errors over those of {method}: median {middle:.2f}, worst {worst:.2f}")
    targets.append(
        at_most(f"held-out heaps: median of errors, of those of {PEER}", float(np.median(to_peer)), _MEAN)
    )
    targets.append(at_most(f"held-out heaps: worst of errors, of {PLAIN}", float(to_plain.max()), _WORSE))
    for group, makers in (("chosen on", figures.CHOSEN_ON), ("held out", figures.HELD_OUT)):
        scores = np.array([_score(make(), device) for make in list(makers.values())[: 1 if quick else None]])
        (middle, chi2), (worst, highest) = np.median(scores, axis=0), scores.max(axis=0)
        notes.append(
            f"figures {group}, errors over those of {PLAIN}: median {middle:.2f}, worst {worst:.2f}; "
            f"chi^2: median {chi2:.2f}, worst {highest:.1f}"
        )
        targets.append(at_most(f"figures {group}: worst of errors, of {PLAIN}", float(worst), _WORSE))
        targets.append(at_most(f"figures {group}: median chi^2", float(chi2), 2.0))
    for group, scenes in (("developed on", occlusions.DEVELOPED_ON), ("held out", occlusions.HELD_OUT)):
        made = [make(shape) for make in list(scenes.values())[: 1 if quick else None]]
        errors = np.array([_errors(scene, device) for scene in made])
        to_plain, to_peer = errors[:, 0] / errors[:, 1], errors[:, 0] / errors[:, 2]
        notes.append(
            f"occlusions {group}, errors over those of {PLAIN}: median {np.median(to_plain):.2f}, worst"
            f" {to_plain.max():.2f}; over those of {PEER}: median {np.median(to_peer):.2f}, worst"
            f" {to_peer.max():.2f}"
        )
        targets.append(
            at_most(f"occlusions {group}: worst of errors, of {PLAIN}", float(to_plain.max()), _WORSE)
        )
    title = f"heights of {len(ratios)} scenes with hidden parts; {' x '.join(map(str, shape))} float64"
    return Case("accuracy-robust", title, [], {}, tuple(notes), () if quick else tuple(targets))


def integrate(scene: depth.Scene, robust: bool, device: Device) -> depth.Map:
    """Return the heights of a scene."""
    height: depth.Map = engine.integrate(
        normals=scene.normals,
        mask=scene.mask,
        pixel_size=scene.pixel_size,
        robust=robust,
        sigma=False,
        device=device,
    ).height
    return height


def _errors(scene: depth.Scene, device: Device) -> tuple[float, float, float]:
    """Return the errors of robust integration, of plain least squares and of the published method, mm."""
    peer, _ = integrate_bilaterally(scene)
    return (
        scene.error(integrate(scene, True, device)),
        scene.error(integrate(scene, False, device)),
        scene.error(peer),
    )


def _score(figure: figures.Figure, device: Device) -> tuple[float, float]:
    """Return the error over that of plain least squares, and chi^2."""
    plain, ours = (
        engine.integrate(**figure.arguments(), robust=robust, device=device) for robust in (False, True)
    )
    chi2 = float(np.nanmean(figure.scores(ours) ** 2))
    return figure.error(ours.height) / figure.error(plain.height), chi2


CASES = {"accuracy-robust": run_robust}
