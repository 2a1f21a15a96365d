"""One typed configuration for the nodes and the command line.

The defaults are the paper's values, plus extensions that measured better. config/paper_rules.yaml
turns the extensions off; config/paper.yaml adds the paper's networks.

Each section configures one stage. Description and range of a field are stated here only: the nodes
declare their ROS parameters `section.field` from this module. A ROS parameter file also works with
`deworldsg run --config`.
"""

import math
from pathlib import Path
from typing import Annotated, Any, Literal, Union

import msgspec

from deworldsg_ros.base.files import MAX_YAML_BYTES, parse_yaml, read_regular
from deworldsg_ros.base.words import suggestion
from deworldsg_ros.scene.errors import ConfigurationError


def option(description: str, **limits: Any) -> Any:
    """Description and limits (`ge`, `gt`, `le`, `lt`) of a field, for `Annotated`."""
    return msgspec.Meta(description=description, **limits)


def texts_limits(kind: Any) -> str:
    """Limits of a list of texts, in words; of msgspec's description of its type."""
    texts = kind.item_type
    return f"at most {kind.max_length} of {texts.min_length} to {texts.max_length} characters"


# Words of `perception.words`, and characters of one.
MAX_WORDS, MAX_WORD_CHARACTERS = 200, 64
Word = Annotated[str, msgspec.Meta(min_length=1, max_length=MAX_WORD_CHARACTERS)]


class PerceptionConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Stage a: image → 2D scene graph and instance image."""

    detector: Annotated[
        str,
        option(
            "detector: nanodet (shipped weights, COCO classes), pair (NanoDet and SSDLite as one, "
            "shipped, too), transformers (D-FINE, RF-DETR and "
            "others of fixed classes; rtdetr, the paper's, is another name of it), open_vocabulary "
            "(OWLv2, Grounding DINO, OmDet-Turbo or SAM 3 look for `words`), onnx (exported by "
            "`deworldsg models export`, runs without torch), topic (another process sends them) or "
            "a plug-in"
        ),
    ] = "nanodet"
    segmenter: Annotated[
        str,
        option(
            "segmenter of the detected boxes: rgbd (no weights), sam2 (the paper's), sam3 or sam"
        ),
    ] = "rgbd"
    relation_head: Annotated[
        str, option("relation head: geometric (no weights) or egtr (the paper's, needs rtdetr)")
    ] = "geometric"
    predicate_set: Annotated[
        Literal["replica_ssg", "3dssg", "checkpoint"],
        option(
            "predicates of the graph: ReplicaSSG (Visual Genome, 50), 3DSSG (7), or those of the "
            "relation head's checkpoint"
        ),
    ] = "replica_ssg"
    score_threshold: Annotated[
        float,
        option(
            "minimum detection score (the paper: 0.7); -1 = the default of the detector",
            ge=-1,
            le=1,
        ),
    ] = -1.0
    max_relations: Annotated[
        int,
        option("maximum number of relations per frame, best first (the paper: 10)", ge=0, le=1000),
    ] = 100
    refine_detections: Annotated[
        bool,
        option(
            "beyond the paper: nested detections of one object are joined, boxes that fill the "
            "image are dropped, weak boxes inside a larger object keep their pixels, and images of "
            "a camera on its side are turned upright"
        ),
    ] = True
    detector_path: Annotated[
        str,
        option("checkpoint of the detector and egtr: a folder, or a hub id in the local cache"),
    ] = ""
    words: Annotated[
        tuple[Word, ...],
        option(
            "what the detector open_vocabulary looks for; with the detector topic, names of the "
            "classes that it sends as numbers, from 0",
            max_length=MAX_WORDS,
        ),
    ] = ()
    segmenter_path: Annotated[
        str, option("checkpoint of sam2, sam3 or sam: a folder, or a hub id in the local cache")
    ] = ""
    embedder: Annotated[
        str,
        option(
            "CLIP, SigLIP or SigLIP 2 that embeds two objects a second, for questions by looks: a "
            "folder, or a hub id in the local cache; empty = none"
        ),
    ] = ""
    device: Annotated[
        Literal["auto", "cpu", "cuda"],
        option(
            "device of all networks on torch, also of world models; auto = CUDA if available, else "
            "the CPU"
        ),
    ] = "auto"
    threads: Annotated[int, option("CPU threads of the networks; 0 = all cores", ge=0, le=64)] = 2


class LiftingConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Stage b: depth refinement and Gaussians (Eq. 1-4)."""

    tau: Annotated[float, option("relative tolerance to the local median, Eq. 1", ge=0, le=1)] = (
        0.05
    )
    gamma_base_m: Annotated[
        float, option("minimum gap between depth clusters, metres, Eq. 2", gt=0, le=10)
    ] = 0.03
    covariance_ridge_m2: Annotated[
        float,
        option("value added to the diagonal of a covariance, square metres, Eq. 4", gt=0, le=1),
    ] = 1e-6
    pixels: Annotated[
        Literal["refined", "mask", "box"],
        option(
            "pixels of an object: refined = mask with depth refinement (Eq. 1-2), mask = mask "
            "only, box = the one at the centre of its box, as FROSS; mask and box are the paper's "
            "ablation"
        ),
    ] = "refined"


class MergingConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Stage c: association and fusion (Eq. 5-7)."""

    association: Annotated[
        Literal["paper", "surface", "things"],
        option(
            "association rule: paper = Gaussian and class distance (Eq. 5-6), surface = overlap of "
            "surfaces, things = surface, and what stands on tables and shelves is an object "
            "without a name where no detector fires"
        ),
    ] = "surface"
    hellinger_threshold: Annotated[
        float, option("maximum Hellinger distance of a match, Eq. 6 (paper rule)", gt=0, lt=1)
    ] = 0.7
    class_distance_threshold: Annotated[
        float, option("maximum class distance of a match, Eq. 6 (paper rule)", gt=0, le=1)
    ] = 0.8
    overlap_threshold: Annotated[
        float,
        option(
            "minimum overlap fraction of a match whose classes agree (surface rule)", gt=0, le=1
        ),
    ] = 0.3


class RelationsConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Stage d: pairing, world model, prior and fusion (Eq. 8-10)."""

    world_model: Annotated[
        str, option("world model: none, physics (embedded), vjepa2, dinov2, or fake for tests")
    ] = "physics"
    geo_cost_threshold: Annotated[
        float,
        option("geometric cost below which two objects are a neighbour pair, Eq. 8", gt=0, le=100),
    ] = 0.45
    clip_length: Annotated[int, option("frames per clip", ge=1, le=256)] = 16
    entropy_threshold_nats: Annotated[
        float,
        option("entropy of the predicates of a pair above which the prior is used", ge=0, le=10),
    ] = 1.0
    fusion_alpha: Annotated[float, option("weight of the prior, Eq. 10", ge=0, le=100)] = 0.5
    edge_belief: Annotated[
        Literal["paper", "all_pairs", "robust"],
        option(
            "meaning of the probability of an edge: paper = which predicate, from the sum of "
            "logits, each direction separately (Eq. 9), of frames in which the two are a neighbour "
            "pair (Eq. 8); all_pairs = the same, of all frames; robust = whether the relation "
            "holds, from frames, fused geometry and the prior; an object has one support"
        ),
    ] = "robust"
    max_clips_per_s: Annotated[
        float,
        option(
            "maximum rate of clips for the world model, Hz, by image stamps; the most uncertain "
            "pairs come first; 0 = every clip of every frame, as in the paper",
            ge=0,
            le=1000,
        ),
    ] = 10.0
    world_model_path: Annotated[
        str, option("checkpoint of the world model: a folder, or a hub id in the local cache")
    ] = ""
    probe_path: Annotated[str, option("folder of the trained probe")] = ""


class InputsConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Input topics, poses and depth."""

    transport: Annotated[
        Literal["auto", "raw", "compressed"],
        option(
            "type of the image topics: raw = Image, compressed = CompressedImage, auto = the type "
            "that is published"
        ),
    ] = "auto"
    reliability: Annotated[
        Literal["auto", "reliable", "best_effort"],
        option(
            "QoS reliability of the camera and pose topics; auto = reliable if every publisher "
            "offers it, else best_effort"
        ),
    ] = "auto"
    pose_source: Annotated[
        Literal["auto", "pose", "odometry", "tf"],
        option(
            "source of the camera poses: PoseStamped, Odometry or TF; auto = the pose topic if it "
            "is published, else TF; TF also transforms an Odometry of another frame to the camera"
        ),
    ] = "auto"
    world_frame: Annotated[
        str,
        option(
            "frame_id of the world frame; poses in another frame are refused; empty = the frame "
            "of the first pose"
        ),
    ] = ""
    world_up: Annotated[
        Literal["auto", "x", "-x", "y", "-y", "z", "-z"],
        option(
            "axis of the world frame that points up; auto = z (the ROS convention) if the camera "
            "poses agree with it, else the axis estimated from the poses"
        ),
    ] = "auto"
    slop_s: Annotated[
        float,
        option(
            "maximum difference between the stamps of an RGB image and its depth image, seconds; "
            "the default is below half a frame period at 20 Hz",
            ge=0,
            le=1,
        ),
    ] = 0.02
    pose_slop_s: Annotated[
        float,
        option(
            "maximum time between an image and the poses around it, seconds; "
            "the default is one period of a 10 Hz localisation",
            ge=0,
            le=10,
        ),
    ] = 0.1
    depth_scale: Annotated[
        float,
        option(
            "metres per unit of a depth image; 0 = by its encoding (REP 118): millimetres in "
            "16UC1, metres in 32FC1",
            ge=0,
            le=1,
        ),
    ] = 0.0
    max_depth_m: Annotated[
        float,
        option(
            "maximum valid depth, metres; larger values count as invalid; the default is the "
            "range of common RGB-D cameras",
            gt=0,
        ),
    ] = 10.0


class OdometryConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Camera poses estimated from the images: odometry_node, `deworldsg run --odometry`."""

    publish_tf: Annotated[
        bool,
        option(
            "also publish to /tf the pose of the frame that the camera is mounted on (needs "
            "tf2_msgs)"
        ),
    ] = False


class OutputConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The published graph."""

    rate_hz: Annotated[
        float, option("maximum rate of /scene_graph/updates, Hz", ge=1e-3, le=1000)
    ] = 30.0
    top_k: Annotated[
        int,
        option(
            "number of classes per node and predicates per edge, most probable first", ge=1, le=1000
        ),
    ] = 5
    min_existence: Annotated[
        float,
        option(
            "minimum probability of a published node that it is an object (surface rule); 0 = all",
            ge=0,
            le=1,
        ),
    ] = 0.5
    min_name: Annotated[
        float,
        option(
            "minimum probability of the label of a published node; below it, the node is an "
            "'object' with its classes as guesses; 0 = the most probable class, always",
            ge=0,
            le=1,
        ),
    ] = 0.5
    publish_tf: Annotated[
        bool,
        option("also publish the boxes of the objects to /tf, as object_ID (needs tf2_msgs)"),
    ] = False
    robot_height_m: Annotated[
        float,
        option(
            "what is higher above the floor is free on /scene_graph/map, metres", ge=0.15, le=10
        ),
    ] = 1.5
    include_surface_points: Annotated[
        bool, option("publish the surface points of each node (large messages)")
    ] = False


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The whole configuration."""

    inputs: InputsConfig = InputsConfig()
    odometry: OdometryConfig = OdometryConfig()
    perception: PerceptionConfig = PerceptionConfig()
    lifting: LiftingConfig = LiftingConfig()
    merging: MergingConfig = MergingConfig()
    relations: RelationsConfig = RelationsConfig()
    output: OutputConfig = OutputConfig()


def load_config(path: Union[str, Path]) -> Config:
    """Read a ROS parameter file, or a file of bare sections.

    Raises:
        ConfigurationError: names the file, the field, the value seen and the value expected.
    """
    try:
        content = parse_yaml(read_regular(Path(path), MAX_YAML_BYTES))
    except OSError as error:
        raise ConfigurationError(f"configuration {path}: {error.strerror}") from error
    except ValueError as error:
        raise ConfigurationError(f"configuration {path}: {error}") from error
    for key in ("/**", "ros__parameters"):
        if isinstance(content, dict) and key in content:
            content = content[key]
    content = {} if content is None else content
    if isinstance(content, dict):
        content.pop("use_sim_time", None)
    return from_mapping(content, str(path))


def from_mapping(content: Any, source: str = "configuration") -> Config:
    """Check nested plain values and convert them to a Config; raises ConfigurationError."""
    if isinstance(content, dict):
        _check_names(content, source)
    try:
        config = msgspec.convert(content, Config)
    except msgspec.ValidationError as error:
        raise ConfigurationError(f"{source}: {error}") from error
    for section, fields in to_mapping(config).items():
        for name, value in fields.items():
            if isinstance(value, float) and not math.isfinite(value):
                raise ConfigurationError(
                    f"{source}: {section}.{name} is {value}: expected a finite number"
                )
    return config


def _check_names(content: dict[Any, Any], source: str) -> None:
    known = to_mapping(Config())
    options = [f"{section}.{name}" for section, fields in known.items() for name in fields]
    for section, fields in content.items():
        if section not in known:
            expected = ", ".join(known)
            raise ConfigurationError(
                f"{source}: there is no section {section}{suggestion(str(section), known)}; "
                f"expected {expected}"
            )
        for name in fields if isinstance(fields, dict) else ():
            if (option := f"{section}.{name}") not in options:
                raise ConfigurationError(
                    f"{source}: there is no option {option}{suggestion(option, options)}"
                )


def to_mapping(config: Config) -> dict[str, Any]:
    """Nested plain values of a configuration: sections of fields."""
    mapping: dict[str, Any] = msgspec.to_builtins(config)
    return mapping


def to_yaml(config: Config) -> str:
    """Text of a ROS parameter file with the whole configuration."""
    content = {"/**": {"ros__parameters": to_mapping(config)}}
    return msgspec.yaml.encode(content).decode()
