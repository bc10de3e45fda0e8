import threading

from site_runtime.operator_requests import OperatorRequests


def test_nothing_is_asked_for_at_first() -> None:
    requests = OperatorRequests()
    assert not requests.clutch
    assert not requests.take_emergency_stop()
    assert not requests.take_reset()


def test_the_clutch_is_toggled() -> None:
    requests = OperatorRequests()
    requests.toggle_clutch()
    assert requests.clutch
    requests.toggle_clutch()
    assert not requests.clutch


def test_a_stop_and_a_reset_are_taken_once() -> None:
    requests = OperatorRequests()
    requests.stop()
    requests.stop()
    assert requests.take_emergency_stop()
    assert not requests.take_emergency_stop()
    requests.reset()
    assert requests.take_reset()
    assert not requests.take_reset()


def test_a_stop_outweighs_a_reset_before_it_but_not_one_after_it() -> None:
    requests = OperatorRequests()
    requests.reset()
    requests.stop()
    assert not requests.take_reset()
    assert requests.take_emergency_stop()
    requests.stop()
    requests.reset()
    assert requests.take_reset()
    assert requests.take_emergency_stop()


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
    assert requests.take_emergency_stop()
    assert requests.take_emergency_stop()
    # and a look that finds nothing writes nothing, so there is no moment to lose one in
    requests.__dict__["armed"] = True
    assert not requests.take_emergency_stop()
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
        assert requests.take_emergency_stop()
        taken.set()
    thread.join(10.0)
    assert not thread.is_alive()
