"""Packets, components and frames, encoded by hand from the tables of the specification.

Floats are IEEE 754 single precision: sign, exponent + 127, 23 bits of fraction. So 1.0 is 3F800000,
and 1000.25 = 1.11110100001b × 2^9 is 0 10001000 11110100001… = 447A1000.
"""

import struct
from typing import Final, Literal, NamedTuple

ByteOrder = Literal["big", "little"]
ALL_ONES: Final = struct.unpack(">f", b"\xff\xff\xff\xff")[0]
"""A float of a missing marker or tool: a NaN with all 32 bits set (§7.3)."""


def _hex(rows: str) -> bytes:
    """Return the bytes of ``rows``. A row has hex digits and their meaning."""
    return b"".join(bytes.fromhex(row.split(maxsplit=1)[0]) for row in rows.strip().splitlines())


def _both_orders(rows: str) -> dict[ByteOrder, bytes]:
    """Return the bytes of ``rows``. A row has a field in hex, in both byte orders, and its meaning."""
    columns = [row.split(maxsplit=2) for row in rows.strip().splitlines()]
    return {
        "big": b"".join(bytes.fromhex(big) for big, _, _ in columns),
        "little": b"".join(bytes.fromhex(little) for _, little, _ in columns),
    }


# Packets, §4.1 and §4.2 ----------------------------------------------------------------------


class PacketVector(NamedTuple):
    name: str
    type: int
    body: bytes
    packet: bytes


PACKETS: Final = (
    PacketVector(
        "error",
        0,
        b"err-version",
        _hex("""
            00000013                Size 19 = 8 + 11
            00000000                Type 0, Error
            6572722D76657273696F6E  "err-version"
        """),
    ),
    PacketVector(
        "command, the example of section 5.1",
        1,
        b"Version 1.0\0",
        _hex("""
            00000014                  Size 20 = 4 + 4 + 12
            00000001                  Type 1, Command
            56657273696F6E20312E3000  "Version 1.0" and NUL
        """),
    ),
    PacketVector(
        "XML ending in NUL (field note 9)",
        2,
        b"<RT_Parameters Ver='1.00'/>\0",
        _hex("""
            00000024                      Size 36 = 8 + 28
            00000002                      Type 2, XML
            3C52545F506172616D6574657273  "<RT_Parameters"
            205665723D27312E303027        " Ver='1.00'"
            2F3E00                        "/>" and NUL
        """),
    ),
    PacketVector(
        "data frame without components",
        3,
        b"\0\0\0\0",
        _hex("""
            0000000C  Size 12 = 8 + 4
            00000003  Type 3, Data frame
            00000000  ComponentCount 0
        """),
    ),
    PacketVector(
        "no data",
        4,
        b"",
        _hex("""
            00000008  Size 8
            00000004  Type 4, No Data
        """),
    ),
    PacketVector(
        "no data with a text (field note 8)",
        4,
        b"No data",
        _hex("""
            0000000F        Size 15 = 8 + 7
            00000004        Type 4, No Data
            4E6F2064617461  "No data"
        """),
    ),
    PacketVector(
        "complete C3D file",
        5,
        b"\x02\x50\x1a\x00\x00\x00",
        _hex("""
            0000000E  Size 14 = 8 + 6, big-endian although the file is little-endian (§4.3)
            00000005  Type 5, Complete C3D file
            0250      a C3D file's first two bytes
            1A00      26 points
            0000      0 analog channels
        """),
    ),
)


# Components, §7.1 to §7.7 --------------------------------------------------------------------


class ComponentVector(NamedTuple):
    """One component's bytes, ``wire``, and their meaning.

    ``fields`` has the values of each field, one per item; Analog has only the field "voltage".
    """

    name: str
    type: int
    frame_number: int
    timestamp_us: int
    num_items: int
    item_bytes: int
    fields: dict[str, list[float]]
    wire: dict[ByteOrder, bytes]


MARKERS: Final = ComponentVector(
    "3d",
    type=1,
    frame_number=16909060,
    timestamp_us=4328719365,
    num_items=2,
    item_bytes=16,
    fields={
        "x": [1.0, ALL_ONES],
        "y": [-2.5, ALL_ONES],
        "z": [1000.25, ALL_ONES],
        "reliability": [0.5, 999.0],
    },
    wire=_both_orders("""
        00000038          38000000          ComponentSize 56 = 24 + 2 × 16
        00000001          01000000          ComponentType 1, 3D
        01020304          04030201          FrameNumber 16909060
        0000000102030405  0504030201000000  TimeStamp 2^32 + 33752069 µs
        00000002          02000000          MarkerCount
        3F800000          0000803F          X 1.0
        C0200000          000020C0          Y -2.5 = -1.01b × 2^1
        447A1000          00107A44          Z 1000.25
        3F000000          0000003F          Reliability 0.5
        FFFFFFFF          FFFFFFFF          X missing
        FFFFFFFF          FFFFFFFF          Y missing
        FFFFFFFF          FFFFFFFF          Z missing
        4479C000          00C07944          Reliability 999.0 = 1.111100111b × 2^9 (field note 7)
    """),
)

ANALOG: Final = ComponentVector(
    "analog",
    type=2,
    frame_number=2,
    timestamp_us=2500,
    num_items=3,
    item_bytes=4,
    fields={"voltage": [0.1, -15000.0, 0.0]},
    wire=_both_orders("""
        00000024          24000000          ComponentSize 36 = 24 + 3 × 4
        00000002          02000000          ComponentType 2, Analog
        00000002          02000000          FrameNumber
        00000000000009C4  C409000000000000  TimeStamp 2500 µs
        00000003          03000000          ChannelCount
        3DCCCCCD          CDCCCC3D          Voltage 0.1 = 1.6 × 2^-4, 0.6 × 2^23 rounds to 4CCCCD
        C66A6000          00606AC6          Voltage -15000.0 = -1.1101010011b × 2^13
        00000000          00000000          Voltage 0.0
    """),
)

FORCE: Final = ComponentVector(
    "force",
    type=3,
    frame_number=3,
    timestamp_us=5000,
    num_items=2,
    item_bytes=24,
    fields={
        "fx": [1.5, 4.0],
        "fy": [-0.75, 5.0],
        "fz": [800.0, 6.0],
        "mx": [2.0, 7.0],
        "my": [-3.0, 8.0],
        "mz": [0.25, 9.0],
    },
    wire=_both_orders("""
        00000048          48000000          ComponentSize 72 = 24 + 2 × 24
        00000003          03000000          ComponentType 3, Force
        00000003          03000000          FrameNumber
        0000000000001388  8813000000000000  TimeStamp 5000 µs
        00000002          02000000          PlateCount
        3FC00000          0000C03F          FX 1.5
        BF400000          000040BF          FY -0.75 = -1.1b × 2^-1
        44480000          00004844          FZ 800.0 = 1.1001b × 2^9
        40000000          00000040          MX 2.0
        C0400000          000040C0          MY -3.0
        3E800000          0000803E          MZ 0.25
        40800000          00008040          FX 4.0
        40A00000          0000A040          FY 5.0
        40C00000          0000C040          FZ 6.0
        40E00000          0000E040          MX 7.0
        41000000          00000041          MY 8.0
        41100000          00001041          MZ 9.0
    """),
)

TOOLS: Final = ComponentVector(
    "6d",
    type=4,
    frame_number=4,
    timestamp_us=7500,
    num_items=2,
    item_bytes=32,
    fields={
        "q0": [0.8, ALL_ONES],
        "qx": [-0.4, ALL_ONES],
        "qy": [0.4, ALL_ONES],
        "qz": [0.2, ALL_ONES],
        "x": [100.0, ALL_ONES],
        "y": [-200.0, ALL_ONES],
        "z": [1600.0, ALL_ONES],
        "error": [0.125, ALL_ONES],
    },
    wire=_both_orders("""
        00000058          58000000          ComponentSize 88 = 24 + 2 × 32
        00000004          04000000          ComponentType 4, 6D
        00000004          04000000          FrameNumber
        0000000000001D4C  4C1D000000000000  TimeStamp 7500 µs
        00000002          02000000          ToolCount
        3F4CCCCD          CDCC4C3F          Q0 0.8 = 1.6 × 2^-1
        BECCCCCD          CDCCCCBE          Qx -0.4 = -1.6 × 2^-2
        3ECCCCCD          CDCCCC3E          Qy 0.4
        3E4CCCCD          CDCC4C3E          Qz 0.2 = 1.6 × 2^-3
        42C80000          0000C842          X 100.0 = 1.1001b × 2^6
        C3480000          000048C3          Y -200.0
        44C80000          0000C844          Z 1600.0 = 1.1001b × 2^10
        3E000000          0000003E          Error 0.125
        FFFFFFFF          FFFFFFFF          Q0 out of view: all 32 bytes FF (field note 7)
        FFFFFFFF          FFFFFFFF          Qx
        FFFFFFFF          FFFFFFFF          Qy
        FFFFFFFF          FFFFFFFF          Qz
        FFFFFFFF          FFFFFFFF          X
        FFFFFFFF          FFFFFFFF          Y
        FFFFFFFF          FFFFFFFF          Z
        FFFFFFFF          FFFFFFFF          Error
    """),
)

SHORT_EVENTS: Final = ComponentVector(
    "events of 16 bytes",
    type=5,
    frame_number=5,
    timestamp_us=10000,
    num_items=2,
    item_bytes=16,
    fields={
        "id": [0x123456, 2],
        "param1": [7, 1065353216],
        "param2": [1, -1],
        "param3": [-1, -1],
    },
    wire=_both_orders("""
        00000038          38000000          ComponentSize 56 = 24 + 2 × 16
        00000005          05000000          ComponentType 5, Event
        00000005          05000000          FrameNumber
        0000000000002710  1027000000000000  TimeStamp 10000 µs
        00000002          02000000          EventCount
        00123456          56341200          ID 0x123456, the example of §6.6
        00000007          07000000          param1 7
        00000001          01000000          param2 1
        FFFFFFFF          FFFFFFFF          param3 unused
        00000002          02000000          ID 2
        3F800000          0000803F          param1, a float 1.0 whose bits are the int 127 × 2^23
        FFFFFFFF          FFFFFFFF          param2 unused
        FFFFFFFF          FFFFFFFF          param3 unused
    """),
)

LONG_EVENTS: Final = ComponentVector(
    "events of 24 bytes (field note 6)",
    type=5,
    frame_number=6,
    timestamp_us=12500,
    num_items=2,
    item_bytes=24,
    fields={
        "id": [0x123456, 2],
        "timestamp": [4328719365, -2],
        "param1": [7, 1065353216],
        "param2": [1, -1],
        "param3": [-1, -1],
    },
    wire=_both_orders("""
        00000048          48000000          ComponentSize 72 = 24 + 2 × 24
        00000005          05000000          ComponentType 5, Event
        00000006          06000000          FrameNumber
        00000000000030D4  D430000000000000  TimeStamp 12500 µs
        00000002          02000000          EventCount
        00123456          56341200          ID 0x123456
        0000000102030405  0504030201000000  time stamp 2^32 + 33752069 µs
        00000007          07000000          param1 7
        00000001          01000000          param2 1
        FFFFFFFF          FFFFFFFF          param3 unused
        00000002          02000000          ID 2
        FFFFFFFFFFFFFFFE  FEFFFFFFFFFFFFFF  time stamp -2 µs
        3F800000          0000803F          param1
        FFFFFFFF          FFFFFFFF          param2 unused
        FFFFFFFF          FFFFFFFF          param3 unused
    """),
)

COMPONENTS: Final = (MARKERS, ANALOG, FORCE, TOOLS, SHORT_EVENTS, LONG_EVENTS)


# Frames, §7.1 --------------------------------------------------------------------------------


def _frame(count: dict[ByteOrder, bytes], *components: dict[ByteOrder, bytes]) -> dict[ByteOrder, bytes]:
    fields = (count, *components)
    return {
        "big": b"".join(field["big"] for field in fields),
        "little": b"".join(field["little"] for field in fields),
    }


EMPTY_FRAME: Final = _both_orders("00000000  00000000  ComponentCount 0")

FULL_FRAME_COMPONENTS: Final = (MARKERS, TOOLS, ANALOG, FORCE, SHORT_EVENTS)
"""The components of FULL_FRAME, in the order of field note 5."""

FULL_FRAME: Final = _frame(
    _both_orders("00000005  05000000  ComponentCount 5"),
    *(component.wire for component in FULL_FRAME_COMPONENTS),
)

UNKNOWN_COMPONENT: Final = _both_orders("""
    0000001C          1C000000          ComponentSize 28 = 20 + 8
    00000009          09000000          ComponentType 9, which is not in the specification
    00000007          07000000          FrameNumber
    0000000000003A98  983A000000000000  TimeStamp 15000 µs
    DEADBEEF          EFBEADDE          data of unknown meaning
    00000001          01000000          data of unknown meaning
""")

FRAME_WITH_UNKNOWN: Final = _frame(
    _both_orders("00000003  03000000  ComponentCount 3"),
    MARKERS.wire,
    UNKNOWN_COMPONENT,
    ANALOG.wire,
)

START_RECORDING: Final = _hex("""
    0000003C          Size 60 = 8 + 52, big-endian (§4.3)
    00000003          Type 3, Data frame: sent by a client (field note 16)
    01000000          ComponentCount 1, little-endian as NDI's client asks (field note 14)
    30000000          ComponentSize 48 = 24 + 24
    05000000          ComponentType 5, Event
    FFFFFFFF          FrameNumber -1
    0000000000000000  TimeStamp 0
    01000000          EventCount 1
    01000000          ID 1: start
    0000000000000000  time stamp 0
    FFFFFFFF          param1 unused
    FFFFFFFF          param2 unused
    FFFFFFFF          param3 unused
""")

STOP_RECORDING: Final = _hex("""
    0000003C          Size 60 = 8 + 52
    00000003          Type 3, Data frame
    00000001          ComponentCount 1, big-endian
    00000030          ComponentSize 48 = 24 + 24
    00000005          ComponentType 5, Event
    FFFFFFFF          FrameNumber -1
    0000000000000000  TimeStamp 0
    00000001          EventCount 1
    00000000          ID 0: stop
    0000000000000000  time stamp 0
    FFFFFFFF          param1 unused
    FFFFFFFF          param2 unused
    FFFFFFFF          param3 unused
""")
