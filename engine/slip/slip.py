"""Displacement and slip from a slide or a twist: where the skin sticks, where and when it slips."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from mirrorskin.engine.base.errors import NotConverged
from mirrorskin.engine.base.inputs import Maps
from mirrorskin.engine.base.method import Method
from mirrorskin.engine.base.operation import Plan
from mirrorskin.engine.base.options import option
from mirrorskin.engine.base.steps import Context, Step
from mirrorskin.engine.base.summary import status_shares
from mirrorskin.engine.slip.search import SlipOnset
from mirrorskin.io import Calibrated, InputError, Result, Source
from mirrorskin.io.base.findings import Finding, with_findings
from mirrorskin.io.model.maps import SlipStatus


class Traction(Step):
    """Traction and force along the sheet, if Young's modulus is known."""

    modulus: float | None = option(
        default=None,
        unit="MPa",
        above=0,
        help="Young's modulus, for traction and the force along the sheet",
        shown_default="that of the calibration",
    )
    window_size: int = SlipOnset.window_size

    def apply(self, result: Result, context: Context) -> Result:
        """Return the result with traction and force; if they cannot be computed, the process says why."""
        source, modulus, modulus_sigma, origin = context.source, self.modulus, 0.0, "given"
        if modulus is None:
            stiffness = source.calibration.stiffness if isinstance(source, Calibrated) else None
            if stiffness is None:
                return result
            modulus, modulus_sigma = stiffness.modulus, math.sqrt(stiffness.covariance[0, 0])
            origin = "of the calibration"
        from mirrorskin.engine.force.tangential import find_tangential_force

        try:
            force = find_tangential_force(
                result,
                source.header.pixel_size,
                modulus,
                window_size=self.window_size,
                modulus_sigma=modulus_sigma,
            )
        except (InputError, NotConverged) as error:
            return result.assign(process={**result.process, "force": f"none: {error}"})
        process = {**result.process, "modulus": f"{modulus:.4g} MPa, {origin}"}
        return result.assign(force, process=process)


class NoContact(Step):
    """Add the reason to the warnings of a result without any pixel that sticks or slips."""

    def apply(self, result: Result, context: Context) -> Result:
        """Return the result; its process says why nothing is known about slip."""
        if np.isin(result.status, (SlipStatus.SLIPPED, SlipStatus.STICKS)).any():
            return result
        text = (
            f"slip is known at no pixel ({status_shares(result)}): the skin must follow the object by its"
            " texture while they are pressed together"
        )
        return with_findings(result, Finding("no contact", text))


class Slide(Method):
    """Displacement of the skin and slip in a slide or a twist; with Young's modulus also the force.

    ``traction``, ``force_x`` and ``force_y`` assume that there is no load along the sheet in the first frame.
    ``process`` contains ``angle``, ``centre_x`` and ``centre_y`` of a twist; see `SlipOnset`.

    `run` returns ``displacement``, ``slip_onset``, ``status``, and for each frame ``slide_distance`` or
    ``twist_angle`` and ``stick_ratio``; with Young's modulus also ``traction``, ``force_x`` and ``force_y``.

    Examples
    --------
    `mirrorskin.engine.reconstruct` uses this class for frames with a displacement:

    >>> import cv2
    >>> import numpy as np
    >>> from mirrorskin import engine
    >>> texture = np.random.default_rng(1).normal(100, 20, (60, 80))
    >>> texture = cv2.GaussianBlur(texture, (0, 0), 1.5).astype(np.float32)
    >>> frames = np.stack([np.roll(texture, -k, axis=1) for k in range(4)])  # the skin sticks to the object
    >>> path = np.outer(range(4), [0.1, 0.0])  # the body moves to the right by one pixel per frame
    >>> options = {"contact": np.ones((60, 80)), "noise": 0.1}
    >>> result = engine.reconstruct(frames, displacement=path, pixel_size=0.1, **options)
    >>> [round(float(part), 3) for part in result.displacement[30, 40]]
    [-0.3, 0.0]
    """

    motions = ("horizontal", "twist")

    contact: Maps | None = SlipOnset.contact
    per_frame: bool = SlipOnset.per_frame
    window_size: int = SlipOnset.window_size
    window_step: int = SlipOnset.window_step
    noise: float | None = SlipOnset.noise
    motion: Literal["horizontal", "twist"] = SlipOnset.motion
    pixel_size: ArrayLike | None = SlipOnset.pixel_size
    centre: tuple[float, float] = SlipOnset.centre
    modulus: float | None = Traction.modulus

    def plan(self, source: Source) -> Plan:
        """Return the search for slip, with the source's motion and pixel size, and the step for the force."""
        slip: SlipOnset = self.configure(SlipOnset).configured_for(source)
        process = {"window_size": slip.window_size, "window_step": slip.window_step}
        return Plan(slip, [self.configure(NoContact), self.configure(Traction)], process)
