"""A ROS 2 node that presses, and publishes the camera's pictures, the heights so far and the surface.

python3 press_node.py rig.toml 1.5    # mm; with ROS 2 sourced, and mirrorskin in the same Python
"""

import sys

import numpy as np
import rclpy
from rclpy.node import Node
from sensor_msgs.msg import Image, PointCloud2, PointField

from mirrorskin import engine, hw
from mirrorskin.engine.live import LiveRun, Loop

FRAME = "sensor"  # x right and y up in the picture, z towards the sensor
ENCODINGS = {"uint8": "mono8", "uint16": "mono16", "float32": "32FC1"}
SPEED = 0.5  # mm/s


class Publisher(Node):
    """Publishes pictures (counts, metres) and points (metres)."""

    def __init__(self):
        super().__init__("mirrorskin")
        self.pixel_size = None  # mm along x and y
        self.camera = self.create_publisher(Image, "camera/image", 10)
        self.height = self.create_publisher(Image, "height", 10)
        self.surface = self.create_publisher(PointCloud2, "surface", 1)

    def show(self, update, status):
        """Publish an update; the loop calls it in a separate thread."""
        self.camera.publish(self.picture(update.picture))
        if update.height is not None:
            self.height.publish(self.picture(update.height * np.float32(1e-3)))
            self.surface.publish(self.cloud(update.height, np.full_like(update.height, np.nan)))

    def finish(self, result):
        """Publish the surface, with the standard error of each height."""
        self.surface.publish(self.cloud(result.height, result.height_sigma))

    def cloud(self, height, sigma):
        """Return the points of heights in mm, (H, W), with their standard errors, which may be NaN."""
        rows, columns = np.indices(height.shape)
        x = (columns - (height.shape[1] - 1) / 2) * self.pixel_size[0]
        y = ((height.shape[0] - 1) / 2 - rows) * self.pixel_size[1]
        points = np.stack([x, y, height, sigma], axis=-1)[np.isfinite(height)]
        data = (1e-3 * points).astype("<f4")
        cloud = self.stamped(PointCloud2())
        cloud.height, cloud.width = 1, len(data)
        cloud.fields = [
            PointField(name=name, offset=4 * n, datatype=PointField.FLOAT32, count=1)
            for n, name in enumerate(("x", "y", "z", "sigma"))
        ]
        cloud.point_step, cloud.row_step = 16, data.nbytes
        cloud.is_bigendian, cloud.is_dense = False, True
        cloud.data = data.tobytes()
        return cloud

    def picture(self, values):
        """Return an image of values, (H, W)."""
        image = self.stamped(Image())
        image.height, image.width = values.shape
        image.encoding = ENCODINGS[values.dtype.name]
        image.is_bigendian, image.step = 0, values.strides[0]
        image.data = np.ascontiguousarray(values).tobytes()
        return image

    def stamped(self, message):
        """Return a message with its header filled in."""
        message.header.stamp = self.get_clock().now().to_msg()
        message.header.frame_id = FRAME
        return message


def main(rig_file, depth):
    """Press as deep as `depth`, mm, and publish; the stage stops on Ctrl-C and on any fault."""
    rclpy.init()
    node = Publisher()
    try:
        with hw.open_rig(hw.load_rig(rig_file)) as rig:
            with hw.SweepScan(rig, hw.VerticalPlan(0.0, depth, speed=SPEED)) as scan:
                node.pixel_size = scan.header.pixel_size
                operation = LiveRun(scan, engine.Press())
                operation.precompile()
                Loop(scan, operation, on_update=node.show).run()
            node.finish(operation.result())
    finally:
        node.destroy_node()
        rclpy.shutdown()


if __name__ == "__main__":
    main(sys.argv[1], float(sys.argv[2]))
