"""The nodes of examples/ros2 on a rig of fakes: their messages, read by another program from a bag.

ROS 2's own Python packages are not on the package index. `rosbags` has the definitions of their messages.
"""

import math
import runpy
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import ModuleType, SimpleNamespace

import cv2
import numpy as np
import pytest
from msgspec import structs
from rig_fakes import fake_rig, spreading
from rosbags.highlevel import AnyReader
from rosbags.interfaces import Nodetype
from rosbags.rosbag2 import Writer
from rosbags.typesys import Stores, get_typestore

from mirrorskin import hw
from mirrorskin.hw.rig.rig import Rig
from mirrorskin.twin.emulator.rig import EmulatedRig

NODES = Path(__file__).parents[1] / "examples" / "ros2"
SHAPE = (24, 32)
NOW = 1000.0
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


class Moment(SimpleNamespace):
    """A time of a node's clock, seconds."""

    def __init__(self, seconds):
        super().__init__(seconds=seconds)

    def __sub__(self, seconds):
        return Moment(self.seconds - seconds)

    def to_msg(self):
        whole = math.floor(self.seconds)
        nanoseconds = round(1e9 * (self.seconds - whole))
        return message_class("builtin_interfaces/msg/Time")(sec=whole, nanosec=nanoseconds)


def answer(answers, node):
    """Call the services of a node once."""
    for name, callback in node.services:
        answers[name] = callback(None, SimpleNamespace(success=False, message=""))


@pytest.fixture
def bag(monkeypatch, tmp_path):
    """The bag that a node's messages are written to, and what it did; ROS 2's modules are made up."""
    kinds = {name: f"sensor_msgs/msg/{name}" for name in ("Image", "PointCloud2", "PointField")}
    kinds |= {name: f"geometry_msgs/msg/{name}" for name in ("PoseWithCovarianceStamped", "WrenchStamped")}
    classes = {name: message_class(kind) for name, kind in kinds.items()}
    times = iter(range(10**6))
    path, ended, answers = tmp_path / "bag", [], {}

    class Node:
        def __init__(self, name):
            self.writer = Writer(path, version=9)
            self.writer.open()
            self.published = []  # the writer takes them in its own thread only

        def create_publisher(self, kind, topic, depth):
            name = next(kinds[name] for name, message_class in classes.items() if message_class is kind)
            connection = self.writer.add_connection(f"/{topic}", name, typestore=STORE)

            def publish(message):
                data = STORE.serialize_cdr(message.typed(), name)
                self.published.append((connection, next(times), data))

            return SimpleNamespace(publish=publish)

        def create_service(self, kind, name, callback):
            self.services = [(name, callback)]

        def get_clock(self):
            return SimpleNamespace(now=lambda: Moment(NOW))

        def destroy_node(self):
            for message in self.published:
                self.writer.write(*message)
            self.writer.close()
            ended.append("node")

    rclpy = {
        "init": lambda: None,
        "shutdown": lambda: ended.append("rclpy"),
        "spin": partial(answer, answers),
    }
    for name, names in (
        ("rclpy", rclpy),
        ("std_srvs", {}),
        ("std_srvs.srv", {"Trigger": object}),
        ("rclpy.node", {"Node": Node}),
        ("rclpy.duration", {"Duration": lambda seconds: seconds}),
        ("geometry_msgs", {}),
        ("geometry_msgs.msg", classes),
        ("sensor_msgs", {}),
        ("sensor_msgs.msg", classes),
    ):
        module = ModuleType(name)
        vars(module).update(names)
        monkeypatch.setitem(sys.modules, name, module)
    return SimpleNamespace(path=path, ended=ended, answers=answers)


@pytest.fixture
def published(bag, clock, monkeypatch):
    """Run the node; return what another program reads in the bag, by topic."""
    rig = fake_rig(spreading(SHAPE), clock, rate=60.0, stated={"pixel_size": (0.05, 0.05), "rate": 60.0})
    monkeypatch.setattr(hw, "load_rig", lambda _path: rig.settings)
    monkeypatch.setattr(hw, "open_rig", lambda settings: rig)
    runpy.run_path(str(NODES / "press_node.py"))["main"]("rig.toml", 1.0)
    assert bag.ended == ["node", "rclpy"]
    assert rig.stage.closed
    return received(bag)


@pytest.fixture
def touch(bag, clock, monkeypatch):
    """Call the service of the node that touches; return its answer, and the messages by topic."""
    scene = {"shape": (48, 64), "pixel_size": 0.06, "pattern": "linear", "rate": 20.0}
    monkeypatch.syspath_prepend(NODES)
    with EmulatedRig("sphere", clock=clock, **scene) as emulated:
        stage = structs.replace(emulated.settings.stage, press=1.0)
        settings = replace(emulated.settings, stage=stage)
        opened = Rig(emulated.open_stage(stage), emulated.camera, settings, clock)
        monkeypatch.setattr(hw, "load_rig", lambda _path: settings)
        monkeypatch.setattr(hw, "open_rig", lambda settings, steps: opened)
        runpy.run_path(str(NODES / "touch_node.py"))["main"]("rig.toml", 20.0)
    return bag.answers["touch"], received(bag)


def test_the_service_touches_and_publishes_the_surface(touch):
    answer, messages = touch
    assert answer.success, answer.message
    assert "the request is met" in answer.message
    points = points_of(messages["/surface"][-1])
    assert np.nanmedian(points[:, 3]) < 20e-6  # holes that were filled have none


def received(bag):
    """Return the messages in a bag by topic."""
    messages = {}
    with AnyReader([bag.path]) as reader:
        for connection, _, data in reader.messages():
            messages.setdefault(connection.topic, []).append(reader.deserialize(data, connection.msgtype))
    return messages


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


RADIUS, DEPTH, MODULUS, PIXEL = 3.0, 0.2, 0.1, 0.05  # of a ball, mm; MPa; mm


def ball(shape=(48, 64)):
    """Return a picture of a ball, which is light where it touches a speckled sheet."""
    x, y = (PIXEL * (np.arange(size) - (size - 1) / 2) for size in shape[::-1])
    depth = (x**2 + (y**2)[:, np.newaxis]) / (2 * RADIUS)
    speckle = cv2.GaussianBlur(np.random.default_rng(1).normal(0, 1, shape), (0, 0), 1.5)
    light = 210 + 30 * speckle / np.abs(speckle).max()
    return lambda place: np.where(place.travel > depth, light, 5).astype(np.uint8)


@pytest.fixture
def tracked(bag, clock, monkeypatch):
    """Run the node that tracks; return what another program reads in the bag, by topic."""
    rig = fake_rig(ball(), clock, rate=60.0, stated={"pixel_size": (PIXEL, PIXEL), "rate": 60.0})
    monkeypatch.setattr(hw, "load_rig", lambda _path: rig.settings)
    monkeypatch.setattr(hw, "open_rig", lambda settings: rig)
    runpy.run_path(str(NODES / "track_node.py"))["main"]("rig.toml", DEPTH, MODULUS, 0.2)
    assert bag.ended == ["node", "rclpy"]
    assert rig.stage.closed
    return received(bag)


def seconds_of(message):
    return message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec


def test_force_and_torque_are_published(tracked):
    last = tracked["/force"][-1].wrench
    assert last.force.z == pytest.approx(16 / 9 * MODULUS * math.sqrt(RADIUS) * DEPTH**1.5, rel=0.1)
    assert math.isnan(last.force.x)  # unknown without a displacement
    assert tracked["/force"][0].wrench.force.z < last.force.z


def test_the_pose_is_published_in_metres_with_its_covariance(tracked):
    pose = tracked["/pose"][-1].pose
    place, turn = pose.pose.position, pose.pose.orientation
    covariance = np.reshape(pose.covariance, (6, 6))
    sigma = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(covariance, covariance.T)
    assert sigma[2] < 1e-5
    assert sigma[5] > 100  # a ball's spin is not determined
    assert abs(place.z) < 5e-5
    assert turn.w == pytest.approx(1, abs=1e-3)


def test_slip_is_published_for_each_window(tracked):
    cloud = tracked["/slip"][-1]
    assert [field.name for field in cloud.fields][3:5] == ["displacement_x", "displacement_y"]
    points = np.frombuffer(cloud.data, "<f4").reshape(cloud.width, 8)
    sticks = points[points[:, 7] == 2]
    assert len(sticks) > 3
    assert np.abs(sticks[:, 3:5]).max() < 1e-6
    assert np.abs(points[:, :2]).max() < 1.2e-3


def test_stamps_are_the_times_of_the_exposures(tracked):
    for topic in ("/force", "/pose"):
        stamps = np.array([seconds_of(message) for message in tracked[topic]])
        assert np.all(stamps <= NOW)
        assert np.all(stamps > NOW - 0.2)
    assert {message.header.frame_id for message in tracked["/slip"]} == {"sensor"}
