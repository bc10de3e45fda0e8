"""What is asked of a site from without: keys, signals and the lease set it, ticks read it."""

CLUTCH_BUTTON, CLUTCH, EMERGENCY_STOP, RESET, UNLEASED = 1, 2, 4, 8, 16
"""Bits of what is asked for in one tick; the first by the device itself."""


class OperatorRequests:
    """Clutch, emergency stop, reset. Any thread or signal handler may set them; none waits.

    While `unleased`, no operator has the lease, or on the operator's side not this one.
    """

    def __init__(self) -> None:
        self.clutch = False
        self.unleased = False
        self._emergency_stop = False
        self._reset = False

    def toggle_clutch(self) -> None:
        """Open the clutch, or close it."""
        self.clutch = not self.clutch

    def stop(self) -> None:
        """Ask for the emergency stop; it outweighs a reset asked for before."""
        self._reset = False
        self._emergency_stop = True

    def reset(self) -> None:
        """Ask to leave FAULT or EMERGENCY_STOP."""
        self._reset = True

    def take(self) -> int:
        """Return clutch and lease, and what else was asked for since the last call, as bits."""
        asked = (CLUTCH if self.clutch else 0) | (UNLEASED if self.unleased else 0)
        # cleared after the look: what is asked for in between is not lost
        if self._emergency_stop:
            self._emergency_stop = False
            asked |= EMERGENCY_STOP
        if self._reset:
            self._reset = False
            asked |= RESET
        return asked

    def ask(self, bits: int) -> None:
        """Ask for what these bits, of an earlier `take`, say."""
        self.clutch = bool(bits & CLUTCH)
        self.unleased = bool(bits & UNLEASED)
        self._emergency_stop = bool(bits & EMERGENCY_STOP)
        self._reset = bool(bits & RESET)
