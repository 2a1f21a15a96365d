"""Names of classes and predicates: the sets in use, kinds of classes, and predicates that agree."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from deworldsg_ros.scene.arrays import Bool, Float64

# --- Kinds of classes by name, for the classes of COCO, Visual Genome and ScanNet.
#
# A kind says how objects of a class usually rest, contain or hang.

TABLES = frozenset({"table", "dining table", "desk", "counter", "bench"})
SEATS = frozenset({"chair", "couch", "seat", "sofa", "stool"})
# A table is with chairs. A bench carries as tables do, and is none; a couch is near a table.
TABLES_WITH_SEATS = TABLES - {"bench"}
TABLE_SEATS = SEATS - {"couch", "sofa"}
STORAGE = frozenset(
    [
        "bookshelf", "cabinet", "drawer", "oven", "refridgerator", "refrigerator", "shelf",
        "stand", "microwave", "toaster",
    ]
)  # fmt: skip
CONTAINERS = frozenset(
    [
        "vase", "pot", "basket", "bowl", "cup", "sink", "bag", "box", "drawer", "backpack",
        "handbag", "suitcase", "bathtub", "glass", "wine glass",
    ]
)  # fmt: skip
PLANTS = frozenset({"plant", "potted plant", "flower", "tree", "leaf", "branch"})
ON_WALLS = frozenset(
    [
        "picture", "clock", "window", "curtain", "shower curtain", "door", "sign", "board",
        "poster", "logo", "flag", "railing",
    ]
)  # fmt: skip
SCREENS = frozenset({"screen", "tv", "laptop"})
SOFT = frozenset(
    [
        "pillow", "towel", "jacket", "coat", "shirt", "blanket", "bag", "handbag", "backpack",
        "teddy bear", "hat", "cap", "glove", "sock", "pant", "jean",
    ]
)  # fmt: skip
FLAT = frozenset({"book", "plate", "paper", "letter", "keyboard", "remote", "tile", "fork"})
BEDS = frozenset({"bed", "bathtub", "toilet"})
KINDS: tuple[frozenset[str], ...] = (
    TABLES, SEATS, STORAGE, CONTAINERS, PLANTS, ON_WALLS, SCREENS, SOFT, FLAT, BEDS,
)  # fmt: skip

# Classes that are furniture even if only a small part is visible.
FURNITURE = (
    TABLES
    | SEATS
    | frozenset(
        [
            "bathtub", "bed", "bookshelf", "cabinet", "curtain", "door", "oven", "refridgerator",
            "refrigerator", "screen", "shelf", "sink", "stand", "toilet", "tv", "window",
        ]
    )
)  # fmt: skip
# Classes of objects that hang on walls.
HUNG = frozenset({"board", "clock", "picture", "sign"})
# Of these, what the embedded relation head says to be above furniture. People move seats, so a seat
# is neither above nor under anything there.
OVERHEAD = (FURNITURE | HUNG) - SEATS - {"sink"}

# Tables, appliances and flat things carry on their tops. Seats and shelves, beds and containers
# carry below their highest point. So may what is not known here.
CARRY_ON_TOP = TABLES | FLAT | {"oven", "refridgerator", "refrigerator", "microwave", "toaster"}

# Two objects of such a class never stand one over the other. Tables are not among them: the box of
# a table often shows what is under it.
ALONE_IN_PLACE = SEATS | BEDS | PLANTS | {"refridgerator", "refrigerator"}

# Classes of the objects that a class is fixed to.
FIXED_TO = {
    "sink": frozenset({"counter", "cabinet", "table"}),
    "curtain": frozenset({"window", "wall"}),
    "shower curtain": frozenset({"wall", "bathtub"}),
    "picture": frozenset({"wall"}),
    "window": frozenset({"wall"}),
    "door": frozenset({"wall"}),
    "handle": frozenset({"door", "cabinet", "drawer"}),
}


def kind_table(classes: Sequence[str]) -> Float64:
    """(C, len(KINDS)) float64: 1 for each kind of a class."""
    table = [[float(name in kind) for kind in KINDS] for name in classes]
    return np.array(table, np.float64).reshape(-1, len(KINDS))


def fixed_table(classes: Sequence[str]) -> Bool:
    """(C, C) bool: the class of the row is usually fixed to the class of the column."""
    table = np.zeros((len(classes), len(classes)), np.bool_)
    for row, subject in enumerate(classes):
        if subject in FIXED_TO:
            table[row] = [name in FIXED_TO[subject] for name in classes]
    return table


# --- Kinds of rooms, and what stands in them.

ROOM_KINDS = (
    "kitchen", "bathroom", "bedroom", "living room", "dining room", "office", "hallway",
    "laundry room",
)  # fmt: skip
ROOM_PRIOR = (0.14, 0.16, 0.23, 0.15, 0.06, 0.10, 0.13, 0.03)
# Of a hundred rooms of each kind, in how many such a thing stands. Estimates of ours, by hand: no
# public count covers these classes. A class that is not listed tells nothing.
_THINGS: dict[str, tuple[int, ...]] = {
    "refrigerator, refridgerator, fridge": (92, 1, 1, 2, 4, 2, 1, 3),
    "oven, stove, cooker": (92, 1, 1, 1, 2, 1, 1, 1),
    "microwave, toaster, kettle, dishwasher, coffee machine": (75, 1, 1, 2, 5, 6, 1, 2),
    "sink": (90, 92, 2, 1, 2, 2, 1, 45),
    "counter": (80, 35, 1, 3, 5, 4, 2, 20),
    "toilet": (1, 92, 1, 1, 1, 1, 1, 3),
    "bathtub, shower, shower curtain": (1, 75, 1, 1, 1, 1, 1, 2),
    "toothbrush, towel, toilet paper, hair drier": (15, 75, 6, 2, 2, 2, 3, 12),
    "bed, pillow, blanket": (1, 1, 92, 12, 1, 6, 1, 1),
    "wardrobe, dresser, nightstand, night stand": (2, 3, 75, 6, 3, 8, 12, 6),
    "couch, sofa": (3, 1, 8, 90, 8, 15, 4, 1),
    "coffee table": (2, 1, 4, 70, 6, 6, 2, 1),
    "tv, television, remote": (8, 1, 25, 75, 10, 15, 1, 1),
    "dining table": (45, 1, 2, 20, 92, 5, 1, 1),
    "table": (35, 3, 15, 45, 60, 35, 15, 6),
    "chair": (40, 4, 30, 55, 90, 85, 8, 4),
    "desk": (3, 1, 25, 12, 3, 90, 2, 1),
    "computer, laptop, keyboard, mouse, monitor, printer, whiteboard": (4, 1, 20, 18, 4, 85, 2, 1),
    "bookshelf, bookcase": (3, 1, 18, 40, 10, 55, 8, 1),
    "book": (12, 3, 40, 50, 12, 65, 5, 1),
    "washing machine, dryer": (12, 15, 1, 1, 1, 1, 1, 90),
    "plate, bowl, knife, fork, spoon, wine glass": (70, 2, 3, 12, 45, 6, 1, 1),
    "cup, mug, bottle": (65, 20, 15, 30, 40, 45, 2, 6),
    "shoe, umbrella, coat, jacket": (3, 2, 25, 8, 3, 10, 55, 10),
    "teddy bear": (1, 1, 25, 12, 1, 2, 1, 1),
    "fireplace": (2, 1, 4, 40, 12, 3, 2, 1),
}
THINGS_OF_ROOMS = {
    name: np.array(row) / 100.0 for names, row in _THINGS.items() for name in names.split(", ")
}


# --- Predicates with the same meaning, and what a predicate says in the opposite direction.

# Names of each physical relation. The first one in a vocabulary names it if no frame named another.
PREDICATES: tuple[tuple[str, ...], ...] = (
    (
        "on", "standing on", "supported by", "sitting on", "lying on", "laying on", "parked on",
        "on back of",
    ),
    ("in", "inside", "standing in", "lying in", "hanging in"),
    ("attached to", "hanging on", "hanging from", "mounted on", "build in", "built in"),
    ("against", "leaning against", "connected to"),
    ("above", "over"),
    ("under", "below"),
    ("near", "next to", "beside", "close by", "with"),
)  # fmt: skip

# If A is near B, B is near A.
SYMMETRIC = frozenset({"near", "next to", "beside", "close by"})


# What is no verb yet gets "is".
_VERBS = {"with": "goes with", "has": "has", "says": "says", "wears": "wears"}


def plain(name: str) -> str:
    """A name in lower case, with spaces."""
    return name.lower().replace("_", " ")


def verb_of(predicate: str) -> str:
    """A predicate between its subject and its object in a sentence: "on" is "is on"."""
    name = plain(predicate)
    return _VERBS.get(name, f"is {name}")


# --- Names of classes and predicates, in the order of the distributions.

# COCO's 80 detection classes, by their official names.
# fmt: off
COCO_CLASSES: tuple[str, ...] = (
    "person", "bicycle", "car", "motorcycle", "airplane", "bus", "train", "truck", "boat",
    "traffic light", "fire hydrant", "stop sign", "parking meter", "bench", "bird", "cat",
    "dog", "horse", "sheep", "cow", "elephant", "bear", "zebra", "giraffe", "backpack",
    "umbrella", "handbag", "tie", "suitcase", "frisbee", "skis", "snowboard", "sports ball",
    "kite", "baseball bat", "baseball glove", "skateboard", "surfboard", "tennis racket",
    "bottle", "wine glass", "cup", "fork", "knife", "spoon", "bowl", "banana", "apple",
    "sandwich", "orange", "broccoli", "carrot", "hot dog", "pizza", "donut", "cake", "chair",
    "couch", "potted plant", "bed", "dining table", "toilet", "tv", "laptop", "mouse",
    "remote", "keyboard", "cell phone", "microwave", "oven", "toaster", "sink",
    "refrigerator", "book", "clock", "vase", "scissors", "teddy bear", "hair drier",
    "toothbrush",
)
# fmt: on

# ReplicaSSG's 150 Visual Genome classes (34 occur in its scenes).
# fmt: off
VISUAL_GENOME_CLASSES: tuple[str, ...] = (
    "airplane", "animal", "arm", "bag", "banana", "basket", "beach", "bear", "bed", "bench",
    "bike", "bird", "board", "boat", "book", "boot", "bottle", "bowl", "box", "boy", "branch",
    "building", "bus", "cabinet", "cap", "car", "cat", "chair", "child", "clock", "coat",
    "counter", "cow", "cup", "curtain", "desk", "dog", "door", "drawer", "ear", "elephant",
    "engine", "eye", "face", "fence", "finger", "flag", "flower", "food", "fork", "fruit",
    "giraffe", "girl", "glass", "glove", "guy", "hair", "hand", "handle", "hat", "head",
    "helmet", "hill", "horse", "house", "jacket", "jean", "kid", "kite", "lady", "lamp",
    "laptop", "leaf", "leg", "letter", "light", "logo", "man", "men", "motorcycle",
    "mountain", "mouth", "neck", "nose", "number", "orange", "pant", "paper", "paw", "people",
    "person", "phone", "pillow", "pizza", "plane", "plant", "plate", "player", "pole", "post",
    "pot", "racket", "railing", "rock", "roof", "room", "screen", "seat", "sheep", "shelf",
    "shirt", "shoe", "short", "sidewalk", "sign", "sink", "skateboard", "ski", "skier",
    "sneaker", "snow", "sock", "stand", "street", "surfboard", "table", "tail", "tie", "tile",
    "tire", "toilet", "towel", "tower", "track", "train", "tree", "truck", "trunk",
    "umbrella", "vase", "vegetable", "vehicle", "wave", "wheel", "window", "windshield",
    "wing", "wire", "woman", "zebra",
)
# fmt: on

# 3DSSG's 20 ScanNet classes.
# fmt: off
SCANNET_CLASSES: tuple[str, ...] = (
    "bathtub", "bed", "bookshelf", "cabinet", "chair", "counter", "curtain", "desk", "door",
    "floor", "otherfurniture", "picture", "refridgerator", "shower curtain", "sink", "sofa",
    "table", "toilet", "wall", "window",
)
# fmt: on

# ReplicaSSG's 50 Visual Genome predicates (nine occur).
# fmt: off
REPLICA_SSG_PREDICATES: tuple[str, ...] = (
    "above", "across", "against", "along", "and", "at", "attached to", "behind",
    "belonging to", "between", "carrying", "covered in", "covering", "eating", "flying in",
    "for", "from", "growing on", "hanging from", "has", "holding", "in", "in front of",
    "laying on", "looking at", "lying on", "made of", "mounted on", "near", "of", "on",
    "on back of", "over", "painted on", "parked on", "part of", "playing", "riding", "says",
    "sitting on", "standing on", "to", "under", "using", "walking in", "walking on",
    "watching", "wearing", "wears", "with",
)
# fmt: on

# 3DSSG's seven predicates.
# fmt: off
SCANNET_PREDICATES: tuple[str, ...] = (
    "attached to", "build in", "connected to", "hanging on", "part of", "standing on",
    "supported by",
)
# fmt: on

# By the value of `perception.predicate_set`.
PREDICATE_SETS: dict[str, tuple[str, ...]] = {
    "replica_ssg": REPLICA_SSG_PREDICATES,
    "3dssg": SCANNET_PREDICATES,
}
