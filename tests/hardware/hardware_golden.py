"""Golden messages of every protocol, from data sheets, vendors' sources and captures; both directions.

The checksums in them were reckoned by the makers (or from published values of a real unit), not by this package.
"""


def bytes_of(text: str) -> bytes:
    return bytes.fromhex(text.replace(" ", "").replace("|", ""))


ESPEC = {
    "TEMP?": (b"TEMP?\r\n", b"26.4,0.0,140.0,-50.0\r\n"),
    "MON?": (b"MON?\r\n", b"24.1,100,CONSTANT,0\r\n"),
    "TYPE?": (b"TYPE?\r\n", b"T,T,S2,160.0\r\n"),
    "TEMP, S25.0": (b"TEMP, S25.0\r\n", b"OK:TEMP, S25.0\r\n"),
    "TEMP, S200.0": (b"TEMP, S200.0\r\n", b"NA:DATA OUT OF RANGE\r\n"),
    "XYZ": (b"XYZ\r\n", b"NA:CMD ERR\r\n"),
}
ESPEC_HEX = (
    bytes_of("54 45 4D 50 3F 0D 0A"),
    bytes_of("32 36 2E 34 2C 30 2E 30 2C 31 34 30 2E 30 2C 2D 35 30 2E 30 0D 0A"),
)

WEISS_NUMBERS = {50.0: "0050.0", 23.4: "0023.4", -40.0: "-040.0", -5.5: "-005.5", 125.0: "0125.0", -12.3: "-012.3"}
WEISS_READ = (
    b"$00I\r",
    b"0023.0 0020.5 0050.0 0041.0 0080.0 0080.0 0000.0 0020.1 0000.0 0020.2 0000.0 0020.3 0000.0 0020.4 "
    b"01101010101010101010101010101010\r",
)
WEISS_READ_HELP = (
    b"$01I\r",
    b"0050.0 0024.6 0080.0 0066.7 0090.0 0090.0 0000.0 0023.8 0000.0 0022.2 0000.0 0025.5 0000.0 0024.4 "
    b"01100000000000000000000000000000\r",
)
WEISS_WRITE_HELP = b"$01E 0050.0 0080.0 0090.0 0000.0 0000.0 0000.0 0000.0 01010101010101010101010101010101\r"
WEISS_WRITE = b"$00E -040.0 0050.0 0080.0 0000.0 0000.0 0000.0 0000.0 01101010101010101010101010101010\r"
WEISS_GRADIENT = b"$01U 0001.1 0000.0 0000.0 0000.0\r"

MODBUS_READ_PV = bytes_of("01 03 00 64 00 01 C5 D5")
MODBUS_25 = bytes_of("01 03 02 00 FA 38 07")
MODBUS_MINUS_40 = bytes_of("01 03 02 FE 70 F9 C0")
MODBUS_WRITE_25 = bytes_of("01 06 01 2C 00 FA C9 BC")
MODBUS_WRITE_MINUS_40 = bytes_of("01 06 01 2C FE 70 08 7B")
MODBUS_STATUS = bytes_of("01 03 00 C8 00 01 05 F4")
MODBUS_TERMINATE = bytes_of("01 06 04 C1 00 01 18 C6")
MODBUS_EXCEPTION = bytes_of("01 83 02 C0 F1")

ZABER_REPLIES = (
    b"@01 0 OK IDLE -- 0:8D",
    b"@1 3 9 OK IDLE -- 0:61",
    b"@01 0 OK IDLE -- 7z:0C",
    b"@01 0 RJ IDLE WR BADCOMMAND:A6",
)
ZABER_COMMANDS = {
    (1, 1, 7, "move vel 123456"): b"/1 1 7 move vel 123456:94\n",
    (1, 1, 8, "stop"): b"/1 1 8 stop:40\n",
    (1, 0, 9, "get pos"): b"/1 0 9 get pos:54\n",
}
ZABER_UNASKED = (b"#03 0 13 Visit www.zaber.com for instruction manuals.", b"!1 3 BUSY --")

ODRIVE_REQUESTS = {
    "r vbus_voltage ": b"r vbus_voltage *93",
    "f 0": b"f 0*118",
    "v 0 1 0": b"v 0 1 0*103",
    "v 0 0.0277778": b"v 0 0.0277778*98",
    "t 0 0.25": b"t 0 0.25*93",
    "u 0": b"u 0*101",
    "r axis0.error": b"r axis0.error*55",
    "r axis0.current_state": b"r axis0.current_state*14",
    "w axis0.requested_state 1": b"w axis0.requested_state 1*3",
}
ODRIVE_REPLIES = (b"0.000000 0.000000*32", b"0.250000 0.000000*39", b"24.087744*32")

STIM300_REAL = bytes_of(
    "af 00 01 24 ff fa d6 00 03 5b 00 ff e7 a6 ff dd 36 08 1c 52 00 ff 7e 70 fe ba 0c 3f fa 1d 00 "
    "23 a0 23 c0 23 a0 00 23 19 23 0a 23 1c 00 23 95 23 b6 23 95 00 ff ef 02 00 e1 01 fa c6 49 42 c6"
)
STIM300_93 = bytes_of(
    "93 00 40 00 ff e0 00 00 10 00 00 00 00 00 00 00 00 08 00 00 00 00 00 00 00 00 00 40 00 00 00 e1 01 fa 59 f1 45 f8"
)
STIM300_91 = bytes_of("91 00 40 00 ff e0 00 00 10 00 00 00 00 00 00 00 00 08 00 00 00 0a 01 fa b3 92 d2 62")
STIM300_A5 = bytes_of(
    "a5 00 40 00 ff e0 00 00 10 00 00 00 00 00 00 00 00 08 00 00 00 19 80 19 80 19 80 00 19 80 19 80 19 80 00 "
    "0a 01 fa b8 f2 2b 26"
)
STIM300_FRAMES = (STIM300_REAL, STIM300_93, STIM300_91, STIM300_A5)
STIM300_UTILITY_REQUESTS = {
    ("isn",): "$isn,28",
    ("im",): "$im,96",
    ("sm", 4): "$sm,4,115",
    ("sd", 1): "$sd,1,148",
    ("id",): "$id,221",
    ("irng",): "$irng,74",
    ("isv",): "$isv,227",
    ("st", "921600", 2, "n", 1, 0, 0): "$st,921600,2,n,1,0,0,168",
    ("ifw",): None,
}
STIM300_UTILITY_REPLIES = (
    "#isn,0,N25582405002002,252",
    "#im,0,4,85",
    "#sm,0,4,213",
    "#sd,0,1,242",
    "#id,0,0,103",
    "#irng,0,400,400,400,10,10,10,1.7,1.7,1.7,NA,61",
    "#isv,0,9958,168",
    "#xn,0,125",
    "#save,0,9958,175",
    "#in,0,STIM300,247",
)
STIM300_UTILITY_REFUSALS = ("#,1,180", "#,2,139", "#,3,158", "#sbto,4,136", "#sbto,5,157", "#save,6,0,158")

VECTORNAV_LINES = (
    "$VNYMR,+100.949,-007.330,+000.715,-00.0049,-00.2449,+00.5397,-01.258,-00.100,-09.701,-00.000018,+00.001122,"
    "-00.000551*69",
    "$VNYMR,-165.981,-037.301,+001.245,+00.2901,+00.0720,+00.7482,-05.966,-00.150,-07.836,+00.001373,-00.001533,"
    "-00.001054*68",
    "$VNRRG,01,VN-200T-CR*31",
    "$VNWRG,07,2*6F",
    "$VNRRG,35,1,1,1,1*75",
    "$VNIMU,-00.0049,-00.2449,+00.5397,-01.258,-00.100,-09.701,-00.000018,+00.001122,-00.000551,+25.5,+101.325*66",
)
VECTORNAV_REQUESTS = {
    "VNRRG,01": "$VNRRG,01*72",
    "VNWRG,06,0": "$VNWRG,06,0*6C",
    "VNWRG,75,1,4,05,0001,001C": "$VNWRG,75,1,4,05,0001,001C*2B",
    "VNWRG,05,921600": "$VNWRG,05,921600*53",
    "VNRST": "$VNRST*4D",
    "VNWNV": "$VNWNV*57",
}
VECTORNAV_ERROR = "$VNERR,12*72"
VECTORNAV_YPR_TIME = bytes_of("FA 01 09 00 70 05 00 03 0A 00 00 00 48 0E 2C 42 08 4C 37 C1 10 38 8B C2 D4 CB")
VECTORNAV_YPR = bytes_of("FA 01 08 00 93 50 2E 42 83 3E F1 3F 48 B5 04 BB 92 88")
VECTORNAV_IMU = bytes_of(
    "FA 05 01 00 1C 00 | 00 CA 9A 3B 00 00 00 00 | CD CC CC 3D CD CC 4C BE 0A E8 1C C1 | "
    "0A D7 23 3C 0A D7 A3 BC 8F C2 F5 3C | 00 00 CC 41 | 5A DA"
)
VECTORNAV_PACKETS = (VECTORNAV_YPR_TIME, VECTORNAV_YPR, VECTORNAV_IMU)
