import pytest
import typer

from site_runtime.metrics import MetricsAddress, metrics_address


@pytest.mark.parametrize(
    ("text", "host", "port"),
    [
        ("9101", "127.0.0.1", 9101),
        ("0", "127.0.0.1", 0),
        ("0.0.0.0:65535", "0.0.0.0", 65535),  # noqa: S104 - a host that was given
        ("robot.example:80", "robot.example", 80),
        ("[::1]:9101", "::1", 9101),
    ],
)
def test_a_port_is_on_loopback_unless_a_host_is_given(text: str, host: str, port: int) -> None:
    assert metrics_address(text) == MetricsAddress(host, port)


@pytest.mark.parametrize(
    "text", ["", "x", "65536", "-1", "1.5", ":9101", "[]:9101", "host:", "host", "²", "::1"]
)
def test_anything_else_is_refused_with_what_it_was(text: str) -> None:
    with pytest.raises(typer.BadParameter) as refused:
        metrics_address(text)
    assert repr(text) in refused.value.message
