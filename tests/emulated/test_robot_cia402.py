"""The drive state machine against CiA 402's table, and one axis at the level of frames."""

from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from echolume_drivers.cia402_words import DriveState, drive_state
from echolume_drivers.emulated.cia402 import TRANSITIONS, Command, State, command, step
from echolume_drivers.emulated.robot_axis import Axis

NODE = 3


@pytest.mark.parametrize(
    ("controlword", "expected"),
    [
        (0x06, Command.SHUTDOWN),
        (0x07, Command.SWITCH_ON),
        (0x0F, Command.ENABLE_OPERATION),
        (0x00, Command.DISABLE_VOLTAGE),
        (0x02, Command.QUICK_STOP),
        (0x0B, Command.QUICK_STOP),
        (0x80, Command.FAULT_RESET),
        (0x1F, Command.ENABLE_OPERATION),
    ],
)
def test_controlwords(controlword: int, expected: Command) -> None:
    assert command(controlword, 0) is expected


def test_a_fault_reset_is_an_edge_not_a_level() -> None:
    assert command(0x80, 0x80) is Command.DISABLE_VOLTAGE


def test_a_fault_is_left_by_a_fault_reset_only() -> None:
    assert [c for c in Command if step(State.FAULT, c) is not State.FAULT] == [Command.FAULT_RESET]


@given(st.lists(st.sampled_from(Command), max_size=20))
def test_operation_is_reached_only_through_its_neighbours(commands: list[Command]) -> None:
    state = State.SWITCH_ON_DISABLED
    for asked in commands:
        before, state = state, step(state, asked)
        if state is State.OPERATION_ENABLED is not before:
            assert before in (State.SWITCHED_ON, State.READY_TO_SWITCH_ON, State.QUICK_STOP_ACTIVE)


def test_the_master_reads_every_state_of_the_drive() -> None:
    for state in State:
        assert drive_state(state.value | 0x0210) is DriveState[state.name]
    assert {was for was, _ in TRANSITIONS} <= set(State)


class Bench:
    """One axis with time in hand."""

    def __init__(self) -> None:
        self.axis = Axis(NODE, 1.0, start=1000, limits=(-50_000, 50_000))
        self.now_s = 100.0
        assert self.axis.tick(self.now_s) == [(0x703, b"\x00")]  # boot-up

    def frame(self, cob_id: int, data: str) -> list[tuple[int, str]]:
        return [(i, d.hex(" ")) for i, d in self.axis.receive(cob_id, bytes.fromhex(data), self.now_s)]

    def wait(self, seconds: float) -> list[tuple[int, str]]:
        self.now_s += seconds
        return [(i, d.hex(" ")) for i, d in self.axis.tick(self.now_s)]

    def enable(self) -> None:
        for word in (0x06, 0x07, 0x0F):
            self.frame(0x600 + NODE, struct.pack("<BHBI", 0x2B, 0x6040, 0, word).hex())
        assert self.axis.state is State.OPERATION_ENABLED


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_transcript_of_sdo(bench: Bench) -> None:
    # upload of the device type: 0x192 servo drive after profile 402
    assert bench.frame(0x603, "40 00 10 00 00 00 00 00") == [(0x583, "43 00 10 00 92 01 02 00")]
    # download of the producer heartbeat time, 100 ms, two bytes expedited
    assert bench.frame(0x603, "2b 17 10 00 64 00 00 00") == [(0x583, "60 17 10 00 00 00 00 00")]
    # upload of it
    assert bench.frame(0x603, "40 17 10 00 00 00 00 00") == [(0x583, "4b 17 10 00 64 00 00 00")]
    # object does not exist in the object dictionary
    assert bench.frame(0x603, "40 99 99 00 00 00 00 00") == [(0x583, "80 99 99 00 00 00 02 06")]
    # sub-index does not exist
    assert bench.frame(0x603, "40 18 10 09 00 00 00 00") == [(0x583, "80 18 10 09 11 00 09 06")]
    # attempt to write a read only object
    assert bench.frame(0x603, "2b 41 60 00 00 00 00 00") == [(0x583, "80 41 60 00 02 00 01 06")]
    # length of service parameter does not match
    assert bench.frame(0x603, "2f 17 10 00 64 00 00 00") == [(0x583, "80 17 10 00 10 00 07 06")]
    # mode 3 (profile velocity) is not supported: value range exceeded
    assert bench.frame(0x603, "2f 60 60 00 03 00 00 00") == [(0x583, "80 60 60 00 30 00 09 06")]
    # segmented upload of the device name: 22 bytes in segments of 7
    assert bench.frame(0x603, "40 08 10 00 00 00 00 00") == [(0x583, "41 08 10 00 16 00 00 00")]
    assert bench.frame(0x603, "60 00 00 00 00 00 00 00") == [(0x583, "00 65 63 68 6f 6c 75 6d")]
    assert bench.frame(0x603, "70 00 00 00 00 00 00 00") == [(0x583, "10 65 20 65 6d 75 6c 61")]
    assert bench.frame(0x603, "60 00 00 00 00 00 00 00") == [(0x583, "00 74 65 64 20 61 78 69")]
    assert bench.frame(0x603, "70 00 00 00 00 00 00 00") == [(0x583, "1d 73 00 00 00 00 00 00")]


def test_transcript_of_the_network_management(bench: Bench) -> None:
    bench.frame(0x603, "2b 17 10 00 64 00 00 00")  # heartbeat every 100 ms
    assert bench.wait(0.1) == [(0x703, "7f")]  # PRE-OPERATIONAL
    assert bench.frame(0x000, "01 03") == []  # start node 3
    assert bench.wait(0.1) == [(0x703, "05")]  # OPERATIONAL
    assert bench.frame(0x000, "80 07") == []  # another node's command
    assert bench.wait(0.1) == [(0x703, "05")]
    assert bench.frame(0x000, "81 00") == [(0x703, "00")]  # reset of all nodes: boot-up


def test_a_missing_master_takes_the_axis_out_of_operation(bench: Bench) -> None:
    bench.frame(0x603, "23 16 10 01 c8 00 7f 00")  # consumer heartbeat: node 127, 200 ms
    bench.frame(0x000, "01 03")
    bench.enable()
    bench.frame(0x77F, "05")  # the master's heartbeat
    assert bench.wait(0.19) == []
    assert bench.wait(0.02) == [(0x083, "30 81 11 00 00 00 00 00")]  # EMCY 0x8130 heartbeat error
    assert bench.axis.nmt == 0x7F
    assert bench.axis.state is State.FAULT


def configure_pdos(bench: Bench) -> None:
    for data in (
        "23 00 14 01 03 02 00 80",  # RPDO1 off
        "2f 00 16 00 00 00 00 00",  # nothing mapped
        "23 00 16 01 10 00 40 60",  # controlword, 16 bits
        "23 00 16 02 20 00 7a 60",  # target position, 32 bits
        "2f 00 16 00 02 00 00 00",
        "23 00 14 01 03 02 00 00",  # on, COB-ID 0x203
        "23 00 18 01 83 01 00 80",  # TPDO1 off
        "2f 00 1a 00 00 00 00 00",
        "23 00 1a 01 10 00 41 60",  # statusword
        "23 00 1a 02 20 00 64 60",  # actual position
        "2f 00 1a 00 02 00 00 00",
        "23 00 18 01 83 01 00 00",  # on, COB-ID 0x183
        "2f 60 60 00 01 00 00 00",  # profile position mode
        "23 81 60 00 10 27 00 00",  # profile velocity 10000 counts/s
        "23 83 60 00 a0 86 01 00",  # acceleration 100000 counts/s^2
    ):
        assert bench.frame(0x603, data)[0][1].startswith("60"), data
    bench.frame(0x000, "01 03")


def test_transcript_of_a_profile_position_move(bench: Bench) -> None:
    configure_pdos(bench)
    # bring-up; statusword low byte: 31 ready, 33 switched on, 37 operation enabled; high byte: 06 remote and reached
    assert bench.frame(0x203, "06 00 e8 03 00 00") == [(0x183, "31 06 e8 03 00 00")]
    assert bench.frame(0x203, "07 00 e8 03 00 00") == [(0x183, "33 06 e8 03 00 00")]
    assert bench.frame(0x203, "0f 00 e8 03 00 00") == [(0x183, "37 06 e8 03 00 00")]
    # new set-point 2000: bit 12 acknowledges it, bit 10 (target reached) falls
    assert bench.frame(0x203, "1f 00 d0 07 00 00") == [(0x183, "37 12 e8 03 00 00")]
    # the master takes its bit back, so does the drive
    assert bench.frame(0x203, "0f 00 d0 07 00 00") == [(0x183, "37 02 e8 03 00 00")]
    # 1000 counts: 0.1 s up, 0.1 s down, no time for the cruise
    assert bench.wait(0.1999) == []
    assert bench.wait(0.001) == [(0x183, "37 06 d0 07 00 00")]  # reached


def test_a_mapping_cannot_change_while_its_pdo_is_on(bench: Bench) -> None:
    configure_pdos(bench)
    assert bench.frame(0x603, "2f 00 16 00 00 00 00 00") == [(0x583, "80 00 16 00 22 00 00 08")]


def test_the_internal_limit_clips_the_target(bench: Bench) -> None:
    configure_pdos(bench)
    bench.enable()
    bench.frame(0x203, "1f 00 00 00 01 00")  # 65536 is beyond 50000
    bench.frame(0x203, "0f 00 00 00 01 00")
    bench.wait(10.0)
    assert bench.axis.position(bench.now_s) == 50_000
    assert bench.axis.statusword() & 0x0C00 == 0x0C00  # internal limit active, target reached


def test_a_new_set_point_at_once_may_turn_round(bench: Bench) -> None:
    configure_pdos(bench)
    bench.enable()
    bench.frame(0x203, "3f 00 20 4e 00 00")  # to 20000
    bench.wait(0.5)
    bench.frame(0x203, "2f 00 20 4e 00 00")
    bench.frame(0x203, "3f 00 00 00 00 00")  # back to 0 in full run
    bench.wait(0.2)
    bench.wait(5.0)
    assert bench.axis.position(bench.now_s) == 0
    assert bench.axis.statusword() & 0x0400


@pytest.mark.parametrize(("option", "end"), [(2, State.SWITCH_ON_DISABLED), (6, State.QUICK_STOP_ACTIVE)])
def test_quick_stop_brakes_and_ends_as_605a_says(bench: Bench, option: int, end: State) -> None:
    configure_pdos(bench)
    bench.frame(0x603, f"2b 5a 60 00 0{option} 00 00 00")
    bench.enable()
    bench.frame(0x203, "1f 00 20 4e 00 00")
    bench.wait(0.5)
    before = bench.axis.position(bench.now_s)
    bench.frame(0x203, "02 00 00 00 00 00")
    assert bench.axis.state is State.QUICK_STOP_ACTIVE
    bench.wait(1.0)
    assert bench.axis.state is end
    ramp = 10_000**2 / (2 * 4_000_000)
    assert bench.axis.position(bench.now_s) == pytest.approx(before + ramp, abs=1)


def test_an_axis_that_sticks_reports_a_following_error(bench: Bench) -> None:
    configure_pdos(bench)
    bench.enable()
    bench.axis.stuck = True
    bench.frame(0x203, "1f 00 20 4e 00 00")
    assert (0x083, "11 86 21 00 00 00 00 00") in bench.wait(0.5)  # EMCY 0x8611
    bench.wait(0.5)
    assert bench.axis.state is State.FAULT
    assert bench.frame(0x603, "40 3f 60 00 00 00 00 00") == [(0x583, "4b 3f 60 00 11 86 00 00")]
    bench.frame(0x203, "80 00 00 00 00 00")  # fault reset
    assert bench.axis.state is State.SWITCH_ON_DISABLED


def test_cyclic_position_follows_and_refuses_leaps(bench: Bench) -> None:
    configure_pdos(bench)
    bench.frame(0x603, "2f 60 60 00 08 00 00 00")
    bench.enable()
    bench.frame(0x203, "0f 00 4c 04 00 00")  # 1100
    assert bench.axis.position(bench.now_s) == 1100
    bench.frame(0x203, "0f 00 00 00 01 00")  # 65536 at once
    assert bench.axis.state is State.FAULT


def test_homing_mode_goes_to_zero_and_says_attained(bench: Bench) -> None:
    configure_pdos(bench)
    bench.frame(0x603, "2f 60 60 00 06 00 00 00")
    bench.enable()
    bench.frame(0x203, "1f 00 00 00 00 00")
    bench.wait(2.0)
    assert bench.axis.position(bench.now_s) == 0
    assert bench.axis.statusword() & 0x1400 == 0x1400  # homing attained, target reached
