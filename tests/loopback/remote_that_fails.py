"""The remote site, whose keeping of the lease fails at the words `FAIL`."""

import runpy
from unittest.mock import patch

from site_runtime import lease_keeper
from site_runtime.lease import Wish
from site_runtime.lease_messages import decode_wish

FAIL = b"fail"


def failing(payload: bytes) -> Wish | None:
    if payload == FAIL:
        raise RuntimeError("words that nobody thought of")
    return decode_wish(payload)


if __name__ == "__main__":
    with patch.object(lease_keeper, "decode_wish", failing):
        runpy.run_module("remote_site", run_name="__main__")
