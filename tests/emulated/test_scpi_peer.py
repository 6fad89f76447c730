"""The emulated instruments speak SCPI and IEEE 488.2 as the standards say."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from echolume_drivers.emulated.scpi_peer import ScpiInstrument, block, header_pattern


def no_answer(arguments):
    return None


def data_block(arguments):
    return block(b"a;b\nc")


def instrument():
    return ScpiInstrument("MAKER,MODEL,1,2", {"CONFigure:RATE": no_answer, "FETCh:DATA?": data_block})


@pytest.mark.parametrize("header", ["CONF:RATE", "CONFIGURE:RATE", ":CONF:RATE"])
def test_headers_have_a_short_and_a_long_form(header):
    assert header_pattern("CONFigure:RATE").match(header)


@pytest.mark.parametrize("header", ["CONFI:RATE", "CON:RATE", "CONF", "CONF:RATE?", "CONF:RATES", "XCONF:RATE"])
def test_nothing_between_the_forms_is_taken(header):
    assert not header_pattern("CONFigure:RATE").match(header)


@pytest.mark.parametrize("header", ["SYST:ERR?", "SYST:ERR:NEXT?", "SYSTEM:ERROR:NEXT?"])
def test_bracketed_nodes_are_optional(header):
    assert header_pattern("SYSTem:ERRor[:NEXT]?").match(header)


@pytest.mark.parametrize(
    ("header", "taken"), [(":PULSE1:WIDTH", True), (":PULS1:WIDT", True), (":PULSE2:WIDTH", False)]
)
def test_numeric_suffixes_belong_to_the_header(header, taken):
    assert bool(header_pattern("PULSe1:WIDTh").match(header)) is taken


TRANSCRIPT = [
    (b"*IDN?", b"MAKER,MODEL,1,2\n"),
    (b"*idn?", b"MAKER,MODEL,1,2\n"),
    (b"*ESR?", b"128\n"),  # power on
    (b"*ESR?", b"0\n"),
    (b"*OPC?;*STB?", b"1;0\n"),
    (b"SYST:ERR?", b'0,"No error"\n'),
    (b"NONSENSE 3", b""),
    (b"*STB?", b"36\n"),  # an error waits, an event is set
    (b"*ESR?", b"32\n"),  # command error
    (b"SYST:ERR?", b'-113,"Undefined header"\n'),
    (b"SYST:ERR?", b'0,"No error"\n'),
    (b"BAD;*OPC?", b""),  # the rest of a refused message is discarded
    (b"*CLS;SYST:ERR?", b'0,"No error"\n'),
    (b"*OPC;*ESR?", b"1\n"),
    (b"CONF:RATE 5", b""),
    (b"FETC:DATA?", b"#15a;b\nc\n"),
    (b"", b""),
]


def test_transcript():
    peer = instrument()
    for k, (said, answered) in enumerate(TRANSCRIPT):
        assert peer.handle(said) == answered, f"line {k}: {said!r}"


def test_a_full_error_queue_ends_in_overflow():
    peer = instrument()
    for _ in range(40):
        peer.handle(b"NONSENSE")
    answers = [peer.handle(b"SYST:ERR?") for _ in range(17)]
    assert answers[0] == b'-113,"Undefined header"\n'
    assert answers[15] == b'-350,"Queue overflow"\n'
    assert answers[16] == b'0,"No error"\n'


@given(st.binary(max_size=300))
def test_blocks_announce_their_length(data):
    found = block(data)
    digits = int(found[1:2])
    assert found[:1] == b"#"
    assert int(found[2 : 2 + digits]) == len(data)
    assert found[2 + digits :] == data


@given(st.binary(max_size=80))
def test_any_line_is_answered_or_recorded_as_an_error(line):
    peer = instrument()
    answer = peer.handle(line)
    assert answer == b"" or answer.endswith(b"\n")
