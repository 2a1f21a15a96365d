"""The clips that wait for the world model: a bounded number, ranked by a policy."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace

from deworldsg_ros.relations.clip_policy import ClipPolicy, PairKey, Rank
from deworldsg_ros.relations.clips import FrameBuffer, QueuedClip, crop_clip

# Memory for the pixels of clips that wait longer than their frames are buffered, in bytes: 60 clips
# of 16 frames of 210 x 210 pixels.
MAX_CUT_BYTES = 128 * 2**20


class ClipQueue:
    """At most `size` clips, one per pair of nodes, in the order of the policy.

    Args:
        size: clips that may wait.
        policy: ranks the clips.
        on_drop: called with the reason of every lost clip: those of the policy, ``superseded`` (a
            newer clip of its pair waits), ``queue_full`` (clips of higher rank filled the queue),
            ``stale`` (its frames left the buffer).
    """

    def __init__(self, size: int, policy: ClipPolicy, on_drop: Callable[[str], None]) -> None:
        if size < 1:
            raise ValueError(f"clip queue of size {size}: expected at least 1")
        self.size = size
        self._policy = policy
        self._on_drop = on_drop
        self._clips: list[QueuedClip] = []

    def __len__(self) -> int:
        return len(self._clips)

    def put(self, clips: Iterable[QueuedClip]) -> None:
        """Add clips, then drop those that the policy refuses or that exceed the size."""
        self._clips.extend(clips)
        self._sift()

    def take(self) -> QueuedClip | None:
        """Remove the first clip that may be encoded now; None if there is none."""
        for rank, clip in self._sift():
            if not rank.ready:
                continue
            if not self._policy.allowance(1):
                return None
            self._policy.spend(rank)
            self._clips = [other for other in self._clips if other is not clip]
            return clip
        return None

    def ready(self) -> int:
        """The number of clips that may be encoded now."""
        return self._policy.allowance(sum(rank.ready for rank, _ in self._sift()))

    def cut(self, leaving_ns: int, frames: FrameBuffer, clip_length: int) -> None:
        """Cut clips of known pairs before the frame with this stamp leaves the buffer.

        The only clip of a pair that waits for confirmation or for the budget is so kept. Clips
        whose pair is not known yet become stale: newer ones will follow.
        """
        bytes_left = MAX_CUT_BYTES
        kept: list[QueuedClip] = []
        for rank, clip in self._sift():
            if clip.pixels is None and clip.frame_stamps_ns[0] <= leaving_ns:
                images = None if rank.pair is None else frames.images(clip.frame_stamps_ns)
                if images is None:
                    self._on_drop("stale")
                    continue
                clip = replace(clip, pixels=crop_clip(images, clip.crop_xyxy, clip_length))
            if clip.pixels is not None:
                bytes_left -= clip.pixels.nbytes
                if bytes_left < 0:
                    self._on_drop("stale")
                    continue
            kept.append(clip)
        self._clips = kept

    def clear(self) -> int:
        """Drop all clips and return their number."""
        count = len(self._clips)
        self._clips.clear()
        return count

    def _sift(self) -> list[tuple[Rank, QueuedClip]]:
        """Drop clips that need not wait; return the others with their ranks, in encoding order."""
        ranked: list[tuple[Rank, QueuedClip]] = []
        newest: dict[PairKey, int] = {}
        # Newest first: the first clip of a pair is the one to keep.
        clips = sorted(self._clips, key=lambda clip: -clip.stamp_ns)
        for clip, rank in zip(clips, self._policy.judge(clips)):
            if isinstance(rank, str):
                self._on_drop(rank)
            elif rank.pair is not None and newest.setdefault(rank.pair, id(clip)) != id(clip):
                self._on_drop("superseded")
            else:
                ranked.append((rank, clip))
        ranked.sort(key=lambda entry: entry[0].order, reverse=True)
        for _ in ranked[self.size :]:
            self._on_drop("queue_full")
        del ranked[self.size :]
        self._clips = [clip for _, clip in ranked]
        return ranked
