"""Object dictionaries typed by hand, after CiA 306, and drives that are mapped by them."""

from made_up_buses import bus_text

from acquisition.protocol import load_dictionary

DEVICE = "[DeviceInfo]\nVendorName=a\nVendorNumber=0x9A\nProductName=gold\nProductNumber=0x30924\n"


def entry_eds(section: str, name: str, kind: str, access: str, *lines: str) -> str:
    text = (
        f"[{section}]\nParameterName={name}\nObjectType=7\nDataType={kind}\nAccessType={access}\n"
    )
    return text + "".join(f"{line}\n" for line in lines)


EDS = (
    entry_eds("1000", "device type", "0x0007", "ro", "DefaultValue=0x00020192")
    + entry_eds("1008", "device name", "0x0009", "const", "DefaultValue=Gold")
    + entry_eds("6041", "statusword", "0x0006", "ro")
    + entry_eds("6060", "mode", "0x0002", "rww", "DefaultValue=8", "ParameterValue=10")
    + entry_eds("6061", "display", "0x0005", "const")
    + entry_eds("6064", "position", "0x0004", "ro")
    + entry_eds("6074", "demand", "0x0003", "ro")
    + entry_eds("6076", "rated torque", "0x0007", "rw", "DefaultValue=420")
    + entry_eds("2000", "a real number", "0x0008", "rw", "DefaultValue=1")
    + "[1018]\nParameterName=identity\nObjectType=9\nSubNumber=3\n"
    + entry_eds("1018sub0", "count", "0x0005", "ro", "DefaultValue=2")
    + entry_eds("1018sub1", "vendor", "0x0007", "ro")
    + entry_eds("1018sub2", "product", "0x0007", "ro", "DefaultValue=0x777")
    + "[1800]\nParameterName=tpdo\nObjectType=9\nSubNumber=2\n"
    + entry_eds("1800sub0", "count", "0x0005", "ro", "DefaultValue=1")
    + entry_eds("1800sub1", "cob", "0x0007", "rw", "DefaultValue=$NODEID+0x180")
)


def found(text: str, node: int = 5):
    return load_dictionary(text.encode(), "a.eds", node)


KINDS = {
    "6040": ("6", "rw"),
    "6041": ("6", "ro"),
    "6064": ("4", "ro"),
    "6074": ("3", "ro"),
    "607A": ("4", "rw"),
}
OBJECTS = "".join(entry_eds(index, "x", *kind) for index, kind in KINDS.items())
SENT_OBJECTS = [3, 0x60410010, 0x60640020, 0x60740010]
TAKEN_OBJECTS = [2, 0x60400010, 0x607A0020]


def dictionary_and_text(records: dict[int, list[int]]) -> tuple[str, dict[str, bytes]]:
    """A drive mapped as its dictionary says, and that dictionary."""
    known = {
        0x1800: [1, 0x181],
        0x1A00: SENT_OBJECTS,
        0x1400: [1, 0x201],
        0x1600: TAKEN_OBJECTS,
    } | records
    eds = OBJECTS
    for index, values in known.items():
        eds += f"[{index:04X}]\nParameterName=p\nObjectType=9\nSubNumber={len(values)}\n"
        for sub, value in enumerate(values):
            eds += entry_eds(
                f"{index:04X}sub{sub}", "s", "7" if sub else "5", "rw", f"DefaultValue=0x{value:X}"
            )
    text = bus_text(1).replace(
        "node = 1\n", 'node = 1\ndictionary = "a.dcf"\nmapping = "dictionary"\n'
    )
    return text, {"dictionary:a.dcf": eds.encode()}
