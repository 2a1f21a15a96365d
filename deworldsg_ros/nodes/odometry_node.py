"""odometry_node: RGB-D images → camera/pose and its corrections, for robots without SLAM."""

from __future__ import annotations

import sys
from typing import Any

from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry, Path

from deworldsg_ros.poses.loops import LoopOdometry, closings_in_words
from deworldsg_ros.poses.odometry import ODOMETRY_FRAME
from deworldsg_ros.ros.inputs import (
    WANTED_DEPTH,
    listen_camera_info,
    listen_depth,
    listen_rgb,
)
from deworldsg_ros.ros.joining import JoiningNode
from deworldsg_ros.ros.node import run
from deworldsg_ros.ros.qos import reliable
from deworldsg_ros.ros.transforms import (
    POSE_DEPTH,
    TRAJECTORY_TOPIC,
    TransformOutput,
    put_pose,
)
from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.scene.camera import Trajectory
from deworldsg_ros.streams.frames import UnposedAssembler, UnposedFrame
from deworldsg_ros.streams.poses import set_stamp


class OdometryNode(JoiningNode[UnposedFrame]):
    """Poses from RGB-D images; a lost frame gets none. Closed loops correct the poses before."""

    def __init__(self, **options: Any) -> None:
        super().__init__("odometry_node", "poses", **options)
        self._world_frame = self.parameters.inputs.world_frame or ODOMETRY_FRAME
        self._odometry = LoopOdometry()
        self._newest_ns = 0
        self._pose_output = self.create_publisher(PoseStamped, "camera/pose", reliable(POSE_DEPTH))
        self._odometry_output = self.create_publisher(
            Odometry, "camera/odometry", reliable(POSE_DEPTH)
        )
        self._path_output = self.create_publisher(Path, TRAJECTORY_TOPIC, reliable(1))
        self._tf_output = TransformOutput(self) if self.parameters.odometry.publish_tf else None
        frames = self._frames = UnposedAssembler(self.parameters.inputs, **self.assembler_options())
        self.join(frames, self._track)
        listen_camera_info(self, self.taking(frames.add_camera_info))
        listen_depth(self, self.taking(frames.add_depth), self.wants_depth, WANTED_DEPTH)
        listen_rgb(self, self.taking(frames.add_rgb), self.wants_images, WANTED_DEPTH)

    def _track(self, frame: UnposedFrame) -> None:
        if frame.stamp_ns < self._newest_ns:  # the clock was set back, or a recording restarted
            self._odometry = LoopOdometry()
        self._newest_ns = frame.stamp_ns
        T_world_camera, closing = self._odometry.track(
            frame.stamp_ns, frame.rgb, frame.depth_m, frame.intrinsics
        )
        if closing is not None:
            self._publish_trajectory(frame.stamp_ns, closing)
        self._publish(frame.stamp_ns, T_world_camera)

    def _pose(self, stamp_ns: int, T_world_camera: Float64) -> PoseStamped:
        pose = PoseStamped()
        pose.header.frame_id = self._world_frame
        set_stamp(pose, stamp_ns)
        put_pose(T_world_camera, pose.pose.position, pose.pose.orientation)
        return pose

    def _publish_trajectory(self, stamp_ns: int, trajectory: Trajectory) -> None:
        poses = zip(trajectory.stamps_ns.tolist(), trajectory.T_world_camera)
        path = Path(poses=[self._pose(*pose) for pose in poses])
        path.header.frame_id = self._world_frame
        set_stamp(path, stamp_ns)
        self._path_output.publish(path)

    def _publish(self, stamp_ns: int, T_world_camera: Float64) -> None:
        pose = self._pose(stamp_ns, T_world_camera)
        self._pose_output.publish(pose)
        odometry = Odometry(header=pose.header, child_frame_id=self._frames.camera_frame)
        odometry.pose.pose = pose.pose
        self._odometry_output.publish(odometry)
        if self._tf_output is not None:
            self._tf_output.publish(
                stamp_ns, self._world_frame, self._frames.camera_frame, T_world_camera
            )

    def more_values(self) -> dict[str, str]:
        """Numbers of tracked and lost frames, of restarts, and the closed loops."""
        closings = closings_in_words(self._odometry.closed, self._odometry.correction_m)
        odometry = self._odometry.odometry
        counts = {"tracked": odometry.tracked, "lost": odometry.lost, "restarts": odometry.restarts}
        values = {f"odometry {name}": str(count) for name, count in counts.items()}
        return {**super().more_values(), **values, "odometry loops": closings}


def main(args: list[str] | None = None) -> int:
    """Run the node."""
    return run(OdometryNode, args)


if __name__ == "__main__":
    sys.exit(main())
