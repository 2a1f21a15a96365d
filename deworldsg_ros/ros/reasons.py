"""The reasons under which /diagnostics counts what is refused, and what to do about each."""

from __future__ import annotations

REASONS: dict[str, str] = {
    # Images
    "unknown_encoding": "the image's encoding is none of those listed in the log line; convert it, "
    "or for compressed depth publish PNG",
    "empty_image": "the image has no pixels; look at the camera driver",
    "bad_step": "a row is shorter than its pixels, or no whole number of them; look at the driver",
    "short_buffer": "the image holds fewer bytes than its size needs; look at the driver",
    "decode_failed": "a compressed image is neither JPEG nor PNG, or is damaged",
    "grid_mismatch": "RGB, depth and camera_info differ in size; publish depth registered to RGB",
    "invalid_intrinsics": "camera_info holds zeros or NaN; calibrate the camera",
    # Poses
    "invalid_pose": "a pose holds NaN, infinity, or a quaternion that is not of length 1",
    "wrong_frame": "a pose is in another world frame than the first one, or than "
    "`inputs.world_frame`; or a local graph in another than the graph",
    "pose_jump": "the camera moved more than 1 m between two frames, or rotated faster than 360 "
    "degrees a second; accepted after five consistent frames at the new position",
    "no_pose": "no pose within `inputs.pose_slop_s` of the image; look at rates and clocks",
    "no_transform": "the odometry is of another frame than the camera's, and TF does not connect "
    "the two; publish that transform, or set `inputs.pose_source` to odometry if the poses are the "
    "camera's all the same",
    "odometry_lost": "a frame fits none before it: blocked, blank or too fast; it gets no pose",
    # Models
    "detector_error": "the detector failed on the image; the log has the first traceback, other "
    "frames go on. Out of memory: a smaller checkpoint, or a free device",
    "segmenter_error": "the segmenter failed on the image: its frame graph is empty; see "
    "`detector_error`",
    "relation_head_error": "the relation head failed on the image: its objects go on without "
    "relations; see `detector_error`",
    # Joining
    "no_depth": "no depth image within `inputs.slop_s` of the RGB image",
    "no_camera_info": "no usable camera_info came while the frame waited (`patience_s`)",
    "no_instances": "a frame graph came without its instance image",
    "no_rgb": "a local graph came without its RGB image",
    "stale": "a message is not newer than the one before it on its topic; two publishers?",
    "time_jump": "stamps went back by more than a second: a recording was started again",
    "overrun": "the node's work is slower than the frames; the oldest of `queue_size` was let go",
    "unmatched_rgb": "an RGB image belonged to no local graph; harmless, its frame was dropped "
    "before",
    "unmatched_depth": "a depth image belonged to no RGB image or frame graph; harmless where "
    "depth is the faster stream",
    "unmatched_instances": "an instance image came without its frame graph",
    "unmatched_local_graph": "a local graph had to go because too many waited for their images",
    "unmatched_frame_graph": "a frame graph had to go because too many waited for depth or pose",
    "unmatched_evidence": "relation evidence waited for a local graph that did not come",
    # Messages between the nodes
    "invalid_message": "a JSON message does not fit its schema; the log line names the field",
    "unknown_schema": "a JSON message is another one, or of a later version",
    "unknown_instance": "the instance image holds a value beyond the frame graph's objects",
    "vocabulary_mismatch": "a message has other classes or predicates than the graph; run all "
    "nodes with one configuration",
    "out_of_order": "a local graph is older than one that is merged already; restart graph_node "
    "after starting a recording again",
    "no_graph": "a pose correction came before the first local graph: there is nothing to correct",
    "unknown_frame": "relation evidence speaks of a frame that the graph does not remember",
    "invalid_prediction": "a world model's answer is no distribution",
    # Neither
    "internal_error": "a mistake in the program; the log has its traceback, the node went on",
}
