"""A JR3 sensor behind its CAN board: what the firmware does, its traps included.

In-process on python-can's "virtual", or as a process of its own on "udp_multicast" or "socketcan":

    python -m tests.fakes.jr3_node --interface udp_multicast --channel 239.74.163.2 --node 1

The sensor is fixed to the base, axes along the base's unless `rotation` says otherwise, and feels
the wrench ON the robot: of a function of time, or of the plant in FARHAND_FAKE_PLANT (or --plant).
"""

import argparse
import mmap
import os
import signal
import struct
import threading
import time
from collections.abc import Callable, Sequence
from math import pi

import can
import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
Frames = list[can.Message]

SAMPLE_S = 128.5e-6
FULL_SCALES = (115, 111, 185, 56, 52, 61)  # N; 0.1 N·m
RAW_FULL_SCALE = 16384
ALONG_THE_BASE = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))

CURRENT = {
    "ack": 0x100,
    "start_sync": 0x180,
    "start_async": 0x200,
    "stop": 0x280,
    "zero": 0x300,
    "set_filter": 0x380,
    "get_state": 0x400,
    "force_scales": 0x480,
    "moment_scales": 0x500,
    "reset": 0x580,
    "forces": 0x600,
    "moments": 0x680,
    "bootup": 0x700,
}
# Two older ones, both of 2023.
SCALES_AS_DATA = {
    "ack": 0x100,
    "start_sync": 0x180,
    "start_async": 0x200,
    "stop": 0x280,
    "zero": 0x300,
    "set_filter": 0x380,
    "scales": 0x400,
    "get_state": 0x480,
    "reset": 0x500,
    "forces": 0x580,
    "moments": 0x600,
    "bootup": 0x700,
}
ACK_0X180 = {
    "bootup": 0x100,
    "ack": 0x180,
    "start_sync": 0x200,
    "start_async": 0x280,
    "stop": 0x300,
    "zero": 0x380,
    "set_filter": 0x400,
    "scales": 0x480,
    "reset": 0x500,
    "forces": 0x580,
    "moments": 0x600,
}
FIRMWARES = {"current": CURRENT, "scales_as_data": SCALES_AS_DATA, "ack_0x180": ACK_0X180}


class Jr3Node:
    """The board, on a thread of its own from `start` to `stop`.

    Faults are attributes, to be set at any time: `frozen` (the sensor has stopped, the board sends
    on), `mute` (nothing is sent), `lose_acks` (so many are lost), `ack_delay_s`, `double_acks`
    (each comes again just before the next), `mangle` (what becomes of each pair of frames),
    `sensor` False from the start (none plugged in). `requests` lists what was asked.
    """

    def __init__(
        self,
        bus: can.BusABC,
        *,
        node: int = 1,
        wrench: Callable[[float], FloatArray] = lambda _: np.zeros(6),
        rotation: npt.ArrayLike = ALONG_THE_BASE,  # sensor axes to base axes
        sensor: bool = True,
        firmware: str = "current",
        zero_at_start: bool = True,
    ) -> None:
        self.frozen = self.mute = self.double_acks = False
        self.lose_acks = 0
        self.ack_delay_s = 0.0
        self.mangle: Callable[[Frames], Frames] = lambda frames: frames
        self.wrench = wrench
        self.sensor = sensor
        self.requests: list[str] = []
        self.pairs = 0
        self._bus = bus
        self._node = node
        self._opcodes = FIRMWARES[firmware]
        self._names = {opcode: name for name, opcode in self._opcodes.items()}
        self._turn = np.kron(np.eye(2), np.array(rotation, dtype=float).T)
        self._zero_at_start = zero_at_start
        self._lock = threading.RLock()
        self._ending = threading.Event()
        self._deaf = False
        self._double: can.Message | None = None
        self._late: list[tuple[float, can.Message]] = []
        self._halt()
        self._thread = threading.Thread(target=self._run, name="jr3-node", daemon=True)

    def start(self) -> None:
        """Switch the board on; it says BOOTUP if it finds its sensor."""
        if self.sensor:
            self._send(self._message("bootup"))
        self._thread.start()

    def stop(self) -> None:
        """Switch it off and close its bus."""
        self._ending.set()
        if self._thread.ident is not None:
            self._thread.join()
        self._bus.shutdown()

    def restart(self) -> None:
        """Lose power for a moment."""
        with self._lock:
            self._halt()
            self._send(self._message("bootup"))

    def error_frame(self, error_class: int) -> None:
        """Show an error frame, as a CAN controller does."""
        self._send(
            can.Message(arbitration_id=error_class, is_error_frame=True, is_extended_id=False)
        )

    def garbage(self, opcode: int, data: bytes) -> None:
        """Send any bytes by the node's name."""
        self._send(can.Message(arbitration_id=opcode | self._node, is_extended_id=False, data=data))

    # The board

    def _halt(self) -> None:
        self._streaming = False
        self._period_s = 1.0
        self._due_s = 0.0
        self._cutoff_hz = 0.0
        self._samples = 0
        self._offset = np.zeros(6)
        self._filtered = np.zeros(6)

    def _run(self) -> None:
        while not self._ending.is_set():
            now_s = time.monotonic()
            due_s = self._due_s if self._streaming else now_s + 0.01
            due_s = min([due_s, *(due for due, _ in self._late)])
            message = self._bus.recv(min(max(due_s - now_s, 0.0), 0.01))
            with self._lock:
                if message is not None and not message.is_error_frame:
                    self._answer(message)
                self._send_late()
                if self._streaming and time.monotonic() >= self._due_s:
                    self._publish()

    def _answer(self, message: can.Message) -> None:
        name = self._names.get(message.arbitration_id & ~0x7F)
        if name is None or message.arbitration_id & 0x7F != self._node or self._deaf:
            return
        data = bytes(message.data)
        if name in ("ack", "forces", "moments", "bootup"):  # a multicast bus hears itself
            return
        self.requests.append(name)
        if name == "start_async":
            self._start(data)
        elif name == "stop":
            self._halt()
        elif name == "set_filter":
            self._cutoff_hz = self._parse_cutoff(data)
        elif name == "reset":
            if not self.sensor:  # it waits for the sensor's EEPROM, for ever
                self._deaf = True
                return
            self._halt()
        if name == "force_scales":
            self._acknowledge(self._scales()[:3])
        elif name == "moment_scales":
            self._acknowledge(self._scales()[3:])
        elif name == "scales":
            self._send(self._data("forces", self._scales()[:3], 0))
            self._send(self._data("moments", self._scales()[3:], 0))
        elif name != "start_sync":
            self._acknowledge()
        if name == "zero":  # after the acknowledgement, and from one sample
            self._offset = self._offset + self._filtered

    def _scales(self) -> tuple[int, ...]:
        return FULL_SCALES if self.sensor else (41234, 0, 7, 65535, 513, 2)

    def _parse_cutoff(self, data: bytes) -> float:
        return float(struct.unpack_from("<H", data)[0]) / 100.0 if len(data) >= 2 else 0.0

    def _start(self, data: bytes) -> None:
        self._halt()
        if not self.sensor:
            return
        self._cutoff_hz = self._parse_cutoff(data)
        period_us = struct.unpack_from("<I", data, 2)[0] if len(data) >= 6 else 0
        self._period_s = max(period_us * 1e-6, 50e-6)  # 0 floods the bus
        if self._zero_at_start:
            self._offset = self._raw(time.monotonic())
        self._started_s = self._due_s = time.monotonic()
        self._streaming = True

    def _raw(self, now_s: float) -> FloatArray:
        scale = np.array(FULL_SCALES) * [1.0, 1.0, 1.0, 0.1, 0.1, 0.1]
        raw = self._turn @ self.wrench(now_s) / scale * RAW_FULL_SCALE
        return np.clip(raw, -RAW_FULL_SCALE, RAW_FULL_SCALE)

    def _publish(self) -> None:
        now_s = time.monotonic()
        self._due_s += self._period_s
        if self._due_s < now_s:  # what is missed is not sent in a burst
            self._due_s = now_s + self._period_s
        if not self.frozen:
            samples = int((now_s - self._started_s) / SAMPLE_S)
            smoothing = (
                SAMPLE_S / (SAMPLE_S + 1.0 / (2.0 * pi * self._cutoff_hz))
                if self._cutoff_hz > 0.0
                else 1.0
            )
            kept = (1.0 - smoothing) ** (samples - self._samples)
            target = self._raw(now_s) - self._offset
            self._filtered = target + kept * (self._filtered - target)
            self._samples = samples
        raw = np.round(self._filtered).astype(int).tolist()
        counter = self._samples & 0xFFFF
        pair = [self._data("forces", raw[:3], counter), self._data("moments", raw[3:], counter)]
        self.pairs += 1
        for message in self.mangle(pair):
            self._send(message)

    def _message(self, name: str, data: bytes = b"") -> can.Message:
        identifier = self._opcodes[name] | self._node
        return can.Message(arbitration_id=identifier, is_extended_id=False, data=data)

    def _data(self, name: str, values: Sequence[int], counter: int) -> can.Message:
        as_words = [value & 0xFFFF for value in values]
        return self._message(name, struct.pack("<4H", *as_words, counter))

    def _acknowledge(self, values: Sequence[int] = ()) -> None:
        message = self._message("ack", struct.pack(f"<B{len(values)}H", not self.sensor, *values))
        if self.lose_acks > 0:
            self.lose_acks -= 1
            return
        due_s = time.monotonic() + self.ack_delay_s
        if self._double is not None:
            self._late.append((due_s, self._double))
        self._double = message if self.double_acks else None
        self._late.append((due_s, message))
        self._send_late()

    def _send_late(self) -> None:
        now_s = time.monotonic()
        for due_s, message in list(self._late):
            if due_s <= now_s:
                self._late.remove((due_s, message))
                self._send(message)

    def _send(self, message: can.Message) -> None:
        if not self.mute:
            self._bus.send(message)


def plant_wrench(path: str) -> Callable[[float], FloatArray]:
    """Return the wrench of a plant's shared memory, whatever the time."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        memory = mmap.mmap(descriptor, 4096, prot=mmap.PROT_READ)
    finally:
        os.close(descriptor)
    if struct.unpack_from("<Q", memory, 0)[0] != 0x46485046414B4531:
        raise ValueError(f"{path} is not the file of a plant")

    def wrench(_: float) -> FloatArray:
        while True:
            before = struct.unpack_from("<Q", memory, 8)[0]
            values = struct.unpack_from("<6d", memory, 288)
            if before % 2 == 0 and struct.unpack_from("<Q", memory, 8)[0] == before:
                return np.array(values)

    return wrench


def main() -> None:
    """Be a node until terminated."""
    parser = argparse.ArgumentParser(description="A JR3 force sensor on a CAN bus, pretended.")
    parser.add_argument("--interface", default="udp_multicast")
    parser.add_argument("--channel", default="239.74.163.2")
    parser.add_argument("--node", type=int, default=1)
    parser.add_argument("--plant", default=os.environ.get("FARHAND_FAKE_PLANT"))
    parser.add_argument("--wrench", type=float, nargs=6, default=[0.0] * 6)
    chosen = parser.parse_args()
    constant = np.array(chosen.wrench)
    options = {"fd": False, "hop_limit": 0} if chosen.interface == "udp_multicast" else {}
    node = Jr3Node(
        can.Bus(interface=chosen.interface, channel=chosen.channel, **options),
        node=chosen.node,
        wrench=plant_wrench(chosen.plant) if chosen.plant else lambda _: constant,
    )
    ending = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: ending.set())
    node.start()
    print("ready", flush=True)  # noqa: T201  whoever started it waits for this
    ending.wait()
    node.stop()


if __name__ == "__main__":
    main()
