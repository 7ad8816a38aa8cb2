"""Heights from a press or its release: onsets, corrected for the elastomer, with holes filled."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.base.errors import NotConverged
from mirrorskin.engine.base.method import Method
from mirrorskin.engine.base.operation import Plan
from mirrorskin.engine.base.options import option
from mirrorskin.engine.base.provenance import estimated_level, level_origin
from mirrorskin.engine.base.steps import Context, Step
from mirrorskin.engine.diagnosis.brightness_levels import frames_of
from mirrorskin.engine.press.changepoint import ChangePoint
from mirrorskin.engine.press.crossing import Event, PressOperation
from mirrorskin.engine.press.levels import Levels
from mirrorskin.engine.press.onset import Onset
from mirrorskin.engine.press.strokes import Strokes
from mirrorskin.io import Calibrated, InputError, Result
from mirrorskin.io.model.maps import PressStatus
from mirrorskin.io.model.positions import stroke_starts

if TYPE_CHECKING:
    from mirrorskin.engine.press.elastic import PressFit
    from mirrorskin.io import Calibration, Source
    from mirrorskin.io.base.types import ProcessValue

PressMethod = Literal["threshold", "change-point"]

_OMIT = ("frame",)  # redundant: it follows from height and travel


class Elastomer(Step):
    """Correct heights for the elastomer, and find pressure and force, if the calibration describes it."""

    threshold: float = Onset.threshold
    modulus: float | None = option(
        default=None,
        unit="MPa",
        above=0,
        help="Young's modulus, for pressure and force; forces also need the calibration's gel",
        shown_default="that of the calibration",
    )

    def apply(self, result: Result, context: Context) -> Result:
        """Return corrected heights; pressure and force if there is a modulus."""
        source = context.source
        if not isinstance(source, Calibrated):
            if self.modulus is not None:
                raise InputError(
                    f"{source.name}: a force takes a calibration with a gel: calibrate elastic first"
                )
            return result
        from mirrorskin.engine.press.elastic import correct_press  # splines, a tenth of a second to load

        deepest, gel = float(np.max(context.positions("travel"))), source.calibration.gel
        result, summary, fit = correct_press(result, source, deepest, self.threshold, gel)
        result = result.assign(process={**result.process, "gel": summary})
        return self._with_force(result, fit, source.calibration)

    def _with_force(self, result: Result, fit: PressFit | None, calibration: Calibration) -> Result:
        """Add pressure and force, if there is a modulus."""
        from mirrorskin.engine.force.normal import check_modulus, force_of_press

        calibrated = calibration.stiffness
        stiffness = calibrated if self.modulus is None else check_modulus(self.modulus)
        if stiffness is None:
            return result
        missing = ""
        if fit is None:
            missing = "the heights are not corrected for the gel"
        elif not isinstance(stiffness, float) and stiffness.gel_threshold != fit.scene.gel.threshold:
            missing = "the modulus was learned with another gel: calibrate force again"
        else:
            try:
                force = force_of_press(fit, stiffness)
            except NotConverged as error:
                missing = str(error)
        if missing:
            return result.assign(process={**result.process, "force": f"none: {missing}"})
        if isinstance(stiffness, float):
            origin = f"{stiffness:g} MPa, given"
        else:
            origin = f"{stiffness.modulus:.4g} MPa of the calibration"
        return result.assign(
            pressure=force.pressure,
            force=force.force,
            force_sigma=force.force_sigma,
            process={**result.process, "modulus": origin},
        )


class HoleFilling(Step):
    """Fill holes, such as flat tops, which never turn light; see `mirrorskin.engine.fill_holes`."""

    fill: bool = option(
        default=True,
        help="fill holes, such as flat tops, which never turn light, if the pixel size is known; they are"
        " marked in `filled`, and have no standard deviation",
    )
    event: Event = Onset.event

    def apply(self, result: Result, context: Context) -> Result:
        """Return heights without holes, and which pixels were filled."""
        pixel_size = context.source.header.pixel_size
        if not self.fill or pixel_size is None:
            reason = "not asked" if not self.fill else "the recording has no pixel size"
            return result.assign(process={**result.process, "fill": f"none: {reason}"})
        from mirrorskin.engine.press.holes import fill_holes

        travel = context.positions("travel")
        above = None
        if self.event == "onset":  # pixels that are light at the start were touched before
            touched = result.status == PressStatus.LIGHT_AT_START
            above = np.where(touched, np.float32(-travel[0]), np.float32(np.nan))
        height, filled = fill_holes(
            result.height, result.height_sigma, pixel_size, above=above, deepest=-float(np.max(travel))
        )
        return result.assign(height=height, filled=filled, process={**result.process, "fill": "holes"})


class Press(Method):
    """Heights of a press or a release; of a press that oscillates also the hysteresis.

    If travel turns more than once, from a press to its release, all strokes are used; see
    `mirrorskin.engine.press.strokes.Strokes`. Levels of dark and light that neither the options nor the
    source specify are estimated from the frames, and their uncertainty is added to ``height_sigma``; if that
    is impossible, the range of the frames' type is used. ``process`` contains the origin of each level.

    `run` returns ``height``, ``height_sigma`` and ``status``; ``filled`` if holes are filled; of a press that
    oscillates also ``hysteresis`` and ``strokes``; with a calibrated elastomer and its modulus also
    ``pressure``, ``force`` and ``force_sigma``.

    Examples
    --------
    >>> from mirrorskin import engine
    >>> from mirrorskin.twin import Twin, Vertical
    >>> travel = 0.1 * np.arange(12)
    >>> press = Twin(
    ...     object="sphere", shape=(40, 40), pixel_size=0.26, movement=Vertical(travel)
    ... )
    >>> result = engine.Press(fill=False).run(press)
    >>> bool(np.nanmax(np.abs(result.height - press.truth.height)) < 0.05)  # half of a step of the travel
    True
    >>> result.process["threshold"]
    0.5
    """

    motions = ("vertical",)

    method: PressMethod = option(
        default="threshold",
        help="first crossing of the threshold, or most likely change",
    )
    threshold: float = Onset.threshold
    dark_sigma: float = Onset.dark_sigma
    bright_sigma: float = Onset.bright_sigma
    event: Event = Onset.event
    subframe: bool = Onset.subframe
    hold: int = Onset.hold
    dark: ArrayLike | None = Onset.dark
    bright: ArrayLike | None = Onset.bright
    noise: float | None = Onset.noise
    travel_sigma: float | None = Onset.travel_sigma
    thresholds: Sequence[float] | None = Levels.thresholds
    inclinations: Sequence[float] | None = Levels.inclinations
    line_time: float | None = Onset.line_time
    blur: float | None = Onset.blur
    modulus: float | None = Elastomer.modulus
    fill: bool = HoleFilling.fill

    @property
    def _has_levels(self) -> bool:
        return self.thresholds is not None or self.inclinations is not None

    def check_options(self) -> None:
        """Raise InputError if the method cannot be used with the other options."""
        if self.method == "threshold":
            if self._has_levels:
                self.configure(Levels)
            return
        if self._has_levels:
            raise InputError("thresholds and inclinations need method 'threshold'")
        if not self.subframe:
            raise InputError(
                "subframe is False, but a change-point lies between frames: equation 4 as printed needs"
                " method 'threshold'"
            )
        self.configure(ChangePoint)

    def plan(self, source: Source) -> Plan:
        """Return the operation for a source, depending on its travel, the method and the available levels."""
        travel: NDArray[np.float64] | None = getattr(source, "travel", None)
        # More than a press and its release.
        oscillates = travel is not None and len(stroke_starts(travel, 1)) > 1
        if travel is None or oscillates:
            frames = range(source.shape[0])
        else:
            frames = _frames_of(source.name, travel, self.event)
        operation: PressOperation = self.configure(self._kind(source, oscillates)).configured_for(source)
        process = self._process(source, operation)
        if self.method == "change-point" and operation.passes == 2:
            if not source.rewindable:
                raise InputError(
                    f"{source.name} cannot be read twice, as a change between unknown levels needs: "
                    "give dark and bright"
                )
            process |= dict.fromkeys(("dark", "bright"), "each pixel's own")
        return Plan(operation, self._steps(operation), process, frames, _OMIT)

    def live_plan(self, source: Source) -> Plan:
        """Return the search for strokes, which does not need the travel in advance."""
        operation: PressOperation = self.configure(Strokes).configured_for(source)
        process, frames = self._process(source, operation), range(source.shape[0])
        return Plan(operation, self._steps(operation), process, frames, _OMIT)

    def _kind(self, source: Source, oscillates: bool) -> type[PressOperation]:
        """Return the class of the operation."""
        if oscillates and self._has_levels:
            raise InputError(f"{source.name}: inclinations need a press that goes down once")
        if oscillates and self.method != "threshold":
            raise InputError(f"{source.name}: travel oscillates, which needs the method 'threshold'")
        if self._has_levels:
            return Levels
        if oscillates:
            return Strokes
        return Onset if self.method == "threshold" else ChangePoint

    def _process(self, source: Source, operation: PressOperation) -> dict[str, ProcessValue]:
        process: dict[str, ProcessValue] = {
            "event": self.event,
            "method": self.method,
            "threshold": operation.lowest_threshold,
            "hold": self.hold,
            "subframe": self.subframe,
            "dark": level_origin(source, "dark", self.dark),
            "bright": level_origin(source, "bright", self.bright),
        }
        process |= {name: estimated_level(getattr(operation, name)) for name in operation.estimated_levels}
        if operation.travel_sigma is not None:
            process["travel_sigma"] = operation.travel_sigma
        if self._has_levels:
            process |= {name: str(list(getattr(self, name))) for name in ("thresholds", "inclinations")}
        return process

    def _steps(self, operation: PressOperation) -> list[Step]:
        return [self.configure(Elastomer, threshold=operation.lowest_threshold), self.configure(HoleFilling)]


def _frames_of(name: str, travel: NDArray[np.float64], event: Event) -> range:
    """Return the frames of the event; InputError if the body does not move as it takes."""
    deepest = travel.max()
    rises, falls = travel[0] < deepest, travel[-1] < deepest
    if event == "release" and rises and not falls:
        raise InputError(f"{name}: travel only rises: that is a press; give event onset")
    if event == "onset" and falls and not rises:
        raise InputError(f"{name}: travel only falls: that is a release; give event release")
    return frames_of(travel, event)
