"""A Quanser data acquisition board as this project uses it: counts in, volts out, amplifiers.

The vendor's module hands buffers to C by address and checks neither their type nor their length:
float64 counts would be read as int32. So every buffer that crosses is made here, once, with the
type that the C side expects; `Card` says which.
"""

import importlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Protocol, cast

import numpy as np
import numpy.typing as npt

from hardware.interface import DeviceError, FloatArray

Channels = npt.NDArray[np.uint32]
Counts = npt.NDArray[np.int32]
States = npt.NDArray[np.int32]
Levels = npt.NDArray[np.int8]

OUTPUT_RANGE_V = 10.0
USUAL_MODULE = "quanser.hardware"
BUFFER_S = 1.0  # of samples, which the board keeps for a late reader before it reports an overflow
# The vendor's name for "without end" is not in every version; this is 24 days at 1 kHz.
SAMPLES_WITHOUT_END = 2**31 - 1

_ADVICE = {
    -107: "is the vendor's driver installed?",
    -108: "is it connected and powered, and are board_type and board_id right?",
    -110: "another program has it open; close that first",
    -111: "the computer did not fetch the samples in time",
}


def missing_module(name: str) -> str | None:
    """Say why the vendor's module cannot be loaded, and how to get it; None if it can be."""
    try:
        importlib.import_module(name)
    except (ImportError, OSError) as error:  # OSError: the shared library behind it
        return (
            f"the vendor's Python module {name} cannot be loaded ({error}); it comes with the "
            f"Quanser SDK or with QUARC, and must be installed for this Python"
        )
    return None


class Card(Protocol):
    """The vendor's `HIL`, as far as it is used. Arrays are contiguous, of exactly these types."""

    def open(self, card_type: str, card_identifier: str) -> None:
        """Connect."""

    def close(self) -> None:
        """Disconnect; idempotent."""

    def set_digital_directions(
        self, inputs: Channels | None, num_inputs: int, outputs: Channels, num_outputs: int
    ) -> None:
        """Make lines inputs and outputs."""

    def set_analog_output_ranges(
        self, channels: Channels, num: int, minima: FloatArray, maxima: FloatArray
    ) -> None:
        """Set the outputs' ranges [V]."""

    def set_encoder_quadrature_mode(self, channels: Channels, num: int, modes: States) -> None:
        """Set how many counts a line gives."""

    def set_encoder_counts(self, channels: Channels, num: int, counts: Counts) -> None:
        """Preset the counters."""

    def read_encoder(self, channels: Channels, num: int, counts: Counts) -> None:
        """Read the counters now."""

    def write_analog(self, channels: Channels, num: int, volts: FloatArray) -> None:
        """Set analog outputs now."""

    def write_digital(self, channels: Channels, num: int, levels: Levels) -> None:
        """Set digital outputs now."""

    def task_create_encoder_reader(
        self, samples_in_buffer: int, channels: Channels, num: int
    ) -> object:
        """Return a task that samples the counters."""

    def task_start(self, task: object, clock: int, frequency: float, num_samples: int) -> None:
        """Sample at a clock of the board [Hz]."""

    def task_read_encoder(self, task: object, num_samples: int, counts: Counts) -> int:
        """Wait for the oldest sample not yet fetched, and fetch it."""
        ...

    def task_stop(self, task: object) -> None:
        """Stop sampling."""

    def task_delete(self, task: object) -> None:
        """Free the task."""

    def watchdog_set_analog_expiration_state(
        self, channels: Channels, num: int, volts: FloatArray
    ) -> None:
        """Say what outputs do on expiry."""

    def watchdog_set_digital_expiration_state(
        self, channels: Channels, num: int, states: States
    ) -> None:
        """Say what lines do on expiry."""

    def watchdog_start(self, timeout: float) -> None:
        """Expire unless reloaded within this time [s]."""

    def watchdog_reload(self) -> bool:
        """Reload; False if it had expired."""
        ...

    def watchdog_is_expired(self) -> bool:
        """Tell whether it has expired, and so blocks every access."""
        ...

    def watchdog_clear(self) -> None:
        """Allow access again."""

    def watchdog_stop(self) -> None:
        """Never expire; does not clear."""


class _Clock(Protocol):
    HARDWARE_CLOCK_0: int


class _DigitalState(Protocol):
    TRISTATE: int


class _Quadrature(Protocol):
    X4: int


class Vendor(Protocol):
    """The module `quanser.hardware`, as far as it is used."""

    HIL: Callable[[], Card]
    HILError: type[Exception]
    Clock: _Clock
    DigitalState: _DigitalState
    EncoderQuadratureMode: _Quadrature


@dataclass(frozen=True, slots=True)
class Wiring:
    """Which board, and what is connected where; encoder i and motor i belong together.

    `enable_channels` are the digital outputs that switch amplifiers on at `enabled_level`.
    """

    module: str
    board_type: str
    board_id: str
    encoder_channels: tuple[int, ...]
    analog_channels: tuple[int, ...]
    enable_channels: tuple[int, ...]
    enabled_level: int


class QuanserBoard:
    """One board: outputs at 0 V and amplifiers off from `open` until told otherwise.

    Everything raises DeviceError with the vendor's words, except what ends things, which goes
    through whatever fails. Only `next_counts` may be called from another thread.
    """

    def __init__(self, wiring: Wiring) -> None:
        n = len(wiring.encoder_channels)
        self._wiring = wiring
        self._encoders = _channels(wiring.encoder_channels)
        self._analogs = _channels(wiring.analog_channels)
        self._enables = _channels(wiring.enable_channels)
        self._volts = np.zeros(n)
        self._zero_volts = np.zeros(n)
        self._range_v = np.full(n, OUTPUT_RANGE_V)
        self._counts = np.zeros(n, np.int32)
        self._sampled = np.zeros(n, np.int32)
        self._zero_counts = np.zeros(n, np.int32)
        self._on = np.full(len(self._enables), wiring.enabled_level, np.int8)
        self._off = np.full(len(self._enables), 1 - wiring.enabled_level, np.int8)
        self._errors: type[Exception] | tuple[type[Exception], ...] = ()
        self._task: object | None = None
        self._card: Card | None = None
        self._safe = True  # 0 V and amplifiers off, as far as the board has confirmed it

    def open(self) -> None:
        """Connect, and leave outputs at 0 V, amplifiers off, expiration states set."""
        wiring, n = self._wiring, len(self._encoders)
        vendor = self._load()
        self._errors = vendor.HILError
        card = vendor.HIL()
        with self._saying("cannot be opened"):
            card.open(wiring.board_type, wiring.board_id)
        self._card, self._clock, self._safe = card, vendor.Clock.HARDWARE_CLOCK_0, False
        tristate = np.full(len(self._enables), vendor.DigitalState.TRISTATE, np.int32)
        quadrature = np.full(n, vendor.EncoderQuadratureMode.X4, np.int32)
        try:
            with self._saying("cannot be made safe"):
                # An expiry outlives the program that let it happen, and blocks all access.
                if card.watchdog_is_expired():
                    card.watchdog_clear()
                card.set_digital_directions(None, 0, self._enables, len(self._enables))
                card.write_digital(self._enables, len(self._enables), self._off)
                card.set_analog_output_ranges(self._analogs, n, -self._range_v, self._range_v)
                card.write_analog(self._analogs, n, self._zero_volts)
            with self._saying("refuses its watchdog's expiration states"):
                # A Q8 board changes nothing on expiry unless both are set.
                card.watchdog_set_analog_expiration_state(self._analogs, n, self._zero_volts)
                card.watchdog_set_digital_expiration_state(
                    self._enables, len(self._enables), tristate
                )
            with self._saying("refuses 4X quadrature"):
                card.set_encoder_quadrature_mode(self._encoders, n, quadrature)
        except Exception:
            self.make_safe()
            self.close()
            raise

    def zero_counts(self) -> None:
        """Set every counter to zero; for a board whose amplifiers are off."""
        card, n = self._opened(), len(self._encoders)
        with self._saying("cannot zero its encoders"):
            card.set_encoder_counts(self._encoders, n, self._zero_counts)

    def read_counts(self) -> Counts:
        """Return the counters (n,) as they are now: asks the board, so it takes a while."""
        card = self._opened()
        with self._saying("cannot be read"):
            card.read_encoder(self._encoders, len(self._encoders), self._counts)
        return self._counts.copy()

    def start_sampling(self, rate_hz: float) -> None:
        """Let the board's own clock sample the counters."""
        card, n = self._opened(), len(self._encoders)
        with self._saying(f"cannot sample at {rate_hz:g} Hz"):
            samples = max(round(BUFFER_S * rate_hz), 1)
            self._task = card.task_create_encoder_reader(samples, self._encoders, n)
            card.task_start(self._task, self._clock, rate_hz, SAMPLES_WITHOUT_END)

    def next_counts(self) -> Counts:
        """Wait for the next sample; return the counters (n,), overwritten by the next call."""
        card = self._opened()
        with self._saying("stopped sampling"):
            if card.task_read_encoder(self._task, 1, self._sampled) < 1:
                raise DeviceError(f"{self._name} stopped sampling: its task has ended")
        return self._sampled

    def stop_sampling(self, nobody_waits: Callable[[], bool]) -> None:
        """Stop the task, and free it if nobody waits in `next_counts` any more; never raises."""
        card, task = self._card, self._task
        if card is not None and task is not None:
            with suppress(Exception):
                card.task_stop(task)
            if nobody_waits():  # else the task stays: freed memory is worse than lost memory
                with suppress(Exception):
                    card.task_delete(task)
        self._task = None

    def arm(self, watchdog_s: float) -> None:
        """Write 0 V, start the watchdog, and only then switch the amplifiers on."""
        card, n = self._opened(), len(self._analogs)
        with self._saying("cannot switch its amplifiers on"):
            card.write_analog(self._analogs, n, self._zero_volts)
            self._safe = False
            card.watchdog_start(watchdog_s)
            card.write_digital(self._enables, len(self._enables), self._on)

    def write_volts(self, volts: Sequence[float]) -> None:
        """Reload the watchdog and set the outputs (n,) [V]."""
        card = self._opened()
        with self._saying("cannot be written"):
            if not card.watchdog_reload():
                raise DeviceError(
                    f"{self._name}: its watchdog expired, no torque was written in time; "
                    f"the board has set its outputs to 0 V"
                )
            self._volts[:] = volts
            card.write_analog(self._analogs, len(self._analogs), self._volts)

    def make_safe(self) -> None:
        """Set the outputs to 0 V, then switch the amplifiers off; never raises."""
        card = self._card
        if card is None:
            return
        at_zero = off = False
        with suppress(Exception):
            card.write_analog(self._analogs, len(self._analogs), self._zero_volts)
            at_zero = True
        with suppress(Exception):
            card.write_digital(self._enables, len(self._enables), self._off)
            off = True
        self._safe = at_zero and off

    def disarm(self) -> None:
        """Stop the watchdog, unless it is all that can still make the board safe; never raises."""
        card = self._card
        if card is not None and self._safe:
            with suppress(Exception):
                card.watchdog_stop()

    def close(self) -> None:
        """Disarm and disconnect; never raises, idempotent."""
        self.disarm()
        card, self._card = self._card, None
        if card is not None:
            with suppress(Exception):
                card.close()

    @property
    def _name(self) -> str:
        return f"Quanser board {self._wiring.board_type} {self._wiring.board_id!r}"

    def _load(self) -> Vendor:
        name = self._wiring.module
        lack = missing_module(name)
        if lack is not None:
            raise DeviceError(f"{self._name} cannot be opened: {lack}")
        return cast(Vendor, importlib.import_module(name))

    def _opened(self) -> Card:
        if self._card is None:
            raise DeviceError(f"{self._name} is not open")
        return self._card

    @contextmanager
    def _saying(self, what: str) -> Iterator[None]:
        """Turn a vendor's error into a DeviceError."""
        try:
            yield
        except self._errors as error:
            code = getattr(error, "error_code", None)
            try:
                words = str(error.get_error_message())  # type: ignore[attr-defined]
            except Exception:  # the message is looked up in the vendor's library
                words = "no message"
            advice = _ADVICE.get(code) if isinstance(code, int) else None
            raise DeviceError(
                f"{self._name} {what}: {words} (error {code})"
                + (f"; {advice}" if advice is not None else "")
            ) from error


def _channels(numbers: tuple[int, ...]) -> Channels:
    return np.array(numbers, np.uint32)
