"""Arrays and quantities of other libraries mean the same for every entry point."""

import dataclasses
import math

import dask.array
import numpy as np
import pandas
import pint
import pytest
import xarray
import zarr
from calls import calls
from operations import CASES, assert_same

from mirrorskin import engine, io
from mirrorskin.engine.live import Stream
from mirrorskin.io.files.arrays import ArrayRecording

UNITS = pint.UnitRegistry()
COUNT, SHAPE = 8, (4, 6)
TRAVEL = 0.125 * np.arange(COUNT)  # in micrometres exact as well
LEVELS = {"dark": 20.0, "bright": 220.0, "noise": 1.0}
ONSET = np.linspace(0.1, 0.8, math.prod(SHAPE)).reshape(SHAPE)
LIGHT = np.clip((TRAVEL[:, None, None] - ONSET) / 0.2 + 0.5, 0, 1)
FRAMES = np.rint(20 + 200 * LIGHT).astype(np.uint8)
HIDDEN = np.zeros(FRAMES.shape, bool)
HIDDEN[:, 1, 2] = True
PARTLY_NAN = np.where(HIDDEN, np.nan, FRAMES).astype(np.float32)


class Brightest(engine.Operation):
    """Any other operation: it accepts all types of samples, and states the last position."""

    rate: float = engine.option(default=1.0, unit="Hz", help="any rate")

    def start(self, shape, dtype):
        self.most, self.at = np.zeros(shape), 0.0

    def push(self, frames, *, travel):
        np.fmax(self.most, np.fmax.reduce(frames), out=self.most)
        self.at = float(travel[-1])

    def result(self):
        return {"brightest": self.most, "at": self.at}


class WithInterface:
    """An array of another library that has ``__array_interface__``."""

    def __init__(self, values):
        self._values, self.__array_interface__ = values, values.__array_interface__


class WithDlpack:
    """An array of another library that has ``__dlpack__`` only."""

    def __init__(self, values):
        self._values = values

    def __dlpack__(self, **options):
        return self._values.__dlpack__(**options)

    def __dlpack_device__(self):
        return self._values.__dlpack_device__()


class OfAstropy(np.ndarray):
    """Numbers with a unit, as a quantity of astropy has them."""

    @property
    def value(self):
        return self.view(np.ndarray)

    def to(self, unit):
        raise NotImplementedError


def of_astropy(values, unit):
    array = np.asarray(values).view(OfAstropy)
    array.unit = unit
    return array


def labelled(*names, **more):
    """Return a function that returns frames as an array of xarray whose dimensions are in this order."""
    return lambda frames: xarray.DataArray(frames, dims=("travel", "y", "x"), **more).transpose(*names)


def of_pandas(values, unit):
    series = pandas.Series(values)
    series.attrs["units"] = unit
    return series


def of_zarr(frames):
    return zarr.array(frames, store=zarr.storage.MemoryStore())


def read_only(frames):
    frames = frames.copy()
    frames.flags.writeable = False
    return frames


FRAMES_OF_KIND = {
    "list of frames": (list, FRAMES),
    "nested lists": (np.ndarray.tolist, FRAMES.astype(np.uint16)),
    "tuple": (tuple, FRAMES),
    "Fortran order": (np.asfortranarray, FRAMES),
    "backwards": (lambda frames: frames[::-1].copy()[::-1], FRAMES),
    "every other column": (lambda frames: np.repeat(frames, 2, axis=2)[:, :, ::2], FRAMES),
    "read-only": (read_only, FRAMES),
    "big-endian": (lambda frames: frames.astype(">u2"), FRAMES.astype(np.uint16)),
    "int64": (lambda frames: frames.astype(np.int64), FRAMES.astype(np.uint16)),
    "float16": (lambda frames: frames.astype(np.float16), FRAMES.astype(np.float32)),
    "big-endian float64": (lambda frames: frames.astype(">f8"), FRAMES.astype(np.float32)),
    "unknown samples": (lambda frames: PARTLY_NAN.astype(np.float64), PARTLY_NAN),
    "nothing masked": (np.ma.masked_array, FRAMES),
    "masked": (lambda frames: np.ma.masked_array(frames, HIDDEN), PARTLY_NAN),
    "masked int64": (lambda frames: np.ma.masked_array(frames.astype(np.int64), HIDDEN), PARTLY_NAN),
    "list of masked frames": (lambda frames: [*np.ma.masked_array(frames, HIDDEN)], PARTLY_NAN),
    "memoryview": (memoryview, FRAMES),
    "array interface": (WithInterface, FRAMES),
    "dlpack": (WithDlpack, FRAMES),
    "list of dlpack": (lambda frames: [WithDlpack(frame) for frame in frames], FRAMES),
    "Dask": (dask.array.from_array, FRAMES),
    "Zarr": (of_zarr, FRAMES),
    "pint": (lambda frames: UNITS.Quantity(frames, "count"), FRAMES),
    "astropy": (lambda frames: of_astropy(frames, "count"), FRAMES),
    "xarray": (labelled("travel", "y", "x"), FRAMES),
    "xarray, travel last": (labelled("y", "x", "travel"), FRAMES),
    "xarray, columns first": (labelled("x", "y", "travel"), FRAMES),
    "xarray of Dask": (lambda frames: labelled("y", "x", "travel")(dask.array.from_array(frames)), FRAMES),
    "xarray of pint": (lambda frames: labelled("y", "x", "travel")(frames * UNITS.count), FRAMES),
    "list of xarray": (lambda frames: [array.T for array in labelled("travel", "y", "x")(frames)], FRAMES),
    "packed xarray": (
        labelled("y", "x", "travel", attrs={"scale_factor": 2.0, "add_offset": 5.0}),
        (2.0 * FRAMES + 5).astype(np.float32),
    ),
    "fill values of xarray": (
        lambda frames: labelled("x", "travel", "y", attrs={"_FillValue": 255})(np.where(HIDDEN, 255, frames)),
        PARTLY_NAN,
    ),
}

TRAVEL_OF_KIND = {
    "list": TRAVEL.tolist(),
    "tuple": tuple(TRAVEL),
    "float16": TRAVEL.astype(np.float16),
    "big-endian": TRAVEL.astype(">f8"),
    "memoryview": memoryview(TRAVEL),
    "dlpack": WithDlpack(TRAVEL),
    "nothing masked": np.ma.masked_array(TRAVEL),
    "pandas": pandas.Series(TRAVEL, index=range(5, 5 + COUNT)),
    "pandas with a unit": of_pandas(1e3 * TRAVEL, "um"),
    "pint": UNITS.Quantity(1e3 * TRAVEL, "um"),
    "pint in another registry": pint.UnitRegistry().Quantity(TRAVEL / 25.4, "inch"),
    "list of pint": [UNITS.Quantity(value, "mm") for value in TRAVEL],
    "list of different units": [
        UNITS.Quantity(value * 10.0 ** (3 * (k % 2)), ("mm", "um")[k % 2]) for k, value in enumerate(TRAVEL)
    ],
    "objects of pint": np.array([None, *[UNITS.Quantity(travel, "mm") for travel in TRAVEL]], object)[1:],
    "astropy": of_astropy(1e-3 * TRAVEL, "m"),
    "xarray": xarray.DataArray(TRAVEL, dims="travel"),
    "xarray with a unit": xarray.DataArray(1e3 * TRAVEL, dims="travel", attrs={"units": "um"}),
    "xarray with a long unit": xarray.DataArray(1e3 * TRAVEL, dims="n", attrs={"units": "micrometer"}),
    "xarray of pint": xarray.DataArray(UNITS.Quantity(0.1 * TRAVEL, "cm"), dims="travel"),
}


def by_push(frames, travel, dtype):
    run = engine.Run(engine.Onset(**LEVELS))
    run.push(frames, travel=travel)
    return run.result()


def by_stream(frames, travel, dtype):
    with Stream(engine.Onset(**LEVELS), SHAPE, dtype, latency=math.inf) as stream:
        stream.push(frames, travel=travel)
        return stream.result()


DOORS = {
    "function": lambda frames, travel, dtype: engine.find_onset(frames, travel, **LEVELS),
    "run": lambda frames, travel, dtype: engine.run(frames, engine.Onset(**LEVELS), travel=travel),
    "push": by_push,
    "reconstruct": lambda frames, travel, dtype: engine.reconstruct(frames, travel=travel, **LEVELS),
    "recording": lambda frames, travel, dtype: engine.run(
        ArrayRecording(frames, {"travel": travel}, {}), engine.Onset(**LEVELS)
    ),
    "stream": by_stream,
}
EACH_DOOR = pytest.mark.parametrize("door", DOORS)


def answer(door, frames, travel, dtype=np.uint8):
    """Return the maps of an entry point, as bytes by name; ``dtype`` is the type of a stream's samples."""
    onset = DOORS[door](frames, travel, dtype)
    return {name: (onset[name].dtype, onset[name].tobytes()) for name in ("height", "height_sigma", "status")}


@pytest.mark.parametrize("kind", FRAMES_OF_KIND)
@EACH_DOOR
def test_frames_of_any_kind_are_those_of_a_plain_array(door, kind):
    convert, plain = FRAMES_OF_KIND[kind]
    result = answer(door, convert(FRAMES), TRAVEL, plain.dtype)
    assert result == answer(door, plain, TRAVEL, plain.dtype)


@pytest.mark.parametrize("kind", FRAMES_OF_KIND)
def test_own_operations_receive_any_kind_of_frames_as_plain_arrays(kind):
    convert, plain = FRAMES_OF_KIND[kind]
    result = engine.run(convert(FRAMES), Brightest, travel=UNITS.Quantity(1e3 * TRAVEL, "um"))
    np.testing.assert_array_equal(
        result["brightest"], np.nanmax(np.pad(plain, ((1, 0), (0, 0), (0, 0))), axis=0)
    )
    assert result.process["at"] == TRAVEL[-1]


@pytest.mark.parametrize("kind", ["masked", "big-endian", "int64", "float16", "xarray", "list of dlpack"])
def test_an_iterator_yields_any_kind_of_frames(kind):
    convert, plain = FRAMES_OF_KIND[kind]
    result = answer("run", iter(convert(FRAMES)), UNITS.Quantity(1e3 * TRAVEL, "um"))
    assert result == answer("run", plain, TRAVEL)


@pytest.mark.parametrize("kind", TRAVEL_OF_KIND)
@EACH_DOOR
def test_positions_of_any_kind_are_those_of_a_plain_array(door, kind):
    result = DOORS[door](FRAMES, TRAVEL_OF_KIND[kind], np.uint8)
    np.testing.assert_allclose(result.height, DOORS[door](FRAMES, TRAVEL, np.uint8).height, rtol=1e-6)


WRONG_TRAVEL = {
    "an angle": (UNITS.Quantity(TRAVEL, "deg"), "travel: 'deg' cannot be converted to 'mm'"),
    "a plain number of pint": (UNITS.Quantity(TRAVEL, ""), "travel: 'dimensionless' cannot be converted"),
    "an offset unit": (UNITS.Quantity(TRAVEL, "degC"), "travel: '°C' cannot be converted to 'mm'"),
    "a time of xarray": (
        xarray.DataArray(TRAVEL, dims="travel", attrs={"units": "s"}),
        "travel: 's' cannot be converted to 'mm'",
    ),
    "one angle": ([UNITS.Quantity(1.0, "deg"), *TRAVEL[1:]], "travel: 'deg' cannot be converted to 'mm'"),
    "masked": (np.ma.masked_array(TRAVEL, TRAVEL == 0.5), "travel.* nan at frame 4"),
    "masked integers": (np.ma.masked_array(range(COUNT), TRAVEL == 0.5), "travel.* nan at frame 4"),
    "complex": (1j * TRAVEL, "travel is a ndarray of complex128: numbers are needed"),
    "texts": ([*map(str, TRAVEL)], "travel is a list: numbers are needed"),
    "dates": (TRAVEL.astype("M8[s]"), "travel is a ndarray of datetime64.*: numbers are needed"),
    "ragged": ([TRAVEL, TRAVEL[1:]], "travel is not an array"),
}


@pytest.mark.parametrize("kind", WRONG_TRAVEL)
@EACH_DOOR
def test_positions_that_are_no_travel_are_refused_in_the_same_line(door, kind):
    travel, line = WRONG_TRAVEL[kind]
    with pytest.raises(io.InputError, match=line) as caught:
        DOORS[door](FRAMES, travel, np.uint8)
    assert "\n" not in str(caught.value)


WRONG_FRAMES = {
    "a length": (UNITS.Quantity(FRAMES, "mm"), "frames: 'mm' cannot be converted to a number without a unit"),
    "complex": (1j * FRAMES, "frames is a ndarray of complex128: numbers are needed"),
    "texts": (FRAMES.astype(str), "frames is a ndarray of <U3: numbers are needed"),
    "ragged": ([FRAMES[0], FRAMES[0, 1:]], "frames is not an array"),
    "two columns": (xarray.DataArray(FRAMES, dims=("x", "col", "t")), "name frames, rows and columns differ"),
    "colours": (xarray.DataArray(FRAMES, dims=("y", "x", "rgb")), "give one channel"),
    "unknown axes": (xarray.DataArray(FRAMES, dims=("x", "a", "b")), r"not \(t, y, x\)"),
    "dataset": (xarray.Dataset({"frames": (("t", "y", "x"), FRAMES)}), "frames is not an array"),
    "too large": (FRAMES.astype(np.int64) * 1000, "frames.* has a sample of .*; int64 is read as uint16"),
}


@pytest.mark.parametrize("kind", WRONG_FRAMES)
@EACH_DOOR
def test_frames_that_are_none_are_refused_in_the_same_line(door, kind):
    frames, line = WRONG_FRAMES[kind]
    with pytest.raises(io.InputError, match=line) as caught:
        DOORS[door](frames, TRAVEL, np.uint8)
    assert "\n" not in str(caught.value)


def content(answer):
    """Return all numbers of an answer as bytes, or as text."""
    if isinstance(answer, io.Result):
        return [(name, content(values)) for name, values in answer.items()]
    if dataclasses.is_dataclass(answer):
        return [content(getattr(answer, field.name)) for field in dataclasses.fields(answer)]
    if isinstance(answer, tuple):
        return [content(part) for part in answer]
    return (answer.dtype, answer.tobytes()) if isinstance(answer, np.ndarray) else repr(answer)


def transposed(values):
    """Return an array as one of xarray whose dimensions are in an unusual order."""
    names = [("t",), ("y", "x"), ("y", "x", "vector") if values.shape[-1] in (2, 3) else ("t", "y", "x")]
    return xarray.DataArray(values, dims=names[values.ndim - 1]).transpose(*names[values.ndim - 1][::-1])


OTHERS = {
    "xarray": transposed,
    "big-endian": lambda values: values.astype(values.dtype.newbyteorder(">")),
    "dlpack": WithDlpack,
    "masked": np.ma.masked_array,
    "Dask": dask.array.from_array,
}


@pytest.mark.filterwarnings("ignore::mirrorskin.io.MirrorskinWarning")
@pytest.mark.parametrize("name", calls())
@pytest.mark.filterwarnings("ignore:.*are estimated from the frames:mirrorskin.io.MirrorskinWarning")
def test_every_function_takes_arrays_of_other_libraries_as_plain_ones(name):
    function, arguments = calls()[name]
    expected = content(function(**arguments))
    for argument, plain in arguments.items():
        if isinstance(plain, np.ndarray):
            for kind, convert in OTHERS.items():
                result = content(function(**{**arguments, argument: convert(plain)}))
                assert result == expected, f"{argument}, {kind}"


@pytest.mark.parametrize("name", calls())
def test_every_function_refuses_a_unit_that_no_argument_has(name):
    function, arguments = calls()[name]
    for argument, plain in arguments.items():
        if isinstance(plain, np.ndarray | float | int):
            with pytest.raises(io.InputError, match="'cd' cannot be converted") as caught:
                function(**{**arguments, argument: UNITS.Quantity(plain, "candela")})
            assert f"{argument}: " in str(caught.value)


def test_counts_in_units_of_a_camera_are_counts():
    dark = xarray.DataArray(np.full(SHAPE, 20.0), dims=("y", "x"), attrs={"units": "DN"})
    onset = engine.find_onset(FRAMES, TRAVEL, **{**LEVELS, "dark": dark})
    assert content(onset) == content(engine.find_onset(FRAMES, TRAVEL, **LEVELS))


@pytest.mark.parametrize("hold", [2.7, np.float64(2.7), np.array(2.7), xarray.DataArray(2.7)])
def test_a_number_of_frames_is_whole(hold):
    with pytest.raises(io.InputError, match=r"hold is .*: a whole number is needed"):
        engine.Onset(hold=hold)


def test_even_steps_have_no_units():
    with pytest.raises(io.InputError, match="step: 'µm' cannot be converted to a number without a unit"):
        io.Steps(UNITS.Quantity(10, "um"))


def test_displacements_have_frames_first():
    slide = np.arange(2.0 * COUNT).reshape(COUNT, 2)
    labels = xarray.DataArray(1e3 * slide.T, dims=("axis", "time"), attrs={"units": "um"})

    class Slide(engine.Operation):
        def push(self, frames, *, displacement):
            self.at = displacement[-1]

        def result(self):
            return {"at": np.broadcast_to(self.at[:1], SHAPE)}

    assert np.all(engine.run(FRAMES, Slide, displacement=labels)["at"] == slide[-1, 0])


def test_an_integrator_takes_arrays_of_other_libraries_as_plain_ones():
    slopes, mask = np.linspace(0, 0.3, 48).reshape(6, 8), np.arange(48).reshape(6, 8) % 11 > 0
    integrators = [engine.Integrator((6, 8), 0.1) for _ in range(2)]
    integrators[0].push(slopes, slopes, mask=mask)
    integrators[1].push(transposed(slopes), np.ma.masked_array(slopes), mask=transposed(mask))
    assert content(integrators[1].result()) == content(integrators[0].result())


FLAT = np.linspace(-0.5, 0.0, 48).reshape(6, 8)
FLAT_SIGMA = np.full_like(FLAT, 0.01)
SIZED = {"x": 0.1 * (np.arange(8) - 3.5), "y": 0.1 * (2.5 - np.arange(6))}


def in_micrometres(*names):
    """Return maps of a surface, some of them in micrometres: with pint, or in a dataset of xarray."""
    plain = {"height": FLAT, "height_sigma": FLAT_SIGMA, **SIZED}
    return {name: UNITS.Quantity(1e3 * mm, "um") if name in names else mm for name, mm in plain.items()}


def area(maps, **options):
    return engine.measure(maps, form="plane", **options).quantities["measured area"].value


UNIT_CASES = {
    "pixel size": lambda q: engine.integrate(FLAT, FLAT, q(0.1, "mm", 100, "um")).height,
    "pixel sizes": lambda q: engine.integrate(FLAT, FLAT, q([0.1, 0.2], "mm", [100, 200], "um")).height,
    "pixel size of an integrator": lambda q: engine.Integrator((6, 8), q(0.1, "mm", 1e-4, "m"))._pixel_size,
    "pixel size of frames": lambda q: (
        engine.run(FRAMES, Brightest, travel=TRAVEL, pixel_size=q(0.25, "mm", 250, "um")).x
    ),
    "pixel size of a press": lambda q: (
        engine.reconstruct(FRAMES, travel=TRAVEL, pixel_size=q(0.25, "mm", 250, "um"), **LEVELS).x
    ),
    "pixel size of heights": lambda q: area(FLAT, pixel_size=q(0.25, "mm", 250, "um")),
    "filter": lambda q: area(in_micrometres(), s_filter=q(0.25, "mm", 250, "um")),
    "section": lambda q: (
        engine.metrology.section(in_micrometres(), q([-0.2, 0.1], "mm", [-200, 100], "um"), (0.2, 0.1)).height
    ),
    "known heights": lambda q: (
        engine.integrate(0 * FLAT, 0 * FLAT, 0.1, known_heights=q(FLAT, "mm", 1e3 * FLAT, "um")).height
    ),
    "standard deviation": lambda q: engine.Onset(travel_sigma=q(0.01, "mm", 10, "um")).travel_sigma,
    "tilt": lambda q: engine.Normals(tilt=q(np.radians(2), "rad", 2, "deg")).tilt,
    "tilts": lambda q: (
        engine.press.Levels(
            thresholds=[0.3, 0.7], inclinations=q([0.3, 0.4], "rad", [300, 400], "mrad")
        ).inclinations
    ),
    "gain": lambda q: engine.Normals(zenith_gain=q(500.0, "count/rad", 0.5, "count/mrad")).zenith_gain,
    "rate": lambda q: Brightest(rate=q(2.0, "Hz", 0.002, "1/ms")).rate,
    "threshold": lambda q: engine.Onset(threshold=q(0.25, "", 0.25, "")).threshold,
    "modulus": lambda q: engine.force.find_force(-FLAT, 0.5, 0.1, modulus=q(0.1, "MPa", 100, "kPa")).pressure,
    "travel of a force": lambda q: (
        engine.force.find_force(-FLAT, q(0.5, "mm", 500, "um"), 0.1, modulus=0.1).pressure
    ),
    "time": lambda q: engine.vibration.estimate_frequency(
        np.cos(0.8 * np.arange(64.0)), q(0.125 * np.arange(64.0), "s", 125 * np.arange(64.0), "ms")
    ),
}


@pytest.mark.parametrize("case", UNIT_CASES)
def test_a_quantity_in_another_unit_is_converted(case):
    call = UNIT_CASES[case]
    plain = call(lambda value, unit, other_value, other_unit: value)
    for result in (
        call(lambda value, unit, other_value, other_unit: UNITS.Quantity(value, unit)),
        call(lambda value, unit, other_value, other_unit: UNITS.Quantity(other_value, other_unit)),
    ):
        np.testing.assert_allclose(result, plain, rtol=1e-6)


@pytest.mark.parametrize("names", [["height", "height_sigma"], ["x", "y"]])
def test_maps_in_other_units_are_converted(names):
    assert area(in_micrometres(*names)) == pytest.approx(area(in_micrometres()), rel=1e-9)


def test_a_dataset_of_quantities_is_converted():
    height = xarray.DataArray(UNITS.Quantity(1e3 * FLAT, "um"), dims=("y", "x"))
    dataset = xarray.Dataset({"height": height}, coords={name: (name, axis) for name, axis in SIZED.items()})
    np.testing.assert_allclose(io.Result.from_xarray(dataset).height, FLAT, rtol=1e-12)


def test_time_differences_are_seconds():
    wave, time = np.cos(0.8 * np.arange(64.0)), 0.125 * np.arange(64.0)
    expected = engine.vibration.estimate_frequency(wave, time)
    days = np.datetime64("2026-01-01") + (1000 * time).astype("m8[ms]")
    assert engine.vibration.estimate_frequency(wave, days - days[0]) == expected
    with pytest.raises(io.InputError, match=r"time is .*datetime64.*: numbers are needed, as in time - time"):
        engine.vibration.estimate_frequency(wave, days)


def test_values_for_a_file_have_units(tmp_path):
    np.save(tmp_path / "press.npy", FRAMES)
    with io.open_recording(
        tmp_path / "press.npy",
        travel=UNITS.Quantity(1e3 * TRAVEL, "um"),
        pixel_size=UNITS.Quantity(30, "um"),
        tilt=UNITS.Quantity(180, "deg"),
    ) as recording:
        np.testing.assert_array_equal(recording.travel, TRAVEL)
        assert recording.header.pixel_size == (0.03, 0.03)
        assert recording.header.tilt == pytest.approx(np.pi)


COUNTED = np.arange(48)
CHANGES = {
    "flicker": lambda frames: (1 + 0.04 * np.sin(2.4 * COUNTED))[:, None, None] * frames,
    "drift": lambda frames: (1 - 0.003 * COUNTED)[:, None, None] * frames,
    "a repeated frame": lambda frames: np.delete(np.insert(frames, 20, frames[19], axis=0), -1, axis=0),
    "a lost frame": lambda frames: np.insert(np.delete(frames, 20, axis=0), -1, frames[-1], axis=0),
    "gamma": lambda frames: 255 * (frames / 255) ** 0.6,
    "noisy first frames": lambda frames: (
        frames + 12 * np.cos(5.0 * COUNTED)[:, None, None] * (COUNTED < 2)[:, None, None]
    ),
}


@pytest.mark.parametrize("change", CHANGES)
@pytest.mark.parametrize("name", [name for name, case in CASES.items() if case.function is not None])
@pytest.mark.filterwarnings("ignore::mirrorskin.io.MirrorskinWarning")
def test_arrays_and_recordings_give_what_the_function_gives(name, change):
    case = CASES[name]
    is_estimated = case.kind is not engine.optical.Focus
    options = {key: value for key, value in case.options.items() if key != "noise" or not is_estimated}
    frames = np.rint(CHANGES[change](case.frames.astype(float))).clip(0, 255).astype(case.frames.dtype)
    expected = case.function(frames, **case.given, **options)
    result = engine.run(frames, case.kind(**options), **case.given)
    assert_same(result, expected)
    assert result.process.get("warnings") == expected.process.get("warnings")
    if not case.weights:
        recording = dataclasses.replace(case, frames=frames).source()
        assert_same(engine.run(recording, case.kind(**options)), expected)
