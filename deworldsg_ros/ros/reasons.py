"""The reasons of refused input and dropped frames in /diagnostics: the cause, and the remedy."""

from __future__ import annotations

REASONS: dict[str, str] = {
    # Images
    "unknown_encoding": "The encoding of an image is not supported. Convert it to one that the log "
    "line lists; for compressed depth publish PNG.",
    "empty_image": "An image has no pixels. Check the camera driver.",
    "bad_step": "The row length (step) of an image does not fit its width and encoding. Check the "
    "camera driver.",
    "short_buffer": "An image contains fewer bytes than its size requires. Check the camera "
    "driver.",
    "decode_failed": "A compressed image is damaged, or is neither JPEG nor PNG. Check the camera "
    "driver and the network.",
    "not_depth": "The depth topic carries pictures: colour images, or depth drawn for people. Name "
    "the topic of the depth images, with 16UC1 or 32FC1, also as compressedDepth.",
    "grid_mismatch": "RGB, depth and camera_info differ in size. Publish depth that is registered "
    "to RGB.",
    "invalid_intrinsics": "camera_info contains zeros, NaN or absurd values. Calibrate the camera.",
    "invalid_frame_id": "A frame_id contains control characters or more than 256 characters. "
    "Correct it in the node that publishes it.",
    # Poses
    "invalid_pose": "A pose contains NaN or infinity, its quaternion is not of length 1, or it is "
    "more than 10 km from the origin. Check the source of the poses; publish them in a frame that "
    "begins near the robot.",
    "invalid_region": "The parameter center of region_node cannot be read; the region stays as it "
    "was. Write X,Y,Z in metres.",
    "invalid_request": "A request to a service cannot be fulfilled, and "
    "changed nothing. Its answer says why.",
    "wrong_frame": "The frame_id of a pose or local graph differs from the world frame of this "
    "session. Publish all of them in one world frame, and set `inputs.world_frame` to it.",
    "pose_jump": "The camera moved more than 1 m between two frames, or rotated faster than 360 "
    "degrees per second. Check the poses; a new position is accepted after five consistent frames.",
    "no_pose": "No pose is within `inputs.pose_slop_s` of the image. Check the rate and the clock "
    "of the poses.",
    "no_transform": "The odometry describes another frame than the camera's, and TF does not "
    "connect the two. Publish that transform; if the poses are the camera's, set "
    "`inputs.pose_source` to odometry.",
    "too_many_frames": "TF has more than 1000 frames, and the new ones are ignored. Look for a "
    "node that gives its frames ever new names.",
    "odometry_lost": "The odometry could not align a frame. The frame gets no pose. Move the "
    "camera more slowly, and keep it unobstructed.",
    # Models
    "detector_error": "The detector failed on an image. The image gives no frame graph. Read the "
    "traceback in the log; if memory is short, choose a smaller checkpoint or another device.",
    "segmenter_error": "The segmenter failed on an image. Its frame graph is empty. Read the "
    "traceback in the log; if memory is short, choose a smaller checkpoint or another device.",
    "relation_head_error": "The relation head failed on an image. Its frame graph has no "
    "relations. Read the traceback in the log; if memory is short, choose a smaller checkpoint or "
    "another device.",
    "world_model_error": "The world model failed on a clip. The clip gives no prediction. Read the "
    "message in the log; if memory is short, choose another device.",
    "nan_features": "The world model computed NaN or infinity for a clip. The clip gives no "
    "prediction. Run it on the CPU (`perception.device: cpu`), and report it with "
    "`deworldsg models inspect`.",
    # Files
    "map_not_written": "A checkpoint of the map could not be written; the file holds the one "
    "before. Make room on the disk, or take another `map_path`.",
    # Joining
    "no_depth": "No depth image is within `inputs.slop_s` of the RGB image. Check the rate and "
    "the stamps of the depth images.",
    "no_camera_info": "No valid camera_info arrived within five seconds of the image. Publish it "
    "on `rgb/camera_info`.",
    "no_instances": "A frame graph arrived without its instance image. Use `config/fastdds.xml` "
    "in every process.",
    "no_rgb": "A local graph arrived without its RGB image. Use `config/fastdds.xml` in every "
    "process.",
    "stale": "A message is not newer than the last one on its topic. Look for a second publisher.",
    "time_jump": "Stamps jumped back by more than a second, or forward by more than a minute "
    "(odometry_node: a second). A jump of one message costs this message. If the next message "
    "confirms it, the node continues at the new time: a recording was restarted, or a clock was "
    "set.",
    "overrun": "Frames arrive faster than a node processes them. It dropped the oldest in its "
    "queue. Lower the camera's frame rate, or choose a faster model.",
    "evidence_overrun": "As `overrun`, for relation evidence. The graph has its frame without it.",
    "lost_rgb": "RGB images were overwritten by newer ones before the node took them, or lost on "
    "the way. If the node is as fast as the camera, use `config/fastdds.xml` in every process.",
    "lost_depth": "As `lost_rgb`, for depth images.",
    "lost_instances": "As `lost_rgb`, for instance images.",
    "lost_camera_info": "As `lost_rgb`, for camera_info.",
    "lost_pose": "As `lost_rgb`, for poses.",
    "lost_frame_graph": "As `lost_rgb`, for frame graphs.",
    "lost_local_graph": "As `lost_rgb`, for local graphs.",
    "lost_relation_evidence": "As `lost_rgb`, for relation evidence.",
    "lost_updates": "As `lost_rgb`, for updates of the graph. The next snapshot replaces them.",
    "unmatched_rgb": "An RGB image belongs to no local graph, because its frame was dropped "
    "before. See the other reasons.",
    "unmatched_depth": "A depth image belongs to no RGB image or frame graph. This is harmless if "
    "depth has the higher rate.",
    "unmatched_instances": "An instance image arrived without its frame graph. Use "
    "`config/fastdds.xml` in every process.",
    "unmatched_local_graph": "Too many local graphs waited for their images, and the oldest was "
    "dropped. Use `config/fastdds.xml` in every process.",
    "unmatched_frame_graph": "Too many frame graphs waited for depth or pose, and the oldest was "
    "dropped. Check the rates of depth and pose.",
    "unmatched_evidence": "The local graph of relation evidence did not arrive. See the reasons of "
    "lifting_node.",
    # Messages between the nodes
    "invalid_message": "A JSON message does not fit its schema. The log line names the field; run "
    "all nodes in one version.",
    "invalid_robot": "A robot of the fleet has a name that is none. Look for another program with "
    "keys of `deworldsg/robots` on the Zenoh network.",
    "too_many_robots": "More than 256 robots were in the fleet, and a new one is ignored. Look for "
    "a robot that gets ever new names, or start fleet_node again.",
    "message_too_large": "A JSON message is larger than 16 MiB, or 256 MiB for the global graph. "
    "Look for a second publisher on its topic.",
    "invalid_stamp": "The stamp of a message is negative. Check the clock of its publisher.",
    "unknown_schema": "A JSON message has another schema, or a later version of it. Run all nodes "
    "in one version.",
    "unknown_instance": "The instance image contains an id without an object in the frame graph. "
    "Run one segmentation_node only.",
    "vocabulary_mismatch": "A message has other classes or predicates than the graph. Run all "
    "nodes with one configuration.",
    "out_of_order": "A local graph is up to a second older than one that is already merged. Look "
    "for a second lifting_node.",
    "no_graph": "A pose correction arrived before the first local graph, and is ignored. Nothing "
    "has to be done.",
    "unknown_frame": "The graph no longer remembers the frame of relation evidence. Choose a "
    "faster world model or device.",
    "invalid_prediction": "The prediction of a world model is not a probability distribution. "
    "Check its probe.",
    # The program
    "internal_error": "An unexpected exception occurred, and the node continued. Report the "
    "traceback in the log.",
}
