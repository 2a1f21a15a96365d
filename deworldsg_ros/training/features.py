"""Features of clips, with a cache on disk: an interrupted training continues from it."""

from __future__ import annotations

import hashlib
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from deworldsg_ros.files import write_atomically
from deworldsg_ros.relations.probing.backbone import FrozenBackbone
from deworldsg_ros.scene.arrays import Float32
from deworldsg_ros.training.labelled_clips import LabelledClip, of_length

# Features per file. An interruption loses at most this many clips.
SHARD_SIZE = 32


class FeatureCache:
    """Features of clips, for one backbone and preprocessing; each has its own folder.

    Args:
        root: folder of all caches.
        description: everything besides the clip that changes a feature.
    """

    def __init__(self, root: Path, description: str) -> None:
        self.folder = root / _digest(description)
        self.folder.mkdir(parents=True, exist_ok=True)
        write_atomically(self.folder / "description.txt", description + "\n")
        self._features: dict[str, Float32] = {}
        self._unsaved: list[str] = []
        for path in sorted(self.folder.glob("*.npz")):
            self._load(path)

    def __len__(self) -> int:
        return len(self._features)

    def get(self, key: str) -> Float32 | None:
        """The feature of a clip, (d,) float32; None if it was not extracted yet."""
        return self._features.get(_digest(key))

    def add(self, key: str, feature: Float32) -> None:
        """Keep a feature; the next full file or `save` writes it."""
        digest = _digest(key)
        self._features[digest] = feature
        self._unsaved.append(digest)
        if len(self._unsaved) >= SHARD_SIZE:
            self.save()

    def save(self) -> None:
        """Write all unsaved features to one new file, completely or not at all."""
        if not self._unsaved:
            return
        digests = self._unsaved
        path = self.folder / f"{_digest(' '.join(digests))}.npz"
        features = np.stack([self._features[digest] for digest in digests])
        write_atomically(
            path, lambda file: np.savez(file, digests=np.array(digests), features=features)
        )
        self._unsaved = []

    def _load(self, path: Path) -> None:
        try:
            with np.load(path, allow_pickle=False) as content:
                rows = zip(content["digests"].tolist(), content["features"])
                self._features.update((digest, np.asarray(row, np.float32)) for digest, row in rows)
        except (OSError, KeyError, ValueError, zipfile.BadZipFile):
            # A damaged file: its features are extracted again.
            path.unlink()


def extract_features(
    backbone: FrozenBackbone,
    clips: Sequence[LabelledClip],
    cache: FeatureCache,
    *,
    batch_size: int,
    advance: Callable[[int], None] = lambda _: None,
) -> Float32:
    """Features of clips, (n, d) float32; only clips that are not in the cache are encoded.

    Args:
        backbone: encodes the clips.
        clips: labelled clips.
        cache: of this backbone.
        batch_size: clips encoded at once.
        advance: called with the number of further clips that are done.
    """
    missing = [clip for clip in clips if cache.get(clip.key) is None]
    advance(len(clips) - len(missing))
    try:
        for start in range(0, len(missing), batch_size):
            batch = missing[start : start + batch_size]
            length = backbone.identity.clip_length
            features = backbone.encode([of_length(clip.read(), length) for clip in batch])
            for clip, feature in zip(batch, features):
                cache.add(clip.key, feature)
            advance(len(batch))
    finally:
        cache.save()
    rows = [feature for clip in clips if (feature := cache.get(clip.key)) is not None]
    return np.stack(rows) if rows else np.zeros((0, backbone.identity.feature_dim), np.float32)


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:20]
