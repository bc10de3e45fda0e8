import pytest

from channel.memory_link import memory_links


def test_each_direction_keeps_its_newest() -> None:
    for sender, receiver in (links := memory_links(capacity=3), links[::-1]):
        for k in range(10):
            assert sender.send(bytes([k]))
        assert receiver.receive() == [bytes([k]) for k in (7, 8, 9)]


def test_capacity_must_be_positive() -> None:
    with pytest.raises(ValueError, match="capacity = 0"):
        memory_links(capacity=0)
