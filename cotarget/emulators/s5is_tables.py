"""What a Canon PowerShot S5 IS announces: operations, events, properties.

As one of them told gphoto2 in July 2008 (libgphoto2, camlibs/ptp2/cameras/canon-s5.txt), but for image size and
quality, which stand at their best here, and the serial number. The properties of `shooting` exist only while it shoots.
"""

from collections.abc import Iterator

from cotarget.emulators.ptp import ARRAY, STRING, UINT8, UINT16, UINT32, Property, Range

MAKER, MODEL, VERSION, SERIAL = "Canon Inc.", "Canon PowerShot S5 IS", "1-3.2.1.0", "0" * 32
EXTENSION = 0xB  # Canon's
FORMATS = (0x3001, 0x3002, 0x3006, 0x300A, 0x3008, 0x3801, 0x3800, 0xB101, 0xBF01)
DIGITAL = 6  # positions of the zoom beyond the last of the lens, which is 128

EVENT_EMULATE_MODE, TRANSFER_MODE, ZOOM, UNIX_TIME = 0xD045, 0xD029, 0xD02A, 0xD034

# fmt: off
OPERATIONS = (
    0x1014, 0x1015, 0x1016, 0x1017, 0x1001, 0x1002, 0x1003, 0x9013, 0x901F, 0x1004, 0x1005, 0x1006, 0x1007, 0x1008,
    0x1009, 0x100A, 0x101B, 0x100C, 0x100D, 0x100B, 0x100F, 0x1012, 0x9001, 0x9021, 0x901B, 0x901E, 0x9019, 0x9006,
    0x901C, 0x9002, 0x904C, 0x902C, 0x902D, 0x902E, 0x9024, 0x9025, 0x900E, 0x900F, 0x9010, 0x9011, 0x9028, 0x9023,
    0x9029, 0x902A, 0x902B, 0x9034, 0x100E, 0x9008, 0x901A, 0x9009, 0x900B, 0x901D, 0x900C, 0x9014, 0x9015, 0x9018,
    0x9012, 0x9801, 0x9802, 0x9803, 0x9804, 0x9805, 0x9020,
)
EVENTS = (
    0x4001, 0x4002, 0x4003, 0x4004, 0x4005, 0x4006, 0x4007, 0x4008, 0x4009, 0x400A, 0x400B, 0x400C, 0x400D, 0x400E,
    0xC001, 0xC005, 0xC008, 0xC009, 0xC00A, 0xC00B, 0xC00C, 0xC00D, 0xC00E, 0xC00F, 0xC011, 0xC013,
)
# fmt: on


def size_qualities() -> Iterator[tuple[int, ...]]:
    """Height, width and number of each size in each of three qualities, as the camera lists them."""
    sizes = ((2448, 3264, 1, 5), (1944, 2592, 2, 5), (1536, 2048, 3, 5), (1200, 1600, 17, 1), (480, 640, 5, 5))
    for height, width, number, step in sizes:
        for quality in range(3):
            yield height, width, number + step * quality, 0, 0, 0


COMPENSATIONS = (8, 11, 13, 16, 19, 21, 24, 27, 29, 32, 35, 37, 40)  # +2 EV to -2 EV
BYTES_OF_SIZES = (
    *(3518464, 2563072, 1640448, 0, 254976, 2109440, 1428480, 914432, 0, 153600),
    *(1003520, 711680, 455680, 0, 86016, 0, 1026048, 571392, 284672),
)

ALWAYS = (
    Property(EVENT_EMULATE_MODE, UINT16, 4, True, (1, 2, 3, 4, 5, 6, 7)),
    Property(0xD04A, UINT8, 0, True, (0, 1, 2, 3)),
    Property(0xD02E, UINT32, 524288),  # size of output data from the camera
    Property(0xD02F, UINT32, 262144),  # size of input data to the camera
    Property(0xD002, UINT16, 1, False, (0, 1, 2, 3, 4, 5)),  # battery type
    Property(0xD003, UINT32, 1, False, (0, 1, 2, 3)),  # battery mode
    Property(UNIX_TIME, UINT32, 0, True),
    Property(0xD047, UINT16, 2),  # type of slideshow
    Property(0xD046, UINT16, 257),  # DPOF version
    Property(0xD02D, ARRAY | UINT32, (119, 0, 159, 0)),  # supported thumb size
    Property(0xD048, ARRAY | UINT32, BYTES_OF_SIZES),  # average file sizes
    Property(0xD02C, ARRAY | UINT32, (0, 0, 0, 0, 0, 0), False, tuple(size_qualities())),
    Property(0xD030, UINT32, 256),  # remote API version
    Property(0xD049, UINT32, 34144256),  # model id
    Property(0xD032, STRING, MODEL),
    Property(0xD033, ARRAY | UINT8, (), True),  # owner
    Property(0xD031, UINT32, 16777472),  # firmware version
    Property(0xD402, STRING, MODEL),  # friendly name
    Property(0xD406, STRING, "Windows", True),  # session initiator
    Property(0xD407, UINT32, 1),  # perceived device type
)


def shooting(last: int) -> tuple[Property, ...]:
    """The properties of a shooting camera whose lens has optical positions from 0 to ``last``."""
    return (
        Property(TRANSFER_MODE, UINT16, 15, True, (1, 2, 3)),
        Property(0xD006, UINT8, 5, True, (5, 3, 2)),  # image quality: superfine, fine, economy
        Property(0xD007, UINT8, 1, False, ()),  # full view file format
        Property(0xD008, UINT8, 0, True, (0, 1, 3, 7, 2)),  # image size: large, medium 1, 2, 3, small
        Property(0xD00E, UINT8, 0, False, ()),  # drive mode
        Property(0xD010, UINT8, 3, True, (3, 0, 1)),  # metering mode
        Property(0xD011, UINT8, 1, True, (1, 3)),  # AF distance
        Property(0xD012, UINT16, 12291, False, ()),  # focusing point
        Property(0xD013, UINT8, 0, True, (0, 1, 2, 3, 4, 7, 5, 6)),  # white balance
        Property(0xD01C, UINT16, 0, True, (0, 69, 72, 80, 88, 96, 104)),  # ISO speed
        Property(0xD01F, UINT8, 24, True, COMPENSATIONS),  # of exposure
        Property(0xD020, UINT8, 24, True, COMPENSATIONS),  # of the flash
        Property(0xD041, UINT16, 1, True, (1, 0)),  # assist light
        Property(0xD042, UINT16, 2, False, ()),  # flash quantity count
        Property(0xD044, UINT16, 0, True, (0, 1)),  # rotation scene
        Property(0xD00A, UINT8, 0, False, ()),  # flash mode
        Property(0xD00C, UINT8, 1, True, (1, 2, 3, 4)),  # shooting mode
        Property(0xD01D, UINT16, 40, False, ()),  # aperture
        Property(0xD01E, UINT16, 112, False, ()),  # shutter speed
        Property(ZOOM, UINT16, 0, True, Range(0, last + DIGITAL)),
        Property(0xD036, UINT8, 3, True, (1, 2, 3)),  # camera output
        Property(0xD037, UINT16, 1),  # Disp Av
        Property(0xD038, UINT16, 27),  # Av open apex
        Property(0xD039, UINT16, 3264),  # digital zoom magnification
        Property(0xD03B, UINT16, 0),  # Disp Av max
        Property(0xD03C, UINT16, 56),  # Av max apex
        Property(0xD03D, UINT16, last + 1),  # EZoom start position
        Property(0xD043, UINT16, 0),  # rotation angle
    )
