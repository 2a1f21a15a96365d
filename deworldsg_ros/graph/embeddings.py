"""What the nodes look like, as vectors of one model: fused over viewpoints, saved, and compared.

Also with texts, as vectors of the same model.
"""

from __future__ import annotations

import functools
import logging
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deworldsg_ros.base.array_file import read_arrays, write_arrays
from deworldsg_ros.scene.arrays import Float16, Float32, Float64, Int64
from deworldsg_ros.scene.checks import checked, contained, distinct, holds, lengths, within
from deworldsg_ros.scene.errors import ClientError, RefusedInput
from deworldsg_ros.scene.frame_graph import Embeddings
from deworldsg_ros.scene.limits import MAX_EMBEDDING, check_names
from deworldsg_ros.wire import messages as wire
from deworldsg_ros.wire.codec import vectors_from_bytes

# Two directions from a node to the camera are one viewpoint if their angle is smaller.
VIEWPOINT_RAD = math.radians(15.0)
# Viewpoints that a node remembers; the oldest ones are summed.
MAX_VIEWPOINTS = 8
MODEL, IDS, COUNTS, DIRECTIONS, VECTORS, FRAMES = (
    f"embedding_{name}" for name in ("model", "ids", "counts", "directions", "vectors", "frames")
)
MAX_FRAMES = 2**52
# Of the graph beside which a file is.
STAMP = "embedding_stamp_ns"


@dataclass
class _Views:
    """The viewpoints of one node, oldest first.

    Attributes:
        directions: (k, 3) float32, unit vectors from the node to the camera. A first row of zeros
            stands for the viewpoints that are not remembered.
        vectors: (k, D) float16, mean vector of each viewpoint; in a first row of zero direction,
            the mean of the unit vectors of the viewpoints.
        frames: (k,) int64, number of frames; in that first row, of viewpoints.
    """

    directions: Float32
    vectors: Float16
    frames: Int64

    def add(self, direction: Float64, vector: Float32, frames: int) -> None:
        """Add the mean vector of some frames from a direction."""
        angles = self.directions @ direction
        row = int(angles.argmax()) if len(angles) else -1
        if row >= 0 and angles[row] > math.cos(VIEWPOINT_RAD):
            known = int(self.frames[row])
            mean = (known * self.vectors[row].astype(np.float32) + frames * vector) / (
                known + frames
            )
            self.vectors[row], self.frames[row] = mean, known + frames
            return
        self._append(direction[None], vector[None], [frames])
        remembered = int(self.directions.any(axis=1).sum())
        if remembered > MAX_VIEWPOINTS:
            self._forget(len(self.frames) - MAX_VIEWPOINTS)

    def absorb(self, other: _Views) -> None:
        """Add all viewpoints of another node."""
        forgotten = ~other.directions.any(axis=1)
        for direction, vector, frames in zip(other.directions, other.vectors, other.frames):
            if direction.any():
                self.add(direction.astype(np.float64), vector.astype(np.float32), int(frames))
        if forgotten.any():
            self.directions = np.concatenate([other.directions[:1], self.directions])
            self.vectors = np.concatenate([other.vectors[:1], self.vectors])
            self.frames = np.concatenate([other.frames[:1], self.frames])
            if not self.directions[1].any():
                self._forget(2)

    def embedding(self) -> Float32:
        """(D,) unit vector: each viewpoint counts once."""
        total: Float32 = self._units(slice(None)).sum(axis=0)
        return total / max(float(np.linalg.norm(total)), 1e-12)

    def _units(self, rows: slice) -> Float32:
        """The vectors by which viewpoints add, (k, D)."""
        vectors = self.vectors[rows].astype(np.float32)
        norms = np.linalg.norm(vectors, axis=1, keepdims=True)
        summed = ~self.directions[rows].any(axis=1, keepdims=True)
        scales = np.where(summed, self.frames[rows][:, None], 1.0 / np.maximum(norms, 1e-12))
        return (vectors * scales).astype(np.float32)

    def _forget(self, count: int) -> None:
        """Join the first rows to one of zero direction."""
        summed = ~self.directions[:count].any(axis=1)
        number = int(np.where(summed, self.frames[:count], 1).sum())
        mean = (self._units(slice(count)).sum(axis=0) / number).astype(np.float16)
        self.directions = self.directions[count - 1 :].copy()
        self.vectors, self.frames = self.vectors[count - 1 :], self.frames[count - 1 :]
        self.directions[0], self.vectors[0], self.frames[0] = 0.0, mean, number

    def _append(self, directions: Any, vectors: Any, frames: Any) -> None:
        self.directions = np.concatenate([self.directions, directions]).astype(np.float32)
        self.vectors = np.concatenate([self.vectors, vectors]).astype(np.float16)
        self.frames = np.concatenate([self.frames, np.asarray(frames, np.int64)])

    def copy(self) -> _Views:
        return _Views(self.directions.copy(), self.vectors.copy(), self.frames.copy())


class NodeEmbeddings:
    """The embeddings of the nodes that have one, by id.

    Attributes:
        model: name of the model of all of them; "" = there are none yet.
        size: D; 0 = there are none yet.
        views: of each node; read only.
        changed: ids whose embedding has changed or gone; the publisher empties the set.
    """

    def __init__(self) -> None:
        self.model, self.size = "", 0
        self.views: dict[int, _Views] = {}
        self.changed: set[int] = set()

    def check_fits(self, seen: Embeddings) -> None:
        """Raise RefusedInput ``embedding_model_mismatch`` for vectors of another model."""
        found, known = (seen.model, seen.vectors.shape[1]), (self.model, self.size)
        if self.model and found != known:
            raise RefusedInput(
                "embedding_model_mismatch",
                f"embeddings are of {found[0]!r} with {found[1]} values: expected those of the "
                f"graph, {known[0]!r} with {known[1]}",
            )

    def add(self, node_id: int, direction: Float64, vector: Float16, model: str) -> None:
        """Add what a frame shows of a node, after `check_fits`.

        Args:
            node_id: of a live node.
            direction: (3,) from the node to the camera, of any length.
            vector: (D,), of length one.
            model: of the vector.
        """
        self.model, self.size = model, len(vector)
        if node_id not in self.views:
            none = np.zeros((0, self.size), np.float16)
            self.views[node_id] = _Views(np.zeros((0, 3), np.float32), none, np.zeros(0, np.int64))
        length = max(float(np.linalg.norm(direction)), 1e-9)
        self.views[node_id].add(direction / length, vector.astype(np.float32), 1)
        self.changed.add(node_id)

    def merge(self, node_id: int, removed_id: int) -> None:
        """Give a node the viewpoints of another one, which goes."""
        removed = self.views.pop(removed_id, None)
        self.changed |= {node_id, removed_id}
        if removed is None:
            return
        if node_id in self.views:
            self.views[node_id].absorb(removed)
        else:
            self.views[node_id] = removed

    def copy(self, node_id: int, new_id: int) -> None:
        """Give a new node the viewpoints of another one."""
        if node_id in self.views:
            self.views[new_id] = self.views[node_id].copy()
            self.changed.add(new_id)

    def turn(self, node_id: int, rotation: Float64) -> None:
        """Turn the directions of a node that was moved, by a rotation (3, 3)."""
        if node_id in self.views:
            views = self.views[node_id]
            views.directions = (views.directions @ rotation.T).astype(np.float32)

    def remove(self, node_id: int) -> None:
        """Forget a node."""
        if self.views.pop(node_id, None) is not None:
            self.changed.add(node_id)

    def of(self, node_ids: Iterable[int]) -> dict[int, Float32]:
        """The unit vectors (D,) of the nodes that have one."""
        return {i: self.views[i].embedding() for i in node_ids if i in self.views}

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Copies by name, for `restore`; empty without embeddings."""
        if not self.views:
            return {}
        ids = sorted(self.views)
        views = [self.views[node_id] for node_id in ids]
        return {
            MODEL: np.frombuffer(self.model.encode(), np.uint8),
            IDS: np.array(ids, np.int64),
            COUNTS: np.array([len(one.frames) for one in views], np.int64),
            DIRECTIONS: np.concatenate([one.directions for one in views]),
            VECTORS: np.concatenate([one.vectors for one in views]),
            FRAMES: np.concatenate([one.frames for one in views]),
        }

    def restore(self, arrays: Mapping[str, NDArray[Any]], known: Int64 | None = None) -> None:
        """Continue with `arrays`, of nodes with the `known` ids; ValueError if they are none."""
        if IDS not in arrays:
            return
        ids = checked(arrays, IDS, np.int64, None)
        distinct(IDS, ids)
        if known is not None:
            contained(IDS, ids, known)
        counts = checked(arrays, COUNTS, np.int64, len(ids))
        vectors = checked(arrays, VECTORS, np.float16, None, None)
        total, size = vectors.shape
        holds(VECTORS, 1 <= size <= MAX_EMBEDDING, f"1 to {MAX_EMBEDDING} values each")
        within(VECTORS, vectors, -1.01, 1.01)
        lengths(COUNTS, counts, total)
        within(COUNTS, counts, 1, MAX_VIEWPOINTS + 1)
        directions = checked(arrays, DIRECTIONS, np.float32, total, 3)
        within(DIRECTIONS, directions, -1.01, 1.01)
        frames = checked(arrays, FRAMES, np.int64, total)
        within(FRAMES, frames, 1, MAX_FRAMES)
        model = checked(arrays, MODEL, np.uint8, None).tobytes().decode()
        check_names([model])
        holds(MODEL, bool(model), "a name")
        ends = counts.cumsum().tolist()
        for node_id, start, end in zip(ids.tolist(), [0, *ends], ends):
            rows = slice(start, end)
            parts = directions[rows].copy(), vectors[rows].copy(), frames[rows].copy()
            self.views[node_id] = _Views(*parts)
        self.model, self.size = model, size
        self.changed.update(ids.tolist())


def embeddings_message(
    embeddings: NodeEmbeddings, whole: bool, stamp_ns: int, frame_id: str
) -> wire.EmbeddingsMessage | None:
    """The embeddings that have changed since the last message, or all; None if there are none.

    Args:
        embeddings: of the nodes.
        whole: all of them.
        stamp_ns: of the newest frame.
        frame_id: world frame.
    """
    changed, embeddings.changed = embeddings.changed, set()
    if not (changed or whole) or not embeddings.model:
        return None
    found = embeddings.of(sorted(embeddings.views if whole else changed))
    return wire.EmbeddingsMessage(
        schema=wire.schema_of(wire.EmbeddingsMessage),
        stamp=wire.stamp_from_ns(stamp_ns),
        frame_id=frame_id,
        whole=whole,
        model=embeddings.model,
        nodes=[
            wire.NodeEmbedding(node_id, vector.astype("<f2").tobytes())
            for node_id, vector in found.items()
        ],
        removed=[] if whole else sorted(changed.difference(found)),
    )


# --- The embeddings of a saved graph: a file beside it, or its map.


@dataclass(frozen=True)
class Looks:
    """The embeddings of the objects of one graph, for questions.

    Attributes:
        model: name of the model.
        vectors: (D,) float32 unit vector of each object that has one, by id.
    """

    model: str
    vectors: Mapping[int, Float32]

    def after(self, message: wire.EmbeddingsMessage) -> Looks:
        """With what a message of the topic changes; ValueError if its vectors do not fit."""
        known = {} if message.whole or message.model != self.model else dict(self.vectors)
        for node_id in message.removed:
            known.pop(node_id, None)
        if message.nodes:
            vectors = vectors_from_bytes([node.vector for node in message.nodes])
            seen = Embeddings(np.arange(len(vectors)), vectors, message.model)
            known.update(zip([n.id for n in message.nodes], seen.vectors.astype(np.float32)))
        if len({len(vector) for vector in known.values()}) > 1:
            raise ValueError("embeddings of other lengths than before")
        return Looks(message.model, known)

    def similar(self, vector: Sequence[float] | Float32) -> list[tuple[int, float]]:
        """The objects and their cosines with a vector (D,), the most similar first.

        Raises:
            ValueError: for a vector of another length, or one without a direction.
        """
        asked = np.asarray(vector, np.float64)
        size = len(next(iter(self.vectors.values()), ()))
        if asked.shape != (size,) or not 0.0 < float(np.linalg.norm(asked)) < np.inf:
            raise ValueError(
                f"a vector of shape {asked.shape}, of {self.model!r} are {size} values expected, "
                "finite and not all 0"
            )
        matrix = np.array(list(self.vectors.values()), np.float64)
        cosines = matrix @ asked / np.linalg.norm(asked)
        found = zip(self.vectors, cosines.round(6).tolist())
        return sorted(found, key=lambda one: (-one[1], one[0]))


def embeddings_path(graph_path: Path) -> Path:
    """The file with the embeddings of a saved graph: ``scene_graph.embeddings.npz``."""
    return graph_path.with_name(f"{graph_path.stem}.embeddings.npz")


def write_embeddings(graph_path: Path, stamp_ns: int, embeddings: NodeEmbeddings) -> None:
    """Write the file beside a saved graph of this stamp, if there are embeddings."""
    if embeddings.views:
        arrays = {**embeddings.arrays(), STAMP: np.array(stamp_ns)}
        write_arrays(embeddings_path(graph_path), arrays)


def read_embeddings(path: Path, stamp_ns: int | None = None) -> Looks | None:
    """The embeddings of a file that `write_embeddings` wrote, or of a map; None if it has none.

    Args:
        path: of the file.
        stamp_ns: of the graph, for the file beside it: that of another graph is left out.

    Raises:
        RefusedInput: ``unreadable_embeddings``.
    """
    embeddings = NodeEmbeddings()
    try:
        arrays = read_arrays(path)
        embeddings.restore(arrays)
        if stamp_ns is not None and checked(arrays, STAMP, np.int64) != stamp_ns:
            return None
    except (OSError, ValueError, MemoryError) as error:
        raise RefusedInput("unreadable_embeddings", f"embeddings {path}: {error}") from error
    views = embeddings.views
    return Looks(embeddings.model, embeddings.of(views)) if views else None


# --- Texts as vectors of CLIP or SigLIP, to compare with what objects look like.

# A longer text is cut by the networks, which take 64 or 77 tokens.
MAX_TEXT = 500


def embed_text(model: str, text: str) -> Float32:
    """The vector (D,) of a text, not scaled.

    Args:
        model: of the embeddings: CLIP, SigLIP or SigLIP 2, a folder or a hub id in the local cache.
        text: what is looked for, e.g. "something to drink from".

    Raises:
        ClientError: without torch and transformers, or without the model.
    """
    if not text.strip() or len(text) > MAX_TEXT:
        raise ClientError(f"text of {len(text)} characters: expected 1 to {MAX_TEXT}")
    network, tokenizer, padding = _tower(model)
    import torch

    length = network.config.max_position_embeddings
    tokens = tokenizer(
        text.lower(), padding=padding, truncation=True, max_length=length, return_tensors="pt"
    )
    with torch.inference_mode():
        # SigLIP was trained without a mask of the padding.
        output = network(input_ids=tokens["input_ids"])
    found = getattr(output, "text_embeds", None)
    features = output.pooler_output if found is None else found
    return np.asarray(features[0].float().numpy(), np.float32)


@contextmanager
def one_tower() -> Iterator[None]:
    """Load one of the two towers of a checkpoint, without a list of the other one in the log."""
    logger = logging.getLogger("transformers")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(level)


@functools.lru_cache(maxsize=2)
def _tower(model: str) -> tuple[Any, Any, Any]:
    """The network of texts, its tokenizer, and the padding of its training."""
    try:
        import torch
        import transformers
    except ImportError as error:
        raise ClientError(
            f"texts are compared with objects by torch and transformers ({error}): pip install "
            "torch transformers"
        ) from error
    families = {
        "clip": transformers.CLIPTextModelWithProjection,
        "siglip": transformers.SiglipTextModel,
    }
    try:
        with one_tower():
            return _load(transformers, model, families, torch.float32)
    except ClientError:
        raise
    except Exception as error:  # transformers raises errors of many types
        reason = (str(error).strip() or type(error).__name__).splitlines()[0].rstrip(".")
        raise ClientError(
            f"the embeddings are of {model!r}, whose texts cannot be loaded ({reason}): expected a "
            f"folder or hub id in the local cache (hf download {model}), with its tokenizer"
        ) from error


def _load(
    transformers: Any, model: str, families: dict[str, Any], dtype: Any
) -> tuple[Any, Any, Any]:
    """See `_tower`; raises errors of many types."""
    transformers.utils.logging.disable_progress_bar()
    whole = transformers.AutoConfig.from_pretrained(model, local_files_only=True)
    if whole.model_type not in families:
        raise ClientError(
            f"the embeddings are of {model!r}, a checkpoint of {whole.model_type}: expected "
            "CLIP or SigLIP, which have texts, too"
        )
    config = whole.text_config
    if whole.model_type == "clip":
        config.projection_dim = whole.projection_dim
    network = families[whole.model_type].from_pretrained(
        model, config=config, dtype=dtype, use_safetensors=True, local_files_only=True
    )
    tokenizer = transformers.AutoTokenizer.from_pretrained(model, local_files_only=True)
    padding = "max_length" if whole.model_type == "siglip" else False
    return network.eval(), tokenizer, padding
