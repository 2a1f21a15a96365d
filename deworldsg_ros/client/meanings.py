"""What people call things: synonyms, kinds ("seat"), colours, and names near a misspelt one.

A table of ours, for the names of COCO, Objects365, ScanNet and Visual Genome that occur indoors:
WordNet knows 100 meanings for each of them, and has to be installed.
"""

from __future__ import annotations

import difflib
import functools
import itertools
import math
from collections import Counter
from collections.abc import Collection, Sequence

from deworldsg_ros.scene.vocabulary import (
    COCO_CLASSES,
    ROOM_KINDS,
    SCANNET_CLASSES,
    VISUAL_GENOME_CLASSES,
    plain,
)

# Names of one thing.
SYNONYMS: tuple[tuple[str, ...], ...] = (
    ("couch", "sofa", "settee", "loveseat"),
    ("refrigerator", "fridge", "refridgerator", "icebox"),
    ("tv", "television", "tv monitor", "television set", "telly", "monitor", "screen", "display"),
    ("cell phone", "phone", "mobile phone", "mobile", "smartphone", "cellphone", "telephone"),
    ("potted plant", "plant", "house plant", "houseplant"),
    ("hair drier", "hair dryer", "hairdryer", "blow dryer"),
    ("stove", "cooker", "hob", "gas stove"),
    ("faucet", "tap"),
    ("trash can", "trash bin", "garbage can", "garbage bin", "rubbish bin", "waste bin", "dustbin",
     "trash bin can", "wastebasket"),
    ("wardrobe", "closet"),
    ("cabinet", "cupboard"),
    ("nightstand", "night stand", "bedside table"),
    ("curtain", "drape"),
    ("carpet", "rug"),
    ("picture", "painting", "photo", "poster", "picture frame"),
    ("bookshelf", "bookcase"),
    ("bicycle", "bike"),
    ("motorcycle", "motorbike"),
    ("person", "human", "somebody", "someone"),
    ("man", "guy", "men"),
    ("child", "kid"),
    ("backpack", "rucksack", "knapsack"),
    ("handbag", "purse"),
    ("teddy bear", "teddy", "plush bear"),
    ("remote", "remote control"),
    ("mouse", "computer mouse"),
    ("laptop", "notebook computer", "laptop computer"),
    ("glasses", "eyeglasses", "spectacles"),
    ("trousers", "pant", "jean"),
    ("lamp", "light"),
    ("pillow", "cushion"),
    ("garbage", "rubbish", "trash"),
    ("bathtub", "bath", "tub"),
    ("washing machine", "washer"),
    ("dishwasher", "dish washer"),
    ("donut", "doughnut"),
    ("stuffed toy", "soft toy", "plush toy"),
    ("socket", "outlet", "power outlet", "plug socket"),
)  # fmt: skip

# A thing that a detector may call by a more general name: a mug is taken as a cup if no mug is
# known. The general name means the thing, too.
SPECIAL: dict[str, tuple[str, ...]] = {
    "cup": ("mug", "teacup", "coffee cup", "tumbler"),
    "chair": ("armchair", "office chair", "swivel chair", "folding chair", "wooden chair"),
    "dining table": ("kitchen table",),
    "table": ("dining table", "coffee table", "side table", "nightstand", "desk"),
    "bottle": ("flask", "wine bottle", "water bottle"),
    "glass": ("wine glass", "drinking glass"),
    "lamp": ("desk lamp", "floor lamp", "table lamp", "ceiling lamp", "lantern"),
    "book": ("notebook", "magazine"),
    "picture": ("photograph",),
    "potted plant": ("flower", "flowerpot", "bonsai", "succulent"),
    "couch": ("sofa bed", "futon"),
    "bed": ("bunk bed", "crib"),
    "knife": ("cutting knife",),
    "clock": ("alarm clock", "wall clock"),
    "vase": ("flower vase",),
    "bag": ("handbag", "backpack", "shopping bag", "tote"),
    "box": ("carton", "cardboard box", "crate"),
    "cabinet": ("wardrobe", "filing cabinet", "dresser", "chest of drawers", "nightstand"),
    "shelf": ("bookshelf",),
    "oven": ("stove",),
    "person": ("man", "woman", "child", "boy", "girl", "people"),
    "stool": ("bar stool",),
}

# Words for many things. A thing is never taken as all others of its kind.
KINDS: dict[str, tuple[str, ...]] = {
    "seat": ("chair", "couch", "bench", "stool"),
    "furniture": (
        "chair", "couch", "bench", "stool", "bed", "table", "dining table", "cabinet", "shelf",
        "counter",
    ),
    "appliance": (
        "refrigerator", "oven", "microwave", "toaster", "stove", "washing machine", "dishwasher",
        "kettle", "coffee machine", "blender", "hair drier", "air conditioner", "vacuum cleaner",
    ),
    "electronics": (
        "tv", "laptop", "cell phone", "keyboard", "mouse", "remote", "tablet", "printer", "speaker",
        "camera", "router", "computer",
    ),
    "tableware": (
        "cup", "bowl", "plate", "fork", "knife", "spoon", "glass", "wine glass", "bottle",
    ),
    "cutlery": ("fork", "knife", "spoon", "chopsticks"),
    "drinking vessel": ("cup", "glass", "wine glass", "bottle"),
    "container": (
        "bowl", "cup", "bottle", "vase", "box", "basket", "bag", "suitcase", "bucket", "jar", "pot",
    ),
    "food": (
        "banana", "apple", "sandwich", "orange", "broccoli", "carrot", "hot dog", "pizza", "donut",
        "cake", "fruit", "vegetable", "bread",
    ),
    "fruit": ("banana", "apple", "orange", "lemon", "pear", "grape", "peach"),
    "animal": ("bird", "cat", "dog", "horse", "sheep", "cow"),
    "pet": ("cat", "dog", "bird"),
    "toy": ("teddy bear", "stuffed toy", "doll", "frisbee", "kite", "sports ball"),
    "vehicle": ("bicycle", "car", "motorcycle", "bus", "train", "truck"),
    "luggage": ("suitcase", "backpack", "handbag"),
    "clothes": (
        "jacket", "coat", "shirt", "hat", "cap", "glove", "sock", "trousers", "shoe", "tie",
        "sneaker", "boot",
    ),
}  # fmt: skip


def words_of(name: str) -> list[str]:
    """The words of a name in lower case; hyphens and underscores separate words."""
    return plain(name).replace("-", " ").split()


# Of a graph with free names, each of them is compared with what is asked.
@functools.lru_cache(maxsize=65_536)
def is_class(asked: str, label: str) -> bool:
    """Whether a name means a class.

    "table" and "tables" mean "table" and "dining table", "sofa" means "couch", "seat" means
    "chair", "cup" means "mug".
    """
    wanted = words_of(asked)
    if is_called(wanted, label):
        return True
    return any(is_called(name.split(), label) for name in meant_by(" ".join(wanted)))


def is_called(wanted: list[str], label: str) -> bool:
    """Whether a class ends with some words, or with their singular."""
    known = words_of(label)
    if not wanted or len(wanted) > len(known):
        return False
    return any(form == known[-len(form) :] for form in singular_forms(wanted))


def singular_forms(words: list[str]) -> list[list[str]]:
    """The words, and what their last one may be the plural of."""
    *first, last = words
    forms = [last]
    if last.endswith("ies"):
        forms.append(last[:-3] + "y")
    if last.endswith("ves"):
        forms += [last[:-3] + "f", last[:-3] + "fe"]
    if last.endswith("es"):
        forms.append(last[:-2])
    if last.endswith("s"):
        forms.append(last[:-1])
    return [[*first, form] for form in forms]


@functools.lru_cache(maxsize=4096)
def meant_by(asked: str) -> frozenset[str]:
    """Further names that a name means, of `SYNONYMS`, `SPECIAL` and `KINDS`."""
    found: set[str] = set()
    new = {name for form in singular_forms(asked.split() or [""]) for name in _same(" ".join(form))}
    while new:
        found |= new
        below = {i for name in new for table in (SPECIAL, KINDS) for i in table.get(name, ())}
        new = {same for name in below for same in _same(name)} - found
    return frozenset(found)


def more_general(asked: str) -> list[str]:
    """What a thing may be called by a detector that does not know it: of "mug", "cup"."""
    forms = {name for form in singular_forms(asked.split()) for name in _same(" ".join(form))}
    return [name for name, special in SPECIAL.items() if forms.intersection(special)]


def near_names(asked: str, names: Collection[str]) -> list[str]:
    """Names that are spelt alike, the best first; at most three."""
    return difflib.get_close_matches(asked, sorted({*names, *KNOWN}), 3, 0.7)


def _same(name: str) -> set[str]:
    return _SAME.get(name, {name})


_SAME: dict[str, set[str]] = {name: set(group) for group in SYNONYMS for name in group}

# All names of the tables, and of the data sets.
KNOWN: frozenset[str] = frozenset(
    plain(name)
    for names in (
        COCO_CLASSES,
        SCANNET_CLASSES,
        VISUAL_GENOME_CLASSES,
        *SYNONYMS,
        KINDS,
        SPECIAL,
        *KINDS.values(),
        *SPECIAL.values(),
    )
    for name in names
)


# --- Names of rooms.

# What people call a kind of room.
ROOM_NAMES: dict[str, str] = {
    **{kind: kind for kind in ROOM_KINDS},
    **dict.fromkeys(("kitchenette",), "kitchen"),
    **dict.fromkeys(("bath room", "restroom", "washroom", "wc", "shower room"), "bathroom"),
    **dict.fromkeys(("bed room", "sleeping room"), "bedroom"),
    **dict.fromkeys(("lounge", "sitting room", "livingroom", "family room"), "living room"),
    **dict.fromkeys(("dining area",), "dining room"),
    **dict.fromkeys(("study", "workroom", "home office"), "office"),
    **dict.fromkeys(("hall", "corridor", "entrance hall", "landing", "passage"), "hallway"),
    **dict.fromkeys(("laundry", "utility room"), "laundry room"),
}


def room_kind(name: str) -> str | None:
    """The kind of room that a name means, also in the plural: "hall" is hallway; None = none."""
    forms = [" ".join(form) for form in singular_forms(words_of(name) or [""])]
    return next((ROOM_NAMES[form] for form in forms if form in ROOM_NAMES), None)


# --- Names of colours: the eleven basic ones of English (Berlin and Kay, 1969).

COLOURS = (
    *("black", "white", "grey", "red", "orange", "brown"),
    *("yellow", "green", "blue", "purple", "pink"),
)
COLOUR_WORDS = {**{name: name for name in COLOURS}, "gray": "grey", "violet": "purple"}
# Below this chroma, a colour is black, grey or white. Cameras give grey things a chroma of up to 8.
GREY_CHROMA = 9.0
# Below and above these lightnesses, it is black and white.
BLACK_LIGHTNESS, WHITE_LIGHTNESS = 25.0, 78.0
# How far a colour may be another one in other light, along each axis of CIELAB.
COLOUR_STEP = 7.0
# Names of vivid colours by hue: up to each angle, degrees.
HUES = ((8, "pink"), (52, "red"), (82, "orange"), (112, "yellow"), (195, "green"), (309, "blue"),
        (345, "purple"), (360, "pink"))  # fmt: skip


def colour_name(lab: Sequence[float]) -> str:
    """The basic colour name of a CIELAB colour (L*, a*, b*)."""
    lightness, chroma = lab[0], math.hypot(lab[1], lab[2])
    hue = math.degrees(math.atan2(lab[2], lab[1])) % 360.0
    if lightness < 0.5 * BLACK_LIGHTNESS and chroma < 2.5 * GREY_CHROMA:
        return "black"
    # Lamps make white and grey things cream, and eyes see little chroma in what is very light.
    is_cream = (60.0 <= hue <= 115.0 and lightness > 60.0) or lightness > 88.0
    if chroma < GREY_CHROMA * (1.5 if is_cream else 1.0):
        if lightness < BLACK_LIGHTNESS:
            return "black"
        return "white" if lightness > WHITE_LIGHTNESS else "grey"
    name = next(name for most, name in HUES if hue <= most)
    # Brown is dark or dull orange, and dull red and yellow; pink is light red.
    if name == "orange" and (lightness < 60.0 or chroma < 45.0):
        return "brown"
    if name == "red" and lightness > 62.0:
        return "pink"
    if name == "red" and chroma < 38.0 and hue > 25.0:
        return "brown"
    if name == "yellow" and (lightness < 45.0 or chroma < 25.0) and hue < 97.0:
        return "brown"
    if name == "yellow" and lightness < 60.0 and hue >= 97.0:
        return "green"
    if name == "pink" and lightness < 45.0:
        return "purple" if hue > 180.0 else "red"
    return name


@functools.lru_cache(maxsize=65_536)
def colour_shares(lab: tuple[float, float, float]) -> dict[str, float]:
    """How probable each name is for a colour, the best first.

    The share of similar colours, 27 up to `COLOUR_STEP` away, that have the name.
    """
    steps = itertools.product((-COLOUR_STEP, 0.0, COLOUR_STEP), repeat=3)
    names = Counter(colour_name([value + step for value, step in zip(lab, by)]) for by in steps)
    return {name: count / 27 for name, count in names.most_common()}
