"""A JR3 force sensor on a CAN bus, behind the board of the Universidad Carlos III de Madrid.

The board's firmware (github.com/roboticslab-uc3m/jr3-mbed-firmware-can, opcodes of late 2023) sends
force and moment in two frames of one counter, which runs at the sensor's rate. Its own zero is
taken anew at every start and lost at every stop, so the zero kept here is the one that counts.
"""

import importlib.util
import math
import os
import queue
import socket
import struct
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from hardware.interface import (
    DeviceConfigurationError,
    DeviceError,
    FloatArray,
    ForceReading,
    Mounting,
)
from hardware.registry import DeviceContext, SensorEntry

if TYPE_CHECKING:
    import can

ACKNOWLEDGE_S = 0.25
"""Longest wait for an acknowledgement."""
FULL_SCALE = 16384
"""Raw value of a force or moment at full scale."""
SATURATED = round(0.98 * FULL_SCALE)
"""Raw value from which an axis counts as saturated; no frame carries a flag."""

_SAMPLE_S = 128.5e-6  # the sensor's period, and so the counter's
_SETTLE_S = 0.1  # after a start, besides the filter's five time constants
_WAKE_S = 0.05  # of the reader, to see that it is to end
_RESTARTS = 3  # while opening; beyond, the sensor has a loose contact
_FRAME = struct.Struct("<3hH")
_FULL_SCALES = struct.Struct("<3H")
_START = struct.Struct("<HI")


class Opcode(IntEnum):
    """Upper bits of a frame's 11-bit identifier; the node is in the lower seven."""

    ACK = 0x100
    START_ASYNC = 0x200
    STOP = 0x280
    GET_STATE = 0x400
    GET_FORCE_SCALES = 0x480
    GET_MOMENT_SCALES = 0x500
    FORCES = 0x600
    MOMENTS = 0x680
    BOOTUP = 0x700


# What older firmware answers with, by length: acknowledgements, and data in place of one. Requests
# of the same opcodes are of other lengths.
_OLDER_ANSWERS = {0x180: (1, 7), 0x380: (1, 7), 0x400: (8,), 0x480: (1, 7, 8), 0x580: (8,)}

_LOST_ARBITRATION = 0x002  # an error frame of this class alone is a busy bus, no error
_ERROR_CLASSES = {
    0x001: "transmission timed out",
    0x004: "controller problem",
    0x008: "protocol violation",
    0x010: "transceiver fault",
    0x020: "no node acknowledges frames",
    0x040: "bus off",
    0x080: "bus error",
    0x100: "controller restarted",
}

_RESTARTED = b""  # in the inbox, between acknowledgements


class _Sample(NamedTuple):
    counter: int
    raw: tuple[int, ...]  # forces, moments


@dataclass(frozen=True, slots=True)
class Jr3Settings:
    """Settings of the sensor "jr3".

    `interface`, `channel` and `bitrate` are python-can's. The sensor filters to `cutoff_hz` and
    sends every `period_s`; a reading older than `stale_after_s` is a fault. The zero is the mean
    of `tare_samples`. `rotation`, three rows, takes the sensor's forces to those ON the robot in
    the axes of `mounting`: a rotation, or the negative of one where the sign turns as well.
    """

    interface: str
    channel: str
    node: int
    mounting: Mounting
    rotation: tuple[
        tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]
    ]
    driver: Literal["jr3"] = "jr3"
    bitrate: int = 1_000_000
    cutoff_hz: float = 100.0
    period_s: float = 0.001
    stale_after_s: float = 0.05
    tare_samples: int = 200

    def __post_init__(self) -> None:
        for name, value, least, most in (
            ("node", self.node, 1, 127),
            ("bitrate", self.bitrate, 10_000, 1_000_000),
            ("cutoff_hz", self.cutoff_hz, 0.1, 655.35),
            ("period_s", self.period_s, 0.001, 0.1),
            ("stale_after_s", self.stale_after_s, 3.0 * self.period_s, 1.0),
            ("tare_samples", self.tare_samples, 1, 10_000),
        ):
            if not least <= value <= most:
                raise DeviceConfigurationError(
                    f"{name} is {value}; choose between {least:g} and {most:g}"
                )
        R = np.array(self.rotation)
        if not np.allclose(R @ R.T, np.eye(3), atol=1e-3):
            raise DeviceConfigurationError(
                f"rotation is {self.rotation}; its rows must be unit vectors, each perpendicular "
                "to the others"
            )


class Jr3:
    """A `ForceSensor` over CAN; the bus has one reader, a thread, and one request in flight.

    `stamp_ns` is when the later of a reading's two frames was received. The sample is older by no
    more than one sensor period (0.13 ms), the frames' time on the bus (0.3 ms at 1 Mbit/s, plus
    what others send) and the time for which the reader was kept from running; what the filter adds
    is about 1/(2π cutoff_hz). The tool's weight is not known: it is part of the zero, and right
    only for the orientation in which that was taken.
    """

    def __init__(self, settings: Jr3Settings, now_ns: Callable[[], int]) -> None:
        self._settings = settings
        self._now_ns = now_ns
        self._stale_ns = round(settings.stale_after_s * 1e9)
        self._bus: can.BusABC | None = None
        self._reader: threading.Thread | None = None
        self._inbox: queue.SimpleQueue[bytes | _Sample | None] = queue.SimpleQueue()
        self._reset()

    @property
    def mounting(self) -> Mounting:
        """The axes of the readings."""
        return self._settings.mounting

    def open(self) -> None:
        """Start the sensor, ask its full scales, wait for its filter, tare."""
        if self._bus is not None:
            raise DeviceError(f"{self._name} is already open; close it first")
        self._reset()
        self._bus = self._open_bus()
        self._reader = threading.Thread(
            target=self._receive,
            args=(self._bus, os.sched_getscheduler(0), os.sched_getparam(0)),
            name="jr3",
            daemon=True,
        )
        try:
            self._reader.start()
            self._initialise()
        except BaseException:
            self.close()
            raise
        self._ready = True
        self._attended = False

    def read(self) -> ForceReading:
        """Return the newest reading; never blocks."""
        if self._fault is None:
            reading = self._reading
            if reading is None or not self._ready:
                raise DeviceError(f"{self._name} is not open; call open() first")
            if self._now_ns() - reading.stamp_ns <= self._stale_ns:
                return reading
            self._fail(self._why_stale())
        raise self._error()

    def tare(self) -> None:
        """Make the present load the zero: the mean of `tare_samples` readings."""
        if self._bus is None:
            raise DeviceError(f"{self._name} is not open; call open() first")
        self._attended = True
        try:
            self._tare()
        finally:
            self._attended = False

    def close(self) -> None:
        """Let go of the bus; a sensor that has answered is told to stop."""
        bus, reader = self._bus, self._reader
        if bus is None:
            return
        self._closing = True
        if self._known:
            with suppress(Exception):
                self._send(Opcode.STOP)
        if reader is not None and reader.ident is not None:
            reader.join()
        with suppress(Exception):
            bus.shutdown()
        self._reset()

    # Shared with the reader: every attribute below is set by one side, whole.

    def _reset(self) -> None:
        self._bus = self._reader = None
        self._closing = False
        self._known = False  # to be of this firmware: to older ones, STOP is another request
        self._ready = False
        self._attended = True  # whether somebody empties the inbox
        self._inbox = queue.SimpleQueue()
        self._fault: str | None = None
        self._forces = self._moments = (-1, (0, 0, 0))
        self._counter: int | None = None
        self._frame_ns = 0
        self._scale: tuple[FloatArray, FloatArray] | None = None  # per raw unit (6, 6), zero (6,)
        self._reading: ForceReading | None = None

    @property
    def _name(self) -> str:
        return f"JR3 node {self._settings.node} on {self._settings.channel!r}"

    def _error(self) -> DeviceError:
        return DeviceError(f"{self._name}: {self._fault}; close it, and open it again")

    def _fail(self, reason: str) -> None:
        if self._fault is None:
            self._fault = reason
            self._inbox.put(None)

    def _open_bus(self) -> "can.BusABC":
        try:
            import can
        except ImportError as error:
            raise DeviceError(
                f"{self._name} needs python-can, which is not installed: pip install python-can"
            ) from error
        settings = self._settings
        options: dict[str, Any] = {"bitrate": settings.bitrate}
        if settings.interface == "udp_multicast":  # between processes of one machine: no hop
            options |= {"fd": False, "hop_limit": 0}
        try:
            return can.Bus(
                interface=settings.interface,
                channel=settings.channel,
                # This node's frames; below 0x200 also error frames, whose identifier is a class.
                can_filters=[
                    {"can_id": settings.node, "can_mask": 0x7F, "extended": False},
                    {"can_id": 0, "can_mask": 0x600},
                ],
                **options,
            )
        except Exception as error:
            hint = (
                f"; is it up? ip link set {settings.channel} up type can bitrate {settings.bitrate}"
                if settings.interface == "socketcan"
                else ""
            )
            raise DeviceError(
                f"{self._name}: the CAN interface {settings.interface!r} does not open: "
                f"{error}{hint}"
            ) from error

    def _initialise(self) -> None:
        for _ in range(_RESTARTS):
            with suppress(_SensorRestartedError):
                self._start()
                self._tare()
                return
        raise DeviceError(f"{self._name} restarted {_RESTARTS} times while it was started")

    def _start(self) -> None:
        settings = self._settings
        self._request(Opcode.GET_STATE)
        self._known = True
        # A process that died may have left it sending, by another counter.
        self._request(Opcode.STOP)
        self._counter = None
        period_us = round(settings.period_s * 1e6)
        start = _START.pack(round(settings.cutoff_hz * 100.0), period_us)
        self._request(Opcode.START_ASYNC, start)
        forces_n = self._full_scales(Opcode.GET_FORCE_SCALES)
        # An acknowledgement does not say of what; one of another length in between keeps a late
        # or doubled answer to the first question from being taken for one to the second.
        self._request(Opcode.GET_STATE)
        moments_dnm = self._full_scales(Opcode.GET_MOMENT_SCALES)
        self._settle(_SETTLE_S + 5.0 / (2.0 * math.pi * settings.cutoff_hz))
        full_scale = np.array([*forces_n, *(0.1 * moment for moment in moments_dnm)])
        rotation = np.kron(np.eye(2), np.array(settings.rotation))
        self._scale = rotation * (full_scale / FULL_SCALE), np.zeros(6)

    def _tare(self) -> None:
        self._forget()
        raw = np.array([self._sample().raw for _ in range(self._settings.tare_samples)])
        if (np.abs(raw) >= SATURATED).any():
            raise DeviceError(
                f"{self._name} is saturated (raw {np.abs(raw).max()} of {FULL_SCALE}) while its "
                "zero is taken; unload it"
            )
        assert self._scale is not None  # noqa: S101  _start has set it
        self._scale = self._scale[0], raw.mean(axis=0)
        self._forget()
        self._sample()  # may have been under way when the zero was set
        self._sample()

    def _full_scales(self, opcode: Opcode) -> tuple[int, ...]:
        scales: tuple[int, ...] = _FULL_SCALES.unpack(self._request(opcode, answer_bytes=7))
        if 0 in scales:
            raise DeviceError(f"{self._name} says that its full scales are {scales}")
        return scales

    def _request(self, opcode: Opcode, payload: bytes = b"", answer_bytes: int = 1) -> bytes:
        """Send a request; return its acknowledgement's payload after the state byte."""
        self._forget()
        self._send(opcode, payload)
        deadline_s = time.monotonic() + ACKNOWLEDGE_S
        while (answer := self._take(deadline_s - time.monotonic())) is not None:
            if isinstance(answer, bytes) and len(answer) == answer_bytes:
                if answer[0] != 0:
                    raise DeviceError(
                        f"{self._name} is not ready (state {answer[0]}): no sensor is plugged into "
                        "its board, or was when that was switched on; plug it in and switch the "
                        "board off and on"
                    )
                return answer[1:]
        raise DeviceError(
            f"{self._name} does not answer {opcode.name} within {ACKNOWLEDGE_S} s; check power, "
            "cable, termination, bit rate and node number (only the firmware of late 2023 on, "
            "with START_ASYNC = 0x200, is known to answer)"
        )

    def _settle(self, seconds: float) -> None:
        """Let so much time pass for the sensor: frames may be read long after they were sent."""
        first = self._sample().counter
        while ((self._sample().counter - first) & 0xFFFF) * _SAMPLE_S < seconds:
            pass

    def _sample(self) -> _Sample:
        """Wait for the next pair of frames."""
        deadline_s = time.monotonic() + self._settings.stale_after_s
        while (item := self._take(deadline_s - time.monotonic())) is not None:
            if isinstance(item, _Sample):
                return item
        self._fail(self._why_stale())
        raise self._error()

    def _forget(self) -> None:
        """Pass over what the reader has passed on."""
        while self._take(0.0) is not None:
            pass

    def _take(self, timeout_s: float) -> bytes | _Sample | None:
        """Take what the reader has passed on; None when nothing comes in time."""
        if self._fault is not None:
            raise self._error()
        try:
            item = self._inbox.get(timeout=max(timeout_s, 0.0))
        except queue.Empty:
            return None
        if item is None:
            raise self._error()
        if item == _RESTARTED:
            raise _SensorRestartedError
        return item

    def _send(self, opcode: Opcode, payload: bytes = b"") -> None:
        import can

        bus = self._bus
        assert bus is not None  # noqa: S101  closed only by the caller
        message = can.Message(
            arbitration_id=opcode | self._settings.node, is_extended_id=False, data=payload
        )
        try:
            bus.send(message)
        except (can.CanError, OSError) as error:
            raise DeviceError(f"{self._name}: {opcode.name} cannot be sent: {error}") from error

    def _why_stale(self) -> str:
        lost = f"no new force for {self._settings.stale_after_s:g} s"
        if self._now_ns() - self._frame_ns < self._stale_ns:
            return f"{lost}: its board sends, but not a pair with a new counter; the sensor is lost"
        return f"{lost}: no frames come; its board, the power or the cable is lost"

    # The reader's side.

    def _receive(self, bus: "can.BusABC", scheduler: int, priority: os.sched_param) -> None:
        # A site's real-time class is not inherited by its threads, and one that is put aside while
        # it holds the interpreter's lock keeps the site waiting.
        with suppress(OSError):
            os.sched_setscheduler(0, scheduler, priority)
        try:
            while not self._closing:
                message = bus.recv(_WAKE_S)
                if message is not None:
                    self._handle(message, self._now_ns())
        except Exception as error:
            self._fail(f"the CAN bus failed: {error}")

    def _handle(self, message: "can.Message", stamp_ns: int) -> None:
        identifier, data = message.arbitration_id, message.data
        if message.is_error_frame:
            if identifier != _LOST_ARBITRATION:
                named = [name for bit, name in _ERROR_CLASSES.items() if identifier & bit]
                self._fail(
                    f"error on the CAN bus: {', '.join(named) or 'unknown'} ({identifier:#x})"
                )
            return
        if (
            identifier & 0x7F != self._settings.node
            or message.is_extended_id
            or message.is_remote_frame
        ):
            return
        opcode, length = identifier & ~0x7F, len(data)
        if opcode in (Opcode.FORCES, Opcode.MOMENTS):
            if length != _FRAME.size:
                self._fail(f"a frame {identifier:#x} has {length} bytes, not {_FRAME.size}")
                return
            self._frame_ns = stamp_ns
            *raw, counter = _FRAME.unpack(data)
            if opcode == Opcode.FORCES:
                self._forces = counter, tuple(raw)
            else:
                self._moments = counter, tuple(raw)
            if self._forces[0] == self._moments[0]:
                self._pair(counter, self._forces[1] + self._moments[1], stamp_ns)
        elif opcode == Opcode.ACK:
            if length not in (1, 7):
                self._fail(f"an acknowledgement has {length} bytes, not 1 or 7")
            elif self._attended:
                self._inbox.put(bytes(data))
        elif opcode == Opcode.BOOTUP and length == 0:
            if self._ready:
                # Its zero is taken anew at the start, under a load that nobody knows.
                self._fail("the sensor has restarted, and its zero is lost")
            else:
                self._inbox.put(_RESTARTED)
        elif length in _OLDER_ANSWERS.get(opcode, ()):
            self._fail(
                f"its firmware is too old: it answers with opcode {opcode:#x}. Flash the current "
                "github.com/roboticslab-uc3m/jr3-mbed-firmware-can (acknowledges with 0x100, sends "
                "forces with 0x600)"
            )

    def _pair(self, counter: int, raw: tuple[int, ...], stamp_ns: int) -> None:
        """Take force and moment of one counter, unless it is no newer than the last."""
        if self._counter is not None and not 0 < (counter - self._counter) & 0xFFFF < 0x8000:
            return
        self._counter = counter
        if self._scale is not None:
            per_raw, zero = self._scale
            wrench = per_raw @ (np.array(raw) - zero)
            wrench.flags.writeable = False  # every reader of this reading gets the same array
            saturated = max(raw) >= SATURATED or min(raw) <= -SATURATED
            self._reading = ForceReading(wrench, stamp_ns, saturated)
        if self._attended:
            self._inbox.put(_Sample(counter, raw))


class _SensorRestartedError(Exception):
    """The sensor has booted while it was being started."""


_HOW_CAN_COMES_UP = "plug in the adapter; ip link set can0 up type can bitrate 1000000"


def _create(settings: Jr3Settings, context: DeviceContext) -> Jr3:
    return Jr3(settings, context.now_ns)


def _missing(settings: Jr3Settings | None) -> str | None:
    """Say which module or CAN interface is not there; without settings, whether any is."""
    if importlib.util.find_spec("can") is None:
        return "python-can is not installed: pip install python-can"
    if settings is not None and settings.interface != "socketcan":
        return None  # whether it opens is told when it is opened
    interfaces = [name for _, name in socket.if_nameindex()]
    if settings is None:
        can_interfaces = [name for name in interfaces if "can" in name]
        return None if can_interfaces else f"no CAN interface ({_HOW_CAN_COMES_UP})"
    if settings.channel in interfaces:
        return None
    return f"there is no CAN interface {settings.channel!r} ({_HOW_CAN_COMES_UP})"


DRIVER = SensorEntry(settings=Jr3Settings, create=_create, missing=_missing)
