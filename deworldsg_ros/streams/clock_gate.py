"""A clock that is wrong for one message costs one message."""

from __future__ import annotations

from typing import Generic, TypeVar

from deworldsg_ros.scene.limits import RESTART_NS

T = TypeVar("T")

# Cameras, and detectors on a CPU, deliver more than a message a minute.
MAX_STEP_NS = 60 * 10**9


class ClockGate(Generic[T]):
    """Holds back a message whose stamp jumps, until the next one confirms the jump.

    A stamp jumps if it is more than `max_step_ns` after the newest one, or more than `RESTART_NS`
    before it. The next message confirms the jump if its stamp is later and jumps in the same
    direction. Otherwise the first one had a wrong stamp, and is lost.

    Args:
        max_step_ns: as above.

    Attributes:
        newest_ns: stamp of the newest message that passed; None before the first.
    """

    def __init__(self, max_step_ns: int = MAX_STEP_NS) -> None:
        self.max_step_ns = max_step_ns
        self.newest_ns: int | None = None
        self._held: tuple[int, T] | None = None

    def admit(self, stamp_ns: int, value: T) -> tuple[list[tuple[int, T]], int | None]:
        """Add a message.

        Returns:
            stamps and values of the messages to take now, in order; and the stamp of a message
            that is lost, or None.
        """
        held, self._held = self._held, None
        lost_ns = None if held is None else held[0]
        side = self._side(stamp_ns)
        if side == 0:
            self.newest_ns = max(stamp_ns, self.newest_ns or 0)
            return [(stamp_ns, value)], lost_ns
        if held is not None and stamp_ns > held[0] and self._side(held[0]) == side:
            self.newest_ns = stamp_ns
            return [held, (stamp_ns, value)], None
        self._held = (stamp_ns, value)
        return [], lost_ns

    def release(self) -> list[tuple[int, T]]:
        """The message that is held back: no other will follow."""
        held, self._held = self._held, None
        return [] if held is None else [held]

    def _side(self, stamp_ns: int) -> int:
        """1 or -1 for a jump forward or back, 0 for none."""
        if self.newest_ns is None:
            return 0
        if stamp_ns < self.newest_ns - RESTART_NS:
            return -1
        return int(stamp_ns > self.newest_ns + self.max_step_ns)


def jump_text(name: str, stamp_ns: int, max_step_ns: int = MAX_STEP_NS) -> str:
    """The message of a drop."""
    return (
        f"{name} at {stamp_ns / 1e9:.3f} s is more than {max_step_ns / 1e9:g} s after, or a second "
        "before, its neighbours: expected increasing stamps. Check the clock"
    )
