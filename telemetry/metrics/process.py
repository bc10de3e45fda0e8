"""The site's end of its Prometheus endpoint: its start, its troubles, its end."""

import json
from types import TracebackType
from typing import Any, Final, Self

from telemetry.companion import Companion, SharedMemory
from telemetry.metrics.site_metrics import MetricsOptions
from telemetry.rows import TelemetryError

_MODULE: Final = "telemetry.metrics.server"
_START_S: Final = 15.0
_END_S: Final = 1.0


class MetricsProcess:
    """A running endpoint over a ring in shared memory; TelemetryError if it does not come up."""

    def __init__(self, memory: SharedMemory, options: MetricsOptions) -> None:
        self._process = Companion(_MODULE, memory, options.to_json(), answers=True)
        try:
            answer = self._await_answer()
            if "error" in answer:
                raise TelemetryError(
                    f"metrics cannot be served on {joined(options.host, options.port)}: "
                    f"{answer['error']}; name another port, or run without --metrics"
                )
        except BaseException:
            self._process.kill()
            raise
        self.url = f"http://{joined(options.host, answer['port'])}/metrics"

    @property
    def pid(self) -> int:
        """Its process id."""
        return self._process.pid

    @property
    def trouble(self) -> str | None:
        """What is wrong with it, None if nothing is. From any thread."""
        code = self._process.exit_code
        return None if code is None else f"no metrics: their process ended with code {code}"

    def close(self) -> None:
        """End it; it has nothing to finish."""
        self._process.close(_END_S)
        if self._process.exit_code is None:
            self._process.kill()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def _await_answer(self) -> dict[str, Any]:
        line = self._process.answer(_START_S)
        if line:
            answer: dict[str, Any] = json.loads(line)
            return answer
        return {
            "error": "their process "
            + ("ended at once" if line == "" else f"did not start within {_START_S:g} s")
        }


def joined(host: str, port: int) -> str:
    """Return HOST:PORT, an IPv6 host in brackets."""
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
