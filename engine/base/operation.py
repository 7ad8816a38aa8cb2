"""Operations convert frames to maps: their base class."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from copy import copy
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, Self, cast, get_args, overload

import numpy as np
from numpy.typing import DTypeLike, NDArray

from mirrorskin.engine.base.options import Configured, Option, option
from mirrorskin.engine.base.provenance import describe
from mirrorskin.engine.base.tiling import MEMORY_LIMIT
from mirrorskin.io import InputError, Map
from mirrorskin.io.base.arguments import unknown_argument
from mirrorskin.io.base.types import Motion
from mirrorskin.io.model.result import check_maps
from mirrorskin.io.watch.traces import FrameSamples
from mirrorskin.kernels.device import Choice, Device, open_devices

if TYPE_CHECKING:
    from mirrorskin.engine.base.picture import Picture
    from mirrorskin.engine.base.steps import Step
    from mirrorskin.io import Source
    from mirrorskin.io.base.types import ProcessValue

COMPONENTS = {"displacement": (2,), "pose": (4,)}
"""Shapes of positions of a frame that are not single numbers."""
_WEIGHTS = "frame_weights"  # the keyword of push that is not a position of the body
_ANSWERS = "result", "preview"
_SIMPLE_TYPES = ("bool", "float", "int", "str")  # annotations of options, not of maps


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

    device: _DeviceOption = _DeviceOption(**{**vars(_device), "kind": "object", "optional": True})

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


@dataclass(frozen=True)
class Plan:
    """What a run computes: an operation, and the steps that follow it.

    Attributes
    ----------
    operation : Operation
        It is configured for the source.
    steps : sequence of Step
        Applied to the operation's maps after its checks, one after the other.
    process : mapping
        The options, and where their values come from.
    frames : range, optional
        Frames that are used, in steps of 1, by default all; earlier ones are read and dropped.
    omit : sequence of str
        Maps of the operation that the result leaves out.
    stream : Source, optional
        Where the frames are read, if not from the source itself.
    checked : bool
        Whether frames are watched, and the checks of the operation are applied.
    """

    operation: Operation
    steps: Sequence[Step] = ()
    process: Mapping[str, ProcessValue] = field(default_factory=dict)
    frames: range | None = None
    omit: Sequence[str] = ()
    stream: Source | None = None
    checked: bool = True


class Operation(OnDevice):
    """Base of operations, which receive frames one block after the other and return maps.

    An operation is a value: its class and its options. `mirrorskin.engine.Run` and all that is built on it
    (`mirrorskin.engine.run`, commands, live runs) compute with a copy of it, so that an operation can be used
    again, and by several threads at once.

    A subclass declares its options (`mirrorskin.engine.option`) and maps (`mirrorskin.io.Map`) as class
    attributes, and defines ``push`` and ``result``:

    - ``start(shape, dtype)`` is called before the first frame with a frame's (H, W) and the samples' type.
    - ``push(frames, *, travel)`` receives the next frames, (n, H, W). Keywords are what it needs of each
      frame: ``time``, ``travel``, ``phase``, ``displacement``, ``twist``, ``tilt`` or ``pose``; see
      `mirrorskin.io.Block`. The result must not depend on how the frames are divided, and the memory of the
      frames is reused.
    - ``result()`` returns the maps of the frames so far by name, and numbers and texts for ``process``. They
      are copied if frames may follow, which ``ended`` tells.
    - ``passes = 2`` means that the frames are pushed twice; ``start_second_pass()`` is called in between.

    Examples
    --------
    >>> from mirrorskin import engine
    >>> class Brightest(Operation):
    ...     least: float = option(default=0.0, unit="counts", help="counts below which a pixel is 0")
    ...     brightest = Map("largest brightness", "counts")
    ...     def start(self, shape, dtype):
    ...         self.most = np.zeros(shape)
    ...     def push(self, frames):
    ...         np.maximum(self.most, frames.max(axis=0), out=self.most)
    ...     def result(self):
    ...         return {"brightest": np.where(self.most < self.least, 0, self.most)}
    >>> run = engine.Run(Brightest(least=4))
    >>> run.push(np.arange(12.0).reshape(3, 2, 2))
    >>> run.result().brightest.tolist()
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
    checks: ClassVar[tuple[type[Step], ...]] = ()
    """Steps that every run applies to the maps: they compare them with the frames, and correct them."""
    usual_findings: ClassVar[tuple[str, ...]] = ()
    """Kinds of findings about frames that are not reported, because its frames are usually so."""
    for_device: ClassVar[bool] = False
    """Whether ``push`` takes frames that are on a device, for `mirrorskin.engine.base.picture.Picture`."""
    updates_per_second: ClassVar[float] = 15.0
    """Number of useful updates per second of a live run."""
    on_objects: ClassVar[tuple[str, ...]] = ("shape", "dtype", "count", "ended")
    """Attributes of objects: rows and columns of a frame, type of a sample, number of frames so far, and
    whether no more frames follow."""

    _weighted: ClassVar[bool] = False  # whether ``push`` takes weights of frames

    def __init_subclass__(cls, **kwargs: Any) -> None:
        if "maps" in vars(cls):
            raise InputError(
                f"{cls.__name__} assigns maps: declare each map as a class attribute, such as"
                ' wear = io.Map("depth of the wear", "mm")'
            )
        maps: dict[str, Map] = {}
        for base in reversed(cls.__mro__):
            maps |= {name: value for name, value in vars(base).items() if isinstance(value, Map)}
        cls.maps = maps
        _check_class(cls)
        if "push" in vars(cls):
            cls._take_positions(vars(cls)["push"])
        definer = {name: next(base for base in cls.__mro__ if name in vars(base)) for name in _ANSWERS}
        if not issubclass(definer["preview"], definer["result"]):  # a shortcut to what another result returns
            cls.preview = Operation.preview  # type: ignore[method-assign]
        super().__init_subclass__(**kwargs)

    @classmethod
    def _take_positions(cls, push: Callable[..., None]) -> None:
        """Set the positions to the keywords of ``push``; others that it accepts are those of the base."""
        parameters = [*inspect.signature(push).parameters.values()][2:]
        named = {
            part.name: part.default is part.empty for part in parameters if part.kind != part.VAR_KEYWORD
        }
        passes_on = len(named) < len(parameters)
        cls._weighted = _WEIGHTS in named or (passes_on and cls._weighted)
        named.pop(_WEIGHTS, None)
        cls.positions = {**(cls.positions if passes_on else {}), **named}

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self._forget_frames()

    def _forget_frames(self) -> None:
        self.shape: Any = None
        self.dtype: Any = None
        self.count = 0
        self.ended = False
        self._second_pass = False
        self._stay_valid = False  # whether the pushed frames stay as they are while they are referenced
        self._on_device = False  # whether frames are on a device, where the maps then stay
        self._picture: Picture | None = None
        self._positions_so_far: dict[str, list[NDArray[np.float64]]] = {}

    def configured_for(self, source: Source) -> Self:
        """Return the operation with options that are not given set from what a source says of its frames."""
        return self

    def plan(self, source: Source) -> Plan:
        """Return the plan for a source: this operation alone."""
        operation = self.configured_for(source)
        return Plan(operation, process=describe(operation, source))

    def positions_so_far(self, name: str) -> NDArray[np.float64]:
        """Return the positions of the frames so far, (T,) or (T, components), such as those of ``travel``."""
        parts = self._positions_so_far.get(name, [])
        if len(parts) > 1:  # joined once, as this may be called with each push
            parts[:] = [np.concatenate(parts)]
        return parts[0].copy() if parts else np.empty(0)

    @property
    def passes(self) -> int:
        """Number of times that all frames are pushed: 1, or 2."""
        return 1

    @property
    def declarations(self) -> Mapping[str, Map]:
        """Declarations of the maps of this object, where they depend on options."""
        return self.maps

    def start(self, shape: tuple[int, int], dtype: np.dtype[Any]) -> None:
        """Prepare for frames of a shape and type; called before the first."""

    def push(self, *args: Any, **kwargs: Any) -> None:
        """Process the next frames."""
        raise NotImplementedError(f"{type(self).__name__} has no push(frames)")

    def start_second_pass(self) -> None:
        """Prepare for the same frames once more."""

    def after_last_frame(self, samples: FrameSamples) -> Self | None:
        """Return the operation that all frames are to be pushed into again, if an assumption was wrong.

        It is called after the last frame, with samples of all of them.
        """
        return None

    @property
    def corrected_kinds(self) -> tuple[str, ...]:
        """Kinds of findings about frames, such as "flicker", that `apply_correction` removes."""
        return ()

    def apply_correction(self, frames: NDArray[Any], first: int) -> NDArray[Any]:
        """Return corrected frames, float32; the first of them has a number."""
        return frames

    def result(self) -> Any:
        """Return the maps of the frames so far."""
        raise NotImplementedError(f"{type(self).__name__} has no result()")

    def preview(self, seconds: float) -> Mapping[str, Any]:
        """Return the maps that a display shows while the body moves, if possible within some seconds."""
        return self.result()  # type: ignore[no-any-return]

    def idle_work(self, seconds: float) -> None:
        """Do postponed work, for some seconds at most, while no frame is expected."""

    def precompile(self) -> None:
        """Push frames of zeros, so that what is compiled on first use is ready; called on a copy."""
        count = max(1, self.least_frames)
        where = {name: np.zeros((count, *COMPONENTS.get(name, ()))) for name in self.positions}
        self.push(np.zeros((count, *self.shape), self.dtype), **where)
        self.count, self._positions_so_far = count, {name: [values] for name, values in where.items()}
        with suppress(InputError):  # such frames may determine nothing
            self.preview(0.0)

    def _copy_for_run(self) -> Self:
        """Return a copy with a state of its own."""
        copied = object.__new__(type(self))
        state = {name: value for name, value in vars(self).items() if name != "_opened_devices"}
        for name, value in state.items():
            is_state = isinstance(value, list | dict | set | np.ndarray) and name not in self.options
            vars(copied)[name] = copy(value) if is_state else value
        copied._forget_frames()
        return copied

    def _begin(self, shape: tuple[int, ...], dtype: DTypeLike) -> None:
        """Prepare a copy for a run over frames of a shape, (H, W), and type."""
        sample_type = np.dtype(dtype)
        if self.dtypes is not None and sample_type not in self.dtypes:
            *others, last = map(str, self.dtypes)
            raise InputError(f"frames of type {sample_type}: {', '.join(others)} or {last} are needed")
        self.shape, self.dtype = (shape[0], shape[1]), sample_type
        self.start(self.shape, sample_type)

    def _begin_second_pass(self) -> None:
        self.start_second_pass()
        self.count, self._second_pass = 0, True
        self._positions_so_far.clear()

    @property
    def frames_at_once(self) -> int:
        """Number of frames that are read at once: half of the memory limit."""
        rows, columns = self.shape
        return max(1, self.memory_limit // (2 * int(rows * columns * self.dtype.itemsize)))

    @property
    def staging_buffer(self) -> NDArray[Any]:
        """Array in which the next frames may be written before they are pushed, (n, H, W)."""
        if self._picture is not None:
            return self._picture.staging_buffer
        buffer = vars(self).get("_staging_buffer")
        if buffer is None:
            buffer = vars(self)["_staging_buffer"] = np.empty((self.frames_at_once, *self.shape), self.dtype)
        return cast("NDArray[Any]", buffer)


def _check_class(cls: type[Operation]) -> None:
    """Raise InputError if a class has attributes that an operation must not have."""
    attributes, name = vars(cls), cls.__name__
    try:
        check_maps(cls.maps)
    except InputError as error:
        raise InputError(f"{name}: {error}") from None
    for map_name in cls.maps:
        if map_name in cls.options:
            raise InputError(f"{name}: {map_name} is an option and a map. Rename one of them")
        if hasattr(Operation, map_name):
            raise InputError(
                f"{name}: a map cannot be called {map_name!r}, which operations use. Choose another name"
            )
    if unknown := [map_name for map_name in cls.optional_maps if map_name not in cls.maps]:
        raise InputError(f"optional_maps: {unknown_argument(name, unknown[0], [*cls.maps], 'map')}")
    for map_name, kind in inspect.get_annotations(cls).items():
        if isinstance(attributes.get(map_name), Map) and getattr(kind, "__name__", kind) in _SIMPLE_TYPES:
            raise InputError(f"{name}: {map_name} is an option and a map. Rename one of them")
    if isinstance(attributes.get("passes"), int) and attributes["passes"] not in (1, 2):
        raise InputError(
            f"{name}: passes is {attributes['passes']}. Frames are pushed once or twice: use 1 or 2"
        )
    if isinstance(cls.motions, str) or not set(cls.motions) <= {*get_args(Motion)}:
        motions = ", ".join(get_args(Motion))
        raise InputError(f'{name}: motions is {cls.motions!r}. Use a tuple of {motions}, such as ("axial",)')
