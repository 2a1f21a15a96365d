"""The clips that wait for the world model: bounded, judged by a policy."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace

from deworldsg_ros.relations.clip_policy import ClipPolicy, PairKey, Rank
from deworldsg_ros.relations.clips import FrameBuffer, QueuedClip, crop_clip

# Room for the pixels of clips that wait longer than their frames are kept.
CUT_BYTES = 128 * 2**20


class ClipQueue:
    """At most `size` clips, one a pair of nodes; the policy decides and nothing else.

    Args:
        size: clips that may wait.
        policy: judges them.
        on_drop: told the reason of every clip that is lost: those of the policy, ``superseded``
            (a newer clip of its pair waits), ``queue_full`` (better ones took its place),
            ``stale`` (its frames are gone).
    """

    def __init__(self, size: int, policy: ClipPolicy, on_drop: Callable[[str], None]) -> None:
        if size < 1:
            raise ValueError(f"queue of {size} clips: wanted at least 1")
        self.size = size
        self._policy = policy
        self._on_drop = on_drop
        self._items: list[QueuedClip] = []

    def __len__(self) -> int:
        return len(self._items)

    def put(self, items: Iterable[QueuedClip]) -> None:
        """Add clips; what is not worth its time goes, and what there is no room for."""
        self._items.extend(items)
        self._sift()

    def take(self, count: int) -> list[QueuedClip]:
        """The first clips that may be encoded now, at most `count`; they wait no longer."""
        ready = [(rank, item) for rank, item in self._sift() if rank.ready]
        taken = ready[: self._policy.allowance(min(count, len(ready)))]
        for rank, _ in taken:
            self._policy.spend(rank)
        gone = {id(item) for _, item in taken}
        self._items = [item for item in self._items if id(item) not in gone]
        return [item for _, item in taken]

    def ready(self) -> int:
        """How many clips may be encoded now."""
        return self._policy.allowance(sum(rank.ready for rank, _ in self._sift()))

    def cut(self, leaving_ns: int, frames: FrameBuffer, clip_length: int) -> None:
        """Cut clips whose pair is known before the frame with this stamp leaves.

        So a pair that is not confirmed yet, or has to wait for the budget, does not lose what may
        stay its only clip. Others are left to go stale: newer ones will come.
        """
        bytes_left = CUT_BYTES
        kept: list[QueuedClip] = []
        for rank, item in self._sift():
            if item.pixels is None and item.frame_stamps_ns[0] <= leaving_ns:
                images = None if rank.pair is None else frames.images(item.frame_stamps_ns)
                if images is None:
                    self._on_drop("stale")
                    continue
                item = replace(item, pixels=crop_clip(images, item.crop_xyxy, clip_length))
            if item.pixels is not None:
                bytes_left -= item.pixels.nbytes
                if bytes_left < 0:
                    self._on_drop("stale")
                    continue
            kept.append(item)
        self._items = kept

    def clear(self) -> int:
        """Drop everything; returns how many there were."""
        count = len(self._items)
        self._items.clear()
        return count

    def _sift(self) -> list[tuple[Rank, QueuedClip]]:
        """What is left of the clips, the first to be encoded first, with their ranks."""
        ranked: list[tuple[Rank, QueuedClip]] = []
        newest: dict[PairKey, int] = {}
        # Newest first, so that the first clip of a pair is the one to keep.
        items = sorted(self._items, key=lambda item: -item.stamp_ns)
        for item, rank in zip(items, self._policy.judge(items)):
            if isinstance(rank, str):
                self._on_drop(rank)
            elif rank.pair is not None and newest.setdefault(rank.pair, id(item)) != id(item):
                self._on_drop("superseded")
            else:
                ranked.append((rank, item))
        ranked.sort(key=lambda entry: entry[0].order, reverse=True)
        for _ in ranked[self.size :]:
            self._on_drop("queue_full")
        del ranked[self.size :]
        self._items = [item for _, item in ranked]
        return ranked
