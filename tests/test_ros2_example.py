"""The node of examples/ros2 on a rig of fakes: its messages, read by another program from a bag.

ROS 2's own Python packages are not on the package index. `rosbags` has the definitions of their messages.
"""

import runpy
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
from rig_fakes import fake_rig, spreading
from rosbags.highlevel import AnyReader
from rosbags.interfaces import Nodetype
from rosbags.rosbag2 import Writer
from rosbags.typesys import Stores, get_typestore

from mirrorskin import hw

NODE = Path(__file__).parents[1] / "examples" / "ros2" / "press_node.py"
SHAPE = (24, 32)
STORE = get_typestore(Stores.ROS2_JAZZY)


def message_class(kind):
    """Return a class of messages as ROS 2 has it: all fields have defaults, and there are no others."""
    constants, fields = STORE.fielddefs[kind]
    defaults = {name: _default(*definition) for name, definition in fields}

    class Message:
        __slots__ = tuple(defaults)

        def __init__(self, **options):
            for name, default in defaults.items():
                setattr(self, name, options.pop(name, None) or default())
            assert not options

        def typed(self):
            """Return the message as rosbags has it."""
            values = {name: getattr(self, name) for name in defaults}
            return STORE.types[kind](**{name: _typed(value) for name, value in values.items()})

    for name, _, value in constants:
        setattr(Message, name, value)
    return Message


def _default(node, what):
    if node == Nodetype.NAME:
        return message_class(what)
    if node == Nodetype.SEQUENCE:
        return list
    return {"string": str, "bool": bool}.get(what[0], int)


def _typed(value):
    if isinstance(value, bytes):
        return np.frombuffer(value, np.uint8)
    if isinstance(value, list):
        return [item.typed() for item in value]
    return value.typed() if hasattr(value, "typed") else value


@pytest.fixture
def bag(monkeypatch, tmp_path):
    """The bag that a node's messages are written to, and what it did; ROS 2's modules are made up."""
    kinds = {name: f"sensor_msgs/msg/{name}" for name in ("Image", "PointCloud2", "PointField")}
    classes = {name: message_class(kind) for name, kind in kinds.items()}
    times = iter(range(10**6))
    path, ended = tmp_path / "bag", []

    class Node:
        def __init__(self, name):
            self.writer = Writer(path, version=9)
            self.writer.open()

        def create_publisher(self, kind, topic, depth):
            name = next(kinds[name] for name, message_class in classes.items() if message_class is kind)
            connection = self.writer.add_connection(f"/{topic}", name, typestore=STORE)

            def publish(message):
                self.writer.write(connection, next(times), STORE.serialize_cdr(message.typed(), name))

            return SimpleNamespace(publish=publish)

        def get_clock(self):
            stamp = message_class("builtin_interfaces/msg/Time")
            return SimpleNamespace(now=lambda: SimpleNamespace(to_msg=stamp))

        def destroy_node(self):
            self.writer.close()
            ended.append("node")

    for name, names in (
        ("rclpy", {"init": lambda: None, "shutdown": lambda: ended.append("rclpy")}),
        ("rclpy.node", {"Node": Node}),
        ("sensor_msgs", {}),
        ("sensor_msgs.msg", classes),
    ):
        module = ModuleType(name)
        vars(module).update(names)
        monkeypatch.setitem(sys.modules, name, module)
    return SimpleNamespace(path=path, ended=ended)


@pytest.fixture
def published(bag, clock, monkeypatch):
    """Run the node; return what another program reads in the bag, by topic."""
    rig = fake_rig(spreading(SHAPE), clock, rate=60.0, stated={"pixel_size": (0.05, 0.05), "rate": 60.0})
    monkeypatch.setattr(hw, "load_rig", lambda _path: rig.settings)
    monkeypatch.setattr(hw, "open_rig", lambda settings: rig)
    runpy.run_path(str(NODE))["main"]("rig.toml", 1.0)
    assert bag.ended == ["node", "rclpy"]
    assert rig.stage.closed
    with AnyReader([bag.path]) as reader:
        received = {}
        for connection, _, data in reader.messages():
            received.setdefault(connection.topic, []).append(reader.deserialize(data, connection.msgtype))
    return received


def points_of(cloud):
    return np.frombuffer(cloud.data, "<f4").reshape(cloud.width, 4)


def test_pictures_are_published(published):
    pictures = published["/camera/image"]
    assert {(picture.height, picture.width, picture.encoding) for picture in pictures} == {(*SHAPE, "mono8")}
    assert np.ptp(pictures[-1].data) > 100


def test_heights_so_far_are_published_in_metres(published):
    last = np.frombuffer(published["/height"][-1].data, "<f4").reshape(SHAPE)
    assert np.nanmax(np.abs(last)) < 1.1e-3


def test_the_surface_grows_while_the_stage_moves(published):
    widths = [cloud.width for cloud in published["/surface"]]
    assert len(widths) == len(published["/height"]) + 1
    assert widths == sorted(widths)


def test_the_surface_has_standard_errors_at_the_end(published):
    cloud = published["/surface"][-1]
    points = points_of(cloud)
    fields = {field.name: field.offset for field in cloud.fields}
    assert fields == {"x": 0, "y": 4, "z": 8, "sigma": 12}
    assert len(points) > 20
    assert np.all(points[:, 3] > 0)
    np.testing.assert_allclose(np.abs(points[:, :2]).max(axis=0), [0.775e-3, 0.575e-3], atol=0.3e-3)
