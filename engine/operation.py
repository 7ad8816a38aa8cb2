"""Operations convert frames to maps: their base class."""

from __future__ import annotations

import difflib
import inspect
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import cached_property, partial, wraps
from typing import TYPE_CHECKING, Any, ClassVar, ParamSpec, Protocol, Self, cast, get_args, overload

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from mirrorskin.engine.device_arrays import AnyArray, as_any_array, device_of, on_host
from mirrorskin.engine.options import RESERVED, Configured, Option, documented, option, signature_of
from mirrorskin.engine.thread_safe import ThreadSafe
from mirrorskin.engine.tiling import MEMORY_LIMIT
from mirrorskin.io import InputError, Map, Result
from mirrorskin.io.arguments import unknown_argument
from mirrorskin.io.findings import warn
from mirrorskin.io.interpreter_end import computes
from mirrorskin.io.layout import as_series
from mirrorskin.io.maps import SIGMA, UNDECLARED, declaration_of
from mirrorskin.io.positions import step_in_degrees
from mirrorskin.io.result import check_maps, result_of
from mirrorskin.io.samples import convert_samples, frame_dtype
from mirrorskin.io.traces import FrameSamples
from mirrorskin.io.types import Motion
from mirrorskin.kernels.array import Array
from mirrorskin.kernels.device import Choice, Device, open_devices

if TYPE_CHECKING:
    from mirrorskin.io import Source

P = ParamSpec("P")

COMPONENTS = {"displacement": (2,), "pose": (4,)}
"""Shapes of positions of a frame that are not single numbers."""
_NOT_POSITIONS = ("lent", "frame_weights")  # keywords of push that are not positions of the body
_SCALARS = str | int | float | np.generic
_ALIKE = 0.75  # similarity, from 0 to 1, from which on a name seems to be misspelt
_SIMPLE_TYPES = ("bool", "float", "int", "str")  # annotations of options, not of maps
ABOUT_WEIGHTS = "Weight of each frame, such as its inverse variance; 0 for a missing frame. By default 1."
"""Description of ``frame_weights`` of array functions."""


class _DeviceOption(Option):
    """The option for one or several devices: names or open devices, opened on first use.

    The attribute is the first of them, which does all work that is not divided.
    """

    def store(self, holder: object, value: Any) -> None:
        vars(holder)["_device"] = value

    def stored(self, holder: object) -> Any:
        return vars(holder)["_device"]

    @overload
    def __get__(self, holder: None, owner: type) -> Option: ...

    @overload
    def __get__(self, holder: object, owner: type) -> Device: ...

    def __get__(self, holder: object | None, owner: type) -> Any:
        return self if holder is None else cast(OnDevice, holder).devices[0]

    def __set__(self, holder: object, value: Choice) -> None:
        super().__set__(holder, value)


_device: Option = option(
    default=None,
    help='device to compute on, or several devices, each for a band of rows: "all" or a list; see'
    " `mirrorskin.kernels.device.open_devices`",
    python_only=True,
)


class OnDevice(Configured):
    """Base of objects with one or several devices, which are opened on first use."""

    device: _DeviceOption = _DeviceOption(**{**vars(_device), "name": "device"})

    @property
    def devices(self) -> Sequence[Device]:
        """The devices, at least one."""
        if not self.opened_devices:
            vars(self)["_opened_devices"] = open_devices(vars(self)["_device"])
        return self.opened_devices

    @property
    def opened_devices(self) -> Sequence[Device]:
        """The devices, if they have been used."""
        opened: Sequence[Device] = vars(self).get("_opened_devices", ())
        return opened


class Operation(ThreadSafe, OnDevice):
    """Base of operations, which receive frames one block after the other and return maps.

    A subclass declares its options (`mirrorskin.engine.option`) and maps (`mirrorskin.io.Map`) as class
    attributes, and defines ``push`` and ``result``:

    - ``start(shape, dtype)`` is called before the first frame with a frame's (H, W) and the samples' type.
    - ``push(frames, *, travel)`` receives the next frames, (n, H, W). Keywords are what it needs of each
      frame: ``time``, ``travel``, ``phase``, ``displacement``, ``twist``, ``tilt`` or ``pose``; see
      `mirrorskin.io.Block`. The result must not depend on how the frames are divided, and the memory of the
      frames is reused.
    - ``result()`` returns the maps of the frames so far by name, and numbers and texts for ``process``. It
      has no side effects.
    - ``passes = 2`` means that the frames are pushed twice; ``start_second_pass()`` is called in between.

    One thread at a time runs the methods of an object; see `mirrorskin.engine.thread_safe.ThreadSafe`.

    Examples
    --------
    >>> class Brightest(Operation):
    ...     least: float = option(default=0.0, unit="counts", help="counts below which a pixel is 0")
    ...     brightest = Map("largest brightness", "counts")
    ...     def start(self, shape, dtype):
    ...         self.most = np.zeros(shape)
    ...     def push(self, frames):
    ...         np.maximum(self.most, frames.max(axis=0), out=self.most)
    ...     def result(self):
    ...         return {"brightest": np.where(self.most < self.least, 0, self.most)}
    >>> operation = Brightest(least=4)
    >>> operation.push(np.arange(12.0).reshape(3, 2, 2))
    >>> operation.result().brightest.tolist()
    [[8.0, 9.0], [10.0, 11.0]]
    """

    memory_limit: int = option(
        default=MEMORY_LIMIT,
        help="bytes of host memory for frames that are read ahead",
        within=(1, None),
        python_only=True,
    )

    motions: ClassVar[tuple[str, ...]] = ()
    """Motions of recordings that it applies to; none for all."""
    dtypes: ClassVar[tuple[np.dtype[Any], ...] | None] = None
    """Types of samples that it takes; None for all numbers."""
    least_frames: ClassVar[int] = 1
    """Number of frames that a result needs."""
    maps: ClassVar[Mapping[str, Map]] = {}
    """The declared maps by name: the class attributes that are maps."""
    optional_maps: ClassVar[tuple[str, ...]] = ()
    """Names of declared maps that ``result`` does not always return."""
    positions: ClassVar[Mapping[str, bool]] = {}
    """Positions that ``push`` takes for each frame, and whether it needs them; may depend on options."""
    on_device: ClassVar[bool] = False
    """Whether frames are read for the device: ahead, or where kernels can read them without a copy."""
    takes_device_arrays: ClassVar[bool] = False
    """Whether ``push`` accepts a `mirrorskin.kernels.array.Array`; otherwise it gets a NumPy array."""
    long_blocks: ClassVar[bool] = False
    """Whether as many frames as possible should be pushed at once."""
    updates_per_second: ClassVar[float] = 15.0
    """Number of useful updates per second of a live run."""
    _takes_lent: ClassVar[bool] = False
    _starts_again: ClassVar[bool] = False  # whether a subclass prepares more than its base clears
    on_objects: ClassVar[tuple[str, ...]] = ("shape", "dtype", "count")
    """Attributes of objects: rows and columns of a frame, type of a sample, number of frames so far."""

    def __init_subclass__(cls, **kwargs: Any) -> None:
        if "maps" in vars(cls):
            raise InputError(
                f"{cls.__name__} assigns maps: declare each map as a class attribute, such as"
                ' wear = io.Map("depth of the wear", "mm")'
            )
        found: dict[str, Map] = {}
        for base in reversed(cls.__mro__):
            found |= {name: one for name, one in vars(base).items() if isinstance(one, Map)}
        cls.maps = found
        _check_class(cls)
        for name, wrap in _WRAPPERS.items():
            owner = cls.__mro__[mro_index(cls, name)]
            if owner is not cls and issubclass(owner, Operation):
                continue
            if name == "push":
                cls._take_positions(vars(owner)[name])
            setattr(cls, name, wrap(vars(owner)[name]))
        for name in ("finish", "preview"):  # a base's shortcuts to what its own result returns
            if mro_index(cls, "result") < mro_index(cls, name):
                setattr(cls, name, vars(Operation)[name])
        cls._starts_again = mro_index(cls, "start") < mro_index(cls, "clear")
        if "room" in vars(cls):
            cls.room = _checked_room(vars(cls)["room"])  # type: ignore[assignment]
        super().__init_subclass__(**kwargs)

    @classmethod
    def _take_positions(cls, push: Callable[..., None]) -> None:
        """Set the positions to the keywords of ``push``; others that it accepts are those of the base."""
        parameters = [*inspect.signature(push).parameters.values()][2:]
        named = {
            part.name: part.default is part.empty for part in parameters if part.kind != part.VAR_KEYWORD
        }
        passes_on = len(named) < len(parameters)
        cls._takes_lent = "lent" in named or (passes_on and cls._takes_lent)
        positions = {name: needed for name, needed in named.items() if name not in _NOT_POSITIONS}
        cls.positions = {**(cls.positions if passes_on else {}), **positions}

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.shape: Any = None
        self.dtype: Any = None
        self._pushing = self._answering = False
        self._forget()

    def _forget(self) -> None:
        self.count, self._pass = 0, 1
        self._on_device = False  # whether frames were on a device, where the maps then stay
        self._pushed: dict[str, list[NDArray[np.float64]]] = {}

    def configured_for(self, source: Source) -> Self:
        """Return the operation with options that are not given set from what a source says of its frames."""
        return self

    def with_options(self, **options: Any) -> Self:
        """Return an operation of the same class in which some options differ."""
        return type(self)(**{**self.chosen(), **options})

    def pushed(self, name: str) -> NDArray[np.float64]:
        """Return the positions of the frames so far, (T,) or (T, components), such as those of ``travel``."""
        return np.concatenate(self._pushed[name]) if name in self._pushed else np.empty(0)

    @property
    def passes(self) -> int:
        """Number of times that all frames are pushed: 1, or 2."""
        return 1

    @property
    def declarations(self) -> Mapping[str, Map]:
        """Declarations of the maps of this object, where they depend on options."""
        return self.maps

    def begin(self, shape: tuple[int, ...], dtype: DTypeLike) -> None:
        """Prepare for frames of a shape, (H, W), and type, and forget all earlier frames."""
        wanted = np.dtype(dtype)
        if self.dtypes is not None and wanted not in self.dtypes:
            *others, last = map(str, self.dtypes)
            raise InputError(f"frames of type {wanted}: {', '.join(others)} or {last} are needed")
        if (self.shape, self.dtype) == (shape, wanted):
            self.reset()
            return
        vars(self).pop("room", None)
        self.shape, self.dtype = (shape[0], shape[1]), wanted
        self._forget()
        self.start(self.shape, wanted)

    def start(self, shape: tuple[int, int], dtype: np.dtype[Any]) -> None:
        """Prepare for frames of a shape and type; called before the first."""

    def clear(self) -> None:
        """Forget the frames so far, but keep what `start` prepared; by default, start again."""
        self.start(self.shape, self.dtype)

    def reset(self) -> None:
        """Forget the frames so far, and all estimates from them."""
        self._forget()
        if self.dtype is not None and self._starts_again:
            self.start(self.shape, self.dtype)
        elif self.dtype is not None:
            self.clear()

    def push(self, *args: Any, **kwargs: Any) -> None:
        """Process the next frames."""
        raise NotImplementedError(f"{type(self).__name__} has no push(frames)")

    def result(self) -> Any:
        """Return the maps of the frames so far."""
        raise NotImplementedError(f"{type(self).__name__} has no result()")

    def finish(self) -> Result:
        """Return the maps of all frames; only `reset` may follow, so that buffers need not be copied."""
        return cast(Result, self.result())

    def reconsider(self, samples: FrameSamples) -> bool:
        """Return whether all frames must be pushed again, because an assumption about them was wrong.

        It is called after the last frame, with samples of all of them. If it returns True, the operation has
        forgotten the frames, and they are pushed again as returned by `corrected`.
        """
        return False

    @property
    def corrects(self) -> tuple[str, ...]:
        """Kinds of findings about frames, such as "flicker", that `corrected` removes."""
        return ()

    def corrected(self, frames: NDArray[Any], first: int) -> NDArray[Any]:
        """Return frames in the operation's type, with its corrections; the first of them has a number."""
        return frames

    def preview(self, seconds: float) -> Mapping[str, Any]:
        """Return the maps that a display shows while the body moves, if possible within some seconds."""
        return self.result()  # type: ignore[no-any-return]

    def spare(self, seconds: float) -> None:
        """Do postponed work, for some seconds at most, while no frame is expected."""

    def warm(self) -> None:
        """Push a frame of zeros and forget it, so that what is compiled on first use is ready."""
        where = {name: np.zeros((1, *COMPONENTS.get(name, ()))) for name in self.positions}
        self.push(np.zeros((1, *self.shape), self.dtype), **where)
        with suppress(InputError):
            self.preview(0.0)
        self.reset()

    def start_second_pass(self) -> None:
        """Prepare for the same frames once more."""

    def next_pass(self) -> None:
        """Begin the second pass, after all frames have been pushed once."""
        self.check_count()
        self.start_second_pass()
        expected = self.count
        self._forget()
        self._pass, self._expected = 2, expected

    @cached_property
    def room(self) -> NDArray[Any]:
        """Array in which the next frames may be written before they are pushed, (n, H, W)."""
        _check_started(self)
        rows, columns = self.shape
        at_once = max(1, self.memory_limit // (2 * rows * columns * self.dtype.itemsize))
        return np.empty((at_once, rows, columns), self.dtype)

    def check_count(self) -> None:
        """Raise InputError if fewer frames have been pushed than a result needs."""
        if self.count < self.least_frames:
            frames = "1 frame" if self.least_frames == 1 else f"{self.least_frames} frames"
            pushed = f"{self.count} has been" if self.count == 1 else f"{self.count or 'none'} have been"
            raise InputError(f"{type(self).__name__} needs at least {frames}; {pushed} pushed so far")

    def _as_frames(self, frames: Any, first: int) -> AnyArray:
        """Return frames as an array in a type that the operation takes; ``first``: number of the first."""
        array = as_any_array("frames", frames)
        if not self.takes_device_arrays:
            array = on_host(array)
        elif isinstance(array, Array):
            self.use_device_of(array)
        if self.dtypes is not None and array.dtype not in self.dtypes and isinstance(array, np.ndarray):
            array = convert_samples(array, frame_dtype(array.dtype, "frames"), "frames", first)
        return array

    def _begin_with(self, frames: Any) -> AnyArray:
        """Forget earlier frames, prepare for these, (n, H, W), and return them in the operation's type."""
        array = self._as_frames(frames, 0)
        if array.ndim == 2 and 0 not in array.shape:
            raise InputError(f"frames are {array.dtype} {array.shape}: for a single frame, pass frame[None]")
        if array.ndim != 3 or 0 in array.shape or array.dtype.kind not in "uif":
            raise InputError(f"frames are {array.dtype} {array.shape}: numbers (n, H, W) are needed")
        self.begin(array.shape[1:], array.dtype)
        return array

    def _check_frames(self, frames: Any) -> AnyArray:
        """Return frames as an array that fits to earlier ones."""
        array = self._begin_with(frames) if self.dtype is None else self._as_frames(frames, self.count)
        self._on_device = isinstance(array, Array)
        if array.dtype != self.dtype or array.shape[1:] != self.shape or len(array) == 0:
            expected = f"{self.dtype} (n, {self.shape[0]}, {self.shape[1]})"
            raise InputError(f"frames are {array.dtype} {array.shape}: {expected} is needed")
        return array

    def use_device_of(self, frames: Array) -> None:
        """Compute on the device of frames, if none was chosen; InputError if they are on another one."""
        vars(self)["_device"] = device_of(self.opened_devices or vars(self)["_device"], frames)

    def _check_positions(self, count: int, given: Mapping[str, Any]) -> None:
        """Raise InputError unless there is a position of each frame."""
        for name, needed in self.positions.items():
            values = given.get(name)
            if values is None and needed:
                raise InputError(f"{name} is missing: {type(self).__name__} needs it of each frame")
            if values is not None and np.shape(values)[:1] != (count,):
                frames = "1 frame" if count == 1 else f"{count} frames"
                last = np.shape(values)[:1] == (self.shape[1],)
                axes = "; if the frames are the last axis, use numpy.moveaxis(frames, -1, 0)" if last else ""
                raise InputError(
                    f"{name} has shape {np.shape(values)} for {frames}: give one of each frame{axes}"
                )
        if foreign := given.keys() - {*self.positions, *_NOT_POSITIONS}:
            names = ", ".join(sorted(foreign))
            taken = ", ".join(self.positions) or "frames only"
            raise InputError(f"{type(self).__name__} does not take {names}. It takes {taken}")


def _checked_push(method: Callable[..., None]) -> Callable[..., None]:
    """Return a method ``push`` that checks its arguments, and counts frames."""

    @wraps(method)
    def push(self: Operation, frames: Any, **given: Any) -> None:
        if self._pushing:  # by the push of a subclass
            method(self, frames, **given)
            return
        array = self._check_frames(frames)
        for name in given.keys() & {*self.positions, "frame_weights"}:
            given[name] = None if given[name] is None else as_series(name, given[name])
        self._check_positions(len(array), given)
        if not self._takes_lent:
            given.pop("lent", None)
        self._pushing = True
        try:
            method(self, array, **given)
        finally:
            self._pushing = False
        self.count += len(array)
        for name, values in given.items():
            if name in self.positions and values is not None:
                self._pushed.setdefault(name, []).append(np.array(values, np.float64))

    return push


def _checked_result(method_name: str, method: Callable[..., Any]) -> Callable[..., Result]:
    """Return a method ``result`` or ``finish`` whose maps are checked against their declarations."""

    @wraps(method)
    def result(self: Operation) -> Result:
        name = type(self).__name__
        self.check_count()
        if self.passes == 2 and (self._pass == 1 or self.count != self._expected):
            raise InputError(f"{name} needs all frames twice, with next_pass() in between")
        outermost, self._answering = not self._answering, True
        try:
            returned = method(self)
        finally:
            self._answering = not outermost
        if not isinstance(returned, Mapping):
            raise InputError(f"{name}.result() returns a {type(returned).__name__}. Return maps by name")
        if outermost:  # to what a base returns, a subclass may add maps
            _check_names(self, returned, method_name)
        return returned if isinstance(returned, Result) else _as_result(self, returned)

    return result


def _as_result(operation: Operation, returned: Mapping[str, Any]) -> Result:
    """Return what a method ``result`` returned by name: maps, and numbers and texts for the process."""
    kind, declared = type(operation).__name__, operation.declarations
    process, maps = dict[str, Any](), dict[str, Any]()
    for name, value in returned.items():
        option_value = operation.options[name].stored(operation) if name in operation.options else None
        if name in RESERVED or (option_value is not None and not _is_rounded(value, option_value)):
            raise InputError(f"{kind}.result() returns {name}, which has a meaning already. Rename it")
        if not isinstance(value, _SCALARS) or declaration_of(name, declared).axes == "none":
            maps[name] = value
        elif option_value is not None:
            process[name] = option_value
        else:
            process[name] = value.item() if isinstance(value, np.generic) else value
    if not maps:
        raise InputError(f"{kind}.result() returns no map: return at least one, (H, W)")
    try:
        return result_of(maps, operation.shape, process, declared)
    except InputError as error:
        raise InputError(f"{kind}.result(): {error}") from error


def _is_rounded(value: Any, option_value: Any) -> bool:
    """Return whether a value equals that of an option, or its rounding to float32."""
    left, right = np.asarray(value), np.asarray(option_value)
    if left.dtype.kind in "uif" and right.dtype.kind in "uif":
        left, right = left.astype(np.float32), right.astype(np.float32)
    return (right.ndim == 0 or right.shape == left.shape) and bool(np.all(left == right))


def _check_names(operation: Operation, returned: Mapping[str, Any], method: str) -> None:
    """Raise InputError if a declared map is missing, or a name looks like that of a missing one.

    A method that overrides another one may return fewer maps than those declared for the other.
    """
    kind, declared = type(operation), operation.declarations
    names = set(returned)  # to look for a name in the result would copy the map from its device
    where = f"{kind.__name__}.result()"
    owner, overridden = [base for base in kind.__mro__ if method in vars(base)][:2]
    last = overridden if overridden is Operation else owner
    classes = kind.__mro__[: kind.__mro__.index(last) + 1]
    promised = {name for base in classes for name, value in vars(base).items() if isinstance(value, Map)}
    missing = [name for name in declared if name not in names]
    required = [name for name in missing if name in promised and name not in kind.optional_maps]
    for name in returned:
        quantity = name.removesuffix(SIGMA)
        deviates = quantity != name
        if declaration_of(name, declared) is not UNDECLARED or (deviates and quantity in names):
            continue
        possible = [f"{other}{SIGMA}" for other in declared] if deviates else missing
        if not isinstance(returned, Result) and isinstance(returned[name], _SCALARS):
            possible = required
        if close := difflib.get_close_matches(name, possible, n=1, cutoff=_ALIKE):
            raise InputError(f"{where} returns {name}, which is not declared: did you mean {close[0]}?")
    if required:
        raise InputError(
            f"{where} does not return {' and '.join(required)}, which its class declares. Return each"
            " declared map, or list those that may be missing in optional_maps"
        )


def _check_class(cls: type[Operation]) -> None:
    """Raise InputError if a class has attributes that an operation must not have."""
    own, name = vars(cls), cls.__name__
    try:
        check_maps(cls.maps)
    except InputError as error:
        raise InputError(f"{name}: {error}") from error
    for one in cls.maps:
        if one in cls.options:
            raise InputError(f"{name}: {one} is an option and a map. Rename one of them")
        if hasattr(Operation, one):
            raise InputError(
                f"{name}: a map cannot be called {one!r}, which operations use. Choose another name"
            )
    if unknown := [one for one in cls.optional_maps if one not in cls.maps]:
        raise InputError(f"{name}: optional_maps has {unknown[0]}, which is not declared as a map")
    for one, kind in inspect.get_annotations(cls).items():
        if isinstance(own.get(one), Map) and getattr(kind, "__name__", kind) in _SIMPLE_TYPES:
            raise InputError(f"{name}: {one} is an option and a map. Rename one of them")
    if isinstance(own.get("passes"), int) and own["passes"] not in (1, 2):
        raise InputError(f"{name}: passes is {own['passes']}. Frames are pushed once or twice: use 1 or 2")
    if isinstance(cls.motions, str) or not set(cls.motions) <= {*get_args(Motion)}:
        motions = ", ".join(get_args(Motion))
        raise InputError(f'{name}: motions is {cls.motions!r}. Use a tuple of {motions}, such as ("axial",)')


def mro_index(cls: type, name: str) -> int:
    """Return the index in the method resolution order of the first class that defines a name."""
    return next(index for index, base in enumerate(cls.__mro__) if name in vars(base))


def _check_started(operation: Operation) -> None:
    """Raise InputError if the shape of the frames is unknown."""
    if operation.shape is None:
        name = type(operation).__name__
        raise InputError(f"{name} does not know the shape of the frames yet. Call begin(shape, dtype) first")


def _checked_room(member: property | cached_property[Any]) -> property:
    """Return the property ``room`` of an operation, which needs the shape of the frames."""

    def room(self: Operation) -> NDArray[Any]:
        _check_started(self)
        return cast("NDArray[Any]", member.__get__(self, type(self)))

    return property(room, doc=member.__doc__)


_WRAPPERS: Mapping[str, Callable[[Any], Any]] = {
    "push": _checked_push,
    "result": partial(_checked_result, "result"),
    "finish": partial(_checked_result, "finish"),
}


def warn_of_degrees(name: str, phase: ArrayLike | None) -> None:
    """Issue a warning if phases of frames, (T,), radians, seem to be degrees; ``name`` begins it."""
    step = 0.0 if phase is None else step_in_degrees(np.asarray(phase))
    if step:
        text = f"phase is in radians; yours steps by {step:.4g} rad: are they degrees?"
        warn(name, {"warnings": text})


Compute = Callable[[Any, dict[str, Any], dict[str, Any]], Result]
"""Function of frames, positions by name and options by name that returns the maps."""


def limit_of(frames: AnyArray) -> int:
    """Return the memory limit of an operation on a stack in memory, bytes."""
    return max(1, min(MEMORY_LIMIT, 2 * int(frames.nbytes)))


def apply(
    operation: Operation, frames: Any, progress: Callable[[int], None] | None = None, **given: Any
) -> Result:
    """Return the maps of a stack that fits in memory; the operation forgets all earlier frames."""

    def push_all() -> None:
        for number in range(operation.passes):
            if number:
                operation.next_pass()
            operation.push(frames, lent=True, **given)
            if progress:
                progress(len(frames))

    frames = operation._begin_with(frames)
    push_all()
    if isinstance(frames, np.ndarray) and operation.reconsider(FrameSamples.of(frames)):
        frames = operation.corrected(frames, 0)
        push_all()
    return operation.finish()


class TravelFunction(Protocol[P]):
    """A function of frames, (T, H, W), their travel, (T,) mm, and options."""

    def __call__(self, frames: ArrayLike, travel: ArrayLike, *args: P.args, **options: P.kwargs) -> Result:
        """Return the maps."""


class PhaseFunction(Protocol[P]):
    """A function of frames, (T, H, W), their phase, (T,) radians, their weights, (T,), and options."""

    def __call__(
        self,
        frames: ArrayLike,
        phase: ArrayLike,
        frame_weights: ArrayLike | None = None,
        *args: P.args,
        **options: P.kwargs,
    ) -> Result:
        """Return the maps."""


def travel_function(
    operation: Callable[P, Operation], name: str, text: str, about_travel: str, compute: Compute | None = None
) -> TravelFunction[P]:
    """Return the function on arrays of an operation whose ``push`` takes ``travel``; see `array_function`."""
    function = array_function(cast(Any, operation), name, text, {"travel": about_travel}, compute=compute)
    return cast(TravelFunction[P], function)


class OptionalPhaseFunction(Protocol[P]):
    """A function of frames, (T, H, W), their phase, (T,) radians, if it is needed, and options."""

    def __call__(
        self, frames: ArrayLike, phase: ArrayLike | None = None, *args: P.args, **options: P.kwargs
    ) -> Result:
        """Return the maps."""


def phase_function(
    operation: Callable[P, Operation], name: str, text: str, about_phase: str
) -> PhaseFunction[P]:
    """Return the function on arrays of an operation whose ``push`` takes ``phase`` and ``frame_weights``."""
    function = array_function(
        cast(Any, operation), name, text, {"phase": about_phase}, {"frame_weights": ABOUT_WEIGHTS}
    )
    return cast(PhaseFunction[P], function)


def optional_phase_function(
    operation: Callable[P, Operation], name: str, text: str, about_phase: str
) -> OptionalPhaseFunction[P]:
    """Return the function on arrays of an operation whose ``push`` takes ``phase`` if options ask for it."""
    function = array_function(cast(Any, operation), name, text, {}, {"phase": about_phase})
    return cast(OptionalPhaseFunction[P], function)


def array_function(
    operation: type[Operation],
    name: str,
    text: str,
    positions: Mapping[str, str],
    optional: Mapping[str, str] | None = None,
    compute: Compute | None = None,
) -> Callable[..., Result]:
    """Return a function of frames, positions and options, with signature and docstring.

    Parameters
    ----------
    operation : type
        Operation that has the options.
    name : str
    text : str
        Docstring without the section "Parameters".
    positions, optional : mapping of str
        Names of what is needed of each frame, or may be given, with descriptions.
    compute : callable, optional
        Receives frames, positions and options, and returns the result; by default that of the operation.
    """
    optional = optional or {}
    options = {one: declared for one, declared in operation.options.items() if one != "memory_limit"}
    signature = signature_of(options, ("frames", *positions), tuple(optional))

    def run(frames: NDArray[Any], where: dict[str, Any], given: dict[str, Any]) -> Result:
        given_positions = {one: values for one, values in where.items() if values is not None}
        return apply(operation(memory_limit=limit_of(frames), **given), frames, **given_positions)

    @computes
    def function(*args: Any, **kwargs: Any) -> Result:
        if unknown := next((one for one in kwargs if one not in signature.parameters), ""):
            raise TypeError(unknown_argument(f"{name}()", unknown, [*signature.parameters]))
        given = signature.bind(*args, **kwargs).arguments
        frames = as_any_array("frames", given.pop("frames"))
        where = {one: given.pop(one, None) for one in (*positions, *optional)}
        where = {one: None if values is None else as_series(one, values) for one, values in where.items()}
        warn_of_degrees(name, where.get("phase"))
        return (compute or run)(frames, where, given)

    before = "frames : array_like or device array, (T, H, W)\n    Raw counts.\n"
    for names, end in ((positions, ""), (optional, ", optional")):
        before += "".join(f"{one} : array_like, (T,){end}\n    {about}\n" for one, about in names.items())
    function.__name__ = function.__qualname__ = name
    function.__module__ = operation.__module__
    function.__doc__ = documented(text, options, before)
    function.__signature__ = signature  # type: ignore[attr-defined]
    return function
