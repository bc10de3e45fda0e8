import threading

import pytest

from site_runtime.operator_requests import CLUTCH, EMERGENCY_STOP, RESET, OperatorRequests


def test_nothing_is_asked_for_at_first() -> None:
    requests = OperatorRequests()
    assert not requests.clutch
    assert requests.take() == 0


def test_the_clutch_is_toggled() -> None:
    requests = OperatorRequests()
    requests.toggle_clutch()
    assert [requests.take(), requests.take()] == [CLUTCH, CLUTCH], "it stays as it is"
    requests.toggle_clutch()
    assert requests.take() == 0


def test_a_stop_and_a_reset_are_taken_once() -> None:
    requests = OperatorRequests()
    requests.stop()
    requests.stop()
    assert [requests.take(), requests.take()] == [EMERGENCY_STOP, 0]
    requests.reset()
    assert [requests.take(), requests.take()] == [RESET, 0]


def test_a_stop_outweighs_a_reset_before_it_but_not_one_after_it() -> None:
    requests = OperatorRequests()
    requests.reset()
    requests.stop()
    assert requests.take() == EMERGENCY_STOP
    requests.stop()
    requests.reset()
    assert requests.take() == EMERGENCY_STOP | RESET


@pytest.mark.parametrize("bits", range(0, 16, 2))
def test_what_was_asked_for_once_can_be_asked_for_again(bits: int) -> None:
    requests = OperatorRequests()
    requests.toggle_clutch()
    requests.stop()
    requests.ask(bits)
    assert requests.take() == bits


class Interrupted(OperatorRequests):
    """Asked to stop at the worst moment: as the flag is put back."""

    def __setattr__(self, name: str, value: bool) -> None:
        super().__setattr__(name, value)
        if name == "_emergency_stop" and value is False and self.__dict__.pop("armed", False):
            self.stop()


def test_a_stop_asked_for_while_the_last_is_taken_is_not_lost() -> None:
    requests = Interrupted()
    requests.__dict__["armed"] = True
    requests.__dict__["_emergency_stop"] = True
    assert requests.take() == EMERGENCY_STOP
    assert requests.take() == EMERGENCY_STOP
    # and a look that finds nothing writes nothing, so there is no moment to lose one in
    requests.__dict__["armed"] = True
    assert requests.take() == 0
    assert requests.__dict__["armed"]


def test_no_stop_is_lost_between_two_threads() -> None:
    requests, asked, taken = OperatorRequests(), threading.Event(), threading.Event()

    def operator() -> None:
        for _ in range(200):
            requests.stop()
            asked.set()
            assert taken.wait(10.0)
            taken.clear()

    thread = threading.Thread(target=operator)
    thread.start()
    for _ in range(200):
        assert asked.wait(10.0)
        asked.clear()
        assert requests.take() == EMERGENCY_STOP
        taken.set()
    thread.join(10.0)
    assert not thread.is_alive()
