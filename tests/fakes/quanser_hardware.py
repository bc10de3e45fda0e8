"""A stand-in for the vendor's `quanser.hardware`, and the bench behind it.

`HIL` behaves as documented, and is stricter where the vendor's is silently wrong: it refuses a
buffer of another type, shape or layout, which the vendor's would misread. Behind it a `Board`
with its clock, watchdog and amplifiers drives a plant: free joints, or the shared plant whose
file the environment variable FARHAND_FAKE_PLANT names, joints from FARHAND_FAKE_QUANSER_FIRST on.
Without further ado a board "q8_usb" "0" is connected; `connect` puts another one in its place.

Time is the computer's, or a `ManualTime` that a test moves on.
"""

import math
import mmap
import os
import struct
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

CHANNELS = 8
RANGE_V = 10.0

INVALID_ARGUMENT = -4
BOARD_NOT_FOUND = -108
UNABLE_TO_LOCK_DEVICE = -110
BUFFER_OVERFLOW = -111
# The vendor's numbers for these two are not known here.
DISCONNECTED = -9001
WATCHDOG_EXPIRED = -9002

_MESSAGES = {
    INVALID_ARGUMENT: "One of the arguments is invalid.",
    BOARD_NOT_FOUND: "The board could not be found.",
    UNABLE_TO_LOCK_DEVICE: "The device is in use.",
    BUFFER_OVERFLOW: "A buffer overflowed: data were not read in time.",
    DISCONNECTED: "The board no longer answers.",
    WATCHDOG_EXPIRED: "The watchdog has expired: access to the hardware is blocked.",
}


class Clock:
    HARDWARE_CLOCK_0 = 0


class DigitalState:
    LOW = 0
    HIGH = 1
    TRISTATE = 2
    NO_CHANGE = 3


class EncoderQuadratureMode:
    X4 = 4


class HILError(Exception):
    def __init__(self, error_code: int) -> None:
        super().__init__(error_code)
        self.error_code = error_code

    def get_error_message(self, locale: str | None = None, buffer_size: int = -1) -> str:
        return _MESSAGES[self.error_code]


@dataclass(frozen=True)
class Robot:
    """How the bench is really wired and geared: what a session's settings must say too."""

    encoder_channels: tuple[int, ...] = (0, 2)
    analog_channels: tuple[int, ...] = (0, 1)
    enable_channels: tuple[int, ...] = (0, 1)
    counts_per_rad: tuple[float, ...] = (6000.0, 5000.0)
    encoder_signs: tuple[int, ...] = (1, -1)
    motor_signs: tuple[int, ...] = (-1, 1)
    amplifier_gain_a_per_v: tuple[float, ...] = (0.5, 0.5)
    torque_constant_nm_per_a: tuple[float, ...] = (0.8, 0.6)


class Plant(Protocol):
    """What the motors push, in the encoders' angles φ."""

    def angle_rad(self) -> list[float]: ...

    def push(self, torque_nm: list[float], from_ns: int, to_ns: int) -> None: ...

    def end_torque_at(self, at_ns: int | None) -> None:
        """Take the watchdog's deadline, for a plant that outlives the process of the board."""


class FreeJoints:
    """Joints that do not know of each other: I φ̈ = τ + hand − d φ̇."""

    def __init__(
        self,
        joints: int = 2,
        inertia_kg_m2: float = 0.02,
        damping_nm_s: float = 0.1,
        angle_rad: tuple[float, ...] | None = None,
    ) -> None:
        self._inertia, self._damping = inertia_kg_m2, damping_nm_s
        self._angle = list(angle_rad or [0.3] * joints)
        self._velocity = [0.0] * joints
        self.hand_nm = [0.0] * joints
        self.locked = [False] * joints

    def angle_rad(self) -> list[float]:
        return list(self._angle)

    def push(self, torque_nm: list[float], from_ns: int, to_ns: int) -> None:
        left_s = (to_ns - from_ns) * 1e-9
        while left_s > 0.0:
            step_s = min(left_s, 1e-3)
            left_s -= step_s
            for i, torque in enumerate(torque_nm):
                drag = self._damping * self._velocity[i]
                self._velocity[i] += step_s * (torque + self.hand_nm[i] - drag) / self._inertia
                if self.locked[i]:
                    self._velocity[i] = 0.0
                self._angle[i] += step_s * self._velocity[i]

    def end_torque_at(self, at_ns: int | None) -> None:
        """The board, in the same process, ends it."""


class SharedPlant:
    """Some joints of the plant that another process runs; the layout is tests/fakes/plant.py's.

    That process plays the board's watchdog too: it runs on where this one is killed or stands.
    """

    def __init__(self, path: str, first: int, joints: int) -> None:
        with open(path, "r+b") as file:
            self._map = mmap.mmap(file.fileno(), 4096)
        self._first, self._joints = first, joints

    def angle_rad(self) -> list[float]:
        for _ in range(10_000):
            (before,) = struct.unpack_from("<Q", self._map, 8)
            angles = struct.unpack_from(f"<{self._joints}d", self._map, 32 + 8 * self._first)
            if before % 2 == 0 and struct.unpack_from("<Q", self._map, 8)[0] == before:
                return list(angles)
            time.sleep(1e-4)
        raise RuntimeError("the shared plant is for ever writing")

    def push(self, torque_nm: list[float], from_ns: int, to_ns: int) -> None:
        now_ns = time.monotonic_ns()
        struct.pack_into(f"<{self._joints}d", self._map, 512 + 8 * self._first, *torque_nm)
        stamps = [now_ns] * self._joints
        struct.pack_into(f"<{self._joints}q", self._map, 640 + 8 * self._first, *stamps)

    def end_torque_at(self, at_ns: int | None) -> None:
        ends = [at_ns or 0] * self._joints
        struct.pack_into(f"<{self._joints}q", self._map, 768 + 8 * self._first, *ends)

    def torque_has_ended(self) -> bool:
        (end_ns,) = struct.unpack_from("<q", self._map, 768 + 8 * self._first)
        return 0 < end_ns <= time.monotonic_ns()


class ManualTime:
    """A clock that only `Board.pass_time` moves."""

    def __init__(self) -> None:
        self.ns = 12_345_678_901_234

    def __call__(self) -> int:
        return self.ns


@dataclass
class _Task:
    channels: list[int]
    capacity: int
    period_ns: int = 0
    start_ns: int = 0
    taken: int = 0  # samples that the clock has taken
    samples: deque[list[int]] = field(default_factory=deque)
    running: bool = False
    overflowed: bool = False
    waiting: bool = False
    reader: threading.Thread | None = None


class Board:
    """One board, the amplifiers on it and the plant that they drive.

    Everything is brought up to the present whenever anyone looks. `calls` lists what the driver
    asked for, in order, reads and reloads of the watchdog left out. `bus_s`: time of an access.
    """

    def __init__(
        self,
        robot: Robot | None = None,
        plant: Plant | None = None,
        now_ns: Callable[[], int] = time.monotonic_ns,
        bus_s: float = 0.0,
    ) -> None:
        self.robot = robot or Robot()
        self.plant: Plant = plant or FreeJoints(len(self.robot.encoder_channels))
        self.now_ns = now_ns
        self.bus_s = bus_s
        self.calls: list[str] = []
        self.owner: HIL | None = None
        self.largest_current_a = [0.0] * len(self.robot.analog_channels)
        self.clock_frozen = False
        self.hung = False  # a waiting read does not even return when its task is stopped
        self.changed = threading.Condition()
        self._dead = False
        self._reached_ns = now_ns()
        self._volts = [0.0] * CHANNELS
        self._levels = [0] * CHANNELS
        self._directions = ["in"] * CHANNELS
        self._offset = [0] * CHANNELS  # counter minus encoder
        self._frozen: dict[int, int] = {}
        self._broken: set[int] = set()
        self._analog_expiry: dict[int, float] = {}
        self._digital_expiry: dict[int, int] = {}
        self._timeout_ns = 0
        self._deadline_ns: int | None = None
        self._expired = False
        self._task: _Task | None = None

    # What a test does to the bench

    def unplug(self) -> None:
        """Pull the cable: nothing answers, and the board's own watchdog is all that is left."""
        with self.changed:
            self._catch_up()
            self._dead = True
            self.changed.notify_all()

    def plug(self) -> None:
        with self.changed:
            self._dead, self.owner, self._task = False, None, None

    def overflow(self) -> None:
        """Lose samples, as if nobody had fetched them in time."""
        with self.changed:
            assert self._task is not None
            self._task.overflowed = True
            self.changed.notify_all()

    def jump(self, joint: int, counts: int) -> None:
        """Disturb a counter, as noise on its lines does."""
        with self.changed:
            self._offset[self.robot.encoder_channels[joint]] += counts

    def freeze_encoder(self, joint: int) -> None:
        with self.changed:
            channel = self.robot.encoder_channels[joint]
            self._frozen[channel] = self._counter(channel)

    def freeze_clock(self) -> None:
        """Take no more samples."""
        with self.changed:
            self._catch_up()
            self.clock_frozen = True

    def break_amplifier(self, joint: int) -> None:
        """Let an amplifier give no more current, and say nothing."""
        with self.changed:
            self._catch_up()
            self._broken.add(joint)

    def expire_watchdog(self) -> None:
        with self.changed:
            self._catch_up()
            self._expire()

    def pass_time(self, seconds: float) -> None:
        """Move a `ManualTime` on; return when the driver has fetched every sample of it."""
        assert isinstance(self.now_ns, ManualTime)
        with self.changed:
            self.now_ns.ns += round(seconds * 1e9)
            self._catch_up()
            self.changed.notify_all()
            while not self._fetched():
                self.changed.wait(0.005)  # again and again: a thread that ends tells nobody

    # What a test sees of the bench

    def current_a(self) -> list[float]:
        """What flows in the motors now."""
        with self.changed:
            self._catch_up()
            return self._currents()

    def torque_nm(self) -> list[float]:
        """What the motors push φ with now."""
        with self.changed:
            self._catch_up()
            return self._torques()

    def amplifiers_on(self) -> list[bool]:
        with self.changed:
            self._catch_up()
            return [self._amplifier_on(joint) for joint in range(len(self.robot.analog_channels))]

    def watchdog_runs(self) -> bool:
        with self.changed:
            return self._deadline_ns is not None

    # What the card does

    @contextmanager
    def access(self, name: str | None = None, *, blocked: bool = True) -> Iterator[None]:
        """Bring the bench up to the present, let one access happen, and bring it up again."""
        if self.bus_s > 0.0:
            time.sleep(self.bus_s)
        with self.changed:
            self._catch_up()
            if name is not None:
                self.calls.append(name)
            if self._dead:
                raise HILError(DISCONNECTED)
            if blocked and self._expired:
                raise HILError(WATCHDOG_EXPIRED)
            yield
            self._push(self._reached_ns)

    def _catch_up(self) -> None:
        """Bring plant, sampling clock and watchdog up to the present, event by event."""
        now_ns = self.now_ns()
        while True:
            sample_ns = self._next_sample_ns()
            expiry_ns = math.inf if self._deadline_ns is None else self._deadline_ns
            event_ns = min(sample_ns, expiry_ns, now_ns)
            self._push(int(event_ns))
            if event_ns == sample_ns:
                self._sample()
            elif event_ns == expiry_ns:
                self._expire()
            else:
                return

    def _push(self, to_ns: int) -> None:
        currents = self._currents()
        self.largest_current_a = [
            max(most, abs(a)) for most, a in zip(self.largest_current_a, currents, strict=True)
        ]
        self.plant.push(self._torques(), self._reached_ns, max(to_ns, self._reached_ns))
        self._reached_ns = max(to_ns, self._reached_ns)

    def _currents(self) -> list[float]:
        return [
            self._volts[channel] * gain if self._amplifier_on(joint) else 0.0
            for joint, (channel, gain) in enumerate(
                zip(self.robot.analog_channels, self.robot.amplifier_gain_a_per_v, strict=True)
            )
        ]

    def _torques(self) -> list[float]:
        return [
            sign * constant * current
            for sign, constant, current in zip(
                self.robot.motor_signs,
                self.robot.torque_constant_nm_per_a,
                self._currents(),
                strict=True,
            )
        ]

    def _amplifier_on(self, joint: int) -> bool:
        enables = self.robot.enable_channels
        channel = enables[joint % len(enables)]
        # A line that nobody drives is pulled up, on a Q8: only 0 V stops the motors then.
        level = self._levels[channel] if self._directions[channel] == "out" else 1
        return bool(level) and joint not in self._broken

    def _next_sample_ns(self) -> float:
        task = self._task
        if task is None or not task.running or self.clock_frozen:
            return math.inf
        return task.start_ns + (task.taken + 1) * task.period_ns

    def _sample(self) -> None:
        task = self._task
        assert task is not None
        task.taken += 1
        if len(task.samples) == task.capacity:
            task.overflowed = True
        else:
            task.samples.append([self._counter(channel) for channel in task.channels])

    def _fetched(self) -> bool:
        task = self._task
        return (
            task is None
            or not task.running
            or (task.reader is not None and not task.reader.is_alive())
            or (task.waiting and not task.samples and not task.overflowed and not self._dead)
        )

    def _counter(self, channel: int) -> int:
        if channel in self._frozen:
            return self._frozen[channel]
        counts = self._offset[channel]
        if channel in self.robot.encoder_channels:
            joint = self.robot.encoder_channels.index(channel)
            angle = self.plant.angle_rad()[joint]
            counts += self.robot.encoder_signs[joint] * math.floor(
                angle * self.robot.counts_per_rad[joint]
            )
        return counts

    def _set_deadline(self, deadline_ns: int | None) -> None:
        self._deadline_ns = deadline_ns
        self.plant.end_torque_at(deadline_ns if self._lets_go_on_expiry() else None)

    def _lets_go_on_expiry(self) -> bool:
        analog = self._analog_expiry and not any(self._analog_expiry.values())
        digital = self._digital_expiry and all(
            state == DigitalState.TRISTATE for state in self._digital_expiry.values()
        )
        return bool(analog and digital)

    def _expire(self) -> None:
        self._deadline_ns = None
        self._expired = True
        if self._lets_go_on_expiry():
            for channel in self._analog_expiry:
                self._volts[channel] = 0.0
            for channel in self._digital_expiry:
                self._directions[channel] = "in"


class HIL:
    """The vendor's class: one card."""

    def __init__(self, card_type: str | None = None, card_identifier: str | None = None) -> None:
        self._board: Board | None = None
        if card_type is not None or card_identifier is not None:
            self.open(card_type, card_identifier)

    def open(self, card_type: str | None, card_identifier: str | None) -> None:
        self.close()
        if not isinstance(card_type, str) or not isinstance(card_identifier, str):
            raise AttributeError("neither may be anything but a str: both are encoded")
        board = _boards.get((card_type, card_identifier))
        if board is None and (card_type, card_identifier) == ("q8_usb", "0"):
            board = connect(_default())
        if board is None or board._dead:
            raise HILError(BOARD_NOT_FOUND)
        if board.owner is not None:
            raise HILError(UNABLE_TO_LOCK_DEVICE)
        with board.access("open", blocked=False):
            board.owner = self
        self._board = board

    def close(self) -> None:
        board, self._board = self._board, None
        if board is not None:
            with board.changed:
                board.calls.append("close")
                board.owner, board._task = None, None

    def set_digital_directions(
        self, inputs: object, num_inputs: int, outputs: object, num_outputs: int
    ) -> None:
        given = _given(outputs, np.uint32, num_outputs)
        assert inputs is None
        assert num_inputs == 0
        board = self._opened()
        with board.access("directions"):
            for channel in _existing(given):
                board._directions[channel] = "out"

    def set_analog_output_ranges(
        self, channels: object, num: int, minima: object, maxima: object
    ) -> None:
        given = _given(channels, np.uint32, num)
        low, high = _given(minima, np.float64, num), _given(maxima, np.float64, num)
        with self._opened().access("ranges"):
            _existing(given)
            if any(x != -RANGE_V for x in low) or any(x != RANGE_V for x in high):
                raise HILError(INVALID_ARGUMENT)

    def set_encoder_quadrature_mode(self, channels: object, num: int, modes: object) -> None:
        given, chosen = _given(channels, np.uint32, num), _given(modes, np.int32, num)
        with self._opened().access("quadrature"):
            _existing(given)
            if any(mode != EncoderQuadratureMode.X4 for mode in chosen):
                raise HILError(INVALID_ARGUMENT)

    def set_encoder_counts(self, channels: object, num: int, counts: object) -> None:
        given, wanted = _given(channels, np.uint32, num), _given(counts, np.int32, num)
        board = self._opened()
        with board.access("zero counts"):
            assert not any(board._amplifier_on(j) for j in range(len(board.robot.analog_channels)))
            for channel, count in zip(_existing(given), wanted, strict=True):
                if channel not in board._frozen:
                    board._offset[channel] += int(count) - board._counter(channel)

    def read_encoder(self, channels: object, num: int, counts: object) -> None:
        given, target = _given(channels, np.uint32, num), _given(counts, np.int32, num)
        board = self._opened()
        with board.access():
            target[:] = [board._counter(channel) for channel in _existing(given)]

    def write_analog(self, channels: object, num: int, volts: object) -> None:
        given, wanted = _given(channels, np.uint32, num), _given(volts, np.float64, num)
        board = self._opened()
        name = "write" if wanted.any() else "write 0 V"
        with board.access(name if board.calls[-1:] != [name] else None):
            for channel, value in zip(_existing(given), wanted.tolist(), strict=True):
                # What the vendor's makes of a NaN is not known; nobody may find out.
                assert math.isfinite(value)
                board._volts[channel] = min(max(value, -RANGE_V), RANGE_V)

    def write_digital(self, channels: object, num: int, levels: object) -> None:
        given, wanted = _given(channels, np.uint32, num), _given(levels, np.int8, num)
        board = self._opened()
        with board.access("amplifiers on" if wanted.any() else "amplifiers off"):
            for channel, level in zip(_existing(given), wanted.tolist(), strict=True):
                if board._directions[channel] != "out":
                    raise HILError(INVALID_ARGUMENT)
                board._levels[channel] = level

    def task_create_encoder_reader(
        self, samples_in_buffer: int, channels: object, num: int
    ) -> list[_Task]:
        given = _given(channels, np.uint32, num)
        board = self._opened()
        with board.access("create task"):
            board._task = _Task(_existing(given), samples_in_buffer)
            return [board._task]

    def task_start(self, task: list[_Task], clock: int, frequency: float, num_samples: int) -> None:
        board = self._opened()
        if not 0 <= num_samples < 2**32:
            raise OverflowError("can't convert it to an unsigned int")
        with board.access("start task"):
            if clock != Clock.HARDWARE_CLOCK_0 or not 0 < frequency <= 1000.0:
                raise HILError(INVALID_ARGUMENT)
            task[0].period_ns = round(1e9 / frequency)
            task[0].start_ns = board.now_ns()
            task[0].running = True

    def task_read_encoder(self, task: list[_Task], num_samples: int, counts: object) -> int:
        board, job = self._opened(), task[0]
        target = _given(counts, np.int32, num_samples * len(job.channels))
        assert num_samples == 1
        job.reader = threading.current_thread()
        with board.changed:
            while True:
                board._catch_up()
                if board._dead or job.overflowed:
                    raise HILError(DISCONNECTED if board._dead else BUFFER_OVERFLOW)
                if job.samples:
                    target[:] = job.samples.popleft()
                    return 1
                if not job.running and not board.hung:
                    return 0
                job.waiting = True
                board.changed.notify_all()
                board.changed.wait(self._pause_s(board))
                job.waiting = False

    @staticmethod
    def _pause_s(board: Board) -> float | None:
        if isinstance(board.now_ns, ManualTime):
            return None
        return min(max((board._next_sample_ns() - board.now_ns()) * 1e-9, 0.0), 0.1)

    def task_stop(self, task: list[_Task]) -> None:
        board = self._opened()
        with board.access("stop task", blocked=False):
            task[0].running = False
            board.changed.notify_all()

    def task_delete(self, task: list[_Task]) -> None:
        board = self._opened()
        with board.access("delete task", blocked=False):
            assert not task[0].waiting, "freed under a thread that waits in it"
            board._task = None

    def watchdog_set_analog_expiration_state(
        self, channels: object, num: int, volts: object
    ) -> None:
        given, wanted = _given(channels, np.uint32, num), _given(volts, np.float64, num)
        board = self._opened()
        with board.access("analog expiration"):
            board._analog_expiry = dict(zip(_existing(given), wanted.tolist(), strict=True))

    def watchdog_set_digital_expiration_state(
        self, channels: object, num: int, states: object
    ) -> None:
        given, wanted = _given(channels, np.uint32, num), _given(states, np.int32, num)
        board = self._opened()
        with board.access("digital expiration"):
            # Only lines that are outputs already take it.
            board._digital_expiry = {
                channel: state
                for channel, state in zip(_existing(given), wanted.tolist(), strict=True)
                if board._directions[channel] == "out"
            }

    def watchdog_start(self, timeout: float) -> None:
        board = self._opened()
        with board.access("start watchdog"):
            board._timeout_ns = round(timeout * 1e9)
            board._set_deadline(board.now_ns() + board._timeout_ns)

    def watchdog_reload(self) -> bool:
        board = self._opened()
        with board.access(blocked=False):
            if board._expired:
                return False
            if board._deadline_ns is not None:
                board._set_deadline(board.now_ns() + board._timeout_ns)
            return True

    def watchdog_is_expired(self) -> bool:
        board = self._opened()
        with board.access(blocked=False):
            return board._expired

    def watchdog_clear(self) -> None:
        """Allow access again, and drive the digital lines as before: amplifiers may come back."""
        board = self._opened()
        with board.access("clear watchdog", blocked=False):
            board._expired = False
            board.plant.end_torque_at(None)
            for channel in board._digital_expiry:
                board._directions[channel] = "out"

    def watchdog_stop(self) -> None:
        board = self._opened()
        with board.access("stop watchdog", blocked=False):
            board._set_deadline(None)

    def _opened(self) -> Board:
        if self._board is None:
            raise HILError(INVALID_ARGUMENT)
        return self._board


_boards: dict[tuple[str, str], Board] = {}


def connect(board: Board, card_type: str = "q8_usb", card_identifier: str = "0") -> Board:
    """Put a board into the computer, in the place of the one that was there."""
    _boards[card_type, card_identifier] = board
    return board


def disconnect_all() -> None:
    _boards.clear()


def _default() -> Board:
    path = os.environ.get("FARHAND_FAKE_PLANT")
    if path is None:
        return Board()
    first = int(os.environ.get("FARHAND_FAKE_QUANSER_FIRST", "0"))
    plant = SharedPlant(path, first, len(Robot().encoder_channels))
    board = Board(plant=plant)
    board._expired = plant.torque_has_ended()  # in a program before this one
    return board


def _given(buffer: object, kind: type[np.generic], count: int) -> "np.ndarray":
    """Take a buffer as C would, and refuse what C would misread."""
    if not isinstance(buffer, np.ndarray):
        raise TypeError(f"a {type(buffer).__name__} has no buffer")
    if buffer.dtype != np.dtype(kind):
        raise TypeError(f"C would read this {buffer.dtype} as {np.dtype(kind)}")
    if not buffer.flags.c_contiguous:
        raise ValueError("the buffer is not contiguous")
    if buffer.shape != (count,):
        raise ValueError(f"C takes {count} items, the buffer's shape is {buffer.shape}")
    return buffer


def _existing(channels: "np.ndarray") -> list[int]:
    numbers: list[int] = channels.tolist()
    if not all(0 <= number < CHANNELS for number in numbers):
        raise HILError(INVALID_ARGUMENT)
    return numbers
