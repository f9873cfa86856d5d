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


MODBUS_READ_PV = bytes_of("01 03 00 64 00 01 C5 D5")
MODBUS_25 = bytes_of("01 03 02 00 FA 38 07")
MODBUS_MINUS_40 = bytes_of("01 03 02 FE 70 F9 C0")
MODBUS_WRITE_25 = bytes_of("01 06 01 2C 00 FA C9 BC")
MODBUS_WRITE_MINUS_40 = bytes_of("01 06 01 2C FE 70 08 7B")
MODBUS_STATUS = bytes_of("01 03 00 C8 00 01 05 F4")
MODBUS_TERMINATE = bytes_of("01 06 04 C1 00 01 18 C6")
MODBUS_EXCEPTION = bytes_of("01 83 02 C0 F1")


STIM300_A5 = bytes_of(
    "a5 00 40 00 ff e0 00 00 10 00 00 00 00 00 00 00 00 08 00 00 00 19 80 19 80 19 80 00 19 80 19 80 19 80 00 "
    "0a 01 fa b8 f2 2b 26"
)
