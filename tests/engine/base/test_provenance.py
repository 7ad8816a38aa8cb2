"""The process in a result, and the name of the source in messages."""

import numpy as np
import pytest
from stacks import MadeUp, record, sphere

from mirrorskin import io
from mirrorskin.engine.base.provenance import attach_provenance, naming, parameter_origin
from mirrorskin.kernels.device import open_device


class Source:
    name = "turn.h5"


def made_up(**header):
    return MadeUp(np.zeros((4, 3, 5), np.uint8), io.Header("axial", **header))


def test_a_parameters_origin_is_its_number_or_a_word():
    a_map = np.ones((3, 5))
    for argument, header_value, expected in (
        (2.5, None, 2.5),
        (0, a_map, 0.0),
        (np.float32(0.5), 7.0, 0.5),
        (a_map, 7.0, "map given"),
        (None, np.array(7), 7.0),
        (None, a_map, "map of the recording"),
        (None, None, "range of the type"),
    ):
        value = parameter_origin(argument, header_value, "range of the type")
        assert value == expected
        assert isinstance(value, str | float)


def test_errors_name_their_source_once_and_others_pass():
    for message, named in (
        ("tilt 0 deg", "turn.h5: tilt 0 deg"),
        ("no phase in turn.h5", "no phase in turn.h5"),
    ):
        with pytest.raises(io.InputError) as caught, naming(Source()):
            raise io.InputError(message)
        assert str(caught.value) == named
        assert str(caught.value.__context__ or caught.value) == message
    with pytest.raises(ZeroDivisionError), naming(Source()):
        raise ZeroDivisionError


def test_a_result_names_its_source_and_its_device(device):
    bare = io.Result(mean=np.zeros((3, 5), np.float32))
    signed = attach_provenance(
        bare, made_up(pixel_size=(0.1, 0.2)), [device], {"method": "exact", "tilt": 0.1}
    )
    assert signed.mean is bare.mean
    np.testing.assert_allclose(signed.x, [-0.2, -0.1, 0, 0.1, 0.2], atol=1e-12)
    np.testing.assert_allclose(signed.y, [0.2, 0, -0.2], atol=1e-12)
    process = dict(signed.process)
    assert process.pop("version")
    assert process.pop("date").endswith("+00:00")
    expected = {"program": "mirrorskin", "device": device.info.title, "driver": device.info.driver}
    assert process == {**expected, "source": "made up", "method": "exact", "tilt": 0.1}


def test_pixels_of_unknown_size_have_no_place():
    signed = attach_provenance(io.Result(), made_up(), [open_device(None)], {})
    assert signed.x is None
    assert signed.y is None


def test_pixels_of_a_part_lie_where_they_do_in_the_whole_picture(tmp_path):
    path = record(sphere(), tmp_path / "ball.h5")
    with io.open_recording(path) as recording:
        whole = attach_provenance(io.Result(), recording, [open_device(None)], {})
        for name in ("fingerprint", "modified"):
            levels = getattr(recording, name)
            assert whole.process[f"source_{name}"] == (levels() if callable(levels) else levels)
        assert (whole.process["dataset"], whole.process["source"]) == (recording.dataset, recording.name)
        count, rows, columns = recording.shape
    part = io.Region((1, rows - 1), (2, columns - 1))
    with io.open_recording(path, region=part, frames=(2, 5)) as recording:
        signed = attach_provenance(io.Result(), recording, [open_device(None)], {})
    np.testing.assert_array_equal(signed.x, whole.x[2:-1])
    np.testing.assert_array_equal(signed.y, whole.y[1:-1])
    assert signed.process["source_region"] == f"2,1,{columns - 3}x{rows - 2}"
    assert signed.process["source_frames"] == "2:5"
    assert whole.process["source_frames"] == f"0:{count}"
