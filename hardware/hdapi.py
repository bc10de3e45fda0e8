"""OpenHaptics HDAPI, version 3, through ctypes: signatures, constants, names of errors.

Constants keep the vendor's names and values. Nothing is loaded on import.
"""

import ctypes
from ctypes import (
    POINTER,
    c_char_p,
    c_double,
    c_float,
    c_int32,
    c_long,
    c_ubyte,
    c_uint16,
    c_uint32,
    c_ulong,
    c_void_p,
)
from typing import Any, Final

HD_CURRENT_BUTTONS: Final = 0x2000  # 1 int: the bits 1, 2, 4, 8 of buttons that are down
HD_CURRENT_POSITION: Final = 0x2050  # 3 doubles, mm, of an arm with the vendor's link lengths
HD_CURRENT_JOINT_ANGLES: Final = 0x2100  # 3 doubles, rad
HD_CURRENT_JOINT_TORQUE: Final = 0x2703  # 3 doubles, mN·m; overrides HD_CURRENT_FORCE
HD_FORCE_OUTPUT: Final = 0x4000
HD_CALIBRATION_OK: Final = 0x5000
HD_CALIBRATION_ENCODER_RESET: Final = 1
HD_CALLBACK_DONE: Final = 0
HD_CALLBACK_CONTINUE: Final = 1
HD_INVALID_HANDLE: Final = 0xFFFFFFFF
HD_MAX_SCHEDULER_PRIORITY: Final = 0xFFFF

ERROR_NAMES: Final = {
    0x0100: "HD_INVALID_ENUM",
    0x0101: "HD_INVALID_VALUE",
    0x0102: "HD_INVALID_OPERATION",
    0x0103: "HD_INVALID_INPUT_TYPE",
    0x0104: "HD_BAD_HANDLE",
    0x0200: "HD_WARM_MOTORS",
    0x0201: "HD_EXCEEDED_MAX_FORCE",
    0x0202: "HD_EXCEEDED_MAX_FORCE_IMPULSE",
    0x0203: "HD_EXCEEDED_MAX_VELOCITY",
    0x0204: "HD_FORCE_ERROR",
    0x0300: "HD_DEVICE_FAULT",
    0x0301: "HD_DEVICE_ALREADY_INITIATED",
    0x0302: "HD_COMM_ERROR",
    0x0303: "HD_COMM_CONFIG_ERROR",
    0x0304: "HD_TIMER_ERROR",
    0x0400: "HD_ILLEGAL_BEGIN",
    0x0401: "HD_ILLEGAL_END",
    0x0402: "HD_FRAME_ERROR",
    0x0500: "HD_INVALID_PRIORITY",
    0x0501: "HD_SCHEDULER_FULL",
    0x0600: "HD_INVALID_LICENSE",
}
_REMEDIES: Final = {
    0x0200: "the motors are warm: let them cool",
    0x0201: "the force was beyond what the device allows",
    0x0202: "the force rose faster than the device allows",
    0x0203: "the arm moved faster than the device allows",
    0x0204: "the device cannot exert the force",
    0x0300: "the device reports a fault",
    0x0301: "another program holds the device",
    0x0302: "the device does not answer: look at cable and power",
    0x0303: "the port of the device is set up wrongly",
    0x0600: "OpenHaptics has no valid licence",
}


class HdapiError(Exception):
    """The vendor's library is missing, or reported an error."""


class ErrorInfo(ctypes.Structure):
    """HDErrorInfo, which hdGetError returns by value."""

    _fields_ = (
        ("code", c_uint32),
        ("internal_code", c_int32),
        ("device", c_uint32),
    )

    code: int
    internal_code: int


Callback = ctypes.CFUNCTYPE(c_uint32, c_void_p)

_HANDLE, _ENUM = c_uint32, c_uint32
_VALUES: Final = {
    "Booleanv": c_ubyte,
    "Integerv": c_int32,
    "Floatv": c_float,
    "Doublev": c_double,
    "Longv": c_long,
}
SIGNATURES: Final[dict[str, tuple[Any, tuple[Any, ...]]]] = {
    "hdInitDevice": (_HANDLE, (c_char_p,)),
    "hdDisableDevice": (None, (_HANDLE,)),
    "hdMakeCurrentDevice": (None, (_HANDLE,)),
    "hdGetCurrentDevice": (_HANDLE, ()),
    "hdBeginFrame": (None, (_HANDLE,)),
    "hdEndFrame": (None, (_HANDLE,)),
    "hdGetError": (ErrorInfo, ()),
    "hdGetErrorString": (c_char_p, (c_uint32,)),
    "hdEnable": (None, (_ENUM,)),
    "hdDisable": (None, (_ENUM,)),
    "hdIsEnabled": (c_ubyte, (_ENUM,)),
    **{f"hdGet{kind}": (None, (_ENUM, POINTER(of))) for kind, of in _VALUES.items()},
    **{f"hdSet{kind}": (None, (_ENUM, POINTER(of))) for kind, of in _VALUES.items()},
    "hdGetString": (c_char_p, (_ENUM,)),
    "hdCheckCalibration": (_ENUM, ()),
    "hdCheckCalibrationStyle": (_ENUM, ()),
    "hdUpdateCalibration": (None, (_ENUM,)),
    "hdUpdateCalibrationMessage": (None, (_ENUM,)),
    "hdScaleGimbalAngles": (None, (c_double, c_double, c_double, POINTER(c_double))),
    "hdDeploymentLicense": (c_ubyte, (c_char_p, c_char_p, c_char_p)),
    "hdStartScheduler": (None, ()),
    "hdStopScheduler": (None, ()),
    "hdSetSchedulerRate": (None, (c_ulong,)),
    "hdScheduleSynchronous": (None, (Callback, c_void_p, c_uint16)),
    "hdScheduleAsynchronous": (c_ulong, (Callback, c_void_p, c_uint16)),
    "hdUnschedule": (None, (c_ulong,)),
    "hdWaitForCompletion": (c_ubyte, (c_ulong, c_uint32)),
    "hdGetSchedulerTimeStamp": (c_double, ()),
}
# May wait for the servo thread, which needs the interpreter: these let go of it. The others keep
# it, since a frame that lets go has to queue for it again.
_WAITING: Final = {
    "hdInitDevice",
    "hdDisableDevice",
    "hdStartScheduler",
    "hdStopScheduler",
    "hdScheduleSynchronous",
    "hdUnschedule",
    "hdWaitForCompletion",
}


def load_hdapi(library: str) -> ctypes.CDLL:
    """Load libHD, its functions declared as attributes; raises HdapiError if it cannot be used."""
    try:
        waiting, holding = ctypes.CDLL(library), ctypes.PyDLL(library)
    except OSError as error:
        raise HdapiError(
            f"the vendor's library cannot be loaded ({error}); install OpenHaptics and the driver "
            "of the PHANToM from 3D Systems, or set `library` to the path of its libHD.so"
        ) from error
    for name, (result, arguments) in SIGNATURES.items():
        try:
            function = getattr(waiting if name in _WAITING else holding, name)
        except AttributeError:
            raise HdapiError(f"{library} is not OpenHaptics 3: it has no {name}") from None
        function.restype, function.argtypes = result, arguments
        setattr(waiting, name, function)
    return waiting


def pop_errors(hd: ctypes.CDLL) -> str | None:
    """Empty the stack of errors; describe the oldest, the cause of the others. None: no error.

    Errors with a force or motor behind them come before any other.
    """
    found = None
    for _ in range(64):  # a library that never runs out of errors must not hold up a frame
        info = hd.hdGetError()
        if info.code == 0:
            break
        if found is None or not is_force_error(found.code) or is_force_error(info.code):
            found = info
    return None if found is None else describe(found.code, found.internal_code)


def is_force_error(code: int) -> bool:
    """Whether the device stopped its motors: too warm, too strong, too fast."""
    return 0x0200 <= code <= 0x0204


def describe(code: int, internal_code: int) -> str:
    """Return the error's name, its numbers and what it means to a person."""
    name = ERROR_NAMES.get(code, "an unknown error")
    remedy = _REMEDIES.get(code)
    return f"{name} (0x{code:04x}, internal {internal_code})" + (f": {remedy}" if remedy else "")
