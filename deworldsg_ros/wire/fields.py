"""Types of the fields of messages, with their limits."""

from typing import Annotated, Union

import msgspec

from deworldsg_ros.scene.limits import (
    MAX_COORDINATE_M,
    MAX_EMBEDDING,
    MAX_FOCAL_PX,
    MAX_GRAPH_COORDINATE_M,
    MAX_GRAPH_VARIANCE_M2,
    MAX_INT,
    MAX_LAB,
    MAX_LOGIT,
    MAX_NAME_CHARACTERS,
    MAX_NAMES,
    MAX_OBJECTS,
    MAX_POINTS,
    MAX_SIDE_PX,
    MAX_VARIANCE_M2,
)

NonNegative = Annotated[int, msgspec.Meta(ge=0, le=MAX_INT)]
Positive = Annotated[int, msgspec.Meta(ge=1, le=MAX_INT)]
NodeId = Annotated[int, msgspec.Meta(ge=1, le=MAX_INT)]
# The sum of rounded probabilities may exceed 1 by some ulp.
Probability = Annotated[float, msgspec.Meta(ge=0.0, le=1.0 + 1e-9)]
Distribution = Annotated[
    list[Probability], msgspec.Meta(max_length=MAX_NAMES, description="sums to one")
]
Coordinate = Annotated[float, msgspec.Meta(ge=-MAX_COORDINATE_M, le=MAX_COORDINATE_M)]
Point = Annotated[list[Coordinate], msgspec.Meta(min_length=3, max_length=3)]
Points = Annotated[list[Point], msgspec.Meta(max_length=MAX_POINTS)]
POINT_BYTES = 12
Side = Annotated[int, msgspec.Meta(ge=1, le=MAX_SIDE_PX, description="pixels")]
Pixel = Annotated[float, msgspec.Meta(ge=-MAX_SIDE_PX, le=MAX_SIDE_PX)]
Focal = Annotated[float, msgspec.Meta(ge=-MAX_FOCAL_PX, le=MAX_FOCAL_PX)]
Box = Annotated[
    list[Pixel],
    msgspec.Meta(
        min_length=4, max_length=4, description="x1 y1 x2 y2, pixels; x1 <= x2 and y1 <= y2"
    ),
]
Covariance = Annotated[
    list[Annotated[float, msgspec.Meta(ge=-MAX_VARIANCE_M2, le=MAX_VARIANCE_M2)]],
    msgspec.Meta(
        min_length=9, max_length=9, description="3x3, row by row, symmetric, positive definite"
    ),
]
Pose = Annotated[
    list[Coordinate],
    msgspec.Meta(
        min_length=16, max_length=16, description="4x4, row by row, a rigid transform, metres"
    ),
]
Logits = Annotated[
    list[Annotated[float, msgspec.Meta(ge=-MAX_LOGIT, le=MAX_LOGIT)]],
    msgspec.Meta(max_length=MAX_NAMES),
]
Name = Annotated[
    str,
    msgspec.Meta(max_length=MAX_NAME_CHARACTERS, description="without control characters"),
]
Colour = Annotated[
    Union[
        Annotated[
            list[Annotated[float, msgspec.Meta(ge=-MAX_LAB, le=MAX_LAB)]],
            msgspec.Meta(min_length=3, max_length=3),
        ],
        msgspec.UnsetType,
    ],
    msgspec.Meta(
        description="mean colour of the surface, CIELAB (D65): L* a* b*; absent = unknown"
    ),
]
# Values of half precision take two bytes.
Vector16 = Annotated[
    bytes,
    msgspec.Meta(
        max_length=2 * MAX_EMBEDDING,
        description="vector of length 1, float16 little-endian, base64",
    ),
]
Embedding = Annotated[
    Union[Vector16, msgspec.UnsetType],
    msgspec.Meta(description="what the image shows of the object; absent = not embedded"),
]
Model = Annotated[
    Union[Name, msgspec.UnsetType],
    msgspec.Meta(description="that made the embeddings; absent = there are none"),
]
# Of a scene graph, in metres.
Vector3 = Annotated[
    list[Annotated[float, msgspec.Meta(ge=-MAX_GRAPH_COORDINATE_M, le=MAX_GRAPH_COORDINATE_M)]],
    msgspec.Meta(min_length=3, max_length=3),
]
Size3 = Annotated[
    list[Annotated[float, msgspec.Meta(ge=0.0, le=2 * MAX_GRAPH_COORDINATE_M)]],
    msgspec.Meta(min_length=3, max_length=3, description="along the box's axes, the third is up"),
]
Matrix3 = Annotated[
    list[Annotated[float, msgspec.Meta(ge=-MAX_GRAPH_VARIANCE_M2, le=MAX_GRAPH_VARIANCE_M2)]],
    msgspec.Meta(min_length=9, max_length=9, description="3x3, row by row"),
]
Height = Annotated[float, msgspec.Meta(ge=-MAX_GRAPH_COORDINATE_M, le=MAX_GRAPH_COORDINATE_M)]
# Part of a direction or quaternion of unit length, which may be rounded.
RgbGrid = Annotated[
    bytes, msgspec.Meta(description="R, G, B of every 8th pixel, from the 4th on; base64; or empty")
]
UnitPart = Annotated[float, msgspec.Meta(ge=-1.01, le=1.01)]
Names = Annotated[list[Name], msgspec.Meta(min_length=1, max_length=MAX_NAMES)]
# Row of an object in the message of its frame.
Row = Annotated[int, msgspec.Meta(ge=0, lt=MAX_OBJECTS)]
