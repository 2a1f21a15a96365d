"""Names of classes: Replica's label, its Visual Genome class and its COCO name.

Labels without a class of their own get the nearest class of the Visual Genome list, so that each
object can be a node. The COCO name is kept beside it.
"""

from __future__ import annotations

# label: (Visual Genome class, COCO or common name)
CLASSES: dict[str, tuple[str, str]] = {
    "armchair": ("chair", "chair"),
    "backpack": ("bag", "backpack"),
    "banana": ("banana", "banana"),
    "base-cabinet": ("cabinet", "cabinet"),
    "basket": ("basket", "basket"),
    "bed": ("bed", "bed"),
    "bench": ("bench", "bench"),
    "board": ("board", "board"),
    "book": ("book", "book"),
    "bottle": ("bottle", "bottle"),
    "bowl": ("bowl", "bowl"),
    "box": ("box", "box"),
    "cabinet": ("cabinet", "cabinet"),
    "chair": ("chair", "chair"),
    "clock": ("clock", "clock"),
    "computer-keyboard": ("board", "keyboard"),
    "countertop": ("counter", "counter"),
    "cup": ("cup", "cup"),
    "curtain": ("curtain", "curtain"),
    "cushion": ("pillow", "pillow"),
    "desk": ("desk", "desk"),
    "door": ("door", "door"),
    "fruit": ("fruit", "apple"),
    "handbag": ("bag", "handbag"),
    "indoor-plant": ("plant", "potted plant"),
    "lamp": ("lamp", "lamp"),
    "laptop": ("laptop", "laptop"),
    "microwave": ("box", "microwave"),
    "monitor": ("screen", "tv"),
    "nightstand": ("stand", "stand"),
    "orange": ("orange", "orange"),
    "oven": ("cabinet", "oven"),
    "phone": ("phone", "cell phone"),
    "picture": ("sign", "picture"),
    "plant-stand": ("stand", "stand"),
    "plate": ("plate", "plate"),
    "pot": ("pot", "pot"),
    "refrigerator": ("cabinet", "refrigerator"),
    "remote-control": ("phone", "remote"),
    "shelf": ("shelf", "shelf"),
    "shoe": ("shoe", "shoe"),
    "sink": ("sink", "sink"),
    "sofa": ("chair", "couch"),
    "stool": ("chair", "chair"),
    "table": ("table", "dining table"),
    "teddy-bear": ("bear", "teddy bear"),
    "towel": ("towel", "towel"),
    "tv-screen": ("screen", "tv"),
    "tv-stand": ("cabinet", "cabinet"),
    "umbrella": ("umbrella", "umbrella"),
    "vase": ("vase", "vase"),
    "wardrobe": ("cabinet", "cabinet"),
    "window": ("window", "window"),
}
SEATS = ("chair", "stool", "sofa", "armchair", "bench")
TABLES = ("table", "desk")
# A table with one of these has the relation `with`.
CHAIRS = ("chair", "stool", "armchair")


def visual_genome(label: str) -> str | None:
    """Visual Genome class of a label; None for walls, floor and ceiling."""
    return CLASSES[label][0] if label in CLASSES else None


def coco(label: str) -> str | None:
    """COCO or common name of a label."""
    return CLASSES[label][1] if label in CLASSES else None
