"""What a self-guided robot and its host say to each other: uuids and records, on ``struct`` alone.

Shared by both sides. Little-endian, and no record longer than the 20 bytes that one notification holds on any
link (the least ATT MTU, 23, less 3). Numbers of lines wrap at 65536; times are whole milliseconds of the robot's
clock. After each line the robot notifies LINE, then ESTIMATE, with the same session and number.
"""

import struct

NAME_PREFIX = "CL-"
VERSION = 1  # of this file's records

SERVICE_UUID = "53840001-f46d-451f-9382-ce2385b3a4a4"
IDENTITY_UUID = "53840002-f46d-451f-9382-ce2385b3a4a4"  # read
STATUS_UUID = "53840003-f46d-451f-9382-ce2385b3a4a4"  # notify: a heartbeat, and at every change of state
LINE_UUID = "53840004-f46d-451f-9382-ce2385b3a4a4"  # notify
ESTIMATE_UUID = "53840005-f46d-451f-9382-ce2385b3a4a4"  # notify
CONTROL_UUID = "53840006-f46d-451f-9382-ce2385b3a4a4"  # write

# (uuid, read, write, notify) of each characteristic of the one service
TABLE = (
    (IDENTITY_UUID, True, False, False),
    (STATUS_UUID, False, False, True),
    (LINE_UUID, False, False, True),
    (ESTIMATE_UUID, False, False, True),
    (CONTROL_UUID, False, True, False),
)

IDLE = 0
ROLLING = 1

STOP = 0
START = 1

IDENTITY_FORMAT = "<BBBBHH"  # records' version, program's major, minor, build; ms between samples; top speed, mm/s
STATUS_FORMAT = "<BBHIfH"  # state, session, runs counted, t in ms, light, battery in mV (0: not measured)
LINE_FORMAT = "<BHBfffI"  # session, number, chords, L1 in cm, L3 in cm^3, length in cm, t in ms at the line's end
ESTIMATE_FORMAT = "<BHffI"  # session, number, area in cm^2, perimeter in cm, lines that crossed the shape
START_FORMAT = "<BBHIfff"  # START, session, speed in mm/s, seed, thresholds: low, middle, high
STOP_FORMAT = "<B"  # STOP

LINE_NUMBERS = 65536
MOST_CHORDS = 255  # that LINE can tell; more are told as this many


def unpack(layout: str, data: bytes) -> tuple[float, ...]:
    """Read a record.

    Raises:
        ValueError: It is not as long as it should be.
    """
    if len(data) != struct.calcsize(layout):
        raise ValueError("a record of " + str(struct.calcsize(layout)) + " bytes came as " + str(len(data)))
    return struct.unpack(layout, data)
