"""Network namespaces of one's own, with TUN devices: what a network on one machine is made of."""

import ctypes
import fcntl
import os
import shutil
import struct
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

_NAMED = Path("/run/netns")
_TUN = "/dev/net/tun"
# linux/if_tun.h, linux/sched.h
_TUNSETIFF, _IFF_TUN, _IFF_NO_PI = 0x400454CA, 0x0001, 0x1000
_CLONE_NEWNET = 0x40000000


@cache
def refusal() -> str | None:
    """Why this machine does not let us make a network; None if it does. Tries it once."""
    if shutil.which("ip") is None:
        return "no `ip` (iproute2)"
    if os.geteuid() != 0:
        return "network namespaces need root"
    name = f"farhand-try-{os.getpid()}"
    try:
        create(name)
        try:
            os.close(open_tun(name, "farhand0", "10.213.0.1/30"))
        finally:
            delete(name)
    except (OSError, subprocess.CalledProcessError) as error:
        told = getattr(error, "stderr", None) or error
        return f"no network namespace with a TUN device: {told}"
    return None


def create(name: str) -> None:
    """Make a namespace with its loopback up; CalledProcessError if refused."""
    ip("netns", "add", name)
    ip("-n", name, "link", "set", "lo", "up")


def delete(name: str) -> None:
    """Remove the namespace's name; it ends with its last process. Never raises."""
    with open(os.devnull, "wb") as nowhere:
        subprocess.run(["ip", "netns", "del", name], stderr=nowhere, check=False)  # noqa: S607


@contextmanager
def inside(name: str) -> Iterator[None]:
    """Put this thread into a namespace: sockets made here belong to it for good."""
    with (_NAMED / name).open("rb") as there, Path("/proc/thread-self/ns/net").open("rb") as here:
        _enter(there.fileno())
        try:
            yield
        finally:
            _enter(here.fileno())


def open_tun(name: str, device: str, address: str) -> int:
    """Make a TUN device with this address in a namespace; return its descriptor, non-blocking.

    One read, one write: one IP packet. The device goes with its descriptor.
    """
    with inside(name):
        descriptor = os.open(_TUN, os.O_RDWR | os.O_NONBLOCK)
        request = struct.pack("16sH22x", device.encode(), _IFF_TUN | _IFF_NO_PI)
        fcntl.ioctl(descriptor, _TUNSETIFF, request)
    ip("-n", name, "address", "add", address, "dev", device)
    # no IPv6 of its own: its discovery packets would come in between ours
    ip("-n", name, "link", "set", device, "addrgenmode", "none")
    ip("-n", name, "link", "set", device, "up")
    return descriptor


def _enter(descriptor: int) -> None:
    # os.setns came with Python 3.12
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.setns(descriptor, _CLONE_NEWNET) != 0:
        code = ctypes.get_errno()
        raise OSError(code, os.strerror(code))


def ip(*arguments: str) -> None:
    """Run `ip`; CalledProcessError with what it said if it refuses."""
    subprocess.run(["ip", *arguments], check=True, capture_output=True, text=True)  # noqa: S607
