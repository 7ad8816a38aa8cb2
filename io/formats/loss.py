"""Whether frames were compressed with a loss, from the bytes of a stream and not from the codec's name."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator

_JPEG_LOSSLESS, _JPEG_LS, _JPEG_SCAN = 0xC3, 0xF7, 0xDA  # markers (ITU-T T.81 and T.87)
_NO_LENGTH = {0xD8, 0x01, *range(0xD0, 0xD8)}  # markers of JPEG without a segment
_CODESTREAM = b"\xff\x4f\xff\x51"  # start of JPEG 2000, and of its sizes (ITU-T T.800)
_CODING_STYLE = b"\xff\x52"
_START = re.compile(b"\0\0\1")  # of a unit of H.264 and HEVC in a byte stream
# Profiles of H.264 whose parameter sets have a chroma format, and with it the flag of lossless blocks.
_HIGH_PROFILES = {100, 110, 122, 244, 44, 83, 86, 118, 128, 138, 139, 134, 135}
_SPS, _PPS_HEVC = 7, 34  # types of units
_VP9_KEY = 0x498342  # sync code of a key frame


class _Bits:
    """Reader of the bits of a header; IndexError at their end."""

    def __init__(self, data: bytes) -> None:
        self._data, self._at = data, 0

    def take(self, count: int = 1) -> int:
        """Return an unsigned number of some bits."""
        value = 0
        for _ in range(count):
            value = value << 1 | self._data[self._at >> 3] >> (7 - self._at % 8) & 1
            self._at += 1
        return value

    def golomb(self) -> int:
        """Return a number in the exponential Golomb code."""
        zeros = 0
        while not self.take():
            zeros += 1
        return (1 << zeros) - 1 + self.take(zeros)


def loss_of(codec: str, extradata: bytes, packet: bytes) -> bool | None:
    """Return whether a stream of a codec that may have a loss has one; None if it is probably lossless.

    Streams that are not known here have one.

    Parameters
    ----------
    codec : str
        Name of FFmpeg's codec.
    extradata, packet : bytes
        Headers of the stream, and its first packet.
    """
    try:
        return READERS[codec](extradata, packet) if codec in READERS else True
    except (IndexError, ValueError):  # damaged, or of a kind that is not known here
        return True


def loss_of_jpeg(data: bytes) -> bool:
    """Return whether a JPEG or JPEG-LS has a loss: not with a predictor, or if no difference is allowed."""
    at, kind = data.find(b"\xff\xd8"), 0
    while 0 <= at < len(data) - 4:
        if data[at] != 0xFF:
            at += 1
            continue
        marker = data[at + 1]
        if marker in _NO_LENGTH or marker == 0xFF:
            at += 1 if marker == 0xFF else 2
            continue
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            kind = marker
        kind = marker if marker == _JPEG_LS else kind
        length = int.from_bytes(data[at + 2 : at + 4], "big")
        if marker == _JPEG_SCAN:
            # After the components: predictor or allowed difference, last coefficient, shift of samples.
            near, _, shift = data[at + 2 + length - 3 : at + 2 + length]
            return not ((kind == _JPEG_LOSSLESS and shift == 0) or (kind == _JPEG_LS and near == 0))
        at += 2 + length
    return True


def _of_jpeg(_extradata: bytes, packet: bytes) -> bool:
    return loss_of_jpeg(packet)


def _of_jpeg_2000(_extradata: bytes, packet: bytes) -> bool | None:
    """JPEG 2000: the wavelet 9-7 has a loss; of the reversible 5-3, parts may have been left out."""
    at = packet.index(_CODESTREAM) if _CODESTREAM in packet else len(packet)
    style = packet[packet.index(_CODING_STYLE, at) + 2 :] if _CODING_STYLE in packet[at:] else b""
    return None if style[11] == 1 else True


def _of_h264(extradata: bytes, packet: bytes) -> bool:
    """H.264: lossless if parameter sets have the flag qpprime_y_zero_transform_bypass."""
    for unit in _units(extradata, packet, hevc=False):
        if unit[0] & 31 == _SPS:
            if unit[1] not in _HIGH_PROFILES:
                return True
            chroma, bits = _chroma_of(unit[1:])
            if chroma == 3:
                bits.take()
            bits.golomb(), bits.golomb()  # depths
            return not bits.take()
    return True


def chroma_of_h264(parameters: bytes) -> int:
    """Return chroma_format_idc of a sequence parameter set of H.264, without its head; 1 by default."""
    try:
        return _chroma_of(parameters)[0] if parameters[0] in _HIGH_PROFILES else 1
    except IndexError:  # it is cut short
        return 1


def _chroma_of(parameters: bytes) -> tuple[int, _Bits]:
    """Return the chroma format of a set of a high profile, and the bits after it."""
    bits = _Bits(parameters[3:])
    bits.golomb()
    return bits.golomb(), bits


def _of_hevc(extradata: bytes, packet: bytes) -> bool | None:
    """HEVC: without transquant_bypass_enabled_flag there is a loss; with it, some blocks may have one."""
    for unit in _units(extradata, packet, hevc=True):
        if unit[0] >> 1 & 63 == _PPS_HEVC:
            bits = _Bits(unit[2:])
            bits.golomb(), bits.golomb()  # numbers of the sets
            bits.take(1 + 1 + 3 + 1 + 1)
            bits.golomb(), bits.golomb(), bits.golomb()  # references, and the initial step
            bits.take(2)
            if bits.take():  # steps of blocks
                bits.golomb()
            bits.golomb(), bits.golomb()  # steps of chroma
            bits.take(1 + 1 + 1)
            return None if bits.take() else True
    return True


def _of_vp9(_extradata: bytes, packet: bytes) -> bool | None:
    """VP9: a loss unless the first frame has the quantiser 0; later frames may have another one."""
    bits = _Bits(packet)
    bits.take(2)
    profile = bits.take() | bits.take() << 1
    if profile == 3:
        bits.take()
    if bits.take() or bits.take():  # a frame that is shown again, or that is no key frame
        return True
    bits.take()
    resilient = bits.take()
    if bits.take(24) != _VP9_KEY:
        return True
    _skip_colours(bits, profile)
    bits.take(32)
    if bits.take():
        bits.take(32)
    bits.take(2 if resilient else 4)
    bits.take(9)  # loop filter
    if bits.take() and bits.take():
        for length in (6, 6, 6, 6, 6, 6):
            if bits.take():
                bits.take(length + 1)
    return None if bits.take(8) == 0 else True


def _skip_colours(bits: _Bits, profile: int) -> None:
    """Skip the description of depth and colours in the header of a key frame of VP9."""
    if profile >= 2:
        bits.take()
    is_rgb = bits.take(3) == 7
    if not is_rgb:
        bits.take()
    if profile in (1, 3):
        bits.take(1 if is_rgb else 3)


READERS: dict[str, Callable[[bytes, bytes], bool | None]] = {
    "mjpeg": _of_jpeg,
    "jpegls": _of_jpeg,
    "jpeg2000": _of_jpeg_2000,
    "h264": _of_h264,
    "hevc": _of_hevc,
    "vp9": _of_vp9,
}
"""Functions that look into the streams of codecs."""


def _units(extradata: bytes, packet: bytes, hevc: bool) -> Iterator[bytes]:
    """Yield the units of the headers of a stream and of its first packet, without emulation prevention."""
    if extradata[:1] == b"\1":
        units = _configured(extradata, hevc)
    else:
        data = extradata + packet
        starts = [match.end() for match in _START.finditer(data)]
        units = (data[start:stop] for start, stop in zip(starts, [*starts[1:], len(data) + 3], strict=True))
    for unit in units:
        if len(unit) > 4:
            yield unit.replace(b"\0\0\3", b"\0\0")


def _configured(data: bytes, hevc: bool) -> Iterator[bytes]:
    """Yield the parameter sets in the configuration of a container (ISO/IEC 14496-15)."""
    groups, at = (data[22], 23) if hevc else (1, 5)
    for _ in range(groups):
        at, count = (
            (at + 3, int.from_bytes(data[at + 1 : at + 3], "big")) if hevc else (at + 1, data[at] & 31)
        )
        for _ in range(count):
            length = int.from_bytes(data[at : at + 2], "big")
            yield data[at + 2 : at + 2 + length]
            at += 2 + length
