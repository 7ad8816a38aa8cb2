"""A ROS 2 node that presses and holds, and publishes the pose of the object, the forces, and slip.

python3 track_node.py rig.toml 1.0 0.2 60    # mm, MPa, s; with ROS 2 sourced, mirrorskin in the same Python

Stamps are the times of the exposures. Lengths are metres, forces newtons, in the frame of the sensor.
"""

import math
import sys

import numpy as np
import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped, WrenchStamped
from rclpy.duration import Duration
from rclpy.node import Node
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import PointCloud2, PointField

from mirrorskin import engine, hw
from mirrorskin.engine.live import Frames, LiveRun, Loop, Stream

FRAME = "sensor"  # x right and y up in the picture, z towards the sensor
SPEED = 0.5  # mm/s
UNKNOWN = 1e6  # variance of what is not determined, such as a ball's spin
SLIP = "x", "y", "z", "displacement_x", "displacement_y", "sigma_x", "sigma_y", "status"


class Publisher(Node):
    """Publishes the answers of trackers."""

    def __init__(self):
        super().__init__("mirrorskin")
        kinds = {"pose": PoseWithCovarianceStamped, "force": WrenchStamped, "slip": PointCloud2}
        self.topics = {name: self.create_publisher(kind, name, 10) for name, kind in kinds.items()}

    def show(self, update, status):
        """Publish the answers in an update."""
        for name, answer in update.tracked.items():
            if answer is not None:
                message = getattr(self, f"{name}_message")(answer)
                exposed = self.get_clock().now() - Duration(seconds=update.latency)
                message.header.stamp, message.header.frame_id = exposed.to_msg(), FRAME
                self.topics[name].publish(message)

    def pose_message(self, pose):
        """Return the motion of the object since the first frame."""
        message = PoseWithCovarianceStamped()
        place, turn = message.pose.pose.position, message.pose.pose.orientation
        place.x, place.y, place.z = map(float, 1e-3 * pose.translation)
        turn.x, turn.y, turn.z, turn.w = map(float, Rotation.from_rotvec(pose.rotation).as_quat())
        # From a small rotation about the origin, and translation, mm, to x, y, z, m, and a rotation.
        x, y, z = 1e-3 * pose.translation
        change = np.zeros((6, 6))
        change[:3, :3] = [[0, z, -y], [-z, 0, x], [y, -x, 0]]
        change[:3, 3:], change[3:, :3] = 1e-3 * np.eye(3), np.eye(3)
        spread = pose.covariance + UNKNOWN * pose.undetermined.T @ pose.undetermined
        message.pose.covariance = (change @ spread @ change.T).ravel()
        return message

    def force_message(self, forces):
        """Return force and torque of the object on the sensor; NaN along the sheet if it is unknown."""
        message = WrenchStamped()
        force = np.array([forces.get("force_x", math.nan), forces.get("force_y", math.nan), forces.force])
        place = np.array([forces.pressure_centre_x, forces.pressure_centre_y, 0.0])
        torque = 1e-3 * np.cross(place, force) if forces.force > 0 else np.zeros(3)
        for part, values in ((message.wrench.force, force), (message.wrench.torque, torque)):
            part.x, part.y, part.z = map(float, values)
        return message

    def slip_message(self, slip):
        """Return the windows in contact, with their displacement and the codes of ``status``."""
        x, y = np.meshgrid(1e-3 * slip.x, 1e-3 * slip.y)
        moved = 1e-3 * np.concatenate([slip.displacement, slip.displacement_sigma], axis=-1)
        points = np.dstack([x, y, 0 * x, moved, slip.status])[slip.contact != 0]
        data = points.astype("<f4")
        message = PointCloud2()
        message.height, message.width = 1, len(data)
        message.fields = [
            PointField(name=name, offset=4 * n, datatype=PointField.FLOAT32, count=1)
            for n, name in enumerate(SLIP)
        ]
        message.point_step, message.row_step = 4 * len(SLIP), data.nbytes
        message.is_bigendian, message.is_dense = False, bool(np.isfinite(data).all())
        message.data = data.tobytes()
        return message


def main(rig_file, depth, modulus, seconds):
    """Press as deep as `depth`, mm, hold, and publish; the stage stops on Ctrl-C and on any fault."""
    rclpy.init()
    node = Publisher()
    try:
        with (
            hw.open_rig(hw.load_rig(rig_file)) as rig,
            hw.SweepScan(rig, hw.VerticalPlan(0.0, depth, speed=SPEED)) as scan,
        ):
            press = LiveRun(scan, engine.Press())
            trackers = {
                "pose": engine.pose.PoseTracker(),
                "force": engine.force.ForceTracker(modulus=modulus),
            }
            loop = Loop(scan, press, trackers=trackers, on_update=node.show)
            loop.precompile()
            loop.run()
            hold(node, rig, press.result().height > -depth, seconds)
    finally:
        node.destroy_node()
        rclpy.shutdown()


def hold(node, rig, contact, seconds):
    """Publish slip in a contact, (H, W), while the body rests."""
    camera = rig.settings.camera
    slip = engine.slip.SlipTracker(contact, camera.pixel_size)
    with Stream(
        Frames(), contact.shape, rig.camera.dtype, trackers={"slip": slip}, on_update=node.show
    ) as stream:
        rig.camera.flush()
        start = rig.clock.now()
        late = start - stream.now() + (camera.delay or 0.0)  # from times of exposures to those of arrivals
        while rig.clock.now() < start + seconds:
            frames = rig.take(64)
            for pixels, time in zip(frames.pixels, frames.time, strict=True):
                stream.push(pixels, time=time - late)


if __name__ == "__main__":
    main(sys.argv[1], *map(float, sys.argv[2:]))
