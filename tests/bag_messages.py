"""Messages of ROS 1 and ROS 2, for bags that tests write."""

import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from jaxslam.io import ros_bags

START = 1_600_000_000.25
FIRST, STEP, LEAST, MOST = -0.9, 0.3, 0.1, 12.0
TRANSFORMS = ros_bags.TRANSFORMS[0]
STORES = {1: Stores.ROS1_NOETIC, 2: Stores.ROS2_HUMBLE}


def quaternion(yaw, roll=0.0):
    """Turned by `roll` about x, then by `yaw` about z."""
    c, s, a, b = np.cos(yaw / 2), np.sin(yaw / 2), np.cos(roll / 2), np.sin(roll / 2)
    return c * b, s * b, s * a, c * a


class Maker:
    """Messages of one of the two systems."""

    def __init__(self, ros):
        self.ros, self.store = ros, get_typestore(STORES[ros])
        if ros == 1:
            text = "geometry_msgs/TransformStamped[] transforms"
            self.store.register(get_types_from_msg(text, TRANSFORMS))
        self.of = self.store.types

    def header(self, t, frame):
        t += START
        stamp = self.of["builtin_interfaces/msg/Time"](int(t), round(1e9 * (t - int(t))))
        seq = {"seq": 0} if self.ros == 1 else {}
        return self.of["std_msgs/msg/Header"](stamp=stamp, frame_id=frame, **seq)

    def scan(self, t, reads, *, first=FIRST, step=STEP, frame="laser"):
        last = first + step * (len(reads) - 1)
        return self.of[ros_bags.SCAN](
            self.header(t, frame), first, last, step, 0.0, 0.1, LEAST, MOST,
            np.asarray(reads, np.float32), np.zeros(0, np.float32),
        )  # fmt: skip

    def odometry(self, t, pose):
        of, cov = self.of, np.zeros(36)
        point = of["geometry_msgs/msg/Point"](pose[0], pose[1], 0.0)
        turn = of["geometry_msgs/msg/Quaternion"](*quaternion(pose[2]))
        where = of["geometry_msgs/msg/Pose"](point, turn)
        none = of["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0)
        speed = of["geometry_msgs/msg/Twist"](none, none)
        return of[ros_bags.ODOMETRY](
            self.header(t, "odom"), "base_link",
            of["geometry_msgs/msg/PoseWithCovariance"](where, cov),
            of["geometry_msgs/msg/TwistWithCovariance"](speed, cov),
        )  # fmt: skip

    def transform(self, t, parent, child, pose, roll=0.0):
        of = self.of
        move = of["geometry_msgs/msg/Vector3"](pose[0], pose[1], 0.2)
        turn = of["geometry_msgs/msg/Quaternion"](*quaternion(pose[2], roll))
        both = of["geometry_msgs/msg/Transform"](move, turn)
        one = of["geometry_msgs/msg/TransformStamped"](self.header(t, parent), child, both)
        return of[TRANSFORMS]([one])
