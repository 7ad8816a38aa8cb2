"""A ROS 2 node with a service that touches, and publishes the surface when it is good enough.

python3 touch_node.py rig.toml 2.0    # µm; with ROS 2 sourced, and mirrorskin in the same Python
ros2 service call /touch std_srvs/srv/Trigger
"""

import sys

import rclpy
from press_node import Publisher
from std_srvs.srv import Trigger

from mirrorskin import engine, hw, io


class Toucher(Publisher):
    """Touches when it is asked to; the answer states whether the request was met, and why it ended."""

    def __init__(self, rig_file, sigma):
        super().__init__()
        self.rig_file, self.sigma = rig_file, sigma  # mm
        self.service = self.create_service(Trigger, "touch", self.touch)

    def touch(self, request, response):
        """Press, turn and publish; any fault stops the stage, and is the answer."""
        try:
            with (
                hw.open_rig(hw.load_rig(self.rig_file), steps=True) as rig,
                hw.RigTouch(rig) as sensor,
            ):
                self.pixel_size = sensor.header.pixel_size
                outcome = engine.live.touch(sensor, self.sigma, on_update=self.follow)
        except (hw.HardwareError, io.InputError) as error:
            response.success, response.message = False, str(error)
            return response
        self.finish(outcome.result)
        response.success, response.message = outcome.reached, str(outcome)
        return response

    def follow(self, text, surface):
        """Publish a surface that is not good enough yet."""
        if surface is not None:
            self.finish(surface)


def main(rig_file, sigma):
    """Wait for calls of the service; `sigma` is the requested standard deviation, µm."""
    rclpy.init()
    node = Toucher(rig_file, 1e-3 * sigma)
    try:
        rclpy.spin(node)
    finally:
        node.destroy_node()
        rclpy.shutdown()


if __name__ == "__main__":
    main(sys.argv[1], float(sys.argv[2]))
