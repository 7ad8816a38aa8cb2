"""A source with a calibration applied: checks of camera and scale, and the calibration of a region."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from types import TracebackType
from typing import Any, Self, cast

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.base.selection import Region
from mirrorskin.io.base.types import Block, Floats, Header, InputError, LiveSource, Source
from mirrorskin.io.model.calibration import PARTS, Calibration, CameraId, LinearResponse, Precession
from mirrorskin.io.model.parameters import median, parameters

Size = tuple[float, float]

SIZED = tuple(name for name, kind in PARTS.items() if kind.motion)
"""The parts whose lengths depend on the pixel size."""

_SAME_SIZE = 1e-3  # relative difference allowed between pixel sizes: below the accuracy of calibrated lengths
_SAME_TILT = 1.25  # allowed ratio of a rotation's half-angle and the calibrated one


def size_facts(pixel_size: Size) -> dict[str, float]:
    """Return the process values of a part that store its pixel size, mm along x and y."""
    return {f"pixel_size_{axis}": float(size) for axis, size in zip("xy", pixel_size, strict=True)}


def differ(size: Size, other: Size) -> bool:
    """Return whether two pixel sizes differ too much for lengths based on both."""
    return not all(abs(value - right) <= _SAME_SIZE * right for value, right in zip(size, other, strict=True))


def outdated(
    calibration: Calibration, pixel_size: Size, parts: Iterable[str] = SIZED
) -> Iterator[tuple[str, Size]]:
    """Yield the parts that were made with another pixel size, if it was stored, and that size."""
    present = calibration.parts()
    for part in parts:
        facts = [calibration.process.get(f"{PARTS[part].command}.{fact}") for fact in size_facts(pixel_size)]
        sizes = [float(fact) for fact in facts if isinstance(fact, float | int)]
        if part in present and len(sizes) == 2 and differ((sizes[0], sizes[1]), pixel_size):
            yield part, (sizes[0], sizes[1])


def check_sizes(
    calibration: Calibration, pixel_size: Size | None, what: str, parts: Iterable[str] = SIZED
) -> None:
    """Raise InputError for parts that were made with another pixel size than the current one, if known."""
    for part, before in outdated(calibration, pixel_size, parts) if pixel_size else ():
        says = f"{what} states" if calibration.lens is None else "the scale now states"
        sizes = (
            f"{x:.5g} mm" if f"{x:.5g}" == f"{y:.5g}" else f"{x:.5g} x {y:.5g} mm"
            for x, y in (before, cast(Size, pixel_size))
        )
        raise InputError(
            f"{calibration.name or 'the calibration'}: calibrate {PARTS[part].command} again: it was made"
            f" with pixels of {next(sizes)}, {says} {next(sizes)}"
        )


def check_camera(
    calibration: Calibration,
    camera: CameraId,
    what: str,
    remedy: str = "calibrate again, or give that camera's",
) -> None:
    """Raise InputError for a calibration of another camera: its name (if any), picture size or data type.

    The message contains the owner of the camera, ``what``, and the ``remedy``.
    """
    mine, differences = calibration.camera, []
    if mine.name and camera.name and mine.name != camera.name:
        differences.append((f"the camera {mine.name!r}", f"{camera.name!r}"))
    if tuple(mine.shape) != tuple(camera.shape):
        sizes = (f"{size.shape[1]} x {size.shape[0]}" for size in (mine, camera))
        differences.append((f"{next(sizes)} pixels", next(sizes)))
    if np.dtype(mine.dtype) != np.dtype(camera.dtype):
        differences.append((f"{np.dtype(mine.dtype).name} samples", np.dtype(camera.dtype).name))
    if differences:
        ours, its = (" and ".join(each) for each in zip(*differences, strict=True))
        raise InputError(f"{calibration.name or 'the calibration'} is of {ours}, {what} of {its}: {remedy}")


def cropped(calibration: Calibration, region: Region, pixel_size: Size | None) -> Calibration:
    """Return the calibration for a part of the picture: maps cropped, positions relative to its centre."""
    picture = calibration.camera.shape
    if region == Region.whole(picture):
        return calibration
    right, up = region.centre(picture, pixel_size) if pixel_size else (0.0, 0.0)
    parts: dict[str, Any] = {}
    for name, part in calibration.parts().items():
        changed: dict[str, Any] = {}
        for field, how in parameters(part).items():
            value = getattr(part, field)
            if how.kind == "map" and value is not None:
                changed[field] = np.ascontiguousarray(value[region.slices])
            elif how.place and value is not None:
                changed[field] = (value[0] - right, value[1] - up, *value[2:])
        parts[name] = replace(part, **changed)
    return replace(calibration, camera=replace(calibration.camera, shape=region.shape), **parts)


def _brightness(response: LinearResponse) -> dict[str, Any]:
    """Return the properties of a header that a response determines."""
    sigma = response.sigma
    return {
        "zenith_gain": response.gain.astype(np.float64),
        "zenith_offset": response.offset.astype(np.float64),
        "gamma": response.gamma,
        "zenith_gain_sigma": sigma["gain"] / abs(median(response.gain)),
        "zenith_offset_sigma": sigma["offset"],
        "gamma_sigma": sigma["gamma"],
    }


class Calibrated:
    """A source with the header and the phases of a calibration; frames are passed on unchanged.

    Other attributes of the source (``travel``, ``region``, ``fingerprint`` ...) are forwarded. The header of
    a live source is only read when it is needed, because reading it moves the stage.

    The ``source`` is live, or a recording, possibly of a part of the picture. The ``calibration``, stored as
    ``whole``, belongs to the whole picture of the camera. InputError if the camera or the half-angle differs,
    or if a part was made with another pixel size.
    """

    source: Source
    whole: Calibration
    name: str
    rewindable: bool

    def __init__(self, source: Source, calibration: Calibration) -> None:
        self.source, self.whole = source, calibration
        self.name, self.motion, self.rewindable = source.name, source.motion, source.rewindable
        if hasattr(source, "now"):
            self._check("")
            self._check_sizes(None)
        else:
            _ = self.header

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") or "source" not in self.__dict__:  # while being copied
            raise AttributeError(name)
        return getattr(self.source, name)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Frames, rows and columns."""
        return self.source.shape

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of a sample."""
        return self.source.dtype

    @property
    def region(self) -> Region:
        """The region of the camera's picture."""
        return getattr(self.source, "region", None) or Region.whole(self.source.shape[1:])

    @functools.cached_property
    def calibration(self) -> Calibration:
        """The calibration of this region: maps cropped, positions relative to its centre."""
        if self.region == Region.whole(self.whole.camera.shape):
            return self.whole
        lens = self.whole.lens
        pixel_size = self.source.header.pixel_size if lens is None else lens.pixel_size
        return cropped(self.whole, self.region, pixel_size)

    @functools.cached_property
    def header(self) -> Header:
        """The source's header, with references, pixel size, response, tilt and pivot of the calibration."""
        stored = self.source.header
        self._check(stored.camera)
        calibration = self.calibration
        properties: dict[str, Any] = {}
        if calibration.references is not None:
            properties |= {"dark": calibration.references.dark, "bright": calibration.references.bright}
        if calibration.lens is not None:
            properties["pixel_size"] = calibration.lens.pixel_size
        if self.motion == "axial" and calibration.response is not None:
            properties |= _brightness(calibration.response)
        if self.motion == "axial" and calibration.precession is not None:
            properties |= self._movement(stored, calibration.precession)
        header = replace(stored, **properties).exposed(stored.exposure_ratio or 1.0, properties)
        self._check_sizes(header.pixel_size)
        return header

    @property
    def phase(self) -> Floats | None:
        """The phases of all frames, radians, if they are known in advance."""
        return self._turned(getattr(self.source, "phase", None))

    def read(self, out: NDArray[Any] | None = None, /) -> Block | None:
        """Read the source's next frames, with corrected phases; see ``Source.read``."""
        return self._corrected(self.source.read(out))

    def read_in_place(self, limit: int) -> Block | None:
        """Return the next frames of an array without a copy, or None; see ``ArrayRecording``."""
        read_in_place: Callable[[int], Block | None] | None = getattr(self.source, "read_in_place", None)
        return None if read_in_place is None else self._corrected(read_in_place(limit))

    def rewind(self) -> None:
        """Go back to the first frame."""
        self.source.rewind()

    def now(self) -> float:
        """Return the time of a live source."""
        return cast(LiveSource, self.source).now()

    def positions(self) -> Mapping[str, Floats]:
        """Return the positions of a live source, with corrected phases."""
        positions = dict(cast(LiveSource, self.source).positions())
        if "phase" in positions:
            positions["phase"] = cast(Floats, self._turned(positions["phase"]))
        return positions

    def __enter__(self) -> Self:
        self.source.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None, /
    ) -> None:
        self.source.__exit__(kind, error, trace)

    def _corrected(self, block: Block | None) -> Block | None:
        return block and replace(block, phase=self._turned(block.phase))

    def _turned(self, phase: Floats | None) -> Floats | None:
        precession = self.whole.precession
        return phase if phase is None or precession is None else precession.phase(phase)

    def _check(self, camera: str) -> None:
        shape: tuple[int, ...] = getattr(self.source, "full_shape", self.source.shape)
        check_camera(self.whole, CameraId(camera, (shape[1], shape[2]), self.source.dtype), self.name)

    def _check_sizes(self, stated: Size | None) -> None:
        size = stated if self.whole.lens is None else self.whole.lens.pixel_size
        used = [name for name in SIZED if PARTS[name].motion == self.motion]
        check_sizes(self.whole, size, self.name, used)

    def _movement(self, header: Header, precession: Precession) -> dict[str, Any]:
        """Return tilt and pivot of the precession, or of the source if undetermined."""
        tilt = precession.tilt
        unknown = header.pivot or (np.nan,) * 3
        places = zip(precession.pivot, unknown, strict=True)
        pivot = tuple(value if np.isfinite(value) else otherwise for value, otherwise in places)
        if header.tilt and not 1 / _SAME_TILT < tilt / header.tilt < _SAME_TILT:
            learned, stated = np.degrees([tilt, header.tilt])
            raise InputError(
                f"{self.whole.name or 'the calibration'} is for a tilt of {learned:.2f} deg, but that of "
                f"{self.name} is {stated:.2f} deg: calibrate the tilt again"
            )
        return {"tilt": tilt, "pivot": pivot if np.isfinite(pivot).all() else None}
