"""The CRC of a part of a stream."""

from hypothesis import given, strategies as st
from tmodbus.utils.crc import calculate_crc16

from custom_components.evse_bus.evse.crc16 import RunningCrc


@given(st.binary(max_size=40), st.binary(min_size=1, max_size=300), st.data())
def test_a_part_has_the_checksum_that_it_has_alone(
    before: bytes, content: bytes, data: st.DataObject
) -> None:
    part = content + calculate_crc16(content)
    crc = RunningCrc()
    for byte in before + part:
        crc.append(byte)
    dropped = data.draw(st.integers(0, len(before)))
    crc.drop(dropped)
    start = len(before) - dropped
    assert crc.is_good(start, start + len(part))


@given(st.binary(min_size=3, max_size=60), st.data())
def test_one_wrong_bit_is_found(content: bytes, data: st.DataObject) -> None:
    part = bytearray(content + calculate_crc16(content))
    bit = data.draw(st.integers(0, 8 * len(part) - 1))
    part[bit // 8] ^= 1 << bit % 8
    crc = RunningCrc()
    for byte in part:
        crc.append(byte)
    assert not crc.is_good(0, len(part))
