"""The lease by itself: every transition, and at random what must never happen."""

from dataclasses import dataclass, field

from hypothesis import given
from hypothesis import strategies as st

from site_runtime.lease import CLAIM_NS, Lease, LeaseRules, Step, Verb, Wish, hear, look

S = 1_000_000_000
RULES = LeaseRules(expire_ns=5 * S, supervisors=frozenset({"carol"}))
PEOPLE = ("alice", "bob", "carol")


@dataclass
class Scene:
    """A lease, its time, and what its site would be like."""

    lease: Lease = field(default_factory=Lease)
    now_ns: int = S
    told: list[str] = field(default_factory=list)
    epoch: int = 100

    def take_in(self, step: Step) -> Step:
        self.lease = step.lease
        self.told += step.told
        return step

    def wish(self, name: str, verb: str, to: str | None = None, epoch: int | None = None) -> Step:
        if epoch is None:
            self.epoch += 1
            epoch = self.epoch if verb != "claim" else 1
        return self.take_in(hear(self.lease, RULES, name, Wish(Verb(verb), epoch, to), self.now_ns))

    def look(
        self, *, heard_ns: int | None = None, engaged: bool = False, settled: bool = True
    ) -> None:
        step = look(
            self.lease, RULES, self.now_ns, heard_ns=heard_ns, engaged=engaged, settled=settled
        )
        self.take_in(step)

    def claimed(self, *names: str) -> "Scene":
        for name in names:
            self.wish(name, "claim")
            self.now_ns += 1
            self.look()
        self.told.clear()
        return self


def test_who_claims_a_free_robot_holds_it() -> None:
    scene = Scene()
    scene.wish("alice", "claim")
    assert scene.lease.obeyed is None
    scene.look(settled=False)  # before anybody held it there is nothing to settle
    assert scene.lease.obeyed == "alice"
    assert scene.told == ["alice claims it", "alice holds it"]


def test_a_second_is_refused_with_the_holders_name_and_told_of_once() -> None:
    scene = Scene().claimed("alice")
    for _ in range(3):
        answer = scene.wish("bob", "claim").answer
        scene.look()
    assert answer == "alice holds it"
    assert scene.lease.refused == {"bob": "alice holds it"}
    assert scene.told == ["bob is refused: alice holds it"]
    assert scene.lease.obeyed == "alice"


def test_a_release_ends_it_and_the_longest_waiting_comes_after_the_site_settled() -> None:
    scene = Scene().claimed("alice", "carol", "bob")
    scene.wish("alice", "release")
    assert scene.lease.obeyed is None
    assert scene.lease.refused["bob"] == "alice is parting from it"
    for _ in range(3):
        scene.look(settled=False)
    assert scene.lease.obeyed is None
    scene.look()
    assert scene.lease.obeyed == "carol"
    assert scene.told == ["alice releases it", "carol holds it"]


def test_what_was_released_is_not_claimed_by_the_run_that_ends() -> None:
    scene = Scene().claimed("alice")
    scene.wish("alice", "release", epoch=7)
    scene.wish("alice", "claim", epoch=7)
    scene.look()
    assert scene.lease == Lease(
        since_ns=scene.lease.since_ns,
        heard_ns=scene.lease.heard_ns,
        rested={"alice": 7},
        asked={"alice": 7},
    )
    scene.wish("alice", "claim", epoch=8)
    scene.wish("alice", "claim", epoch=2)  # a run that goes on; a command claimed for it
    scene.look()
    assert scene.lease.obeyed == "alice"


def test_who_withdraws_while_waiting_is_passed_over() -> None:
    scene = Scene().claimed("alice", "bob")
    assert scene.wish("bob", "release").answer == "your claim is withdrawn"
    scene.wish("alice", "release")
    scene.look()
    assert scene.lease.holder is None


def test_claims_and_packets_each_renew_it() -> None:
    for by_packets in (False, True):
        scene = Scene().claimed("alice")
        for _ in range(20):
            scene.now_ns += RULES.expire_ns // 2
            if by_packets:
                scene.look(heard_ns=scene.now_ns - 1)
            else:
                scene.wish("alice", "claim")
                scene.look(heard_ns=5)
        assert scene.lease.obeyed == "alice"


def test_silence_ends_it_to_the_nanosecond_but_never_while_engaged() -> None:
    scene = Scene().claimed("alice")
    since_ns = scene.lease.heard_ns
    scene.now_ns = since_ns + RULES.expire_ns - 1
    scene.look()
    assert scene.lease.obeyed == "alice"
    scene.now_ns += 1
    scene.look(engaged=True)
    assert scene.lease.obeyed == "alice"
    scene.look()
    assert scene.lease.obeyed is None
    assert scene.told == ["expired: nothing of alice for 5.0 s"]
    scene.wish("alice", "claim")  # woken up: too late for this one, in time for the next
    scene.look(settled=False)
    assert scene.lease.obeyed is None
    scene.look()
    assert scene.lease.obeyed == "alice"


def test_a_claim_younger_than_the_silence_goes_with_the_lease() -> None:
    rules = LeaseRules(expire_ns=CLAIM_NS // 2)
    scene = Scene().claimed("alice", "bob")
    for _ in range(3):
        scene.now_ns += rules.expire_ns // 2
        scene.wish("bob", "claim")
        scene.take_in(
            look(scene.lease, rules, scene.now_ns, heard_ns=None, engaged=False, settled=True)
        )
    assert scene.lease.obeyed == "bob"


def test_packets_from_before_the_lease_do_not_renew_it() -> None:
    scene = Scene().claimed("alice")
    scene.now_ns += RULES.expire_ns
    scene.look(heard_ns=scene.lease.since_ns)
    assert scene.lease.obeyed is None


def test_a_claim_not_repeated_is_none() -> None:
    scene = Scene().claimed("alice", "bob")
    scene.now_ns += CLAIM_NS
    scene.wish("alice", "release")
    scene.look()
    assert scene.lease.holder is None


def test_a_holder_gives_it_to_one_who_claims_it() -> None:
    scene = Scene().claimed("alice", "carol", "bob")
    assert scene.wish("alice", "give", "bob").granted
    assert scene.lease.obeyed is None
    scene.look(settled=False)
    scene.look()
    assert scene.lease.obeyed == "bob"
    assert scene.told == ["alice gives it to bob", "bob holds it"]


def test_what_may_not_be_given() -> None:
    scene = Scene().claimed("alice", "bob")
    for name, to, answer in (
        ("bob", "carol", "you do not hold it"),
        ("bob", "bob", "you do not hold it"),
        ("alice", "carol", "carol does not claim it"),
        ("alice", None, "None does not claim it"),
        ("alice", "alice", "you hold it"),
    ):
        step = scene.wish(name, "give", to)
        assert (step.granted, step.answer) == (False, answer)
        assert len(step.told) == 1
        scene.look()
        assert scene.lease.obeyed == "alice"


def test_a_successor_who_left_meanwhile_does_not_get_it() -> None:
    scene = Scene().claimed("alice", "bob")
    scene.wish("alice", "give", "bob")
    scene.wish("bob", "release")
    scene.look()
    assert scene.lease.obeyed == "alice"  # who still claims it


def test_only_a_supervisor_takes_it() -> None:
    scene = Scene().claimed("alice", "bob")
    step = scene.wish("bob", "take")
    assert not step.granted
    assert scene.lease.obeyed == "alice"
    assert scene.told == ["bob may not take it: no supervisor"]
    assert scene.wish("carol", "take").granted
    scene.look(settled=False)
    assert scene.lease.obeyed is None
    scene.look()
    assert scene.lease.obeyed == "carol"
    assert scene.told[1:] == ["carol takes it from alice", "carol holds it"]


def test_a_take_goes_before_a_gift() -> None:
    scene = Scene().claimed("alice", "bob")
    scene.wish("alice", "give", "bob")
    scene.wish("carol", "take")
    scene.look()
    assert scene.lease.obeyed == "carol"


def test_a_supervisor_takes_a_free_one_and_keeps_his_own() -> None:
    scene = Scene()
    scene.wish("carol", "take")
    scene.look()
    assert scene.lease.obeyed == "carol"
    before = scene.lease.since_ns
    assert scene.wish("carol", "take").answer == "you hold it"
    scene.look()
    assert (scene.lease.obeyed, scene.lease.since_ns) == ("carol", before)


def test_a_wish_that_arrives_again_does_nothing() -> None:
    scene = Scene().claimed("alice", "bob")
    scene.wish("alice", "give", "bob", epoch=9)
    scene.look()
    scene.wish("bob", "give", "alice")
    scene.look()
    assert scene.lease.obeyed == "alice"
    scene.wish("alice", "give", "bob", epoch=9)
    scene.wish("alice", "release", epoch=8)
    scene.look()
    assert scene.lease.obeyed == "alice"


EVENTS = st.lists(
    st.one_of(
        st.tuples(
            st.just("wish"),
            st.sampled_from(PEOPLE),
            st.sampled_from(list(Verb)),
            st.sampled_from((*PEOPLE, None)),
            st.integers(1, 30),
        ),
        st.tuples(st.just("look"), st.booleans(), st.booleans(), st.booleans()),
        st.tuples(st.just("wait"), st.integers(1, 6 * S)),
    ),
    max_size=60,
)


@given(EVENTS)
def test_nobody_follows_another_but_over_a_settled_site(events) -> None:
    """Whoever is obeyed claimed it; between two of them lies a look at a settled site."""
    scene = Scene()
    settled_since = True
    for kind, *rest in events:
        before = scene.lease.obeyed
        if kind == "wait":
            scene.now_ns += rest[0]
            continue
        if kind == "wish":
            name, verb, to, epoch = rest
            scene.wish(name, verb, to, epoch)
            after = scene.lease.obeyed
            assert after in (None, before)  # no wish gives it to anybody at once
            if before is not None and after is None:
                may = name == before or (verb is Verb.TAKE and name == "carol")
                assert may, "ended by another"
        else:
            engaged, settled, heard = rest
            claims = scene.lease.claims
            settled_since |= settled and scene.lease.obeyed is None
            scene.look(heard_ns=scene.now_ns if heard else None, engaged=engaged, settled=settled)
            after = scene.lease.obeyed
            if before is None and after is not None:
                assert after in claims
                assert settled_since
                settled_since = False
            if before is not None and engaged:
                assert after == before
        if scene.lease.obeyed != before:
            assert scene.told, "not audited"
        assert set(scene.lease.refused) <= set(scene.lease.claims)
