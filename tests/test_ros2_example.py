"""The node of examples/ros2, on a rig of fakes, with stand-ins of ROS 2's modules."""

import runpy
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
from rig_fakes import fake_rig, spreading

from mirrorskin import hw

NODE = Path(__file__).parents[1] / "examples" / "ros2" / "press_node.py"
SHAPE = (24, 32)


class Message(SimpleNamespace):
    FLOAT32 = 7

    def __init__(self, **fields):
        super().__init__(header=SimpleNamespace(), **fields)


@pytest.fixture
def published(monkeypatch):
    """What was published, by topic; rclpy and its messages are made up."""
    said = {}

    class Node:
        def __init__(self, name):
            self.name = name

        def create_publisher(self, kind, topic, depth):
            said[topic] = []
            return SimpleNamespace(publish=said[topic].append)

        def get_clock(self):
            return SimpleNamespace(now=lambda: SimpleNamespace(to_msg=lambda: "now"))

        def destroy_node(self):
            said["destroyed"] = True

    kinds = dict.fromkeys(("Image", "PointCloud2", "PointField"), Message)
    for name, names in (
        ("rclpy", {"init": lambda: None, "shutdown": lambda: None}),
        ("rclpy.node", {"Node": Node}),
        ("sensor_msgs", {}),
        ("sensor_msgs.msg", kinds),
    ):
        module = ModuleType(name)
        vars(module).update(names)
        monkeypatch.setitem(sys.modules, name, module)
    return said


def test_a_press_is_published(published, clock, monkeypatch):
    rig = fake_rig(spreading(SHAPE), clock, rate=60.0, told={"pixel_size": (0.05, 0.05), "rate": 60.0})
    monkeypatch.setattr(hw, "load_rig", lambda _path: rig.settings)
    monkeypatch.setattr(hw, "open_rig", lambda told: rig)
    runpy.run_path(str(NODE))["main"]("rig.toml", 1.0)
    assert published["destroyed"]
    assert rig.stage.closed
    pictures, heights, (cloud,) = (published[topic] for topic in ("camera/image", "height", "surface"))
    assert {(one.height, one.width, one.encoding) for one in pictures} == {(*SHAPE, "mono8")}
    last = np.frombuffer(heights[-1].data, "<f4").reshape(SHAPE)
    points = np.frombuffer(cloud.data, "<f4").reshape(-1, 4)
    assert [field.name for field in cloud.fields] == ["x", "y", "z", "sigma"]
    assert len(points) == cloud.width > 20
    assert np.nanmax(np.abs(last)) < 1.1e-3  # metres
    assert np.all(points[:, 3] > 0)
    np.testing.assert_allclose(np.abs(points[:, :2]).max(axis=0), [0.775e-3, 0.575e-3], atol=0.3e-3)
