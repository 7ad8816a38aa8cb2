"""Videos, decoded by FFmpeg through PyAV."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.base.content import identified
from mirrorskin.io.base.findings import Finding
from mirrorskin.io.base.opencv import is_coloured, look_up, rows_of, to_grey
from mirrorskin.io.base.selection import Span
from mirrorskin.io.base.system import MAX_UNPACKED_BYTES, check_regular, check_unpacked
from mirrorskin.io.base.text import one_line
from mirrorskin.io.base.types import Floats, InputError
from mirrorskin.io.formats.colour_table import ColourTable
from mirrorskin.io.formats.loss import READERS, chroma_of_h264, loss_of
from mirrorskin.io.formats.registry import Format
from mirrorskin.io.model.frames import CONVERTED_COLOUR, WholeFrames, lossy, lost_frames, maybe_lossy

if TYPE_CHECKING:
    from av.container import InputContainer
    from av.video.frame import VideoFrame
    from av.video.stream import VideoStream

VIDEO = Format(
    name="video",
    suffixes=(
        ".avi",
        ".mp4",
        ".mov",
        ".m4v",
        ".mkv",
        ".webm",
        ".mpg",
        ".mpeg",
        ".ts",
        ".wmv",
        ".asf",
        ".flv",
        ".ogv",
        ".ogg",
        ".nut",
        ".3gp",
        ".3g2",
        ".mj2",
        ".y4m",
    ),
    source="a video (AVI, MP4, MOV, MKV)",
    reader="VideoFrames",
    has_positions=False,
    takes=("dataset", "channel", "memory_limit"),
    extra="video",
)


# Playlists are not opened, because they name other files and addresses. Edit lists are ignored: all frames in
# the file are read, and the frames that players omit are counted.
_OPTIONS = {
    "protocol_whitelist": "file",
    "format_whitelist": "avi,mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,mpeg,mpegts,asf,flv,ogg,nut,yuv4mpegpipe",
}
_DECODER_FRAMES = 10  # frames that a decoder and its packets take at the same time, measured with H.264
_CONVERTED_BYTES = 6  # bytes per pixel of the colours, luma and frame made of one
# It applies from the opening of the file, to frames of at least one byte per pixel.
_LIMIT = {"max_pixels": str(MAX_UNPACKED_BYTES // (_DECODER_FRAMES + _CONVERTED_BYTES))}
_ALL_FRAMES = {"ignore_editlist": "1"}
_INSTALL = "videos need mirrorskin[video]: pip install 'mirrorskin[video]'"
_KEPT = 256_000_000  # bytes of decoded frames that are kept in memory, by default
_HEAD_BYTES = 1 << 16  # bytes of a packet in which its headers are
_QUOTED_MAX = 100  # characters quoted of an error message
_DEEP = re.compile(r"(gray|yuva?4\d\dp)(9|10|12|14|16)(le|be)")  # formats whose first plane is the luma
_RANGES = {1: "limited", 2: "full"}  # AVCOL_RANGE_MPEG and AVCOL_RANGE_JPEG
_DARK, _BRIGHT = 16, 235  # ends of the limited range
_BEYOND = 1e-3  # share of samples beyond the limited range, from which the range is full; a codec overshoots
_SPS = re.compile(rb"\x67|\x27|\x47")  # head of a sequence parameter set of H.264
_SPS_BYTES = 12  # of such a set, after its head, that contain the chroma format
_MOST_LOST = 1 << 30  # maximum number of frames lost between two frames
_GREY_COUNTS = 8  # largest difference between the colours of a grey frame, after a lossy compression
# Table that converts 8-bit luma of limited range, 16 to 235, to full range.
_FULL = np.clip(np.rint((np.arange(256) - 16) * (255 / 219)), 0, 255).astype(np.uint8)


def load_av(path: Path) -> ModuleType:
    """Return PyAV; InputError if it is not installed."""
    try:
        import av
    except ImportError:
        raise InputError(f"{path}: {_INSTALL}") from None
    return av


class VideoFrames(WholeFrames):
    """The frames of a video as grey samples of the displayed picture.

    8-bit luma of limited range, 16 to 235, is stretched to full range, 0 to 255. If the file does not
    state the range, it is full for grey video, and limited for the luma of colours; and it is full if a
    thousandth of the samples is beyond the limited range, whatever is stated. Samples of more bits are
    returned as stored, in uint16. Colours of RGB become grey as in ``to_grey``. The rotation stored in
    the file is applied. ``time`` is the time stamp of each frame relative to the first; if these do not
    increase, it is computed from the frame rate. In an AVI, whose rate is constant, a jump of the time
    stamps is a gap of lost frames.

    The file is decoded when it is opened: containers do not state the number of their frames reliably.
    Frames that fit into ``memory_limit`` are kept; otherwise they are decoded again.

    Parameters
    ----------
    path : Path
    dataset : str, optional
        Number of the video stream, if there are several.
    channel : int, optional
        Colour to read: 0 red, 1 green, 2 blue; by default luma.
    memory_limit : int, optional
        Bytes.
    """

    def __init__(
        self,
        path: Path,
        dataset: str | None = None,
        channel: int | None = None,
        memory_limit: int | None = None,
    ) -> None:
        check_regular(path, "name a video, a TIFF or a folder of pictures")
        self._path, self.files, self._wanted, self._channel = path, (path,), dataset, channel
        self._next, self._kept, self._closed = 0, list[NDArray[Any]](), False
        self._container: InputContainer | None = None
        self._head = b""  # start of the first packet
        self._is_limited = False
        try:
            self._survey(memory_limit or _KEPT)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close the file, and release the frames."""
        if self._container is not None:
            self._container.close()
        self._container, self._kept, self._closed = None, [], True

    def fetch(self, spans: Sequence[Span], out: NDArray[Any]) -> None:
        """Copy or decode frames."""
        if not self._kept:
            super().fetch(spans, out)
            return
        (start, stop), *part = spans
        region = tuple(slice(*span) for span in part)
        for target, frame in zip(out, self._kept[start:stop], strict=True):
            target[...] = frame[region]

    def frames(self, start: int, stop: int) -> Iterator[tuple[str, NDArray[Any]]]:
        """Decode frames, from the current one on or from the first."""
        if self._closed:
            raise ValueError("(it is closed)")
        if self._container is None or start < self._next:
            self._reopen()
        for number in range(self._next, stop):
            frame = next(self._decoded, None)
            name = f"{self._path} (frame {number})"
            if frame is None:
                raise InputError(f"{name} cannot be decoded any more: was it changed?")
            self._next = number + 1
            if number >= start:
                yield name, self._samples(frame, name)

    def _reopen(self) -> None:
        if self._container is not None:
            self._container.close()
        self._container, stream = self._open(_ALL_FRAMES)
        self._decoded, self._next = self._decode(self._container, stream), 0

    def _open(self, options: dict[str, str]) -> tuple[InputContainer, VideoStream]:
        av = load_av(self._path)
        try:
            place = str(self._path.absolute())
            arguments = _OPTIONS | options | _LIMIT
            container = av.open(place, "r", options=arguments, metadata_errors="replace")
        except Exception as error:  # of many types
            raise self._not_a_video() from error
        try:
            stream = self._choose(container)
            context = stream.codec_context
            if context is None:
                raise self._not_a_video()
            pixel = _DECODER_FRAMES * (context.format.padded_bits_per_pixel / 8 if context.format else 4)
            size = int(context.width * context.height * (pixel + _CONVERTED_BYTES))
            check_unpacked(size, f"{self._path}: a frame", "encode it in a smaller size")
            context.options = _LIMIT
        except BaseException:
            container.close()
            raise
        return container, stream

    def _not_a_video(self) -> InputError:
        kind = identified(self._path)
        wrong = f"it is {kind}" if kind else "it is damaged, cut off, or not a video"
        return InputError(f"{self._path} cannot be opened as a video: {wrong}")

    def _choose(self, container: InputContainer) -> VideoStream:
        """Return the requested stream of frames, or the only one."""
        streams = [
            stream
            for stream in container.streams.video
            if not stream.disposition & stream.disposition.attached_pic
        ]
        if not streams:
            raise self._not_a_video()
        number = self._wanted
        if number is None and len(streams) == 1:
            return streams[0]
        if number is not None and number.isdecimal() and int(number) < len(streams):
            return streams[int(number)]
        wrong = "choose one with --dataset" if number is None else f"{number!r} is not one of them"
        raise InputError(f"{self._path} contains {len(streams)} streams of frames, numbered from 0: {wrong}")

    def _decode(self, container: InputContainer, stream: VideoStream) -> Iterator[VideoFrame]:
        """Yield the frames; InputError where one cannot be decoded."""
        number = 0
        with self._errors_named(lambda: number):
            for packet in container.demux(stream):
                if packet.is_corrupt:
                    raise ValueError("it is incomplete")
                self._head = self._head or bytes(packet)[:_HEAD_BYTES]
                for frame in packet.decode():
                    if frame.is_corrupt:
                        raise ValueError("it is damaged")
                    yield frame
                    number += 1

    @contextmanager
    def _errors_named(self, number: Any) -> Iterator[None]:
        """Convert errors of the decoder to a one-line error that names the frame."""
        try:
            yield
        except (InputError, MemoryError):
            raise
        except Exception as error:  # of many types
            text = one_line(getattr(error, "strerror", None) or error)[:_QUOTED_MAX]
            raise InputError(
                f"{self._path}: frame {number()} cannot be decoded ({text}): the video is damaged or cut off;"
                " copy it again, or encode anew what there is"
            ) from error

    def _survey(self, limit: int) -> None:
        """Decode all frames once: their number, size, type and times; keep those that fit into memory."""
        self._container, stream = self._open(_ALL_FRAMES)
        self.how = f"by FFmpeg ({stream.codec.canonical_name}, {stream.codec_context.pix_fmt})"
        stamps, ends, size, name = list[float](), 0.0, 0, str(self._path)
        keeps, beyond, looked_at = True, 0, False
        for number, frame in enumerate(self._decode(self._container, stream)):
            base = float(frame.time_base or 0)
            stamps.append(np.nan if frame.pts is None else frame.pts * base)
            ends = stamps[-1] + (frame.duration or 0) * base
            if number == 0:
                first = self._samples(frame, name)
                self.shape, self.dtype = (0, *first.shape), first.dtype
                self.findings = tuple(self._find(stream, frame))
                stated, is_grey = self._range(stream, frame)
                looked_at = stated is not None and stated != "full"
            if keeps or looked_at:
                samples = self._checked(frame, number) if keeps else self._samples(frame, name)
            if looked_at:
                beyond += int(np.count_nonzero(samples < _DARK) + np.count_nonzero(samples > _BRIGHT))
            if keeps:
                self._kept.append(samples)
                size += first.nbytes
                keeps = size <= limit
                self._kept = self._kept if keeps else []
        if not stamps:
            raise InputError(f"{name} has no frames that can be decoded")
        self.shape = (len(stamps), *self.shape[1:])
        if stated is not None:
            self._settle_range(stated, is_grey, beyond)
        rate = float(stream.average_rate or 0)
        seconds = np.array(stamps)
        self.time, self.lost = times(seconds, rate), None
        avi = self._container.format.name == "avi"
        self._check_complete(stream, avi, seconds, ends)
        if avi and self.time is not None and len(stamps) > 1:
            steps = np.diff(self.time)
            lost = np.clip(np.rint(steps / np.median(steps)) - 1, 0, _MOST_LOST)
            self.lost = np.concatenate([[0], lost]).astype(np.int32)
            self.findings += lost_frames(self.lost)
        skipped = self._hidden(len(stamps))
        if skipped:
            text = (
                f"an edit list leaves out {skipped} of the {len(stamps)} frames, which are read as"
                " well; --frames leaves them out"
            )
            self.findings += (Finding("edit list", text),)
        self._container.close()
        self._container = None

    def _settle_range(self, stated: str, is_grey: bool, beyond: int) -> None:
        """Decide on the range of luma from what is stated and the samples beyond the limited range."""
        is_full = stated == "full" or (stated == "" and is_grey) or beyond > _BEYOND * math.prod(self.shape)
        self._is_limited = not is_full
        self.findings += tuple(_range_findings(stated, is_full, is_grey))
        if self._is_limited:
            self._kept = [look_up(_FULL, samples) for samples in self._kept]

    def _checked(self, frame: VideoFrame, number: int) -> NDArray[Any]:
        """Return the samples of a frame, which has the size and type of the first."""
        samples = self._samples(frame, f"{self._path} (frame {number})")
        if samples.shape != self.shape[1:] or samples.dtype != self.dtype:
            raise InputError(f"{self._path}: the size of the picture changes at frame {number}: cut it there")
        return samples

    def _check_complete(self, stream: VideoStream, avi: bool, stamps: Floats, end: float) -> None:
        """Raise InputError unless the frames reach the duration that the container states."""
        if avi:
            step = float(np.median(np.diff(stamps))) if len(stamps) > 1 else float(stream.time_base or 0)
            stated = stream.frames * float(stream.time_base or 0)
            missing = round((stated - stamps[-1]) / step) - 1 if step > 0 else 0
            if missing > 0:
                raise InputError(
                    f"{self._path} should have {len(stamps) + missing} frames, but {len(stamps)} can be"
                    " decoded: it is damaged or cut off; copy it again, or encode anew what there is"
                )
            return
        assert self._container is not None
        stated = (self._container.duration or 0) / 1e6
        step = float(np.median(np.diff(stamps))) if len(stamps) > 1 else 0.0
        alone = len(self._container.streams) == 1 and self._container.format.name.startswith("matroska")
        if alone and step > 0 and end - stamps[0] < stated - step / 2:
            raise InputError(
                f"{self._path} states a duration of {stated:.3f} s, but its frames end after"
                f" {end - stamps[0]:.3f} s: it is damaged or cut off; copy it again"
            )

    def _hidden(self, count: int) -> int:
        """Return the number of frames that an edit list omits."""
        assert self._container is not None
        if not self._container.format.name.startswith("mov"):
            return 0
        container, stream = self._open({})
        with container, self._errors_named(lambda: count):
            shown = sum(1 for packet in container.demux(stream) if packet.size and not packet.is_discard)
        container, stream = self._open(_ALL_FRAMES)
        with container, self._errors_named(lambda: count):
            return max(0, sum(1 for packet in container.demux(stream) if packet.size) - shown)

    def _find(self, stream: VideoStream, frame: VideoFrame) -> Iterator[Finding]:
        name = str(self._path)
        yield from self._loss(stream)
        if frame.interlaced_frame:
            text = "a frame has two fields of different times, in alternate rows: record progressive frames"
            yield Finding("interlaced", text)
        aspect = float(stream.sample_aspect_ratio or 1)
        if aspect > 0 and aspect != 1:
            text = f"pixels are displayed {aspect:.4g} times as wide as high: give --pixel-size X,Y"
            yield Finding("pixel aspect", text)
        bits = max(part.bits for part in frame.format.components)
        if bits < 8:
            text = f"{bits} bits a sample are scaled to 8: small changes of brightness are lost"
            yield Finding("few bits", text)
        if frame.format.has_palette:
            yield from ColourTable(name, frame.to_ndarray()[1][:, 1:]).findings
        if self._channel is None and _shows_colour(frame, name):
            yield CONVERTED_COLOUR

    def _range(self, stream: VideoStream, frame: VideoFrame) -> tuple[str | None, bool]:
        """Return the stated range, and whether the video is grey; None if samples are not luma of 8 bits."""
        kind = frame.format
        parts = [part for part in kind.components if not part.is_alpha]
        is_luma = parts[0].is_luma and (self._channel is None or len(parts) < 3)
        if not is_luma or kind.has_palette or kind.is_bayer or max(part.bits for part in parts) != 8:
            return None, False
        if kind.name.startswith("yuvj"):
            return "full", False
        is_grey = len(parts) == 1 or (stream.codec.canonical_name == "h264" and self._is_grey_h264(stream))
        return _RANGES.get(int(frame.color_range), ""), is_grey

    def _is_grey_h264(self, stream: VideoStream) -> bool:
        """Return whether H.264 has no chroma, which FFmpeg decodes as colours without saturation."""
        head = bytes(stream.codec_context.extradata or b"") or self._head
        sets = (head[match.end() : match.end() + _SPS_BYTES] for match in _SPS.finditer(head[:4096]))
        return any(chroma_of_h264(parameters) == 0 for parameters in sets)

    def _loss(self, stream: VideoStream) -> Iterator[Finding]:
        """Yield the finding for a compression that has a loss, or may have one."""
        codec = stream.codec
        if not codec.lossy:
            return
        loss = loss_of(codec.canonical_name, bytes(stream.codec_context.extradata or b""), self._head)
        if loss is None or (loss and codec.lossless and codec.canonical_name not in READERS):
            yield maybe_lossy(codec.canonical_name, warning=loss is not None)
        elif loss:
            yield lossy(codec.canonical_name)

    def _samples(self, frame: VideoFrame, name: str) -> NDArray[Any]:
        """Return a frame as grey samples of the displayed picture."""
        grey = to_grey(_stored(frame, name, self._channel), name, self._channel)
        return np.ascontiguousarray(_upright(frame, look_up(_FULL, grey) if self._is_limited else grey))


def _range_findings(stated: str, is_full: bool, is_grey: bool) -> Iterator[Finding]:
    """Yield a note if the range of samples is not stated, or is contradicted by them."""
    as_read = "as stored" if is_full else f"stretched from {_DARK} to {_BRIGHT} to 0 to 255"
    contradicted = is_full and stated != "full" and not (is_grey and not stated)
    if contradicted:
        claim = f"the range is stated as {stated}" if stated else "the range of brightness is not stated"
        text = f"{claim}, but samples are beyond {_DARK} to {_BRIGHT}: they are read {as_read}"
        yield Finding("range of brightness", text, warning=False)
    elif not stated:
        kind = "grey" if is_grey else "luma"
        text = f"the range of brightness is not stated: {kind} is read {as_read}"
        yield Finding("range of brightness", text, warning=False)


def _shows_colour(frame: VideoFrame, name: str) -> bool:
    """Return whether the colours of a frame differ by more than a lossy compression causes."""
    if frame.format.is_rgb or len(frame.format.components) < 3:
        return is_coloured(_stored(frame, name, None))
    colours = frame.reformat(format="bgr24").to_ndarray()
    return any(np.ptp(colours[rows], axis=2).max() > _GREY_COUNTS for rows in rows_of(colours))


def _stored(frame: VideoFrame, name: str, channel: int | None) -> NDArray[Any]:
    """Return the luma of a frame, or its colours if it is RGB or if one was requested: blue, green, red."""
    kind = frame.format
    parts = [part for part in kind.components if not part.is_alpha]
    bits, luma = max(part.bits for part in parts), parts[0].is_luma
    if kind.is_bayer or (bits > 16 and kind.name[:7] != "grayf32") or kind.name[:3] == "xyz":
        raise InputError(
            f"{name} has the pixel format {kind.name}, which is not supported: convert it to gray or"
            " gray16le, for example with ffmpeg -pix_fmt"
        )
    if kind.has_palette:
        indices, colours = frame.to_ndarray()
        return ColourTable(name, colours[:, 1:]).look_up(indices)
    if luma and (channel is None or len(parts) < 3):
        return _luma(frame, bits)
    if bits <= 8:
        return frame.reformat(format="bgr24").to_ndarray()
    if bits == 16:
        return frame.reformat(format="bgr48le").to_ndarray().astype(np.uint16, copy=False)
    planes = frame.reformat(format=f"gbrp{bits}le")
    return np.stack([_plane(planes, number, np.dtype("<u2")) for number in (1, 0, 2)], axis=-1)


def _luma(frame: VideoFrame, bits: int) -> NDArray[Any]:
    kind = frame.format
    order = ">" if kind.is_big_endian else "<"
    if bits > 16:
        return _plane(frame, 0, np.dtype(f"{order}f4"))
    if bits > 8:
        if not _DEEP.fullmatch(kind.name):  # the samples are shifted, or packed
            frame, order = frame.reformat(format=f"yuv444p{bits}le"), "<"
        return _plane(frame, 0, np.dtype(f"{order}u2"))
    if len(kind.components) == 1:
        return _plane(frame if bits == 8 else frame.reformat(format="gray"), 0, np.dtype("u1"))
    plane = frame if kind.is_planar else frame.reformat(format="gray" if kind.name[:2] == "ya" else "yuv444p")
    return _plane(plane, 0, np.dtype("u1"))


def _plane(frame: VideoFrame, number: int, dtype: np.dtype[Any]) -> NDArray[Any]:
    """Return the samples of a plane of a frame."""
    plane = frame.planes[number]
    samples: Any = plane  # its stub lacks the buffer protocol
    lines = np.frombuffer(samples, dtype).reshape(-1, abs(plane.line_size) // dtype.itemsize)
    return np.asarray(lines[: frame.height, : frame.width].astype(dtype.newbyteorder("=")))


def _upright(frame: VideoFrame, picture: NDArray[Any]) -> NDArray[Any]:
    """Rotate and mirror a picture according to the display matrix of its frame."""
    data: Any = frame.side_data.get("DISPLAYMATRIX")
    if data is None:
        return picture
    a, b, _, c, d, *_ = np.frombuffer(data, np.int32).tolist()
    if abs(a) >= abs(b):
        return picture[:: -1 if d < 0 else 1, :: -1 if a < 0 else 1]
    return picture.T[:: -1 if b < 0 else 1, :: -1 if c < 0 else 1]


def times(stamps: Floats, rate: float) -> Floats | None:
    """Return the times of frames relative to the first: their stamps if they increase, else from the rate."""
    if np.all(np.isfinite(stamps)) and np.all(np.diff(stamps) > 0):
        return np.asarray(stamps - stamps[0])
    return np.arange(len(stamps)) / rate if 0 < rate < np.inf else None
