"""The settings of a batch, a file of TOML: what is given of stacks, and how they are reconstructed."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta, Struct, field, structs

from mirrorskin.cli.options import MotionName
from mirrorskin.cli.quantity import angle, per_angle, pressure
from mirrorskin.cli.stack import stack_options
from mirrorskin.engine.batch.jobs import Plan
from mirrorskin.engine.press.onset import Event
from mirrorskin.engine.press.press import PressMethod
from mirrorskin.engine.rotation.normals_kernel import NormalMethod
from mirrorskin.engine.rotation.tilt import check_tilt
from mirrorskin.io import InputError, Motion
from mirrorskin.io.settings_file import load_toml


def _text(example: str) -> Meta:
    return Meta(min_length=1, description="a text in quotes", examples=[example])


_Counts = Annotated[float, Meta(description="a number of counts", examples=[12.5])]
_Share = Annotated[float, Meta(ge=0, le=1, description="a share from 0 (dark) to 1 (bright)", examples=[0.5])]
_Frames = Annotated[int, Meta(ge=1, lt=2**31, description="a number of frames from 1 on", examples=[2])]
_Pixels = Annotated[int, Meta(ge=1, lt=2**16, description="a number of pixels from 1 on", examples=[8])]
_Sigma = Annotated[
    float, Meta(ge=0, description="a standard deviation in counts, not below 0,", examples=[1.5])
]
_SigmaAboveZero = Annotated[
    float, Meta(gt=0, description="a standard deviation in counts, above 0,", examples=[1.5])
]


class _Stack(Struct, frozen=True, rename="kebab"):
    dataset: Annotated[str, _text("/entry/data")] | None = None
    motion: Motion | None = None
    travel_step: Annotated[str, _text("0.1mm")] | None = None
    travel_start: Annotated[str, _text("0mm")] | None = None
    travel: Annotated[str, _text("stage.csv")] | None = None
    phase_step: Annotated[str, _text("45deg")] | None = None
    tilt: Annotated[str, _text("2.5deg")] | None = None
    pixel_size: Annotated[str, _text("0.03mm")] | None = None
    region: Annotated[str, _text("100,50,640x480")] | None = None
    frames: Annotated[str, _text("10:200")] | None = None


class _Press(Struct, frozen=True, rename="kebab"):
    event: Event | None = None
    method: PressMethod | None = None
    threshold: _Share | list[_Share] | None = None
    inclination: list[Annotated[str, _text("12deg")]] | None = None
    hold: _Frames | None = None
    subframe: bool | None = None
    dark: _Counts | None = None
    bright: _Counts | None = None
    noise: _Sigma | None = None
    fill: bool | None = None
    modulus: Annotated[str, _text("0.1MPa")] | None = None

    def __post_init__(self) -> None:
        if self.method == "change-point" and self.subframe is False:
            raise ValueError("subframe is false: a change-point lies between frames; leave it out")
        if self.method == "change-point" and self.threshold in (0.0, 1.0):
            raise ValueError("threshold: a change-point needs a share between 0 and 1; write e.g. 0.5")


class _Rotation(Struct, frozen=True, rename="kebab"):
    method: NormalMethod | None = None
    tilt: Annotated[str, _text("2.5deg")] | None = None
    zenith_gain: Annotated[str, _text("5.7/deg")] | None = None
    zenith_offset: _Counts | None = None
    noise: _SigmaAboveZero | None = None
    per_turn: bool | None = None
    robust: bool | None = None


class _Slip(Struct, frozen=True, rename="kebab"):
    per_frame: bool | None = None
    window: _Pixels | None = None
    step: _Pixels | None = None
    noise: _SigmaAboveZero | None = None
    modulus: Annotated[str, _text("0.1MPa")] | None = None


class _Settings(Struct, frozen=True):
    stack: _Stack = field(default_factory=_Stack)
    press: _Press = field(default_factory=_Press)
    rotation: _Rotation = field(default_factory=_Rotation)
    slip: _Slip = field(default_factory=_Slip)


_REMEDY = f"write the tables {', '.join(f'[{name}]' for name in _Settings.__struct_fields__)} in TOML"


def read_settings(path: Path | None, memory_limit: int) -> Plan:
    """Read what a batch does with every recording."""
    settings = _Settings() if path is None else load_toml(path, _Settings, _REMEDY)
    where = f"{path}: "
    opening = _opening(_given(settings.stack), f"{where}stack.")
    return Plan(
        opening,
        _press(_given(settings.press), f"{where}press."),
        _rotation(_given(settings.rotation), f"{where}rotation."),
        memory_limit,
        _slip(_given(settings.slip), f"{where}slip."),
    )


def _given(table: Struct) -> dict[str, Any]:
    return {name: value for name, value in structs.asdict(table).items() if value is not None}


def _opening(values: dict[str, Any], where: str) -> dict[str, Any]:
    """Convert [stack] to keywords of ``open_recording``; refuse what no stack can have."""
    dataset = {name: values.pop(name) for name in ("dataset",) if name in values}
    if "motion" in values:
        values["motion"] = MotionName(values["motion"])
    if "travel" in values:
        values["travel"] = Path(values["travel"])
    options = stack_options(**values, where=where)
    if "tilt" in options:
        _check_tilt(options["tilt"], f"{where}tilt")
    if min(options.get("pixel_size", (1.0,))) <= 0:
        raise InputError(f'{where}pixel-size: a length above 0 is needed; write e.g. "0.03mm"')
    return {**dataset, **options}


def _slip(values: dict[str, Any], where: str) -> dict[str, Any]:
    """Convert [slip] to keywords of ``reconstruct``."""
    if "modulus" in values:
        values["modulus"] = pressure(values["modulus"], f"{where}modulus")
    return values


def _press(values: dict[str, Any], where: str) -> dict[str, Any]:
    """Convert [press] to keywords of ``reconstruct``."""
    if "inclination" in values:
        values["inclinations"] = [angle(text, f"{where}inclination") for text in values.pop("inclination")]
    return _slip(values, where)


def _rotation(values: dict[str, Any], where: str) -> dict[str, Any]:
    """Convert [rotation] to keywords of ``reconstruct``."""
    if values.get("tilt", "estimate") != "estimate":
        values["tilt"] = _check_tilt(angle(values["tilt"], f"{where}tilt"), f"{where}tilt")
    if "zenith_gain" in values:
        text = values.pop("zenith_gain")
        values["gain"] = per_angle(text, f"{where}zenith-gain")
        if values["gain"] == 0:
            raise InputError(f'{where}zenith-gain {text}: other than 0 is needed; write e.g. "5.7/deg"')
    if "zenith_offset" in values:
        values["offset"] = values.pop("zenith_offset")
    return values


def _check_tilt(radians: float, where: str) -> float:
    try:
        return check_tilt(radians)
    except InputError as error:
        raise InputError(f"{where}: {error}") from error
