"""The device layer: selection of a device, compilation, arrays, launches.

It contains no algorithms. Nothing here uses OpenCL before the first call.
"""

from __future__ import annotations

import functools
import itertools
import json
import logging
import operator
import os
import re
import threading
import time
import warnings
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple, SupportsIndex, TypeAlias, cast
from weakref import WeakSet

import numpy as np
import pyopencl as cl
from numpy.typing import ArrayLike, DTypeLike, NDArray

from mirrorskin.kernels import bitcode, embedded, memory
from mirrorskin.kernels.array import Array, BorrowedBuffer, Operand, can_be_borrowed, device_error
from mirrorskin.kernels.disk_cache import digest, keep, recall
from mirrorskin.kernels.errors import DeviceError, UnknownDeviceError
from mirrorskin.kernels.layout import CPU_LAYOUT, GPU_LAYOUT, Layout
from mirrorskin.kernels.pool import SHARE, BufferPool
from mirrorskin.kernels.profile import Profile
from mirrorskin.kernels.signature import OPTION, Signature, converter, read_signatures
from mirrorskin.kernels.transfer import Transfers
from mirrorskin.kernels.waiting import close_at_exit, waiting

DeviceKind = Literal["gpu", "cpu", "other"]
Choice: TypeAlias = "str | int | Device | Sequence[str | int | Device] | None"
"""A choice of one or several devices; see `open_devices`."""
ALL = "all"
"""The choice of all devices of a kind."""
C_TYPES = {"uint8": "uchar", "uint16": "ushort", "float32": "float"}
"""OpenCL's names of the types of samples; use these for ``dtypes`` of an operation."""

_FOLDER = Path(__file__).parent
_log = logging.getLogger("mirrorskin.kernels")
_opening = threading.Lock()
_numbers = itertools.count()  # of buffers that were arguments of kernels
_UNSET = object()  # no value of an argument
_NUMBERS = frozenset((int, float))
_FIXED = frozenset((int, float, bool, tuple))  # the same object is the same number
_OPERANDS = Array, BorrowedBuffer  # sooner than the union of them
_opened: WeakSet[Device] = WeakSet()
_left_out: set[cl.Device] = set()  # devices that failed and were replaced by others
_KINDS = ("gpu", "cpu", "other")  # in the order of preference
_PLACE = re.compile(r"(\w+\.clh?|<kernel>):(\d+):(\d+):\s*(?:fatal )?(?:error:)?\s*(.+)")
_INSTALL = "install a GPU's OpenCL driver, or on x86-64 Linux 'pip install pocl-binary-distribution'"


@dataclass(frozen=True, slots=True)
class DeviceInfo:
    """Properties of a device that are available without opening it.

    Attributes
    ----------
    name, platform, driver : str
    kind : {"gpu", "cpu", "other"}
    compute_units : int
    memory, max_allocation : int
        Bytes in all, and in one buffer.
    shares_memory : bool
        Whether it works in the host's own memory.
    float64 : bool
        Whether it has double precision.
    note : str
        A note for users; mostly empty.
    """

    name: str
    platform: str
    driver: str
    kind: DeviceKind
    compute_units: int
    memory: int
    max_allocation: int
    shares_memory: bool
    float64: bool
    note: str = ""

    @property
    def title(self) -> str:
        """Platform and name, as accepted by ``--device``."""
        return f"{self.platform}: {self.name}"


def list_devices() -> list[DeviceInfo]:
    """Return OpenCL's devices on this machine, in the order of their numbers in ``open_device``."""
    return [_describe(device) for device in _find()]


def open_device(choice: Choice = None) -> Device:
    """Return an open device; the same choice returns the same object, with its compiled programs.

    Parameters
    ----------
    choice : str, int, Device, list of them, or None
        A number of ``list_devices``, ``"gpu"``, ``"cpu"``, or a part of the platform's and device's
        names. None selects the device in ``PYOPENCL_CTX``; if that is not set, the best GPU that works, then
        the best CPU. Devices with their own memory are preferred, then those with the largest product of
        compute units and memory. Of several devices, the first is opened; see `open_devices`.

    Raises
    ------
    UnknownDeviceError
        No device, or more than one, matches the name.
    DeviceError
        There is no OpenCL device, or it cannot run a kernel; or this process was forked from one that had
        opened a device, and has no driver threads.
    """
    if any(device.process != os.getpid() for device in opened_devices()):
        raise DeviceError(
            "this process was forked from one that had used OpenCL, so it has no driver threads: "
            "start it with multiprocessing.get_context('spawn')"
        )
    choice = _checked(choice)
    if isinstance(choice, Device):
        return choice
    if not isinstance(choice, str | None):
        return open_devices(choice)[0]
    with _opening:
        *others, last = _choose(None if _is_all(choice) else choice)
        for device in others:
            if (opened := _open_if_it_works(device)) is not None:
                return opened
        return _open(last)


def open_devices(choice: Choice = None) -> list[Device]:
    """Open several devices, among which large pictures are divided.

    Parameters
    ----------
    choice : str, Device, sequence of them, or None
        ``"all"`` opens the default device of `open_device`, and then all others of the same kind and platform
        that work. A sequence opens each of its items. Any other choice opens one device.

    Raises
    ------
    UnknownDeviceError, DeviceError
        As of `open_device`; or a sequence is empty.

    Examples
    --------
    >>> open_devices("all")[0] is open_device()
    True
    """
    choice = _checked(choice)
    if not isinstance(choice, str | Device | None):
        opened = [device for name in choice for device in open_devices(name)]
        if not opened:
            raise UnknownDeviceError("no device is given: give at least one, or None for the default one")
        return list(dict.fromkeys(opened))
    first = open_device(choice)
    if not _is_all(choice):
        return [first]
    with _opening:
        alike = [device for device in _best_first(_find()) if _are_alike(_describe(device), first.info)]
        candidates = dict.fromkeys([first, *map(_open_if_it_works, alike)])
    return [device for device in candidates if device is not None]


def are_several(choice: Choice) -> bool:
    """Return whether a choice means several devices, even if there is only one of the kind."""
    choice = _checked(choice)
    if isinstance(choice, str | Device | None):
        return _is_all(choice)
    return len(choice) > 1 or any(map(are_several, choice))


def _checked(choice: Choice) -> str | Device | Sequence[str | int | Device] | None:
    """Return a choice, a number as text; UnknownDeviceError for an invalid one."""
    if isinstance(choice, SupportsIndex) and not isinstance(choice, bool):
        return str(operator.index(choice))
    if isinstance(choice, int | bytes) or not isinstance(choice, str | Device | Sequence | None):
        raise UnknownDeviceError(
            f"device is {choice!r:.60}: give a number of list_devices, a part of a name, 'gpu' or 'cpu'"
        )
    return choice


def opened_devices() -> list[Device]:
    """Return the devices that are open in this process."""
    return list(_opened)


def free_memory() -> None:
    """Release the memory that is cached between calls.

    Memory of arrays and maps is reused once it is no longer referenced, because its pages are already mapped.
    Unused memory of at most `mirrorskin.kernels.memory.KEPT`, 512 MB, is cached. The solver of the last call
    of `mirrorskin.engine.integrate` is cached in addition: about 100 bytes per pixel, for pictures up to
    8 Mpx. For a device with its own memory, at most an eighth of that memory is cached as well, and 48 MB of
    host memory for copies.

    Examples
    --------
    >>> from mirrorskin import engine
    >>> engine.free_memory()
    """
    with _opening:
        for device in opened_devices():
            device.cache.clear()
            device.transfers.free(device)
            device.pool.free()
    memory.free()


class Device:
    """An open device: context, queue, compiled programs and profile.

    Attributes
    ----------
    info : DeviceInfo
    process : int
        The process that opened it, the only one in which it works.
    context, queue, copies
        The OpenCL objects; frames are copied on a queue of their own, concurrently with kernels.
    profile : Profile
        Statistics of the work so far.
    max_allocation : int
        Maximum size of an array, bytes.
    layout : Layout
        How work is divided: for the cores of a CPU, or for the lanes of other devices.
    enqueuing : threading.Lock
        Held only while a command is enqueued, because drivers differ in their thread safety.
    transfers, pool
        Staging buffers and cached buffers, if it has its own memory.
    cache : dict of str to object
        Objects that callers cache between calls, removed while in use.
    """

    info: DeviceInfo
    process: int
    queue: cl.CommandQueue
    copies: cl.CommandQueue
    transfers: Transfers
    pool: BufferPool

    def __init__(self, device: cl.Device) -> None:
        self.info, self.process = _describe(device), os.getpid()
        if _is_pocl(device):
            embedded.verify(device)
        self.profile: Profile = Profile()
        self.max_allocation: int = self.info.max_allocation
        self.layout: Layout = CPU_LAYOUT if self.info.kind == "cpu" else GPU_LAYOUT
        close_at_exit()
        try:
            self.context: cl.Context = cl.Context([device])
            self.queue, self.copies = _queues(self.context)
        except cl.Error as error:
            raise device_error(self, "be used", error) from None
        self._programs: dict[tuple[str | Path, tuple[str, ...]], _Program] = {}
        self._lock = threading.Lock()
        self._launching = threading.Lock()
        self.enqueuing = threading.Lock()
        self.transfers, self.pool = Transfers(), BufferPool(self.info.memory // SHARE)
        self._kernels: dict[tuple[object, ...], Kernel] = {}
        self.cache: dict[str, Any] = {}
        _opened.add(self)
        _log.info("using %s (driver %s)", self.info.title, self.info.driver)

    @property
    def number(self) -> int:
        """Its number in `list_devices`, which distinguishes it from others of the same title."""
        return _find().index(self.context.devices[0])

    def __reduce__(self) -> tuple[Any, ...]:
        """Return how another process opens it: by its title, or by its number if that is ambiguous."""
        titles = [info.title for info in list_devices()]
        title = self.info.title
        return open_device, (title if titles.count(title) == 1 else str(self.number),)

    def array(self, name: str, shape: tuple[int, ...], dtype: DTypeLike, zeroed: bool = True) -> Array:
        """Return a new array on the device.

        Parameters
        ----------
        name : str
            Name in the profile.
        shape : tuple of int
        dtype : dtype
        zeroed : bool
            Whether it is initialised with zeros, which need not be copied.

        Raises
        ------
        DeviceMemoryError
            It does not fit; a smaller one may.
        """
        return Array(self, name, shape, np.dtype(dtype), zeroed)

    def from_host(self, name: str, values: ArrayLike, dtype: DTypeLike = np.float32) -> Array:
        """Return a new array with the given values; without values, it has one undefined element.

        Parameters
        ----------
        name : str
            Name in the profile.
        values : array_like
        dtype : dtype

        Raises
        ------
        DeviceMemoryError
            It does not fit.
        """
        values = np.asarray(values)
        if values.size == 0:
            return self.from_host(name, np.zeros(1), dtype)
        array = self.array(name, values.shape or (1,), dtype, zeroed=False)
        array.write(values)
        return array

    def borrow(self, name: str, values: NDArray[Any]) -> BorrowedBuffer | None:
        """Return another owner's memory for use by kernels in place; the device must share the host's memory.

        None if this is not possible: the values are not in C order, not aligned or not followed by 64
        readable bytes, or the device refuses the memory, such as a mapped file.

        Parameters
        ----------
        name : str
            Name in the profile.
        values : ndarray
            Must not be written to while it is borrowed.
        """
        address = values.ctypes.data
        if not can_be_borrowed(values, address):
            return None
        try:
            return BorrowedBuffer(self, name, values, address)
        except DeviceError as error:
            _log.info("%s cannot use %s in place (%s): it is copied", self.info.title, name, error)
            return None

    def share(self, name: str, values: NDArray[Any] | Array) -> Operand:
        """Return values for use by kernels in place, or a copy; they must not be written to meanwhile.

        An array of the device is returned unchanged.
        """
        if isinstance(values, Array):
            return values
        borrowed = self.borrow(name, values) if self.info.shares_memory else None
        return borrowed or self.from_host(name, values, values.dtype)

    def take_buffer(self, nbytes: int) -> tuple[cl.Buffer, cl.Event | None]:
        """Return memory on the device, and the last command that uses it; `cl.Error` if there is none."""
        kept = self.pool.take(nbytes)
        if kept is not None:
            return kept
        try:
            return self._new_buffer(nbytes), None
        except cl.Error:
            self.pool.free()
            return self._new_buffer(nbytes), None

    def _new_buffer(self, nbytes: int) -> cl.Buffer:
        buffer = cl.Buffer(self.context, cl.mem_flags.READ_WRITE, size=nbytes)
        # Drivers allocate on first use; a migration makes a lack of memory show here.
        undefined = cl.mem_migration_flags.CONTENT_UNDEFINED
        with self.enqueuing:
            event = cl.enqueue_migrate_mem_objects(self.copies, [buffer], flags=undefined)
        self.profile.wait("allocation", event)
        return buffer

    def kernel(self, file: str | Path, name: str, /, **defines: str | int) -> Kernel:
        """Return a kernel, compiled once for each set of defines.

        Parameters
        ----------
        file : str or Path
            A file of ``mirrorskin.kernels`` without its ending, the path of any other, or OpenCL C itself.
        name : str
            The function in it.
        **defines : str or int
            Macros to set; ``TILE`` is set by the device's layout.

        Raises
        ------
        DeviceError
            It does not compile; the message quotes the line.

        Examples
        --------
        >>> device = open_device()
        >>> words = device.from_host("words", np.arange(8), np.uint32)
        >>> copy = device.kernel("limits", "copy_all", LANES=2, WORDS=2, STRIDE=1)
        >>> copy(1, words=words, count=2, moved=32)
        >>> words.read().tolist()
        [0, 1, 2, 3, 0, 1, 2, 3]
        """
        key = file, name, self.layout.tile, self.layout.group, *defines.items()  # hashed sooner than a layout
        kernel = self._kernels.get(key)
        if kernel is None:
            macros = {"TILE": self.layout.tile, **defines}
            options = tuple(f"-D{key}={value}" for key, value in sorted(macros.items()))
            kernel = self._kernels.setdefault(key, self._make_kernel(file, name, options))
        return kernel

    def with_new_queue(self) -> Device:
        """Return the same device with new queues, whose kernels do not wait for earlier kernels.

        Arrays can be used on both; a kernel waits for their ``arrived``.
        """
        other = object.__new__(type(self))
        vars(other).update(vars(self))
        other.queue, other.copies = _queues(self.context)
        other._launching, other._kernels = threading.Lock(), {}
        return other

    def free(self) -> None:
        """Return cached memory to the driver."""
        self.cache.clear()
        try:
            self.transfers.free(self)
            self.pool.free()
        except cl.Error as error:
            raise device_error(self, "release memory", error) from None

    def flush(self) -> None:
        """Submit the enqueued commands to the device, without waiting."""
        try:
            self.queue.flush()
        except cl.Error as error:
            raise device_error(self, "start its work", error) from None

    def finish(self) -> None:
        """Wait until all enqueued commands are done."""
        try:
            with self.profile.waiting_for("queue"):
                self.queue.finish()
        except cl.Error as error:
            raise device_error(self, "finish its work", error) from None

    def _make_kernel(self, file: str | Path, name: str, options: tuple[str, ...]) -> Kernel:
        try:
            program = self._program(file, options)
            if name not in program.signatures:
                if f"_cl_{name}" in program.signatures:  # PoCL renames these functions, and thus the kernel
                    raise DeviceError(
                        f"{name} is a function of OpenCL: rename the kernel, such as to my_{name}"
                    )
                names = ", ".join(program.signatures) or "none"
                raise DeviceError(f"there is no kernel {name} in the source; it has {names}")
            try:
                kernel = cl.Kernel(program.built, name + program.suffix)
            except cl.LogicError:  # the driver's cache of built programs is damaged: add a line to the source
                program = self._program(file, options, "__constant int again = 0;\n")
                kernel = cl.Kernel(program.built, name + program.suffix)
            return Kernel(self, name, kernel, program.signatures[name])
        except OSError as error:
            problem = f"pyopencl cannot write its cache ({error})"
            raise DeviceError(f"{problem}; set XDG_CACHE_HOME to a writable folder") from error
        except cl.Error as error:
            raise device_error(self, f"compile {name}", error) from None

    def _program(self, file: str | Path, options: tuple[str, ...], more: str = "") -> _Program:
        with self._lock:
            if more or (file, options) not in self._programs:
                self._programs[file, options] = self._build(file, options, more)
            return self._programs[file, options]

    def _build(self, file: str | Path, options: tuple[str, ...], more: str) -> _Program:
        written = isinstance(file, str) and "{" in file
        path = Path("text.cl") if written else file if isinstance(file, Path) else source_file(f"{file}.cl")
        try:
            text = str(file) if written else path.read_text(encoding="utf-8")
            source = _with_includes(path.name, text) + more
        except OSError as error:
            raise DeviceError(f"the kernel {path} cannot be read ({error}); reinstall mirrorskin") from None
        start = time.perf_counter()
        try:
            with _without_build_logs, waiting:
                program = self._recall_or_compile(source, ["-cl-std=CL1.2", OPTION, *options])
        except cl.RuntimeError as error:
            cause = embedded.why_no_kernel(_is_pocl(self.context.devices[0]))
            raise DeviceError(
                _explain_build(path, source, str(error), self.info) + (f" ({cause})" if cause else "")
            ) from None
        self.profile.add("compile", path.stem, time.perf_counter() - start)
        return program

    def _recall_or_compile(self, source: str, options: list[str]) -> _Program:
        """Load the program built from this source for this device and driver from the disk, or build it."""
        device = self.context.devices[0]
        driver = device.platform.version, device.name, device.version, device.driver_version
        circumstances = driver, embedded.compiler(), options, source
        record = recall("program", circumstances)
        if record is not None:
            head, _, binary = record.partition(b"\n")
            try:
                return _Program(self._load(binary, options), *json.loads(head))
            except cl.Error as error:
                _log.info("building a program again: %s", error)
        program, kept = self._compile_to_keep(source, options, f"_{digest(circumstances)}")
        if kept is not None:
            keep("program", circumstances, b"\n".join([json.dumps(program[1:]).encode(), kept]))
        return program

    def _compile_to_keep(self, source: str, options: list[str], suffix: str) -> tuple[_Program, bytes | None]:
        """Build a program; also return its binary if the driver has one without further work."""
        device = self.context.devices[0]
        if not _is_pocl(device):
            program = self._compile(source, options)
            return program, cast(list[bytes], program.built.get_info(cl.program_info.BINARIES))[0]
        if bitcode.works_with(device.driver_version):
            try:
                program = self._compile(source, [*options, *bitcode.rename_kernels(source, suffix)])
                if program.signatures and all(name.endswith(suffix) for name in program.signatures):
                    binary = bitcode.find_bitcode(embedded.kernel_cache(), next(iter(program.signatures)))
                    built = program.built if binary is None else self._load(binary, options)
                    named = {
                        name.removesuffix(suffix): signature for name, signature in program.signatures.items()
                    }
                    return _Program(built, suffix, named), binary
            except (cl.Error, OSError) as error:
                _log.info("a program is not cached: %s", error)
        return self._compile(source, options), None

    def _compile(self, source: str, options: list[str]) -> _Program:
        built: cl.Program = cl.Program(self.context, source).build(options, cache_dir=cast(Any, False))
        return _Program(built, "", read_signatures(built))

    def _load(self, binary: bytes, options: list[str]) -> cl.Program:
        loaded: cl.Program = cl.Program(self.context, self.context.devices, [binary]).build(options)
        return loaded


class _WithoutBuildLogs:
    """A context in which pyopencl does not warn of build logs, because some compilers always write one.

    Warning filters belong to the process. `warnings.catch_warnings` in two threads at once may leave the
    filters of one of them behind; here the first thread sets them, and the last one restores them.
    """

    def __init__(self) -> None:
        self._lock, self._threads = threading.Lock(), 0

    def __enter__(self) -> None:
        with self._lock:
            if self._threads == 0:
                self._filters = warnings.catch_warnings()
                self._filters.__enter__()
                warnings.simplefilter("ignore", cl.CompilerWarning)
            self._threads += 1

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._threads -= 1
            if self._threads == 0:
                self._filters.__exit__(None, None, None)


_without_build_logs = _WithoutBuildLogs()


class _Program(NamedTuple):
    """A built program: the suffix of its kernels' names, and their arguments."""

    built: cl.Program
    suffix: str
    signatures: dict[str, Signature]


class Kernel:
    """A compiled kernel, ready to be launched.

    Attributes
    ----------
    name : str
    arguments : tuple of str
        Names of its arguments, in the order of the source.
    group : int
        Work-items of a group.
    """

    def __init__(self, device: Device, name: str, kernel: cl.Kernel, signature: Signature) -> None:
        self.name = name
        self._device = device
        self._kernel = kernel
        self._signature = [(name, converter(name, type_name)) for name, type_name in signature]
        self.arguments: tuple[str, ...] = tuple(name for name, _ in signature)
        self._names = frozenset(self.arguments)
        # Of a number, set_arg takes 12 us: it tries other types first, and C++ throws an exception for each.
        self._set_number = getattr(kernel, "_set_arg_buf", kernel.set_arg)
        self._set = [_UNSET] * len(signature)  # the current value of each argument
        self._given = [_UNSET] * len(signature)  # the number that was converted to it
        self.group: int = _group_of(kernel, device.context.devices[0], device.layout.group)

    def __call__(
        self,
        items: int,
        /,
        *,
        moved: int,
        first_item: int = 0,
        **arguments: Operand | float | Sequence[float] | np.generic | None,
    ) -> None:
        """Enqueue one launch.

        Parameters
        ----------
        items : int
            Work-items needed; more may start, so the kernel checks its bounds.
        moved : int
            Bytes that it must read and write, for the profile.
        first_item : int
            Number of the first item, for work that is done in parts.
        **arguments : Array, BorrowedBuffer, number, sequence of numbers or None
            The kernel's arguments by their names in the source. Numbers are converted to the types there, and
            sequences to vectors; None is a null pointer.

        Raises
        ------
        TypeError
            An argument is missing, unknown, or not a number where one is needed.
        """
        if arguments.keys() != self._names:
            missing = [name for name in self.arguments if name not in arguments]
            unknown = [name for name in arguments if name not in self._names]
            raise TypeError(
                f"{self.name}: missing: {missing}; unknown: {unknown}; it takes {[*self.arguments]}"
            )
        group = self.group
        size = -(-items // group) * group
        try:
            with self._device._launching:  # because a kernel object stores the arguments until it is enqueued
                arrays = self._bind(arguments)
                copies = [array.arrived for array in arrays if array.arrived is not None]
                if copies:
                    complete = cl.command_execution_status.COMPLETE
                    copies = [copy for copy in copies if copy.command_execution_status != complete]
                with self._device.enqueuing:
                    event = cl.enqueue_nd_range_kernel(
                        self._device.queue, self._kernel, (size,), (group,), (first_item,), wait_for=copies
                    )
                for array in arrays:
                    array.last_use = event
            self._device.profile.watch("kernel", self.name, event, moved)
        except cl.Error as error:
            raise device_error(self._device, f"run {self.name}", error) from None

    def _bind(self, arguments: dict[str, Any]) -> list[Operand]:
        """Set the arguments that are not as in the last launch, and return the arrays.

        Setting all of them takes longer than a launch.
        """
        arrays: list[Operand] = []
        last, current = self._given, self._set
        for place, (name, convert) in enumerate(self._signature):
            given = arguments[name]
            if convert is not None:
                # An equal number needs no conversion either, except 0 or -0. An array may have changed.
                before, kind = last[place], type(given)
                if given is before or (
                    kind in _NUMBERS and kind is type(before) and given == before and given
                ):
                    continue
                last[place] = _UNSET
                try:
                    value = convert(given)
                except (TypeError, OverflowError) as error:
                    raise TypeError(f"{self.name}: {name} cannot be {given!r}: {error}") from None
                key = value.tobytes()  # 0 and -0 are equal
                fixed = given if kind in _FIXED else _UNSET
            elif isinstance(given, _OPERANDS):
                arrays.append(given)
                value = given.buffer
                key = value.__dict__.get("number")
                if key is None:  # not id(): a new buffer may have the id of a deleted one
                    key = value.__dict__["number"] = next(_numbers)
            elif given is None:
                value = key = None
            else:
                raise TypeError(f"{self.name}: {name} must be an array of the device, not {given!r}")
            if key != current[place]:
                current[place] = _UNSET
                (self._kernel.set_arg if convert is None else self._set_number)(place, value)
                current[place] = key
            if convert is not None:
                last[place] = fixed
        return arrays


def _group_of(kernel: cl.Kernel, device: cl.Device, desired: int) -> int:
    """Return the size of a work-group: required by the kernel, or the desired one within the limits."""
    ask = cl.kernel_work_group_info
    demanded = int(kernel.get_work_group_info(ask.COMPILE_WORK_GROUP_SIZE, device)[0])
    if demanded:
        return demanded
    allowed = kernel.get_work_group_info(ask.WORK_GROUP_SIZE, device)
    size = min(desired, allowed, device.max_work_item_sizes[0])
    lanes = kernel.get_work_group_info(ask.PREFERRED_WORK_GROUP_SIZE_MULTIPLE, device)
    return size // lanes * lanes or size


def _queues(context: cl.Context) -> list[cl.CommandQueue]:
    """Return a queue for kernels and one for copies."""
    profiling = cl.command_queue_properties.PROFILING_ENABLE
    return [cl.CommandQueue(context, properties=profiling) for _ in range(2)]


@functools.cache  # OpenCL loads its drivers once in a process
def _find() -> list[cl.Device]:
    embedded.prepare()
    try:
        platforms = cl.get_platforms()
    except cl.LogicError:  # raised by the loader if there is no platform
        return []
    devices: list[cl.Device] = []
    for platform in platforms:
        with suppress(cl.RuntimeError):  # a driver without its hardware
            devices += platform.get_devices()
    return devices


@functools.cache
def _describe(device: cl.Device) -> DeviceInfo:
    kind: DeviceKind = "other"
    if device.type & cl.device_type.GPU:
        kind = "gpu"
    elif device.type & cl.device_type.CPU:
        kind = "cpu"
    return DeviceInfo(
        name=device.name.strip(),
        platform=device.platform.name.strip(),
        driver=device.driver_version,
        kind=kind,
        compute_units=device.max_compute_units,
        memory=device.global_mem_size,
        max_allocation=device.max_mem_alloc_size,
        shares_memory=bool(device.host_unified_memory),
        float64="cl_khr_fp64" in device.extensions,
        note=embedded.note(device.driver_version, device.max_compute_units) if _is_pocl(device) else "",
    )


def _is_pocl(device: cl.Device) -> bool:
    return "Portable Computing Language" in device.platform.name


def _choose(choice: str | None) -> list[cl.Device]:
    """Return the devices that match a choice, the best first; the first that works is to be used."""
    devices = _find()
    if not devices:
        reason = embedded.why_no_device()
        raise DeviceError(f"no OpenCL device found: {reason or _INSTALL}")
    if choice is None:
        return _default(devices)
    matches = _matching(choice, devices)
    titles = {_describe(device).title for device in matches}
    if len(titles) == 1 or (titles and choice.casefold().strip() in _KINDS[:2]):
        return _best_first(matches)
    listed = "; ".join(f"{i} = {_describe(d).title}" for i, d in enumerate(devices))
    problem = "no such device" if not matches else "more than one device matches"
    reason = None if matches else embedded.why_no_device()
    raise UnknownDeviceError(
        f"device {choice!r}: {problem}; there is {listed}{f' ({reason})' if reason else ''}"
    )


def _matching(choice: str, devices: list[cl.Device]) -> list[cl.Device]:
    if choice.isdecimal():
        return devices[int(choice) : int(choice) + 1]
    text = choice.casefold().strip()
    if text in _KINDS[:2]:
        return [device for device in devices if _describe(device).kind == text]
    return [device for device in devices if text and text in _describe(device).title.casefold()]


def _default(devices: list[cl.Device]) -> list[cl.Device]:
    if "PYOPENCL_CTX" in os.environ:
        try:
            return [cl.create_some_context(interactive=False).devices[0]]
        except (cl.Error, RuntimeError, ValueError, IndexError) as error:
            named = os.environ["PYOPENCL_CTX"]
            raise UnknownDeviceError(f"PYOPENCL_CTX={named!r} matches no device: {error}") from None
    return _best_first(devices)


def _best_first(devices: list[cl.Device]) -> list[cl.Device]:
    """Sort devices: GPUs before CPUs, own memory before the host's, then by size."""

    def rank(device: cl.Device) -> tuple[int, bool, int]:
        info = _describe(device)
        return _KINDS.index(info.kind), info.shares_memory, -info.compute_units * info.memory

    return sorted(devices, key=rank)


@functools.cache
def _open(device: cl.Device) -> Device:
    return Device(device)


def _open_if_it_works(device: cl.Device) -> Device | None:
    """Return a device, or None, with a warning the first time, if it does not work."""
    try:
        if device not in _left_out:
            return _open(device)
    except DeviceError as error:
        _left_out.add(device)
        _log.warning("%s is left out: %s", _describe(device).title, error)
    return None


def _are_alike(first: DeviceInfo, second: DeviceInfo) -> bool:
    """Return whether devices are of one kind and platform.

    Another platform may list the same hardware again, with results that differ in the last digits.
    """
    return (first.platform, first.kind) == (second.platform, second.kind)


def _is_all(choice: object) -> bool:
    """Return whether a choice is the word for all devices."""
    return isinstance(choice, str) and choice.casefold().strip() == ALL


@functools.cache
def source_file(name: str) -> Path:
    """Return the file of kernels with a name, such as ``onset.cl``, in this folder or one below it."""
    return next(_FOLDER.glob(f"*/{name}"), _FOLDER / name)


def _with_includes(name: str, text: str) -> str:
    """Return kernels with the files that they include, which is the key of the compiled program."""
    lines = [f'#line 1 "{name}"']
    for number, line in enumerate(text.splitlines(), 1):
        included = re.fullmatch(r'#include "(\w+\.clh)"', line)
        lines += [_shared(included[1]), f'#line {number + 1} "{name}"'] if included else [line]
    return "\n".join(lines) + "\n"


def _shared(name: str) -> str:
    """Return the text of a file that kernels include."""
    return _with_includes(name, source_file(name).read_text(encoding="utf-8"))


def _explain_build(path: Path, source: str, log: str, info: DeviceInfo) -> str:
    """Return the first error of a compiler in one line."""
    errors = [line.strip() for line in log.splitlines() if "error" in line.lower()]
    match = next(filter(None, (_PLACE.search(line) for line in errors)), _PLACE.search(log))
    lines = _lines_of(source)
    if match is None:
        return f"{path.name} does not compile on {info.title}: {(errors or [log.strip()])[-1]}"
    number, message = int(match[2]), match[4].strip()
    if match[1] == "<kernel>":  # NVIDIA's compiler counts the lines of the whole source
        file, number, text = lines[min(number, len(lines)) - 1]
    else:
        file, text = match[1], next((text for *place, text in lines if place == [match[1], number]), "")
    quoted = f" `{text.strip()}`" if text else ""
    return f"{file} line {number} does not compile on {info.title}: {message}{quoted}"


def _lines_of(source: str) -> list[tuple[str, int, str]]:
    """Return each line of a source with its includes, with its file and its number there."""
    lines, file, number = [], "", 0
    for line in source.splitlines():
        lines.append((file, number, line))
        number += 1
        if place := re.fullmatch(r'#line (\d+) "(.+)"', line):
            number, file = int(place[1]), place[2]
    return lines
