"""What a site's own operator asks of it: keys and signals set it, ticks read it."""


class OperatorRequests:
    """Clutch, emergency stop, reset. Any thread or signal handler may set them; none waits."""

    def __init__(self) -> None:
        self.clutch = False
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

    def take_emergency_stop(self) -> bool:
        """Whether it was asked for since the last call."""
        if not self._emergency_stop:
            return False
        self._emergency_stop = False  # after the look: one asked for in between is not lost
        return True

    def take_reset(self) -> bool:
        """Whether it was asked for since the last call."""
        if not self._reset:
            return False
        self._reset = False
        return True
