"""The lease: one commands, and a dead client's hold runs out."""

from __future__ import annotations

import pytest

from echolume_daemon.lease import LEASE_S, Lease
from echolume_messages.errors import LeaseHeldError


class Hands:
    """A clock that the test turns."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


def test_a_lease_lasts_at_most_five_seconds() -> None:
    assert LEASE_S <= 5.0


def test_a_second_holder_is_refused_and_told_who_commands() -> None:
    clock = Hands()
    lease = Lease(now_s=clock)
    lease.take("ann@lab")
    clock.now_s += 2.0
    with pytest.raises(LeaseHeldError, match=r"ann@lab commands the rig; free at the latest 3\.0 s"):
        lease.take("bob@lab")
    assert lease.holder == "ann@lab"


def test_a_dead_clients_lease_frees_by_itself() -> None:
    clock = Hands()
    lease = Lease(now_s=clock)
    lease.take("ann@lab")
    clock.now_s += LEASE_S
    assert lease.holder == ""
    lease.take("bob@lab")
    assert lease.holder == "bob@lab"


def test_renewing_prolongs_the_holders_lease_and_nobody_elses() -> None:
    clock = Hands()
    lease = Lease(now_s=clock)
    lease.take("ann@lab")
    clock.now_s += 4.0
    lease.renew("ann@lab")
    clock.now_s += 4.0
    assert lease.holder == "ann@lab"
    lease.renew("bob@lab")
    clock.now_s += 1.0
    assert lease.holder == ""
    lease.renew("ann@lab")
    assert lease.holder == ""


def test_a_nameless_command_is_refused() -> None:
    with pytest.raises(LeaseHeldError, match="holder"):
        Lease().take("")


def test_a_released_lease_is_free_at_once() -> None:
    lease = Lease(now_s=Hands())
    lease.take("ann@lab")
    lease.release("bob@lab")
    assert lease.holder == "ann@lab"
    lease.release("ann@lab")
    assert lease.holder == ""
