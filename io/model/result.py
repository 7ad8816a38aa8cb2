"""The result of a reconstruction: maps by name, with their declarations."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import fields, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.io.base.arguments import unknown_argument
from mirrorskin.io.base.findings import merged
from mirrorskin.io.base.types import PIXEL, Floats, InputError, ProcessValue
from mirrorskin.io.model.fitted import Fitted, taken_from
from mirrorskin.io.model.maps import (
    FIELDS,
    RESERVED,
    SIGMA,
    UNDECLARED,
    Map,
    check_declarations,
    check_new,
    declaration_of,
    is_builtin,
    is_deviation,
    may_name_a_map,
    place_of,
)

if TYPE_CHECKING:
    import xarray
    from matplotlib.axes import Axes

    from mirrorskin.io.model.calibration import Calibration


_UNKNOWN = Fitted()
_OF_SAME_MAPS = frozenset(FIELDS) - {"declarations"}  # fields that can change without a look at the maps
_CENTRED = 0.01  # largest mean of a piece, over the range of its heights, that counts as 0
_FEW_GAPS = 16  # maximum number of gaps between codes that are searched one by one


class MapContainer:
    """Base class of maps that are displayed: as text, in a notebook, and as figures."""

    __slots__ = ()

    def maps(self) -> dict[str, NDArray[Any]]:
        """Return the existing maps, by name."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}  # type: ignore[arg-type]
        return {
            name: value for name, value in values.items() if isinstance(value, np.ndarray) and value.ndim > 1
        }

    def numbers(self) -> dict[str, float]:
        """Return the existing single numbers, by name."""
        return {}

    def declaration(self, name: str) -> Map:
        """Return the declaration of a map: its unit, meaning, legend and more."""
        return declaration_of(name)

    def plot(self, name: str | None = None, axes: Axes | None = None) -> Axes:
        """Draw a map with its scale, in millimetres if the pixel size is known.

        Parameters
        ----------
        name : str, optional
            Name of the map; by default the height, or the first other map.
        axes : matplotlib.axes.Axes, optional
            Where to draw; by default in a new figure.

        Raises
        ------
        InputError
            There is no such map, or it is not a picture: it has vectors, or several turns.
        ImportError
            Matplotlib is not installed: ``pip install 'mirrorskin[view]'``.

        Examples
        --------
        >>> result = Result(height=np.zeros((2, 3), np.float32), x=np.arange(3.0), y=np.arange(2.0))
        >>> result.plot("height").get_xlabel()
        'x [mm]'
        """
        from mirrorskin.io.model.notebook import plot

        return plot(self, name, axes)

    def __repr__(self) -> str:
        from mirrorskin.io.model.notebook import as_text

        return as_text(self)

    def _repr_html_(self) -> str:
        from mirrorskin.io.model.notebook import as_html

        return as_html(self)


@lru_cache(maxsize=256)
def _ordered(names: tuple[str, ...]) -> tuple[str, ...]:
    """Return names of maps in the order of the table."""
    return tuple(sorted(names, key=place_of))


class Result(MapContainer, Mapping[str, Any]):
    """The maps of a reconstruction: a read-only mapping from names to arrays, with attribute access.

    The table in `mirrorskin.io.model.maps` declares the maps of built-in operations: ``result.height`` is
    an array, or None if that map was not computed. A map that a user's own operation declares with the
    quantity ``"height"`` is also available as ``result.height``. The standard deviation of a map ``x`` is
    ``x_sigma``.

    If a rotation is evaluated turn by turn, all maps have a leading axis, (turns, H, W), and components are
    numbered consecutively over all turns.

    Parameters
    ----------
    maps : mapping of str to ndarray or float, optional
        Maps, series (T,) and numbers by name; those that are None are left out. A function without arguments
        that returns a map is called when the map is first used, and an array on a device is then copied to
        the host.
    x, y : ndarray, (W,) and (H,), float64, optional
        Millimetres of the pixel centres from the picture's centre; y points up the picture.
    process : mapping, optional
        Program, version, date, all parameters, device, source and its hash, for display.
    fitted : Fitted, optional
        What later stages need to know of the maps, such as the tilt of a rotation.
    calibration : Calibration, optional
        The calibration used, for the camera's whole picture.
    declarations : mapping of str to Map, optional
        Declarations of maps that are not in the table, or whose legend or texts differ from it.
    **named
        Maps by name. A map with the name of a method is only accessible as ``result[name]``.

    Raises
    ------
    InputError
        A declaration gives a built-in map another unit, or two maps the same quantity.
    AttributeError
        An attribute is neither a map of this result nor one in the table.

    Examples
    --------
    >>> result = Result(height=np.zeros((2, 3), np.float32))
    >>> result.height.shape, result.normals is None, list(result)
    ((2, 3), True, ['height'])
    >>> wear = Result(wear=np.ones((2, 3)), declarations={"wear": Map("wear", "mm", quantity="height")})
    >>> wear.height is wear["wear"], wear.declaration("wear").unit
    (True, 'mm')
    """

    __slots__ = ("_maps", "_on_device", "calibration", "declarations", "fitted", "process", "x", "y")

    x: Floats | None
    y: Floats | None
    process: Mapping[str, ProcessValue]
    fitted: Fitted
    calibration: Calibration | None
    declarations: Mapping[str, Map]

    def __init__(
        self,
        maps: Mapping[str, Any] | None = None,
        /,
        *,
        x: Floats | None = None,
        y: Floats | None = None,
        process: Mapping[str, ProcessValue] | None = None,
        fitted: Fitted = _UNKNOWN,
        calibration: Calibration | None = None,
        declarations: Mapping[str, Map] | None = None,
        **named: Any,
    ) -> None:
        values = {**(maps or {}), **named}
        kept = {name: values[name] for name in _ordered(tuple(values)) if values[name] is not None}
        declared = {name: declaration for name, declaration in (declarations or {}).items() if name in kept}
        check_declarations(declared)
        for name, value in {
            "_maps": {name: getattr(value, "read", value) for name, value in kept.items()},
            "_on_device": {name: value for name, value in kept.items() if hasattr(value, "read")},
            "x": x,
            "y": y,
            "process": process or {},
            "fitted": fitted,
            "calibration": calibration,
            "declarations": declared,
        }.items():
            object.__setattr__(self, name, value)

    def __getitem__(self, name: str) -> Any:
        value = self._maps[name]
        if callable(value):  # a map that is computed when it is needed
            value = self._maps[name] = value()
        return value

    def __iter__(self) -> Iterator[str]:
        return iter(self._maps)

    def __len__(self) -> int:
        return len(self._maps)

    def __getattr__(self, name: str) -> Any:
        if name in Result.__slots__:  # the constructor failed
            raise AttributeError(name)
        own_name = self.name_of(name)
        if own_name is not None:
            return self[own_name]
        if is_builtin(name):
            return None
        raise AttributeError(unknown_argument("the result", name, [*self._maps], "map"))

    def __setattr__(self, name: str, value: object) -> NoReturn:
        raise AttributeError(f"results are read-only: use result.assign({name}=...)")

    def __reduce__(self) -> tuple[Any, ...]:
        return _restore, (dict(self), {name: getattr(self, name) for name in FIELDS})

    __eq__ = object.__eq__
    __hash__ = object.__hash__

    def name_of(self, quantity: str) -> str | None:
        """Return the name of the map of a quantity: the same name, or one declared with this quantity.

        Examples
        --------
        >>> maps = {"wear": np.ones((2, 3)), "wear_sigma": np.ones((2, 3))}
        >>> worn = Result(maps, declarations={"wear": Map("wear", "mm", quantity="height")})
        >>> worn.name_of("height_sigma")
        'wear_sigma'
        """
        name = self._own_name(quantity)
        return name if name in self._maps else None

    def _own_name(self, quantity: str) -> str:
        """Return the name of a quantity in this result; the quantity itself if it has none."""
        if quantity in self._maps or not self.declarations:
            return quantity
        base = quantity.removesuffix(SIGMA) if is_deviation(quantity) else quantity
        names = (name for name, declaration in self.declarations.items() if declaration.quantity == base)
        return next(names, base) + quantity.removeprefix(base)

    def declaration(self, name: str) -> Map:
        """Return the declaration of a map: its unit, meaning, legend and more."""
        return declaration_of(name, self.declarations)

    def assign(self, maps: Mapping[str, Any] | None = None, /, **changes: Any) -> Result:
        """Return a copy of the result in which maps or fields are replaced; a map set to None is removed.

        Parameters
        ----------
        maps : mapping of str to ndarray or float, optional
            The warnings and notes of a result are added to those of this one.
        **changes
            Maps by name or quantity; ``x``, ``y``, ``process``, ``fitted``, ``calibration`` and
            ``declarations``.
            Declarations are added to those of the result.

        Examples
        --------
        >>> flat = Result(height=np.zeros((2, 3), np.float32), process={"source": "a"})
        >>> list(flat.assign(height=None, slope=np.zeros((2, 3))))
        ['slope']
        """
        if isinstance(maps, Result) and "process" not in changes:
            findings = {name: maps.process[name] for name in ("warnings", "notes") if name in maps.process}
            changes["process"] = merged(self.process, findings)
        values = {**(maps or {}), **changes}
        if values.keys() <= _OF_SAME_MAPS:
            changed = object.__new__(Result)
            for name in Result.__slots__:
                object.__setattr__(changed, name, values.get(name, getattr(self, name)))
            return changed
        fields = {name: values.pop(name, getattr(self, name)) for name in FIELDS}
        fields["declarations"] = {**self.declarations, **(fields["declarations"] or {})}
        replaced = {self._own_name(name): value for name, value in values.items()}
        changed = Result({**self._maps, **replaced}, **fields)
        kept = {name: value for name, value in self._on_device.items() if name not in replaced}
        changed._on_device.update(kept)
        return changed

    def with_fitted(self, **values: Any) -> Result:
        """Return a copy in which values of ``fitted`` are replaced, which ``process`` shows, too.

        Examples
        --------
        >>> turn = Result(zenith=np.zeros((2, 3), np.float32)).with_fitted(tilt=0.05)
        >>> turn.fitted.tilt, turn.process
        (0.05, {'tilt': 0.05})
        """
        return self.assign(fitted=replace(self.fitted, **values), process={**self.process, **values})

    def with_process(self, process: Mapping[str, ProcessValue]) -> Result:
        """Return a copy with another process; what `Fitted` declares of it is in ``fitted``, if unknown."""
        return self.assign(fitted=taken_from(process) | self.fitted, process=process)

    def on_device(self, name: str) -> Any:
        """Return a map as a `mirrorskin.kernels.array.Array`, or None if it is not on a device.

        Maps stay on the device if the frames, or other inputs, are there. They are copied to the host when
        they are first used as ``result.height`` or ``result["height"]``.

        Examples
        --------
        >>> from mirrorskin import engine
        >>> from mirrorskin.kernels.device import open_device
        >>> frames = open_device().from_host("frames", np.ones((8, 2, 3)), np.uint8)
        >>> fit = engine.correlate(frames, np.arange(8) * np.pi / 4)
        >>> fit.on_device("mean").shape, fit.mean[0, 0]
        ((2, 3), np.float32(1.0))
        """
        own_name = self._own_name(name)
        if own_name not in self._maps and not is_builtin(name):
            raise InputError(unknown_argument("the result", name, [*self._maps], "map"))
        return self._on_device.get(own_name)

    def maps(self) -> dict[str, NDArray[Any]]:
        """Return the maps, by name: built-in ones in the order of the table, then others."""
        return self._along("pixels")

    def numbers(self) -> dict[str, float]:
        """Return the single numbers, by name."""
        return {name: float(value) for name, value in self._along("none").items()}

    def series(self) -> dict[str, Floats]:
        """Return the values for each frame, by name."""
        return self._along("frames")

    def _along(self, axes: str) -> dict[str, Any]:
        return {name: self[name] for name in self if self.declaration(name).axes == axes}

    def measured(self) -> NDArray[np.float32]:
        """Return the measured heights, (H, W): NaN where heights are unknown or were filled.

        Examples
        --------
        >>> Result(height=np.zeros((1, 2)), filled=np.array([[0, 1]], np.uint8)).measured()
        array([[ 0., nan]])
        """
        height = self.height
        if height is None:
            raise InputError("the result has no heights")
        filled = self.filled
        return np.asarray(height if filled is None else np.where(np.asarray(filled) > 0, np.nan, height))

    def to_xarray(self) -> xarray.Dataset:
        """Return the result as an `xarray.Dataset`: coordinates ``x`` and ``y`` in mm, units as attributes.

        The process and ``fitted`` become the dataset's attributes. It needs the package xarray:
        ``pip install 'mirrorskin[xarray]'``.

        Examples
        --------
        >>> result = Result(height=np.zeros((2, 3), np.float32), x=np.arange(3.0), y=np.arange(2.0))
        >>> float(result.to_xarray().height.sel(x=1, y=0))
        0.0
        """
        from mirrorskin.io.model.notebook import as_xarray

        return as_xarray(self, map_shape(self))

    @classmethod
    def from_xarray(cls, dataset: xarray.Dataset) -> Result:
        """Return the result converted by ``to_xarray``, without its calibration.

        Examples
        --------
        >>> result = Result(height=np.zeros((2, 3), np.float32), x=np.arange(3.0), y=np.arange(2.0))
        >>> Result.from_xarray(result.to_xarray()).height.shape
        (2, 3)
        """
        from mirrorskin.io.model.notebook import from_xarray

        maps, others = from_xarray(dataset)
        return cls(maps, **others)


def in_pixels(result: Result) -> bool:
    """Return whether heights are in pixels, because slopes were integrated without a pixel size."""
    name = result.name_of("height")
    return name is not None and result.declaration(name).unit == PIXEL


def _restore(maps: Mapping[str, Any], others: Mapping[str, Any]) -> Result:
    return Result(maps, **others)


def result_of(
    maps: Mapping[str, ArrayLike],
    shape: tuple[int, int],
    process: Mapping[str, ProcessValue],
    declarations: Mapping[str, Map] | None = None,
) -> Result:
    """Return a result with maps that are checked against their declarations.

    Parameters
    ----------
    maps : mapping of array_like, (H, W), or of vectors, (H, W, components)
        Built-in and declared maps are converted to the declared type; an array on a device that has this type
        stays there.
    shape : (int, int)
    process : mapping
    declarations : mapping of str to Map, optional

    Raises
    ------
    InputError
        A map has the wrong shape, values that its type cannot represent or that are not numbers, or an
        invalid name.

    Examples
    --------
    >>> result_of({"height": [[0.5, 1.0]], "total": [[7, 8]]}, (1, 2), {})["total"].tolist()
    [[7, 8]]
    """
    declarations = declarations or {}
    if not isinstance(declarations, Mapping):
        raise InputError(f"maps are declared as {declarations!r:.40}. Use a dictionary of names and Map(...)")
    check_maps(declarations, *maps)
    checked = {
        name: _checked_map(name, values, declaration_of(name, declarations), shape)
        for name, values in maps.items()
    }
    return Result(checked, process=process, declarations=declarations)


def check_maps(declarations: Mapping[str, Map], *others: str) -> None:
    """Raise InputError if declarations are invalid, or conflict with other names in one result."""
    check_new(declarations, others)
    for name in (*others, *declarations):
        if not may_name_a_map(name):
            taken = ", ".join(sorted(RESERVED))
            raise InputError(f"a map cannot be called {name!r}: use letters, digits and _, but not {taken}")


def _checked_map(name: str, values: Any, declared: Map, shape: tuple[int, int]) -> Any:
    """Return a map in its declared type; raise InputError if its shape or values do not fit."""
    size = (*shape, len(declared.components)) if declared.components else shape
    if hasattr(values, "read") and (values.shape, values.dtype) == (size, np.dtype(declared.dtype)):
        return values
    values = np.asarray(values)
    if declared.axes != "pixels":
        size = () if declared.axes == "none" else (*values.shape[:1],) or (1,)
    size_of_values = values.shape[1:] if declared.per_frame and values.ndim > len(size) else values.shape
    if values.dtype.kind not in "buif" or size_of_values != size:
        raise InputError(f"map {name} is {values.dtype} {values.shape}: numbers {size} are needed")
    if declared is UNDECLARED:
        return values.astype(np.uint8) if values.dtype.kind == "b" else values
    if declared.is_integer and values.size:
        limits, low, high = np.iinfo(declared.dtype), values.min(), values.max()
        if not (limits.min <= low and high <= limits.max and np.all(values == np.floor(values))):
            raise InputError(
                f"map {name} has values from {low:g} to {high:g}, which {declared.dtype} cannot hold. "
                "Declare another dtype"
            )
    converted = values.astype(declared.dtype, copy=False)
    if declared.codes and values.size:
        code = _unlisted(converted, declared.codes)
        if code is not None:
            legend = ", ".join(f"{number} {text}" for number, text in declared.codes.items())
            raise InputError(
                f"map {name} has the value {code}, which is not in its codes ({legend:.200}). Add it to codes"
            )
    return converted if values.ndim else float(values)


def _unlisted(values: NDArray[Any], codes: Mapping[int, str]) -> int | None:
    """Return a value that is not a code, or None; `numpy.isin` takes 60 ms for a map of 4K."""
    low, high = int(values.min()), int(values.max())
    if low not in codes or high not in codes:
        return low if low not in codes else high
    inner = sum(low <= code <= high for code in codes)
    if high - low + 1 - inner <= _FEW_GAPS:
        gaps = (number for number in range(low, high) if number not in codes)
        return next((number for number in gaps if np.any(values == number)), None)
    others = values[~np.isin(values, [*codes])]
    return int(others[0]) if others.size else None


def absolute_heights(result: Result) -> NDArray[np.float32] | None:
    """Return the heights of a result; pieces with an unknown offset are NaN."""
    height: NDArray[np.float32] | None = result.height
    piece, unknown = result.component, result.offset_unknown
    if height is None or piece is None or unknown is None or not unknown.any():
        return height
    return np.where((piece >= 0) & (unknown[piece] == 0), height, np.float32(np.nan))


def zero_of_relative(result: Result) -> str:
    """Return what is 0 in pieces with an unknown offset, for notes: their mean, or nothing in particular.

    Examples
    --------
    >>> piece = {"component": np.zeros((1, 2), np.int32), "offset_unknown": np.ones(1, np.uint8)}
    >>> zero_of_relative(Result(piece, height=np.float32([[-1, 1]])))
    'their mean is 0'
    >>> zero_of_relative(Result(piece, height=np.float32([[9, 11]])))  # of another program
    'their zero is arbitrary'
    """
    height, piece, unknown = result.height, result.component, result.offset_unknown
    if height is not None and piece is not None and unknown is not None:
        for number in np.flatnonzero(unknown)[:1]:
            heights = height[(piece == number) & np.isfinite(height)].astype(np.float64)
            if heights.size and abs(np.mean(heights)) > _CENTRED * np.ptp(heights):
                return "their zero is arbitrary"
    return "their mean is 0"


def display_order(result: Result) -> list[str]:
    """Return the names of the maps in the order in which a display offers them; it shows the first one.

    Heights come first, then the other built-in maps in the order of the table, then others as declared. Maps
    of codes, standard deviations, and maps that an overview omits come last.

    Examples
    --------
    >>> declared = {"kind": Map(codes={0: "none", 1: "steel"}), "wear": Map(), "gloss": Map()}
    >>> maps = {name: np.zeros((2, 3)) for name in ("gloss", "kind", "wear")}
    >>> display_order(Result(maps, declarations=declared))
    ['wear', 'gloss', 'kind']
    """
    height, names = result.name_of("height"), [*result.declarations]

    def place(name: str) -> tuple[bool, bool, bool, int]:
        declaration, builtin = result.declaration(name), is_builtin(name)
        aside = bool(declaration.codes) or is_deviation(name) or not declaration.overview
        return name != height, aside, not builtin, names.index(name) if name in names and not builtin else 0

    return sorted(result.maps(), key=place)


def map_shape(result: Result) -> tuple[int, ...]:
    """Return the shape of a result's maps: (H, W), or (turns, H, W)."""
    for name in result:
        if result.declaration(name).axes == "pixels":
            return size_of_maps(result.declaration(name), shape_of(result, name))
    return (0, 0)


def shape_of(result: Result, name: str) -> tuple[int, ...]:
    """Return the shape of a map, without copying it from a device."""
    on_device = result.on_device(name)
    return np.shape(result[name]) if on_device is None else tuple(on_device.shape)


def size_of_maps(declared: Map, shape: tuple[int, ...]) -> tuple[int, ...]:
    """Return the shape of the maps of a result, (H, W) or (turns, H, W), from the shape of one map."""
    size = shape[:-1] if declared.components else shape
    return size[-2:] if declared.per_frame else size


def select_turn(result: Result, turn: int | None) -> Result:
    """Return the maps of one turn, or all maps of a result without turns.

    Parameters
    ----------
    result : Result
    turn : int or None
        Number of the turn, from 0; None for a result whose maps combine all turns.

    Returns
    -------
    Result
        Maps (H, W); components are numbered from 0, and the process contains the turn.

    Raises
    ------
    InputError
        The result has turns and none is selected, or it does not have the selected turn.

    Examples
    --------
    >>> turns = Result(zenith=np.zeros((3, 4, 5), np.float32))
    >>> select_turn(turns, 1).zenith.shape
    (4, 5)
    """
    maps, size = result.maps(), map_shape(result)
    if len(size) == 2:
        if turn is not None:
            raise InputError("the maps of this result are not of single turns: leave --turn out")
        return result
    if turn is None or not 0 <= turn < size[0]:
        wrong = "" if turn is None else f", and none of turn {turn}"
        count, last = ("1 turn", "") if size[0] == 1 else (f"{size[0]} turns", f" to {size[0] - 1}")
        raise InputError(f"this result has maps of {count}{wrong}: choose one with --turn 0{last}")
    chosen: dict[str, Any] = {name: values[turn] for name, values in maps.items()}
    if result.component is not None:
        chosen |= _renumbered(result.component[turn], result.offset_unknown)
    return result.assign(chosen, process={**result.process, "turn": turn})


def _renumbered(
    component: NDArray[np.int32], offset_unknown: NDArray[np.uint8] | None
) -> dict[str, NDArray[Any]]:
    """Renumber the components of one turn from 0."""
    components = np.unique(component[component >= 0])
    numbered = np.where(component >= 0, np.searchsorted(components, component), -1).astype(np.int32)
    if offset_unknown is None:
        return {"component": numbered}
    return {"component": numbered, "offset_unknown": offset_unknown[components]}
