"""What OpenCV's reader of PNG believes: it asks for as much memory as a chunk claims, up to 4 GiB, and fills it."""

import struct

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_AROUND = 12  # bytes of a chunk beside its data: length, type and checksum (PNG specification, 5.3)


def chunks_are_there(content: bytes) -> bool:
    """Whether the chunks of a PNG file are all as long as they claim, up to the last; True for any other file."""
    if not content.startswith(_SIGNATURE):
        return True
    place, kind = len(_SIGNATURE), b""
    while kind != b"IEND":
        if place + _AROUND > len(content):
            return False
        length, kind = struct.unpack_from(">I4s", content, place)
        place += _AROUND + length
    return place <= len(content)
